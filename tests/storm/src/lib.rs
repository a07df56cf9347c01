//! Storms over the protocol: one learner and its actors in a world whose clock, network, disk and
//! mishaps follow from a seed.
//!
//! The decisions are the production code's: the rounds of the receiving thread with dispatcher and
//! assembly (`skein_learner::episodes`), the bookkeeping of the training loop
//! (`skein_learner::training::plan`), the store of checkpoints (`skein_learner::checkpoint`), and
//! an actor's session (`skein_actor::session`). Simulated are what they stand on, physics and
//! learning (hashes), and the order of operations in the training thread and in an actor's loop.
//!
//! In a storm messages are lost, doubled, reordered and late, links are cut, processes die and
//! stand still, services fail, the disk is full, power is cut. A cut link looks as a gateway must
//! make it look: the learner is gone on the far side, the actors are gone on the near side.
//!
//! The claim: the run takes in the calm run's episodes, whole and in order, ends with the calm
//! run's results, never meets a damaged checkpoint, and never stands still once the storm is over.

mod actor;
mod calm;
mod checkpoints;
mod dice;
mod disk;
mod flight;
mod hunt;
mod learner;
mod mutant;
mod shape;
mod weather;
mod wire;
mod world;

pub use hunt::{Finding, Passed, hunt};
pub use mutant::Mutant;
pub use world::Outcome;

use shape::{SHAPES, Shape};
use world::World;

/// Everything that storms share.
#[derive(Debug)]
pub struct Sky {
    shapes: Vec<Shape>,
}

impl Sky {
    /// Computes the calm runs.
    #[expect(
        clippy::new_without_default,
        reason = "it takes long, which Default would hide"
    )]
    pub fn new() -> Self {
        Self {
            shapes: (0..SHAPES).map(Shape::new).collect(),
        }
    }

    /// Lets the storm of `seed` pass, with a planted bug if there is a `mutant`.
    pub fn storm(&self, seed: u64, mutant: Option<Mutant>) -> Outcome {
        World::new(&self.shapes, seed, mutant).pass()
    }

    /// Like [`Sky::storm`], and prints everything that happens.
    pub fn storm_logged(&self, seed: u64, mutant: Option<Mutant>) -> Outcome {
        World::new(&self.shapes, seed, mutant).logged().pass()
    }
}
