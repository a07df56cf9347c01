//! Native inference: depth image to latent code, observation to action, without libtorch.
//!
//! An actor computes one image at a time, for which a tensor library spends more time on overhead
//! than on the network. So both networks are written with the kernels that the learner trains them
//! with; whole-system tests compare the two. The learner uses the same encoder to recompute stored
//! codes, so that all codes in its replay come from the same arithmetic. A [`Network`] is immutable
//! and shared between threads; each thread writes to its own [`Scratch`], allocated once.

mod decoder;
mod encoder;
mod linear;
mod policy;

use skein_kernels::Isa;
use skein_protocol::config::{Observation, ObservationLayout};
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::{IMAGE_PIXELS, LatentCode};

pub use decoder::Decoder;
pub use encoder::{Encoder, EncoderScratch};
pub use policy::{ActionDistribution, Policy, PolicyScratch};

/// Networks of a snapshot, with weights arranged for inference.
#[derive(Debug)]
pub struct Network {
    version: PolicyVersion,
    encoder: Encoder,
    policy: Policy,
}

/// Working memory of one thread.
#[derive(Debug, Default)]
pub struct Scratch {
    encoder: EncoderScratch,
    policy: PolicyScratch,
}

/// Returns the encoder of a snapshot.
///
/// # Panics
/// As [`Network::new`].
pub fn encoder(snapshot: &Snapshot, layout: &SnapshotLayout) -> Encoder {
    Encoder::new(Isa::best(), tensors(snapshot, layout))
}

/// Returns the encoder of a file.
///
/// # Panics
/// If the number of values does not fit the code's length, which [`TrainedEncoder::load`] refuses.
pub fn trained_encoder(trained: &TrainedEncoder) -> Encoder {
    // The encoder's tensors precede the policy's, whatever the policy.
    let view = ObservationLayout::present(Observation::Latent, trained.latent);
    let layout = SnapshotLayout::new(&view, 1);
    Encoder::new(Isa::best(), |name| {
        let tensor = layout
            .tensor(name)
            .expect("every layout has the encoder's tensors");
        &trained.values[tensor.range.clone()]
    })
}

/// Returns a function from a tensor's name to its values.
fn tensors<'a>(snapshot: &'a Snapshot, layout: &SnapshotLayout) -> impl Fn(&str) -> &'a [f32] {
    |name| {
        let tensor = layout
            .tensor(name)
            .expect("every layout has the tensors of encoder and policy");
        &snapshot.values[tensor.range.clone()]
    }
}

impl Network {
    /// Arranges a snapshot's parameters for inference.
    ///
    /// # Panics
    /// If the snapshot does not have this layout, which [`Snapshot::receive`] and
    /// [`Snapshot::load`] refuse.
    pub fn new(snapshot: &Snapshot, layout: &SnapshotLayout) -> Self {
        Self {
            version: snapshot.version,
            encoder: encoder(snapshot, layout),
            policy: Policy::new(Isa::best(), layout.head(), tensors(snapshot, layout)),
        }
    }

    /// Policy version of the snapshot.
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
