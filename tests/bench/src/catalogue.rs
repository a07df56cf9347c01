//! `tests/bench/benchmarks.toml`: which benchmarks there are, what they must reach, and what they are
//! compared with.

use serde::Deserialize;

/// The file, compiled in.
const FILE: &str = include_str!("../benchmarks.toml");

/// All of it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Catalogue {
    /// What is run, in this order.
    #[serde(rename = "bench")]
    pub benches: Vec<Bench>,
    /// The table.
    #[serde(rename = "row")]
    pub rows: Vec<Row>,
    /// The pictures of how cost grows.
    #[serde(rename = "growth")]
    pub growths: Vec<Growth>,
}

/// A benchmark target of some package.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bench {
    /// Its name for cargo, and the first part of the name of each of its figures.
    pub name: String,
    /// How it is run.
    #[serde(default)]
    pub kind: BenchKind,
    /// When it is run.
    #[serde(default)]
    pub when: When,
}

/// How a benchmark is run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BenchKind {
    /// By criterion, pinned to one core.
    #[default]
    OneCore,
    /// By itself, on all cores: it starts processes. It is given `--quick` or nothing, and prints a
    /// line of JSON for each figure: see [`figures`](super::figures).
    Processes,
}

/// When a benchmark is run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum When {
    /// Each time.
    #[default]
    Always,
    /// When pictures of growth are asked for.
    Growth,
}

/// A row of the table.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// What is measured, for readers.
    pub stage: String,
    /// Name of the figure: what criterion calls it, or a line of JSON.
    pub figure: String,
    /// How the figure is shown.
    pub show: Show,
    /// Unit it is shown in; of a time `s`, `ms`, `µs` or `ns`.
    pub unit: String,
    /// What it is multiplied by. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
    /// What it must reach, in `unit`; of a share of the peak, the share.
    pub at_least: Option<f64>,
    /// What it must not exceed, in `unit`.
    pub at_most: Option<f64>,
    /// What it is compared with. A figure that comes as JSON may bring its own.
    pub baseline: Option<Baseline>,
    /// How many times better than the baseline it must be.
    pub ratio_at_least: Option<f64>,
}

/// What a figure is compared with.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// For readers.
    pub what: String,
    /// Names of the figures whose times add up to it.
    pub of: Vec<String>,
}

/// How a figure is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Show {
    /// Elements a second.
    Rate,
    /// Time of one element.
    Time,
    /// Time of one iteration, whose elements are floating-point operations, and how much of the
    /// core's peak that is.
    PeakShare,
    /// As it comes; of figures that come as JSON.
    Value,
}

/// A picture of how cost grows with something.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Growth {
    /// File name without extension.
    pub picture: String,
    /// Above the picture.
    pub title: String,
    /// What grows.
    pub x: String,
    /// What it costs, with its unit.
    pub y: String,
    /// The lines.
    pub series: Vec<Series>,
}

/// A line of such a picture: all figures named `of/<number>`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Series {
    /// In the legend.
    pub label: String,
    /// The figures' names up to the number.
    pub of: String,
    /// How figures are shown.
    pub show: Show,
    /// Unit of a time; otherwise for readers.
    pub unit: String,
    /// What figures are multiplied by. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
}

const fn one() -> f64 {
    1.0
}

impl Catalogue {
    /// What the file says.
    ///
    /// # Panics
    /// When it cannot be read, which a test rules out.
    pub fn load() -> Self {
        toml::from_str(FILE).expect("tests/bench/benchmarks.toml is compiled in and tested")
    }
}

impl Row {
    /// How a figure that its baseline is made of is shown, and in what unit. Times add up, rates do
    /// not.
    pub(super) fn part_shown(&self) -> (Show, &str) {
        match self.show {
            Show::Rate | Show::Time => (Show::Time, "s"),
            Show::PeakShare => (Show::PeakShare, "s"),
            Show::Value => (Show::Value, &self.unit),
        }
    }
}

/// Name of the benchmark that a figure is from.
pub fn bench_of(figure: &str) -> &str {
    figure.split_once('/').map_or(figure, |(bench, _)| bench)
}

/// How many of a unit of time a second has; `None` of any other unit.
pub(super) fn per_second(unit: &str) -> Option<f64> {
    Some(match unit {
        "s" => 1.0,
        "ms" => 1e3,
        "µs" => 1e6,
        "ns" => 1e9,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fs;
    use std::path::Path;

    use super::*;

    #[test]
    fn the_file_makes_sense() {
        let catalogue: Catalogue = toml::from_str(FILE).unwrap();
        let timed = |show, unit: &str| match show {
            Show::Time | Show::PeakShare => per_second(unit).is_some(),
            Show::Rate | Show::Value => true,
        };
        for row in &catalogue.rows {
            assert!(
                timed(row.show, &row.unit),
                "{} is no unit of time: {}",
                row.unit,
                row.stage
            );
            assert!(
                row.at_least.is_none() || row.at_most.is_none(),
                "{}",
                row.stage
            );
            let compared = row
                .baseline
                .as_ref()
                .is_some_and(|baseline| !baseline.of.is_empty());
            assert!(
                row.ratio_at_least.is_none() || compared,
                "{} has no baseline",
                row.stage
            );
            for figure in row.baseline.iter().flat_map(|baseline| &baseline.of) {
                assert_eq!(
                    bench_of(figure),
                    bench_of(&row.figure),
                    "one run measures both"
                );
            }
        }
        for growth in &catalogue.growths {
            assert!(
                growth
                    .series
                    .iter()
                    .all(|series| timed(series.show, &series.unit))
            );
        }
        let named: BTreeSet<&str> = catalogue
            .benches
            .iter()
            .map(|bench| bench.name.as_str())
            .collect();
        let series = catalogue.growths.iter().flat_map(|growth| &growth.series);
        let figures = catalogue
            .rows
            .iter()
            .map(|row| &row.figure)
            .chain(series.map(|series| &series.of));
        for figure in figures {
            assert!(
                named.contains(bench_of(figure)),
                "no benchmark measures {figure}"
            );
        }
    }

    /// Of a package's manifest, what is needed.
    #[derive(Deserialize)]
    struct Manifest {
        #[serde(default)]
        bench: Vec<Target>,
        workspace: Option<Workspace>,
    }

    #[derive(Deserialize)]
    struct Target {
        name: String,
    }

    #[derive(Deserialize)]
    struct Workspace {
        members: Vec<String>,
    }

    #[test]
    fn the_file_names_the_benchmarks_that_there_are_and_no_other() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let manifest = |folder: &Path| -> Manifest {
            toml::from_str(&fs::read_to_string(folder.join("Cargo.toml")).unwrap()).unwrap()
        };
        let members = manifest(&root).workspace.unwrap().members;
        let there: BTreeSet<String> = members
            .iter()
            .flat_map(|member| manifest(&root.join(member)).bench)
            .map(|target| target.name)
            .collect();
        let named: BTreeSet<String> = Catalogue::load()
            .benches
            .into_iter()
            .map(|bench| bench.name)
            .collect();
        assert_eq!(named, there);
    }
}
