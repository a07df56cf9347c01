//! The networks: what they compute, apart from the numbers they compute it with.
//!
//! A network here is a description only: its layers know their place in a flat vector of
//! parameters, and every forward pass is given the vector ([`Parameters`]) it shall use. So the
//! critic and its slowly following target are one network with two vectors, the optimizer steps one
//! tensor, and publishing a network is one copy.

mod critic;
mod decoder;
mod encoder;
mod flat;
mod layers;
pub mod native;
mod policy;

pub use critic::Critic;
pub use decoder::Decoder;
pub use encoder::{Encoded, Encoder, ImageEncoder, LOG_VARIANCE_BOUND, pixels};
pub use flat::{Layout, ParameterSpec, Parameters};
pub use layers::{Convolution, Linear, TransposedConvolution};
pub use policy::{Policy, PolicySample};
