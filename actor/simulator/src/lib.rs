//! Courses, the quadrotor that flies through them, and its depth camera.
//!
//! The crate is usable alone: it knows nothing of actors, learners or transports. Everything is
//! `f32` and deterministic. On one machine type, the same course, settings, start and actions give
//! the same episode, bit for bit.
//!
//! World frame: x forward along the course, y to the left, z up. Body frame: x forward, y left, z
//! up. Units are metres, seconds and radians, unless a name says otherwise.
//!
//! | module | content |
//! |---|---|
//! | [`simulator`] | [`Simulator`](simulator::Simulator): `reset`, `step`, `render` |
//! | [`reward`] | the terms of the reward and their sizes |
//! | [`course`] | corridors with walls and openings, worlds of obstacles; files; random ones |
//! | [`vehicle`] | drone presets and their flight controller |
//! | [`camera`] | depth image, with or without a stereo camera's errors |
//! | [`disturbances`] | gusts, latency, mass, depth noise |
//! | [`suite`] | evaluation suites |
//! | [`text`] | rules for names and lists in files |
//! | [`viewpoints`] | depth images from random poses |

mod body;
pub mod camera;
pub mod course;
pub mod disturbances;
mod oracle;
pub mod reward;
pub mod simulator;
mod step_report;
pub mod suite;
mod surfaces;
pub mod text;
pub mod vehicle;
pub mod viewpoints;
mod world;

pub use skein_action::{Action, ActionSpace};
