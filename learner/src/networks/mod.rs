//! The networks: what they compute, separate from the parameters they compute it with.
//!
//! A network here is only a description. Its layers know their ranges in a flat parameter vector,
//! and every forward pass receives that vector ([`Parameters`]). So the critic and its target are
//! one network with two vectors, the optimizer steps one tensor, and publishing a network is one
//! copy.

mod critic;
mod decoder;
mod encoder;
mod flat;
mod layers;
pub mod native;
mod policy;

pub use critic::CriticNetwork;
pub use decoder::DecoderNetwork;
pub use encoder::{Encoded, EncoderNetwork, ImageEncoder, LOG_VARIANCE_BOUND, pixels};
pub(crate) use flat::WIDER;
pub use flat::{Layout, ParameterSpec, Parameters};
pub use layers::{ConvolutionLayer, LinearLayer, TransposedConvolutionLayer};
pub use policy::{PolicyNetwork, PolicySample};
