//! The actor: a process that flies tickets and sends the records.
//!
//! Episodes are flown by [`skein_rollout`]; [`service`] is the process around it, [`session`] what
//! it decides, [`snapshot_cache`] the cache of its snapshots, [`recorder`] writes some of its
//! episodes to files.

pub mod recorder;
pub mod service;
pub mod session;
pub mod snapshot_cache;
