//! The contract between Skein's processes.
//!
//! Everything that two processes must agree on is defined here, and nothing else: who flies what
//! ([`ticket`], [`segment`]), what a flown step looks like on the wire ([`transition`]), what a
//! policy snapshot contains ([`snapshot`]), the iceoryx2 services that carry them ([`services`]),
//! the configuration of a run ([`config`]) and the files it leaves ([`run`], [`evaluation`],
//! [`summary`]), and what their time is counted by ([`stages`]); and what all of our programs do
//! alike ([`allocation`], [`logging`]). It knows neither libtorch nor the physics engine, so that
//! every process can afford to depend on it.

pub mod allocation;
pub mod claims;
pub mod config;
pub mod durable;
pub mod evaluation;
pub mod failure;
pub mod fault;
pub mod ids;
pub mod log_tail;
pub mod logging;
pub mod orphans;
pub mod progress;
pub mod run;
pub mod seeds;
pub mod segment;
pub mod services;
pub mod snapshot;
pub mod stages;
pub mod status;
pub mod summary;
pub mod ticket;
pub mod transition;

/// Version of everything in this crate that crosses a process boundary; part of every service's
/// attributes, so that a process of another version is refused when it opens a service.
pub const PROTOCOL_VERSION: u32 = 8;

/// Width of the depth image in pixels (paper, section 3.3).
pub const IMAGE_WIDTH: usize = 128;
/// Height of the depth image in pixels (paper, section 3.3).
pub const IMAGE_HEIGHT: usize = 72;
/// Pixels, and bytes, of one 8-bit depth image.
pub const IMAGE_PIXELS: usize = IMAGE_WIDTH * IMAGE_HEIGHT;
/// Length of the longest latent code that `vae.latent` allows; records have room for it.
pub const LONGEST_LATENT: usize = 64;
/// Room for a latent code of any length. What lies behind a shorter one is zero.
pub type LatentCode = [f32; LONGEST_LATENT];
/// Length of an action: lateral and vertical velocity, each in [-1, 1].
pub const ACTION: usize = 2;
/// Numbers of what the simulator knows of a moment, [`transition::TransitionRecord::ground_truth`].
pub const GROUND_TRUTH: usize = 16;
/// Length of what a critic gets of a moment that is told the ground truth: that, velocity `[3]`,
/// tilt `[2]` and the action before.
pub const TRUE_STATE: usize = GROUND_TRUTH + 3 + 2 + ACTION;
/// Bounds of the logarithm of a policy's standard deviation, for actor and learner alike: beyond
/// them tanh saturates or the noise vanishes (as in the authors' implementation of
/// arXiv:1812.05905).
pub const LOG_STD: (f32, f32) = (-20.0, 2.0);
