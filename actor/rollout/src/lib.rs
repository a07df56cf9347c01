//! Flies episodes with a policy: simulator, encoder and policy in one loop, without any transport.
//!
//! Begin with [`environment_loop`]: an episode from its ticket to its closing record. It hands each
//! record to a [`RecordLink`](environment_loop::RecordLink): shared memory in an actor, plain
//! memory in an [`evaluation`]. Inference is native ([`skein_inference`]) and needs no libtorch, so
//! programs on this crate build in minutes and start at once.

pub mod agent;
pub mod courses;
pub mod environment_loop;
pub mod evaluation;
pub mod recording;
#[cfg(test)]
mod testing;
pub mod world;
