//! The `[replay]` section.

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[replay]` section: the split replay buffer (paper, section 3.5).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReplaySection {
    /// Transitions in both parts together, 256 to 2^24; some 300 bytes each. Default 131072, as in
    /// the paper (2^17).
    pub capacity: usize,
    /// Share of the capacity, and of every minibatch, reserved for success experience; in [0, 1). 0
    /// keeps everything in one part, as in ordinary SAC. Default 0.125, as in the paper.
    pub success_share: f64,
    /// Definition of success experience: `level-up` or `approach`. The paper gives none. Default
    /// `level-up`.
    pub success: SuccessRule,
    /// Steps before the level-up that also count as success, 1 to 1000; only for `success =
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
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
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
            "is outside [0, 1): minibatches would hold nothing but success experience; 0 keeps \
            everything in one part",
        )?;
        require(
            (1..=1000).contains(&self.approach_steps),
            "replay.approach_steps",
            self.approach_steps,
            "is outside 1..=1000",
        )
    }
}

/// Transitions that go into the success part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SuccessRule {
    /// The step that crossed a wall or reached the destination.
    LevelUp,
    /// The same step and the `approach_steps` before it, in which the drone avoided the obstacle.
    Approach,
}
