//! `[replay]`.

use serde::{Deserialize, Serialize};

use super::{Invalid, require};

/// `[replay]`: the split replay buffer (paper, section 3.5).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplaySection {
    /// Transitions held in both parts together (paper: 2^17). Default 131072.
    pub capacity: usize,
    /// Share of the capacity, and of every minibatch, that belongs to success experience (paper:
    /// 0.125); with 0 there is one part for everything, as in ordinary SAC. Default 0.125.
    pub success_share: f64,
    /// What counts as success experience; the paper does not say. Default `level-up`.
    pub success: SuccessRule,
    /// Steps that led to the level-up and count as success with it; only for `success =
    /// "approach"`. Default 5.
    pub approach_steps: usize,
}

impl Default for ReplaySection {
    fn default() -> Self {
        Self {
            capacity: 1 << 17,
            success_share: 0.125,
            success: SuccessRule::LevelUp,
            approach_steps: 5,
        }
    }
}

impl ReplaySection {
    pub(super) fn validate(&self) -> Result<(), Invalid> {
        require(
            (256..=1 << 24).contains(&self.capacity),
            "replay.capacity",
            self.capacity,
            "is outside 256..=2^24: each transition takes some 300 bytes of memory",
        )?;
        require(
            (0.0..1.0).contains(&self.success_share),
            "replay.success_share",
            self.success_share,
            "is outside [0, 1): nothing but success experience would ever be learned from; 0 keeps everything in one part",
        )?;
        require(
            (1..=1000).contains(&self.approach_steps),
            "replay.approach_steps",
            self.approach_steps,
            "is outside 1..=1000",
        )
    }
}

/// Which transitions go into the success part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SuccessRule {
    /// The step in which a wall was crossed or the destination reached.
    LevelUp,
    /// That step and the `approach_steps` before it, in which the obstacle was avoided.
    Approach,
}
