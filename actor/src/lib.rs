//! The actor: a process that flies against tickets and sends back what it saw.
//!
//! How an episode is flown is [`skein_rollout`]'s; [`service`] is the life cycle of the process
//! around it, [`weights`] the snapshots it holds.

pub mod service;
pub mod weights;
