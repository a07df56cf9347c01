//! BenchmarkFigures that the benchmarks measured: criterion's samples, and lines of JSON from
//! benchmarks that criterion cannot run.
//!
//! A figure is the fastest sample. Virtual machines share their cores with others, who slow whole
//! seconds down by half, invisibly from within; nothing makes code faster than it is. The median is
//! kept too, to show how much the machine was disturbed.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::catalogue::{Show, per_second};

/// All figures of one session, by name.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct BenchmarkFigures(BTreeMap<String, Figure>);

/// One figure.
#[derive(Debug, Clone, PartialEq)]
pub enum Figure {
    /// Measured by criterion.
    Timed {
        /// Seconds per iteration in the fastest sample.
        secs: f64,
        /// Seconds per iteration in the median sample.
        median_secs: f64,
        /// Elements per iteration.
        elements: f64,
    },
    /// From a line of JSON.
    Printed(PrintedFigure),
}

/// Line of JSON that a benchmark prints.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct PrintedFigure {
    /// Name of the figure.
    pub name: String,
    /// Value of the figure.
    pub figure: f64,
    /// Unit of the value, which must equal that of its row.
    pub unit: String,
    /// Description of the baseline.
    pub baseline: Option<String>,
    /// Value of the baseline, in the same unit.
    pub baseline_figure: Option<f64>,
}

/// Reason why a file of figures cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FiguresError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// The contents are invalid.
    #[error("{}: {source}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Problem of the contents.
        #[source]
        source: serde_json::Error,
    },
}

/// Reason why a figure cannot be shown in the requested form.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// It has another unit.
    #[error("is in {found}, not in {asked}")]
    Unit {
        /// Unit of the figure.
        found: String,
        /// Requested unit.
        asked: String,
    },
    /// A time is requested.
    #[error("is a value printed by a benchmark, not a time measured by criterion")]
    Printed,
    /// A value is requested.
    #[error("is a time measured by criterion, not a value printed by a benchmark")]
    Timed,
}

/// Needed part of criterion's `benchmark.json`.
#[derive(Deserialize)]
struct About {
    full_id: String,
    throughput: Option<Throughput>,
}

#[derive(Deserialize)]
struct Throughput {
    #[serde(rename = "Elements")]
    elements: Option<f64>,
}

/// Needed part of criterion's `sample.json`: iterations and nanoseconds of each sample.
#[derive(Deserialize)]
struct Samples {
    iters: Vec<f64>,
    times: Vec<f64>,
}

impl BenchmarkFigures {
    /// Reads all figures in `directory`: criterion's in `criterion/`, and those in the lines of
    /// `*.figures` that begin with a brace.
    ///
    /// # Errors
    /// [`FiguresError`] names the file.
    pub fn read(directory: &Path) -> Result<Self, FiguresError> {
        let mut figures = Self::default();
        figures.read_criterion(&directory.join("criterion"))?;
        for path in entries(directory)? {
            if path
                .extension()
                .is_some_and(|extension| extension == "figures")
            {
                figures.read_lines(&path)?;
            }
        }
        Ok(figures)
    }

    /// Returns `true` if there are no figures.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the most disturbed figure, with the ratio of its median to its fastest sample.
    pub fn most_disturbed(&self) -> Option<(&str, f64)> {
        self.0
            .iter()
            .filter_map(|(name, figure)| Some((name.as_str(), figure.disturbance()?)))
            .max_by(|(_, a), (_, b)| a.total_cmp(b))
    }

    /// Returns the figure called `name`.
    pub fn get(&self, name: &str) -> Option<&Figure> {
        self.0.get(name)
    }

    /// Returns all figures called `of/<number>` with their numbers, in ascending order.
    pub fn series(&self, of: &str) -> Vec<(f64, &Figure)> {
        let number = |name: &str| name.strip_prefix(of)?.strip_prefix('/')?.parse().ok();
        let mut series: Vec<(f64, &Figure)> = self
            .0
            .iter()
            .filter_map(|(name, figure)| Some((number(name)?, figure)))
            .collect();
        series.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        series
    }

    /// A benchmark's results lie in folders named after its parts, in `new/` of the last.
    fn read_criterion(&mut self, folder: &Path) -> Result<(), FiguresError> {
        let about = folder.join("new/benchmark.json");
        if about.exists() {
            let About {
                full_id,
                throughput,
            } = json(&about)?;
            let samples: Samples = json(&folder.join("new/sample.json"))?;
            if let Some((secs, median_secs)) = samples.secs() {
                let figure = Figure::Timed {
                    secs,
                    median_secs,
                    elements: throughput.and_then(|count| count.elements).unwrap_or(1.0),
                };
                self.0.insert(full_id, figure);
            }
        }
        for path in entries(folder)? {
            if path.is_dir() {
                self.read_criterion(&path)?;
            }
        }
        Ok(())
    }

    fn read_lines(&mut self, path: &Path) -> Result<(), FiguresError> {
        let text = fs::read_to_string(path).map_err(|source| FiguresError::Read {
            path: path.to_owned(),
            source,
        })?;
        for line in text.lines().filter(|line| line.starts_with('{')) {
            let printed: PrintedFigure =
                serde_json::from_str(line).map_err(|source| FiguresError::Malformed {
                    path: path.to_owned(),
                    source,
                })?;
            self.0
                .insert(printed.name.clone(), Figure::Printed(printed));
        }
        Ok(())
    }
}

impl Samples {
    /// Returns the seconds per iteration: fastest and median. `None` without samples.
    fn secs(&self) -> Option<(f64, f64)> {
        let mut secs: Vec<f64> = self
            .times
            .iter()
            .zip(&self.iters)
            .map(|(nanos, iterations)| nanos / iterations / 1e9)
            .collect();
        secs.sort_by(f64::total_cmp);
        Some((*secs.first()?, secs[secs.len() / 2]))
    }
}

impl Figure {
    /// Returns the shown number, in `unit` and times `scale`; for a share of the peak, the time.
    ///
    /// # Errors
    /// Returns [`Unfit`] if this figure has no such number.
    pub fn shown(&self, show: Show, unit: &str, scale: f64) -> Result<f64, Unfit> {
        let foreign = |found: &str| Unfit::Unit {
            found: found.to_owned(),
            asked: unit.to_owned(),
        };
        let in_unit = |secs: f64| Ok(secs * per_second(unit).ok_or_else(|| foreign("s"))?);
        let value = match (self, show) {
            (Self::Timed { secs, elements, .. }, Show::Rate) => elements / secs,
            (Self::Timed { secs, elements, .. }, Show::Time) => in_unit(secs / elements)?,
            (Self::Timed { secs, .. }, Show::PeakShare) => in_unit(*secs)?,
            (Self::Printed(printed), Show::Value) if printed.unit == unit => printed.figure,
            (Self::Printed(printed), Show::Value) => return Err(foreign(&printed.unit)),
            (Self::Timed { .. }, Show::Value) => return Err(Unfit::Timed),
            (Self::Printed(_), Show::Rate | Show::Time | Show::PeakShare) => {
                return Err(Unfit::Printed);
            }
        };
        Ok(value * scale)
    }

    /// Returns the same figure by the median of its samples, if it was timed.
    pub fn at_median(&self) -> Option<Self> {
        match *self {
            Self::Timed {
                median_secs,
                elements,
                ..
            } => Some(Self::Timed {
                secs: median_secs,
                median_secs,
                elements,
            }),
            Self::Printed(_) => None,
        }
    }

    /// Returns the ratio of the median to the fastest sample, if it was timed.
    pub fn disturbance(&self) -> Option<f64> {
        match self {
            Self::Timed {
                secs, median_secs, ..
            } => Some(median_secs / secs),
            Self::Printed(_) => None,
        }
    }
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, FiguresError> {
    let entries = match fs::read_dir(folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries,
    };
    let mut paths = entries
        .and_then(|entries| {
            entries
                .map(|entry| Ok(entry?.path()))
                .collect::<io::Result<Vec<_>>>()
        })
        .map_err(|source| FiguresError::Read {
            path: folder.to_owned(),
            source,
        })?;
    paths.sort();
    Ok(paths)
}

fn json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, FiguresError> {
    let text = fs::read(path).map_err(|source| FiguresError::Read {
        path: path.to_owned(),
        source,
    })?;
    serde_json::from_slice(&text).map_err(|source| FiguresError::Malformed {
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Returns figures as criterion leaves them: name, nanoseconds, elements.
    pub(in super::super) fn timed(figures: &[(&str, f64, f64)]) -> BenchmarkFigures {
        let figure = |&(name, nanos, elements): &(&str, f64, f64)| {
            let secs = nanos / 1e9;
            let figure = Figure::Timed {
                secs,
                median_secs: secs,
                elements,
            };
            (name.to_owned(), figure)
        };
        BenchmarkFigures(figures.iter().map(figure).collect())
    }

    #[test]
    fn criterions_files_and_lines_of_json_are_found_by_name() {
        let directory = tempfile::tempdir().unwrap();
        let new = directory.path().join("criterion/replay/sample/1024/new");
        fs::create_dir_all(&new).unwrap();
        let about = r#"{"full_id":"replay/sample/1024","throughput":{"Elements":4},"title":"any"}"#;
        fs::write(new.join("benchmark.json"), about).unwrap();
        let samples =
            r#"{"sampling_mode":"Flat","iters":[2.0,2.0,2.0],"times":[8000.0,4000.0,6000.0]}"#;
        fs::write(new.join("sample.json"), samples).unwrap();
        let line = concat!(
            r#"{"name":"transport/records","figure":3e5,"unit":"records/s","#,
            r#""baseline":"memcpy","baseline_figure":6e5}"#
        );
        fs::write(
            directory.path().join("transport.figures"),
            format!("a word\n{line}\n"),
        )
        .unwrap();

        let figures = BenchmarkFigures::read(directory.path()).unwrap();
        let timed = figures.get("replay/sample/1024").unwrap();
        assert_eq!(timed.shown(Show::Time, "µs", 1.0), Ok(0.5));
        assert_eq!(timed.shown(Show::Rate, "any", 0.5), Ok(1e6));
        assert_eq!(timed.disturbance(), Some(1.5));
        assert_eq!(
            timed.at_median().unwrap().shown(Show::Time, "µs", 1.0),
            Ok(0.75)
        );
        assert_eq!(timed.shown(Show::Value, "any", 1.0), Err(Unfit::Timed));
        let printed = figures.get("transport/records").unwrap();
        assert_eq!(printed.shown(Show::Value, "records/s", 1.0), Ok(3e5));
        let refused = printed.shown(Show::Value, "steps/s", 1.0).unwrap_err();
        assert_eq!(refused.to_string(), "is in records/s, not in steps/s");
        assert_eq!(
            printed.shown(Show::Rate, "records/s", 1.0),
            Err(Unfit::Printed)
        );

        fs::write(directory.path().join("bad.figures"), "{\"name\":1}\n").unwrap();
        let refused = BenchmarkFigures::read(directory.path())
            .unwrap_err()
            .to_string();
        assert!(refused.contains("bad.figures"), "{refused}");
    }

    #[test]
    fn a_series_is_in_the_order_of_its_numbers() {
        let figures = timed(&[
            ("a/b/1024", 2.0, 1.0),
            ("a/b/64", 1.0, 1.0),
            ("a/b/other", 1.0, 1.0),
        ]);
        let xs: Vec<f64> = figures.series("a/b").iter().map(|(x, _)| *x).collect();
        assert_eq!(xs, [64.0, 1024.0]);
    }
}
