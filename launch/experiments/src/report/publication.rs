//! Putting a report where readers find it: RESULTS.md, and the pictures of the documents.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use super::runs::RUNS;
use super::{Findings, Picture, Written};
use crate::plan::{self, REPORT};

/// What begins the part of RESULTS.md that belongs to an experiment, before its name.
const BEGIN: &str = "<!-- experiment: ";
/// What ends the part of RESULTS.md that belongs to an experiment.
const END: &str = "<!-- end -->";
/// Where the pictures and the figures of each run lie, relative to RESULTS.md.
const PICTURES: &str = "launch/pictures/experiments";

/// RESULTS.md, with a place for an experiment.
#[derive(Debug)]
pub struct Publication {
    results: PathBuf,
    name: String,
}

/// RESULTS.md without the part of the experiment.
struct Surroundings {
    before: String,
    after: String,
}

/// Why a report cannot be published.
#[derive(Debug, thiserror::Error)]
pub enum PublicationError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The part of the experiment has no end, or there are two of it.
    #[error("{}: {problem}", path.display())]
    Markers {
        /// RESULTS.md.
        path: PathBuf,
        /// What is wrong with it, and what to write.
        problem: String,
    },
    /// Somebody is publishing.
    #[error("{}: another experiment is being published: do it again, with --report --publish", .0.display())]
    Busy(PathBuf),
}

impl Publication {
    /// Finds the place of the experiment called `name` in RESULTS.md of `repository`: between its
    /// markers, or, where there are none, a new part at the end. Nothing is written.
    ///
    /// # Errors
    /// [`PublicationError`] names the file and what is wrong with the markers.
    pub fn find(repository: &Path, name: &str) -> Result<Self, PublicationError> {
        let found = Self {
            results: repository.join("RESULTS.md"),
            name: name.to_owned(),
        };
        found.surroundings().map(|_| found)
    }

    /// What RESULTS.md has around the experiment's part now.
    fn surroundings(&self) -> Result<Surroundings, PublicationError> {
        let text = fs::read_to_string(&self.results).map_err(at(&self.results))?;
        let begin = &self.begin();
        let markers = |problem| {
            Err(PublicationError::Markers {
                path: self.results.clone(),
                problem,
            })
        };
        let parts: Vec<&str> = text.split(begin).collect();
        match parts[..] {
            [all] => Ok(Surroundings {
                before: format!("{}\n\n## Experiment: {}\n\n", all.trim_end(), self.name),
                after: "\n".to_owned(),
            }),
            [before, after] => match after.split_once(END) {
                Some((mine, after)) if !mine.contains(BEGIN) => Ok(Surroundings {
                    before: before.to_owned(),
                    after: after.to_owned(),
                }),
                _ => markers(format!(
                    "nothing ends what `{begin}` begins: write {END} after it"
                )),
            },
            _ => markers(format!("`{begin}` is there more than once: leave one")),
        }
    }

    fn begin(&self) -> String {
        format!("{BEGIN}{} -->", self.name)
    }

    /// Puts the report there, and its pictures and the figures of each run beside the documents'
    /// others. Returns what was written.
    ///
    /// # Errors
    /// [`PublicationError`] names the file; nothing was written where another experiment is just
    /// being published.
    pub fn publish(
        &self,
        findings: &Findings<'_>,
        report: &Written,
    ) -> Result<Vec<PathBuf>, PublicationError> {
        let repository = self.results.parent().unwrap_or(Path::new(""));
        let folder = repository.join(PICTURES);
        let _claim = claim(&folder)?;
        let mut written = Vec::new();
        let mut put = |file: &str| {
            let published = format!("{}_{file}", findings.experiment.name);
            let (from, to) = (
                findings.plan.root.join(REPORT).join(file),
                folder.join(&published),
            );
            fs::copy(&from, &to).map_err(at(&to))?;
            written.push(to);
            Ok(published)
        };
        let runs = put(RUNS)?;
        let mut pictures = Vec::new();
        for Picture { file, caption } in &report.pictures {
            let caption = caption.clone();
            pictures.push(Picture {
                file: put(file)?,
                caption,
            });
        }
        self.write(&findings.document(&pictures, &format!("{PICTURES}/"), &runs))?;
        written.push(self.results.clone());
        Ok(written)
    }

    /// Puts `document` into RESULTS.md as it is now: hours have passed since its place was found.
    fn write(&self, document: &str) -> Result<(), PublicationError> {
        let Surroundings { before, after } = self.surroundings()?;
        let text = format!(
            "{before}{}\n{}\n{END}{after}",
            self.begin(),
            document.trim_end()
        );
        let aside = self.results.with_extension("md.partial");
        fs::write(&aside, text)
            .and_then(|()| fs::rename(&aside, &self.results))
            .map_err(at(&self.results))
    }
}

/// Claims the documents, by the folder of their pictures, until what it gives is dropped.
fn claim(folder: &Path) -> Result<File, PublicationError> {
    let claimed = plan::claim(folder).map_err(at(folder))?;
    claimed.ok_or_else(|| PublicationError::Busy(folder.to_owned()))
}

fn at(path: &Path) -> impl FnOnce(io::Error) -> PublicationError {
    let path = path.to_owned();
    move |source| PublicationError::Io { path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What RESULTS.md becomes when `new` is published for the experiment `lag`, and somebody has
    /// put `changed` there since its place was found.
    fn published(results: &str, changed: &str) -> Result<String, String> {
        let repository = tempfile::tempdir().unwrap();
        let file = repository.path().join("RESULTS.md");
        fs::write(&file, results).unwrap();
        let place =
            Publication::find(repository.path(), "lag").map_err(|error| error.to_string())?;
        fs::write(&file, changed).unwrap();
        place.write("new\n\n").map_err(|error| error.to_string())?;
        Ok(fs::read_to_string(&file).unwrap())
    }

    fn place(results: &str) -> Result<String, String> {
        published(results, results)
    }

    #[test]
    fn only_what_lies_between_the_markers_is_replaced() {
        let results = "# Results\n<!-- experiment: lagging -->\nx\n<!-- end -->\n<!-- experiment: lag -->\nold\n<!-- end -->\nafter\n<!-- end -->\n";
        assert_eq!(place(results).unwrap(), results.replace("old", "new"));
        assert_eq!(
            place("# Results\n\n").unwrap(),
            "# Results\n\n## Experiment: lag\n\n<!-- experiment: lag -->\nnew\n<!-- end -->\n"
        );
    }

    #[test]
    fn what_was_written_while_runs_were_under_way_stays() {
        let results = |words| format!("{words}\n<!-- experiment: lag -->\nold\n<!-- end -->\n");
        let published = published(&results("before"), &results("since"));
        assert_eq!(published.unwrap(), results("since").replace("old", "new"));
    }

    #[test]
    fn two_do_not_publish_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let first = claim(folder.path()).unwrap();
        let second = claim(folder.path()).unwrap_err().to_string();
        assert!(second.contains("--report --publish"), "{second}");
        drop(first);
        claim(folder.path()).unwrap();
    }

    #[test]
    fn markers_that_leave_a_doubt_are_refused() {
        let begin = "<!-- experiment: lag -->";
        for unended in [
            begin.to_owned(),
            format!("{begin}\n<!-- experiment: k -->\n{END}"),
        ] {
            assert!(
                place(&unended)
                    .unwrap_err()
                    .contains("write <!-- end --> after it")
            );
        }
        assert!(
            place(&format!("{begin}\n{END}\n{begin}\n{END}"))
                .unwrap_err()
                .contains("more than once")
        );
    }
}
