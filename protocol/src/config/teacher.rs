//! The `[teacher]` section.

use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[teacher]` section: an expert whose action is recorded beside the drone's own in each
/// training step (DAgger, arXiv:1011.0686). The paper has none.
///
/// `learning.algorithm = "distill"` learns from its actions alone, `"sac"` also from them, until
/// its weight has fallen to zero.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TeacherSection {
    /// Expert: `none`; `oracle`, which knows the next opening and the drone's motion; or
    /// `snapshot`, a trained policy that sees what the drone sees. Default `none`.
    pub policy: TeacherName,
    /// File of the policy, with `policy = "snapshot"`: any snapshot of this version.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub snapshot: Option<PathBuf>,
    /// Share of the first training steps that the teacher flies, 0 to 1. It falls linearly to 0.
    /// Default 0.
    pub flown_share: f64,
    /// Environment steps after which the teacher flies no step any more. Default 0.
    pub flown_steps: u64,
    /// Weight of the squared distance between the teacher's action and the policy's in SAC's policy
    /// loss, at the first update; 0 to 1000. It falls linearly to 0. Default 5.
    pub loss_weight: f64,
    /// Policy updates after which that weight is 0, so that SAC learns from rewards alone. Default
    /// 10,000.
    pub loss_updates: u64,
}

impl Default for TeacherSection {
    fn default() -> Self {
        Self {
            policy: TeacherName::None,
            snapshot: None,
            flown_share: 0.0,
            flown_steps: 0,
            loss_weight: 5.0,
            loss_updates: 10_000,
        }
    }
}

impl TeacherSection {
    /// Returns `true` if there is a teacher.
    pub fn is_configured(&self) -> bool {
        self.policy != TeacherName::None
    }

    /// Returns the share of steps that the teacher flies, after `steps` environment steps.
    pub fn flown_share_after(&self, steps: u64) -> f64 {
        self.flown_share * remaining(steps, self.flown_steps)
    }

    /// Returns the weight in SAC's policy loss, after `updates` policy updates.
    pub fn loss_weight_after(&self, updates: u64) -> f64 {
        match self.policy {
            TeacherName::None => 0.0,
            TeacherName::Oracle | TeacherName::Snapshot => {
                self.loss_weight * remaining(updates, self.loss_updates)
            }
        }
    }

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            (0.0..=1.0).contains(&self.flown_share),
            "teacher.flown_share",
            self.flown_share,
            "is outside [0, 1]: it is a share of the steps",
        )?;
        require(
            self.flown_share == 0.0 || self.is_configured(),
            "teacher.flown_share",
            self.flown_share,
            "is above 0, but teacher.policy = \"none\": nobody would fly these steps; set it to \
            0, or teacher.policy to \"oracle\"",
        )?;
        let is_snapshot = self.policy == TeacherName::Snapshot;
        require(
            !is_snapshot || self.snapshot.is_some(),
            "teacher.policy",
            "snapshot",
            "asks for a policy's file: name it in teacher.snapshot",
        )?;
        if let Some(file) = &self.snapshot {
            require(
                is_snapshot,
                "teacher.snapshot",
                format!("\"{}\"", file.display()),
                "is asked nothing: set teacher.policy to \"snapshot\", or leave it out",
            )?;
        }
        require(
            (0.0..=1000.0).contains(&self.loss_weight),
            "teacher.loss_weight",
            self.loss_weight,
            "is outside [0, 1000]",
        )
    }
}

/// Linear decay from 1 to 0: returns the rest after `done` of `all`.
fn remaining(done: u64, all: u64) -> f64 {
    if done >= all {
        0.0
    } else {
        1.0 - done as f64 / all as f64
    }
}

/// Teacher.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TeacherName {
    /// No teacher.
    None,
    /// The scripted expert of the simulator.
    Oracle,
    /// The policy of a snapshot's file.
    Snapshot,
}

impl fmt::Display for TeacherName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::None => "none",
            Self::Oracle => "oracle",
            Self::Snapshot => "snapshot",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn share_and_weight_fall_linearly_to_zero() {
        let teacher = TeacherSection {
            policy: TeacherName::Oracle,
            snapshot: None,
            flown_share: 0.5,
            flown_steps: 100,
            loss_weight: 4.0,
            loss_updates: 10,
        };
        let shares = [0, 50, 100, 1000].map(|steps| teacher.flown_share_after(steps));
        assert_eq!(shares, [0.5, 0.25, 0.0, 0.0]);
        let weights = [0, 5, 10, 1000].map(|updates| teacher.loss_weight_after(updates));
        assert_eq!(weights, [4.0, 2.0, 0.0, 0.0]);
    }

    #[test]
    fn nobody_flies_a_share_without_a_teacher() {
        let mut teacher = TeacherSection {
            flown_share: 0.5,
            ..TeacherSection::default()
        };
        assert_eq!(teacher.validate().unwrap_err().key, "teacher.flown_share");
        assert_eq!(teacher.loss_weight_after(0), 0.0);
        teacher.policy = TeacherName::Oracle;
        assert_eq!(teacher.validate(), Ok(()));
    }
}
