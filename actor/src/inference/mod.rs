//! Native inference: depth image to latent code, observation to action, without libtorch.
//!
//! An actor looks at one image at a time, where a tensor library spends more time on itself than on the network. So the two networks are written out over
//! the kernels that the learner trains them with; the whole-system tests hold them to the learner's. A [`Network`] is immutable and shared between threads; what a thread writes
//! to is its own [`Scratch`], allocated once.

mod encoder;
mod linear;
mod policy;

use skein_kernels::Isa;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::{IMAGE_PIXELS, LATENT};

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

impl Network {
    /// Rearranges a snapshot's parameters.
    ///
    /// # Panics
    /// When the snapshot is not of this layout; [`Snapshot::receive`] and [`Snapshot::load`] let none such through.
    pub fn new(snapshot: &Snapshot, layout: &SnapshotLayout) -> Self {
        let tensor = |name: &str| {
            let tensor = layout
                .tensor(name)
                .expect("every layout has the encoder's and the policy's tensors");
            &snapshot.values[tensor.range.clone()]
        };
        let isa = Isa::best();
        Self {
            version: snapshot.version,
            encoder: Encoder::new(isa, tensor),
            policy: Policy::new(isa, tensor),
        }
    }

    /// The snapshot's number.
    pub fn version(&self) -> PolicyVersion {
        self.version
    }

    /// See [`Encoder::encode`].
    pub fn encode(&self, image: &[u8; IMAGE_PIXELS], scratch: &mut Scratch) -> [f32; LATENT] {
        self.encoder.encode(image, &mut scratch.encoder)
    }

    /// See [`Policy::distribution`].
    pub fn distribution(&self, observation: &[f32], scratch: &mut Scratch) -> ActionDistribution {
        self.policy.distribution(observation, &mut scratch.policy)
    }
}
