//! Publishes reports in `docs/results/NAME.md`, with their pictures and the figures of each run.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use skein_protocol::files::{self, REPORT_BYTES};

use super::runs::RUNS;
use super::{Findings, Picture, WrittenReport};
use crate::plan::REPORT;

/// Folder of the published reports, relative to the repository.
const RESULTS: &str = "docs/results";
/// Folder of the pictures, relative to the published reports.
const PICTURES: &str = "pictures";
/// Folder of the figures of each run, relative to the published reports.
const FIGURES: &str = "runs";
/// Line before the report in its document.
const BEGIN: &str = "<!-- report -->";
/// Line after the report in its document.
const END: &str = "<!-- end -->";
/// Link below the report to the legend of all reports.
const LEGEND: &str =
    "How to read the tables and pictures: [README.md](README.md#how-to-read-a-table).";

/// Document of an experiment, with a place for its report. It may not exist yet.
#[derive(Debug)]
pub struct Publication {
    document: PathBuf,
}

/// Document without the report.
struct Surroundings {
    before: String,
    after: String,
}

/// Reason why a report cannot be published.
#[derive(Debug, thiserror::Error)]
pub enum PublicationError {
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// The markers of the report are missing or repeated.
    #[error(
        "{}: the report belongs between {BEGIN} and {END}: write each marker once, in this order",
        .0.display()
    )]
    Markers(PathBuf),
}

impl Publication {
    /// Finds the document of the experiment called `name` in `repository`, and checks its markers.
    /// Nothing is written.
    ///
    /// # Errors
    /// [`PublicationError`] names the document and the remedy.
    pub fn find(repository: &Path, name: &str) -> Result<Self, PublicationError> {
        let found = Self {
            document: repository.join(RESULTS).join(format!("{name}.md")),
        };
        found.surroundings().map(|_| found)
    }

    /// Reads the present surroundings of the report; `None` if there is no document.
    fn surroundings(&self) -> Result<Option<Surroundings>, PublicationError> {
        let text = match files::read_text(&self.document, REPORT_BYTES) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(at(&self.document)(error)),
        };
        let parts = text.split_once(BEGIN).and_then(|(before, rest)| {
            let (_, after) = rest.split_once(END)?;
            Some((before, after))
        });
        let once = [BEGIN, END]
            .iter()
            .all(|line| text.matches(line).count() == 1);
        match parts {
            Some((before, after)) if once => Ok(Some(Surroundings {
                before: before.to_owned(),
                after: after.to_owned(),
            })),
            _ => Err(PublicationError::Markers(self.document.clone())),
        }
    }

    /// Writes the report into its document, with its pictures and the figures of each run beside
    /// it. Returns the paths of the files written.
    ///
    /// # Errors
    /// [`PublicationError`] names the file.
    pub fn publish(
        &self,
        findings: &Findings<'_>,
        report: &WrittenReport,
    ) -> Result<Vec<PathBuf>, PublicationError> {
        let results = self.document.parent().unwrap_or(Path::new(""));
        let name = &findings.experiment.name;
        let mut written = Vec::new();
        let mut put = |file: &str, folder: &str, published: String| {
            fs::create_dir_all(results.join(folder)).map_err(at(results))?;
            let from = findings.plan.root.join(REPORT).join(file);
            let within = format!("{folder}/{published}");
            let to = results.join(&within);
            fs::copy(&from, &to).map_err(at(&to))?;
            written.push(to);
            Ok(within)
        };
        let runs = put(RUNS, FIGURES, format!("{name}.csv"))?;
        let mut pictures = Vec::new();
        for Picture { file, caption } in &report.pictures {
            pictures.push(Picture {
                file: put(file, PICTURES, format!("{name}_{file}"))?,
                caption: caption.clone(),
            });
        }
        let surroundings = Surroundings {
            before: findings.heading(),
            after: format!("\n\n{}", findings.how_to_repeat()),
        };
        self.write(&findings.body(&pictures, &runs), surroundings)?;
        written.push(self.document.clone());
        Ok(written)
    }

    /// Writes `report` into the document, which is read again because it may have changed while the
    /// runs were under way. A missing document is created with the surroundings in `new`.
    fn write(&self, report: &str, new: Surroundings) -> Result<(), PublicationError> {
        let Surroundings { before, after } = self.surroundings()?.unwrap_or(new);
        let text = format!(
            "{before}{BEGIN}\n{}\n\n{LEGEND}\n{END}{after}",
            report.trim_end()
        );
        let aside = self.document.with_extension("md.partial");
        fs::write(&aside, text)
            .and_then(|()| fs::rename(&aside, &self.document))
            .map_err(at(&self.document))
    }
}

fn at(path: &Path) -> impl FnOnce(io::Error) -> PublicationError {
    let path = path.to_owned();
    move |source| PublicationError::Io { path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the document after a publication of `new`, if its text was `found` at the beginning
    /// and is `changed` since.
    fn published(found: Option<&str>, changed: Option<&str>) -> Result<String, String> {
        let repository = tempfile::tempdir().unwrap();
        let results = repository.path().join(RESULTS);
        fs::create_dir_all(&results).unwrap();
        let file = results.join("lag.md");
        let put = |text: Option<&str>| text.map(|text| fs::write(&file, text).unwrap());
        put(found);
        let place =
            Publication::find(repository.path(), "lag").map_err(|error| error.to_string())?;
        put(changed);
        let new = Surroundings {
            before: "# Why?\n\n".to_owned(),
            after: "\n".to_owned(),
        };
        let written = place.write("new\n\n", new);
        written.map_err(|error| error.to_string())?;
        Ok(fs::read_to_string(&file).unwrap())
    }

    fn with(report: &str, words: &str) -> String {
        format!("# Why?\n\n{words}\n\n{BEGIN}\n{report}\n{END}\n\nafter\n")
    }

    #[test]
    fn only_the_part_between_the_markers_is_replaced() {
        let (old, new) = (
            with("old", "Because."),
            with(&format!("new\n\n{LEGEND}"), "Because."),
        );
        assert_eq!(published(Some(&old), Some(&old)).unwrap(), new);
        assert_eq!(published(Some(&new), Some(&new)).unwrap(), new);
    }

    #[test]
    fn a_missing_document_is_created_with_the_question() {
        assert_eq!(
            published(None, None).unwrap(),
            format!("# Why?\n\n{BEGIN}\nnew\n\n{LEGEND}\n{END}\n")
        );
    }

    #[test]
    fn text_written_while_runs_were_under_way_is_kept() {
        let (before, since) = (with("old", "Before."), with("old", "Since."));
        assert_eq!(
            published(Some(&before), Some(&since)).unwrap(),
            with(&format!("new\n\n{LEGEND}"), "Since.")
        );
    }

    #[test]
    fn ambiguous_markers_are_refused() {
        let twice = format!("{BEGIN}\n{END}\n{BEGIN}\n{END}");
        for text in ["no marker", BEGIN, "<!-- end -->\n<!-- report -->", &twice] {
            let refusal = published(Some(text), None).unwrap_err();
            assert!(
                refusal.contains("lag.md") && refusal.contains("write each marker once"),
                "{refusal}"
            );
        }
    }
}
