//! The learner: hands out tickets, commits the episodes flown for them, trains VAE and policy, and
//! publishes snapshots.
//!
//! Training is a function of configuration and seed. Episodes are learned from in episode order,
//! every random draw has its own seed, and nothing depends on which actor flew an episode, or when.

pub mod algorithm;
mod average;
mod batch;
mod best;
pub mod checkpoint;
pub mod curriculum;
pub mod device;
pub mod disk;
mod distill;
pub mod episode;
pub mod episodes;
mod error;
mod evaluation;
pub mod faults;
mod imitation;
mod incarnations;
pub mod metrics;
mod mirror;
pub mod networks;
pub mod noise;
mod notice;
mod optimizer;
mod perception;
pub mod replay;
mod report;
pub mod sac;
mod spent;
pub mod state;
mod td3;
pub mod threads;
mod trainer;
pub mod training;
pub mod vae;
mod watchdog;

pub use error::UpdateError;
