//! The actor: flies against tickets and sends back what it saw.
//!
//! Begin with [`environment_loop`]: an episode from its ticket to its closing record. [`service`]
//! is the life cycle of the process around it, [`evaluation`] the same episodes without a learner.
//! There is no libtorch here: inference is native ([`skein_inference`]), so an actor is a small
//! program that starts at once.

pub mod agent;
pub mod courses;
pub mod environment_loop;
pub mod evaluation;
pub mod recording;
pub mod service;
#[cfg(test)]
mod testing;
pub mod weights;
