//! The `[courses]` section.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};
use crate::files::{SETTINGS_BYTES, read_text};

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
    /// Returns the file name of a course without the extension.
    pub fn stem_of(course: &Path) -> String {
        course
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    }

    /// Returns the names of `courses` in reports: the key `name` of each file. Equal names get the
    /// file's stem in brackets. A file without a name, or that cannot be read, is named by its
    /// stem. In it, "_" stands for what a table or a terminal cannot show.
    pub fn names<P: AsRef<Path>>(courses: &[P]) -> Vec<String> {
        let own: Vec<_> = courses
            .iter()
            .map(|course| {
                let stem = Self::stem_of(course.as_ref());
                let stem = stem.replace(|sign: char| sign.is_control() || sign == '|', "_");
                (
                    name_in(course.as_ref()).unwrap_or_else(|| stem.clone()),
                    stem,
                )
            })
            .collect();
        let mut names: Vec<String> = Vec::with_capacity(own.len());
        for (name, stem) in &own {
            let is_shared = own.iter().filter(|(other, _)| other == name).count() > 1;
            let base = match is_shared {
                true => format!("{name} ({stem})"),
                false => name.clone(),
            };
            let mut numbered = (2..).map(|number| format!("{base} {number}"));
            let mut unused = base.clone();
            while names.contains(&unused) {
                unused = numbered.next().expect("there is always a next number");
            }
            names.push(unused);
        }
        names
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

/// Returns the key `name` of the course file at `path`, unless it is blank.
fn name_in(path: &Path) -> Option<String> {
    let course: toml::Table = toml::from_str(&read_text(path, SETTINGS_BYTES).ok()?).ok()?;
    let name = course.get("name")?.as_str()?.trim();
    (!name.is_empty()).then(|| name.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_course_is_shown_by_its_name_and_equal_names_are_distinguished() {
        let folder = tempfile::tempdir().unwrap();
        let write = |file: &str, text: &str| {
            let path = folder.path().join(file);
            std::fs::write(&path, text).unwrap();
            path
        };
        let courses = [
            write("gates.toml", "name = \"two gates\""),
            write("hall.toml", "name = \"hall\""),
            write("hall_2.toml", "name = \" hall \""),
            write("blank.toml", "name = \"\""),
            write("un\u{1b}named|.toml", ""),
            folder.path().join("missing.toml"),
        ];
        let names = CoursesSection::names(&courses);
        assert_eq!(
            names,
            [
                "two gates",
                "hall (hall)",
                "hall (hall_2)",
                "blank",
                "un_named_",
                "missing"
            ]
        );
        let twice = CoursesSection::names(&[&courses[0], &courses[0]]);
        assert_eq!(twice, ["two gates (gates)", "two gates (gates) 2"]);
    }
}
