//! Putting a report where readers find it: RESULTS.md, and the pictures of the documents.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::{Findings, Picture, Written};
use crate::experiments::plan::REPORT;

/// What begins the part of RESULTS.md that belongs to an experiment, before its name.
const BEGIN: &str = "<!-- experiment: ";
/// What ends the part of RESULTS.md that belongs to an experiment.
const END: &str = "<!-- end -->";
/// Where the pictures lie, relative to RESULTS.md.
const PICTURES: &str = "launch/pictures/experiments";

/// RESULTS.md, with a place for an experiment.
#[derive(Debug)]
pub struct Publication {
    results: PathBuf,
    begin: String,
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
}

impl Publication {
    /// Finds the place of the experiment called `name` in RESULTS.md of `repository`: between its markers, or, where there are none, a new part at the end.
    /// Nothing is written.
    ///
    /// # Errors
    /// [`PublicationError`] names the file and what is wrong with the markers.
    pub fn find(repository: &Path, name: &str) -> Result<Self, PublicationError> {
        let results = repository.join("RESULTS.md");
        let text = fs::read_to_string(&results).map_err(at(&results))?;
        let begin = format!("{BEGIN}{name} -->");
        let markers = |problem| PublicationError::Markers {
            path: results.clone(),
            problem,
        };
        let parts: Vec<&str> = text.split(&begin).collect();
        let (before, after) = match parts[..] {
            [all] => (
                format!("{}\n\n## Experiment: {name}\n\n", all.trim_end()),
                "\n".to_owned(),
            ),
            [before, after] => match after.split_once(END) {
                Some((mine, after)) if !mine.contains(BEGIN) => (before.to_owned(), after.to_owned()),
                _ => {
                    return Err(markers(format!(
                        "nothing ends what `{begin}` begins: write {END} after it"
                    )));
                }
            },
            _ => return Err(markers(format!("`{begin}` is there more than once: leave one"))),
        };
        Ok(Self {
            results,
            begin,
            before,
            after,
        })
    }

    /// Puts the report there, and its pictures beside the documents' others. Returns what was written.
    ///
    /// # Errors
    /// [`PublicationError::Io`] names the file.
    pub fn publish(&self, findings: &Findings<'_>, report: &Written) -> Result<Vec<PathBuf>, PublicationError> {
        let repository = self.results.parent().unwrap_or(Path::new(""));
        let folder = repository.join(PICTURES);
        fs::create_dir_all(&folder).map_err(at(&folder))?;
        let mut written = Vec::new();
        let mut pictures = Vec::new();
        for picture in &report.pictures {
            let file = format!("{}_{}", findings.experiment.name, picture.file);
            let (from, to) = (findings.plan.root.join(REPORT).join(&picture.file), folder.join(&file));
            fs::copy(&from, &to).map_err(at(&to))?;
            written.push(to);
            pictures.push(Picture {
                file,
                caption: picture.caption.clone(),
            });
        }
        let document = findings.document(&pictures, &format!("{PICTURES}/"));
        let text = format!(
            "{}{}\n{}\n{END}{}",
            self.before,
            self.begin,
            document.trim_end(),
            self.after
        );
        let aside = self.results.with_extension("md.partial");
        fs::write(&aside, text)
            .and_then(|()| fs::rename(&aside, &self.results))
            .map_err(at(&self.results))?;
        written.push(self.results.clone());
        Ok(written)
    }
}

fn at(path: &Path) -> impl FnOnce(io::Error) -> PublicationError {
    let path = path.to_owned();
    move |source| PublicationError::Io { path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(results: &str) -> Result<(String, String), String> {
        let repository = tempfile::tempdir().unwrap();
        fs::write(repository.path().join("RESULTS.md"), results).unwrap();
        Publication::find(repository.path(), "lag")
            .map(|found| (found.before, found.after))
            .map_err(|error| error.to_string())
    }

    #[test]
    fn only_what_lies_between_the_markers_is_replaced() {
        let results = "# Results\n<!-- experiment: lagging -->\nx\n<!-- end -->\n<!-- experiment: lag -->\nold\n<!-- end -->\nafter\n<!-- end -->\n";
        let (before, after) = place(results).unwrap();
        assert_eq!(before, "# Results\n<!-- experiment: lagging -->\nx\n<!-- end -->\n");
        assert_eq!(after, "\nafter\n<!-- end -->\n");
        assert_eq!(
            place("# Results\n\n").unwrap(),
            ("# Results\n\n## Experiment: lag\n\n".to_owned(), "\n".to_owned())
        );
    }

    #[test]
    fn markers_that_leave_a_doubt_are_refused() {
        let begin = "<!-- experiment: lag -->";
        for unended in [begin.to_owned(), format!("{begin}\n<!-- experiment: k -->\n{END}")] {
            assert!(place(&unended).unwrap_err().contains("write <!-- end --> after it"));
        }
        assert!(
            place(&format!("{begin}\n{END}\n{begin}\n{END}"))
                .unwrap_err()
                .contains("more than once")
        );
    }
}
