//! Catalogue of the benchmarks (`tests/bench/benchmarks.toml`), with their targets and baselines.

use serde::Deserialize;

/// Contents of the file, compiled in.
const FILE: &str = include_str!("../benchmarks.toml");

/// Contents of the catalogue.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Catalogue {
    /// Benchmarks, in the order in which they run.
    #[serde(rename = "bench")]
    pub benches: Vec<Bench>,
    /// Rows of the table.
    #[serde(rename = "row")]
    pub rows: Vec<BenchmarkRow>,
    /// Pictures of how cost grows.
    #[serde(rename = "growth")]
    pub growths: Vec<Growth>,
}

/// A benchmark target of a package.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bench {
    /// Its name for cargo, and the first part of the name of each of its figures.
    pub name: String,
    /// Its kind, which decides how it is started.
    #[serde(default)]
    pub kind: BenchKind,
    /// Condition on which it runs.
    #[serde(default)]
    pub when: RunCondition,
}

/// Kind of a benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BenchKind {
    /// By criterion, pinned to one core.
    #[default]
    OneCore,
    /// On all cores, because it starts processes. It accepts `--quick` and prints a line of JSON
    /// per figure: see [`figures`](super::figures).
    Processes,
}

/// Condition on which a benchmark runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunCondition {
    /// It always runs.
    #[default]
    Always,
    /// It runs if pictures of growth are requested.
    Growth,
    /// It runs if `--only` names it.
    Named,
}

/// BenchmarkRow of the table.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchmarkRow {
    /// Stage that is measured, for readers.
    pub stage: String,
    /// Name of the figure, from criterion or from a line of JSON.
    pub figure: String,
    /// Form in which the figure is shown.
    pub show: Show,
    /// Unit of the shown figure; for a time `s`, `ms`, `µs` or `ns`.
    pub unit: String,
    /// Factor applied to the figure. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
    /// Lower limit, in `unit`; for a share of the peak, as a share.
    pub at_least: Option<f64>,
    /// Upper limit, in `unit`.
    pub at_most: Option<f64>,
    /// Baseline to compare with. A figure from a line of JSON may have its own.
    pub baseline: Option<Baseline>,
    /// Required improvement over the baseline, as a factor.
    pub ratio_at_least: Option<f64>,
}

/// Baseline of a figure.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Description for readers.
    pub what: String,
    /// Names of the figures whose times add up to the baseline.
    pub of: Vec<String>,
}

/// Form in which a figure is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Show {
    /// Elements per second.
    Rate,
    /// Time per element.
    Time,
    /// Time per iteration, whose elements are floating-point operations, and the share of the
    /// core's peak.
    PeakShare,
    /// The value itself, for figures from lines of JSON.
    Value,
}

/// Picture of how a cost grows with a size.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Growth {
    /// File name without extension.
    pub picture: String,
    /// Title above the picture.
    pub title: String,
    /// Label of the x axis: the size.
    pub x: String,
    /// Label of the y axis: the cost, with its unit.
    pub y: String,
    /// Lines of the picture.
    pub series: Vec<GrowthSeries>,
}

/// Line of a growth picture: all figures named `of/<number>`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GrowthSeries {
    /// Label in the legend.
    pub label: String,
    /// Names of the figures up to the number.
    pub of: String,
    /// Form in which the figures are shown.
    pub show: Show,
    /// Unit of a time; otherwise for readers.
    pub unit: String,
    /// Factor applied to the figures. Default 1.
    #[serde(default = "one")]
    pub scale: f64,
}

const fn one() -> f64 {
    1.0
}

impl Catalogue {
    /// Returns the contents of the file.
    ///
    /// # Panics
    /// Panics if the file is invalid, which a test rules out.
    pub fn load() -> Self {
        toml::from_str(FILE).expect("tests/bench/benchmarks.toml is compiled in and tested")
    }
}

impl BenchmarkRow {
    /// Returns the form and unit for figures of the row's baseline. Times can be added up, rates
    /// cannot.
    pub(super) fn part_shown(&self) -> (Show, &str) {
        match self.show {
            Show::Rate | Show::Time => (Show::Time, "s"),
            Show::PeakShare => (Show::PeakShare, "s"),
            Show::Value => (Show::Value, &self.unit),
        }
    }
}

/// Returns the name of the benchmark of a figure.
pub fn bench_of(figure: &str) -> &str {
    figure.split_once('/').map_or(figure, |(bench, _)| bench)
}

/// Returns the number of such units in a second; `None` if it is not a unit of time.
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
    fn the_file_is_consistent() {
        let catalogue: Catalogue = toml::from_str(FILE).unwrap();
        let timed = |show, unit: &str| match show {
            Show::Time | Show::PeakShare => per_second(unit).is_some(),
            Show::Rate | Show::Value => true,
        };
        for row in &catalogue.rows {
            assert!(
                timed(row.show, &row.unit),
                "{} is not a unit of time: {}",
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

    /// Needed part of a package's manifest.
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
    fn the_file_names_exactly_the_existing_benchmarks() {
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
