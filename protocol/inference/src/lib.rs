//! Native inference: depth image to latent code, observation to action, without libtorch.
//!
//! An actor looks at one image at a time, where a tensor library spends more time on itself than on
//! the network. So the two networks are written out over the kernels that the learner trains them
//! with; the whole-system tests hold them to the learner's. The learner uses the same encoder to
//! make stored codes anew, so that all codes in its replay are made alike. A [`Network`] is
//! immutable and shared between threads; what a thread writes to is its own [`Scratch`], allocated
//! once.

mod encoder;
mod linear;
mod policy;

use skein_kernels::Isa;
use skein_protocol::config::Precision;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::{IMAGE_PIXELS, LatentCode};

pub use encoder::{Encoder, EncoderScratch};
pub use policy::{ActionDistribution, Policy, PolicyScratch};

/// A snapshot, rearranged to be flown.
#[derive(Debug)]
pub struct Network {
    version: PolicyVersion,
    encoder: Encoder,
    policy: Policy,
}

/// Working memory of one thread that flies.
#[derive(Debug, Default)]
pub struct Scratch {
    encoder: EncoderScratch,
    policy: PolicyScratch,
}

/// The encoder of a snapshot alone.
///
/// # Panics
/// As [`Network::new`].
pub fn encoder(snapshot: &Snapshot, layout: &SnapshotLayout, precision: Precision) -> Encoder {
    Encoder::new(Isa::best(), precision, tensors(snapshot, layout))
}

fn tensors<'a>(snapshot: &'a Snapshot, layout: &SnapshotLayout) -> impl Fn(&str) -> &'a [f32] {
    |name| {
        let tensor = layout
            .tensor(name)
            .expect("every layout has the encoder's and the policy's tensors");
        &snapshot.values[tensor.range.clone()]
    }
}

impl Network {
    /// Rearranges a snapshot's parameters; images are to be encoded in `precision`.
    ///
    /// # Panics
    /// When the snapshot is not of this layout; [`Snapshot::receive`] and [`Snapshot::load`] let
    /// none such through.
    pub fn new(snapshot: &Snapshot, layout: &SnapshotLayout, precision: Precision) -> Self {
        Self {
            version: snapshot.version,
            encoder: encoder(snapshot, layout, precision),
            policy: Policy::new(Isa::best(), layout.head(), tensors(snapshot, layout)),
        }
    }

    /// The snapshot's number.
    pub fn version(&self) -> PolicyVersion {
        self.version
    }

    /// See [`Encoder::encode`].
    pub fn encode(&self, image: &[u8; IMAGE_PIXELS], scratch: &mut Scratch) -> LatentCode {
        self.encoder.encode(image, &mut scratch.encoder)
    }

    /// See [`Policy::distribution`].
    pub fn distribution(&self, observation: &[f32], scratch: &mut Scratch) -> ActionDistribution {
        self.policy.distribution(observation, &mut scratch.policy)
    }
}
