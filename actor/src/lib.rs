//! The actor: flies against tickets and sends back what it saw.

pub mod inference;
