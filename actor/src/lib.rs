//! The actor: a process that flies tickets and sends the records.
//!
//! Episodes are flown by [`skein_rollout`]; [`service`] is the process around it,
//! [`snapshot_cache`] the cache of its snapshots, [`recorder`] writes some of them to files.

pub mod recorder;
pub mod service;
pub mod snapshot_cache;
