//! The `[courses]` section.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[courses]` section: the courses of training and evaluation.
///
/// Paths are relative to the configuration file; with `--set`, to the working directory. Keys left
/// out name the courses that come with Skein, in `configs/courses/`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CoursesSection {
    /// Course file of the training episodes. Default `courses/training.toml`.
    pub training: PathBuf,
    /// Share of training episodes that fly a generated course instead, a new one each, in [0, 1].
    /// Default 0: the training course only, as in the paper.
    pub generated_share: f64,
    /// Course files of the final evaluation, in the order of its table; 1 to 64. Candidates for the
    /// best snapshot are confirmed on the first. Default: `training.toml`, `rearranged_34125.toml`,
    /// `rearranged_53412.toml` and `non_rectangular.toml`.
    pub evaluation: Vec<PathBuf>,
}

impl Default for CoursesSection {
    fn default() -> Self {
        let shipped = |name: &str| PathBuf::from("courses").join(name);
        Self {
            training: shipped("training.toml"),
            generated_share: 0.0,
            evaluation: [
                "training.toml",
                "rearranged_34125.toml",
                "rearranged_53412.toml",
                "non_rectangular.toml",
            ]
            .map(shipped)
            .to_vec(),
        }
    }
}

impl CoursesSection {
    /// Name of a course in reports: its file name without the extension.
    pub fn name_of(course: &Path) -> String {
        course
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    }

    /// Returns every course file.
    pub fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        std::iter::once(&self.training).chain(&self.evaluation)
    }

    /// Returns every course file, mutable.
    pub fn paths_mut(&mut self) -> impl Iterator<Item = &mut PathBuf> {
        self.evaluation.iter_mut().chain([&mut self.training])
    }

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            (0.0..=1.0).contains(&self.generated_share),
            "courses.generated_share",
            self.generated_share,
            "is outside [0, 1]: it is a share of the training episodes",
        )?;
        require(
            !self.evaluation.is_empty(),
            "courses.evaluation",
            "[]",
            "is empty: no snapshot could be confirmed",
        )?;
        require(
            self.evaluation.len() <= 64,
            "courses.evaluation",
            self.evaluation.len(),
            "lists more than 64 courses: tickets could not number them",
        )
    }
}
