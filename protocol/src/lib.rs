//! Types and formats that Skein's processes agree on.
//!
//! The crate defines the work of an actor ([`ticket`], [`segment`]), one flown step on the wire
//! ([`transition`]), a policy snapshot ([`snapshot`]), an actor's reports ([`status`], [`stages`]),
//! the configuration of a run ([`config`]), and the formats of its files ([`evaluation`],
//! [`summary`]) and progress reports ([`progress`]), and how such files are read ([`files`]). It
//! only defines them: the crate `skein-transport` carries the records; `skein-run` manages files
//! and processes.

pub mod config;
pub mod decoder_file;
pub mod encoder_file;
pub mod evaluation;
pub mod files;
pub mod heading;
pub mod ids;
pub mod policy_file;
pub mod progress;
pub mod seeds;
pub mod segment;
pub mod snapshot;
pub mod stages;
pub mod status;
pub mod summary;
pub mod ticket;
pub mod transition;

pub use skein_action::{Action, ActionSpace, Axis, MAX_ACTION};

/// Version of everything in this crate that crosses a process boundary. It is an attribute of every
/// service: a process of another version is refused when it opens one.
pub const PROTOCOL_VERSION: u32 = 11;

/// Width of the depth image in pixels (paper, section 3.3).
pub const IMAGE_WIDTH: usize = 128;
/// Height of the depth image in pixels (paper, section 3.3).
pub const IMAGE_HEIGHT: usize = 72;
/// Pixels, and bytes, of one 8-bit depth image.
pub const IMAGE_PIXELS: usize = IMAGE_WIDTH * IMAGE_HEIGHT;
/// Length of the longest latent code that `vae.latent` allows. Records have room for it.
pub const MAX_LATENT: usize = 64;
/// Room for a latent code of any length. Values after a shorter code are zero.
pub type LatentCode = [f32; MAX_LATENT];
/// Names of the reward's terms, in the order of their sum: those of the simulator's
/// `reward_terms!`, which `skein-rollout` holds equal to these when it is compiled. Curves are
/// called `reward/NAME`.
pub const REWARD_TERM_NAMES: [&str; 8] = [
    "collision",
    "level_up",
    "destination",
    "open_view",
    "progress",
    "clearance",
    "effort",
    "effort_change",
];
/// Number of the reward's terms.
pub const REWARD_TERMS: usize = REWARD_TERM_NAMES.len();
/// Length of the simulator's ground truth, [`transition::TransitionRecord::ground_truth`].
pub const GROUND_TRUTH: usize = 18;
/// Bounds of the logarithm of a policy's standard deviation, for actor and learner alike. Beyond
/// them tanh saturates or the noise vanishes (as in the authors' implementation of
/// arXiv:1812.05905).
pub const LOG_STD: (f32, f32) = (-20.0, 2.0);

/// Returns the input length of a critic that sees the ground truth: ground truth, velocity `[3]`,
/// tilt `[2]`, where the drone turns also its heading `[2]`, and the previous action.
pub fn critic_state(action: ActionSpace) -> usize {
    let heading = match action {
        ActionSpace::Lateral | ActionSpace::Velocity => 0,
        ActionSpace::VelocityYaw => 2,
    };
    GROUND_TRUTH + 3 + 2 + heading + action.numbers()
}

/// Returns the sizes of the records on the wire, and the reward's terms. Processes in which all are
/// equal can read each other's records.
pub fn record_layout() -> String {
    format!(
        "transition {} control {} segment {} status {} snapshot header {} \
         reward {}",
        size_of::<transition::TransitionRecord>(),
        size_of::<ticket::ControlRecord>(),
        size_of::<segment::SegmentRecord>(),
        size_of::<status::StatusRecord>(),
        size_of::<snapshot::SnapshotHeader>(),
        REWARD_TERM_NAMES.join("+"),
    )
}
