//! What the benchmarks left: criterion's samples, and lines of JSON of those that criterion cannot
//! run.
//!
//! The figure is the fastest sample. Virtual machines share their cores with strangers, who slow
//! whole seconds down by half, unseen from within; nothing makes code faster than it is. The median
//! is kept beside it, so that it is seen how much the machine was disturbed.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::catalogue::{Show, per_second};

/// All figures of one run, by name.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Figures(BTreeMap<String, Figure>);

/// One figure.
#[derive(Debug, Clone, PartialEq)]
pub enum Figure {
    /// By criterion.
    Timed {
        /// Seconds an iteration takes, in the fastest of the samples.
        secs: f64,
        /// The same, in their median.
        median_secs: f64,
        /// What an iteration counts for.
        elements: f64,
    },
    /// From a line of JSON.
    Told(Told),
}

/// A line of JSON that a benchmark prints.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Told {
    /// The figure's name.
    pub name: String,
    /// The figure.
    pub figure: f64,
    /// Its unit, which must be that of its row.
    pub unit: String,
    /// What it is compared with.
    pub baseline: Option<String>,
    /// That, in the same unit.
    pub baseline_figure: Option<f64>,
}

/// A file that is not what it should be.
#[derive(Debug, thiserror::Error)]
pub enum FiguresError {
    /// It cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// It does not hold what it should.
    #[error("{}: {source}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: serde_json::Error,
    },
}

/// Why a figure cannot be shown as it is asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// It has another unit.
    #[error("is in {found}, not in {asked}")]
    Unit {
        /// Its own.
        found: String,
        /// The one asked for.
        asked: String,
    },
    /// A time is asked for.
    #[error("is a value that a benchmark told, not a time that criterion took")]
    Told,
    /// A value is asked for.
    #[error("is a time that criterion took, not a value that a benchmark told")]
    Timed,
}

/// Of criterion's `benchmark.json`, what is needed.
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

/// Of criterion's `sample.json`, what is needed: iterations and nanoseconds of each sample.
#[derive(Deserialize)]
struct Samples {
    iters: Vec<f64>,
    times: Vec<f64>,
}

impl Figures {
    /// All figures that `directory` holds: criterion's in `criterion/`, and those in the lines of
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

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The figure that others held up longest, and how many times longer its median is than its
    /// fastest sample.
    pub fn most_disturbed(&self) -> Option<(&str, f64)> {
        self.0
            .iter()
            .filter_map(|(name, figure)| Some((name.as_str(), figure.disturbance()?)))
            .max_by(|(_, a), (_, b)| a.total_cmp(b))
    }

    /// The figure called `name`.
    pub fn get(&self, name: &str) -> Option<&Figure> {
        self.0.get(name)
    }

    /// All figures called `of/<number>`, with that number, from the smallest number on.
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

    /// A benchmark's results lie in folders named after its parts, `new/` in the last.
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
            let told: Told =
                serde_json::from_str(line).map_err(|source| FiguresError::Malformed {
                    path: path.to_owned(),
                    source,
                })?;
            self.0.insert(told.name.clone(), Figure::Told(told));
        }
        Ok(())
    }
}

impl Samples {
    /// Seconds of an iteration: the fastest, and the median. `None` without samples.
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
    /// The number that is shown, in `unit` and `scale` times; of a share of the peak, the time.
    ///
    /// # Errors
    /// [`Unfit`] when this figure has no such number.
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
            (Self::Told(told), Show::Value) if told.unit == unit => told.figure,
            (Self::Told(told), Show::Value) => return Err(foreign(&told.unit)),
            (Self::Timed { .. }, Show::Value) => return Err(Unfit::Timed),
            (Self::Told(_), Show::Rate | Show::Time | Show::PeakShare) => return Err(Unfit::Told),
        };
        Ok(value * scale)
    }

    /// The same figure by the median of its samples, if it was timed.
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
            Self::Told(_) => None,
        }
    }

    /// How many times longer than the fastest sample the median took, if it was timed.
    pub fn disturbance(&self) -> Option<f64> {
        match self {
            Self::Timed {
                secs, median_secs, ..
            } => Some(median_secs / secs),
            Self::Told(_) => None,
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

    /// Figures as criterion would have left them: name, nanoseconds, elements.
    pub(in super::super) fn timed(figures: &[(&str, f64, f64)]) -> Figures {
        let figure = |&(name, nanos, elements): &(&str, f64, f64)| {
            let secs = nanos / 1e9;
            let figure = Figure::Timed {
                secs,
                median_secs: secs,
                elements,
            };
            (name.to_owned(), figure)
        };
        Figures(figures.iter().map(figure).collect())
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
        let line = r#"{"name":"transport/records","figure":3e5,"unit":"records/s","baseline":"memcpy","baseline_figure":6e5}"#;
        fs::write(
            directory.path().join("transport.figures"),
            format!("a word\n{line}\n"),
        )
        .unwrap();

        let figures = Figures::read(directory.path()).unwrap();
        let timed = figures.get("replay/sample/1024").unwrap();
        assert_eq!(timed.shown(Show::Time, "µs", 1.0), Ok(0.5));
        assert_eq!(timed.shown(Show::Rate, "any", 0.5), Ok(1e6));
        assert_eq!(timed.disturbance(), Some(1.5));
        assert_eq!(
            timed.at_median().unwrap().shown(Show::Time, "µs", 1.0),
            Ok(0.75)
        );
        assert_eq!(timed.shown(Show::Value, "any", 1.0), Err(Unfit::Timed));
        let told = figures.get("transport/records").unwrap();
        assert_eq!(told.shown(Show::Value, "records/s", 1.0), Ok(3e5));
        let refused = told.shown(Show::Value, "steps/s", 1.0).unwrap_err();
        assert_eq!(refused.to_string(), "is in records/s, not in steps/s");
        assert_eq!(told.shown(Show::Rate, "records/s", 1.0), Err(Unfit::Told));

        fs::write(directory.path().join("bad.figures"), "{\"name\":1}\n").unwrap();
        let refused = Figures::read(directory.path()).unwrap_err().to_string();
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
