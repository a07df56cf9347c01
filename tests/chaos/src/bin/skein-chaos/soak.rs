//! Soak test: a long run with actors coming and going, watched for anything that grows.
//!
//! Learner, supervisor and one actor, the elder, are spared, so that they run throughout. The other
//! actors are killed, frozen, attached and removed all the time. Some growth at first is normal,
//! such as a filling replay buffer. A suitable configuration completes it within the warm-up;
//! everything must be flat afterwards.

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_chaos::{Footprint, ListedProcess, Role, Usage, footprint};
use skein_protocol::ids::RunId;
use skein_run::RunDirectory;

use crate::plan::{DetachSignal, Disturbance};
use crate::statistics::{Trend, most_frequent};
use crate::storm::{Script, Storm};

/// Time between two samples.
const SAMPLE: Duration = Duration::from_secs(5);
/// Average time between two disturbances.
const CHURN: Duration = Duration::from_secs(3);
/// Share of the soak that is warm-up. Its samples are written but not judged.
const WARM_UP: f64 = 0.2;
/// Largest number of `skein attach` processes at a time.
const CREWS: usize = 3;
/// Tolerated growth, as a share of the value.
const TOLERANCE: f64 = 0.05;

/// Sampled series.
const SERIES: [SoakSeries; 13] = [
    SoakSeries::new("learner", "resident MiB", 4.0),
    SoakSeries::new("learner", "anonymous MiB", 4.0),
    SoakSeries::new("learner", "descriptors", 4.0),
    SoakSeries::new("learner", "threads", 1.0),
    SoakSeries::new("supervisor", "resident MiB", 1.0),
    SoakSeries::new("supervisor", "descriptors", 4.0),
    SoakSeries::new("elder actor", "resident MiB", 1.0),
    SoakSeries::new("elder actor", "anonymous MiB", 1.0),
    SoakSeries::new("elder actor", "descriptors", 4.0),
    SoakSeries::new("elder actor", "threads", 1.0),
    SoakSeries::new("machine", "shared-memory segments", 8.0),
    SoakSeries::new("machine", "shared-memory MiB", 4.0),
    SoakSeries::new("machine", "files in /tmp", 16.0),
];

/// One sampled quantity.
#[derive(Debug, Clone, Copy)]
struct SoakSeries {
    whose: &'static str,
    what: &'static str,
    /// Tolerated growth whatever the value: the change caused by an actor or two.
    at_least: f64,
}

impl SoakSeries {
    const fn new(whose: &'static str, what: &'static str, at_least: f64) -> Self {
        Self {
            whose,
            what,
            at_least,
        }
    }
}

/// Values of all series at one time; `None` if the process did not exist.
type Sample = [Option<f64>; SERIES.len()];

/// Disturbs a run for a given time, samples its resources, then ends it.
#[derive(Debug)]
pub(crate) struct Soak {
    run: RunDirectory,
    id: Option<RunId>,
    length: Duration,
    started: Instant,
    generator: Pcg64Mcg,
    next_disturbance: Instant,
    next_sample: Instant,
    ending: SoakEnding,
    table: File,
    samples: Vec<SampledMoment>,
}

/// Samples of one time.
#[derive(Debug)]
struct SampledMoment {
    secs: f64,
    /// Number of the run's processes.
    processes: usize,
    sample: Sample,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SoakEnding {
    NotYet,
    Interrupted,
}

impl Soak {
    /// Creates a soak test of `run`. Samples go to the new file `table`, as CSV.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub(crate) fn new(
        run: &RunDirectory,
        length: Duration,
        seed: u64,
        table: &Path,
    ) -> Result<Self> {
        let mut file =
            File::create(table).with_context(|| format!("cannot write {}", table.display()))?;
        let columns: Vec<_> = SERIES
            .iter()
            .map(|series| format!("{} {}", series.whose, series.what).replace(' ', "_"))
            .collect();
        writeln!(file, "secs,episodes,processes,{}", columns.join(","))?;
        let now = Instant::now();
        Ok(Self {
            run: run.clone(),
            id: None,
            length,
            started: now,
            generator: Pcg64Mcg::seed_from_u64(seed),
            next_disturbance: now + CHURN,
            next_sample: now + SAMPLE,
            ending: SoakEnding::NotYet,
            table: file,
            samples: Vec::new(),
        })
    }

    fn disturb(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        let choice = self.generator.random();
        let what = match self.generator.random_range(0..10) {
            0..6 => Disturbance::KillActor { choice },
            6 => Disturbance::FreezeActor {
                choice,
                secs: self.generator.random_range(0.1..8.0),
            },
            7..9 if storm.crews() < CREWS => Disturbance::Attach {
                count: self.generator.random_range(1..=2),
            },
            _ => Disturbance::Detach {
                choice,
                manner: if self.generator.random_bool(0.5) {
                    DetachSignal::Interrupt
                } else {
                    DetachSignal::Kill
                },
            },
        };
        // A missing process does not matter: others follow.
        storm.disturb(what)?;
        let pause = CHURN.mul_f64(self.generator.random_range(0.2..1.8));
        self.next_disturbance = Instant::now() + pause;
        Ok(())
    }

    fn sample(&mut self, storm: &Storm<'_>) -> Result<()> {
        self.next_sample = Instant::now() + SAMPLE;
        if self.id.is_none() {
            self.id = self.run.open().ok().map(|(identity, _)| identity.run);
        }
        let processes = storm.processes();
        let usage = |role| {
            let eldest: Option<&ListedProcess> =
                processes.iter().find(|process| process.role() == role);
            eldest.and_then(|process| process.usage().ok())
        };
        let sample = figures(
            usage(Role::Learner),
            usage(Role::Supervisor),
            usage(Role::Actor),
            self.id.map(footprint).unwrap_or_default(),
        );
        let secs = self.started.elapsed().as_secs_f64();
        let cells: Vec<_> = sample
            .iter()
            .map(|value| value.map(|value| format!("{value:.3}")).unwrap_or_default())
            .collect();
        writeln!(
            self.table,
            "{secs:.1},{},{},{}",
            storm.episodes(),
            processes.len(),
            cells.join(",")
        )?;
        self.samples.push(SampledMoment {
            secs,
            processes: processes.len(),
            sample,
        });
        Ok(())
    }

    /// Returns the trend of each series after the warm-up. Only the moments with the most common
    /// number of processes count, because each additional process brings files, segments and
    /// descriptors with it.
    pub(crate) fn findings(&self) -> Vec<Finding> {
        let warm = self.length.as_secs_f64() * WARM_UP;
        let hours = (self.length.as_secs_f64() - warm) / 3600.0;
        let judged: Vec<_> = self
            .samples
            .iter()
            .filter(|moment| moment.secs >= warm)
            .collect();
        let attendance = most_frequent(judged.iter().map(|moment| moment.processes));
        let finding = |(index, series): (usize, &SoakSeries)| {
            let values: Vec<_> = judged
                .iter()
                .filter(|moment| Some(moment.processes) == attendance)
                .filter_map(|moment| Some((moment.secs, moment.sample[index]?)))
                .collect();
            let trend = Trend::of(&values);
            let tolerance =
                trend.map_or(0.0, |trend| (trend.first * TOLERANCE).max(series.at_least));
            Finding {
                whose: series.whose,
                what: series.what,
                trend,
                tolerance,
                flat: trend.is_some_and(|trend| trend.is_flat(tolerance, hours)),
            }
        };
        SERIES.iter().enumerate().map(finding).collect()
    }
}

/// Trend of a series over the soak.
#[derive(Debug)]
pub(crate) struct Finding {
    pub(crate) whose: &'static str,
    pub(crate) what: &'static str,
    /// Trend; `None` with too few samples.
    pub(crate) trend: Option<Trend>,
    /// Tolerated growth.
    pub(crate) tolerance: f64,
    /// `true` if it grew by no more than that.
    pub(crate) flat: bool,
}

/// Returns the values in the order of [`SERIES`].
fn figures(
    learner: Option<Usage>,
    supervisor: Option<Usage>,
    elder: Option<Usage>,
    footprint: Footprint,
) -> Sample {
    let mebibytes = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let resident = |usage: Option<Usage>| usage.map(|usage| mebibytes(usage.resident_bytes));
    let anonymous = |usage: Option<Usage>| usage.map(|usage| mebibytes(usage.anonymous_bytes));
    let descriptors = |usage: Option<Usage>| usage.map(|usage| usage.descriptors as f64);
    let threads = |usage: Option<Usage>| usage.map(|usage| usage.threads as f64);
    [
        resident(learner),
        anonymous(learner),
        descriptors(learner),
        threads(learner),
        resident(supervisor),
        descriptors(supervisor),
        resident(elder),
        anonymous(elder),
        descriptors(elder),
        threads(elder),
        Some(footprint.segments as f64),
        Some(mebibytes(footprint.segment_bytes)),
        Some(footprint.transport_entries as f64),
    ]
}

impl Script for Soak {
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        if self.ending == SoakEnding::Interrupted {
            return Ok(());
        }
        if Instant::now() >= self.next_sample {
            self.sample(storm)?;
        }
        if self.started.elapsed() >= self.length {
            self.ending = SoakEnding::Interrupted;
            return storm.interrupt();
        }
        if Instant::now() >= self.next_disturbance {
            self.disturb(storm)?;
        }
        Ok(())
    }
}
