//! The arithmetic of Skein's networks: matrix products, convolutions, Adam.
//!
//! Actors and learner compute the same layers, actors for one image at a time and the learner for
//! whole minibatches, and both spend most of their time in matrix products. No library offers all
//! that they need together: the same bits with every instruction set and for any number of threads,
//! no memory allocation, little overhead for a small product, and convolutions that read images
//! where they lie.
//!
//! **Every result is a function of its operands alone.** An element is the sum of its terms in one
//! documented order, each added by a fused multiply-add. Instruction sets differ only in how many
//! elements are computed at a time, and members of a [`Team`] only in which elements.
//!
//! Nothing public is generic over numbers, so every kernel is compiled once, here, and not again in
//! each crate that calls it.

mod adam;
mod gradient;
mod isa;
mod math;
mod panel_work;
mod panels;
mod peak;
mod product;
mod team;
mod tile;
mod windows;

pub use adam::AdamStep;
pub use gradient::{Terms, gradient};
pub use isa::Isa;
pub use math::{exp, sigmoid};
pub use panels::{Matrix, Panels};
pub use peak::peak_flops;
pub use product::{Finish, Rows, Start, product, product_once};
pub use team::Team;
pub use windows::{Windows, spread};

#[cfg(test)]
mod tests;
