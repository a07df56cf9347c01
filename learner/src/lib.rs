//! The learner: hands out tickets, commits the episodes flown for them, trains VAE and policy, and
//! publishes snapshots.
//!
//! Training is a function of configuration and seed. Episodes are learned from in episode order,
//! every random draw has its own seed, and nothing depends on which actor flew an episode, or when.

pub mod algorithm;
pub mod average;
mod batch;
pub mod best;
pub mod checkpoint;
pub mod curriculum;
pub mod device;
pub mod disk;
pub mod episode;
pub mod episodes;
mod error;
pub mod evaluation;
pub mod faults;
pub mod incarnations;
pub mod metrics;
mod mirror;
pub mod networks;
pub mod noise;
mod notice;
pub mod optimizer;
mod perception;
pub mod replay;
pub mod report;
pub mod sac;
pub mod spent;
pub mod state;
pub mod td3;
pub mod threads;
pub mod trainer;
pub mod training;
pub mod vae;
pub mod watchdog;

pub use error::UpdateError;
