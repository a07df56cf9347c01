//! The arithmetic under Skein's networks: products, convolutions, Adam.
//!
//! Actors and learner compute the same layers, one image at a time and whole minibatches at a time,
//! and both are bound by matrix products. They are written out here because no library gives all of
//! what they need together: the same bits on every processor and for any number of threads, no
//! memory allocated, no time lost before the first multiplication of a small product, and
//! convolutions that read images where they lie.
//!
//! **Every result is a function of its operands alone.** An element is the sum of its terms in one
//! stated order, each added by a fused multiply-add. Instruction sets differ in how many elements
//! are under way at a time, members of a [`Team`] in which elements; nothing else.

mod adam;
mod gradient;
mod isa;
mod math;
mod pair;
mod panels;
mod peak;
mod product;
mod team;
mod tile;
mod windows;
mod work;

pub use adam::AdamStep;
pub use gradient::{Terms, gradient};
pub use isa::Isa;
pub use math::{exp, sigmoid};
pub use pair::{Pair, Term};
pub use panels::{Matrix, Panels};
pub use peak::peak_flops;
pub use product::{Finish, Rows, Start, product, product_once};
pub use team::Team;
pub use windows::{Windows, spread};

#[cfg(test)]
mod tests;
