//! Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018, arXiv:1802.09477): what
//! the paper compares SAC with (its Fig. 11).
//!
//! Two engines do the same update, as of [`crate::sac`]. The critic is that of SAC, with as many
//! networks, so that the algorithms differ in nothing else; by default one network with two
//! estimates, whose second one only ever steadies the targets.

mod native;
mod torch;

pub use native::NativeTd3;
pub use torch::TorchTd3;
