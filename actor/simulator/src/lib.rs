//! The walled corridor, the quadrotor that flies it, and the depth camera it sees by.
//!
//! Usable alone: nothing here knows of actors, learners or transports. All is `f32` and
//! deterministic: the same course, settings, start and actions give the same episode, bit for bit,
//! on one machine type.
//!
//! World frame: x forward along the corridor, y to the left, z up. Body frame: x forward, y left, z
//! up. Metres, seconds, radians, unless a name says otherwise.

pub mod camera;
pub mod course;
pub mod disturbances;
pub mod oracle;
pub mod reward;
pub mod simulator;
pub mod suite;
mod text;
pub mod vehicle;

mod world;
