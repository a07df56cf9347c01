//! Trains an encoder before any run, on depth images from random poses, and measures encoders.
//!
//! The camera draws tens of thousands of images a second from poses in random courses, which takes
//! no flight. An encoder trained on them is there when the first episode begins (`vae.start_from`).
//! Training is a function of configuration and seed: each step's views and noise derive from the
//! seed and the step's number alone.

pub mod arguments;
mod checkpoint;
mod curve;
pub mod measurement;
mod progress;
pub mod training;
pub mod views;
