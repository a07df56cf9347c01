//! Metrics of a training run: `episodes.csv`, TensorBoard curves, and averages over the latest
//! episodes.
//!
//! All three are keyed by committed episode, not by time. So two runs of one configuration have the
//! same curves, whatever machines flew them, and a resumed run continues where its checkpoint was
//! taken.

mod episodes;
mod events;
mod faults;
mod messages;
mod pictures;
mod scalars;
mod window;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use skein_protocol::config::Config;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::transition::Outcome;
use skein_protocol::{REWARD_TERM_NAMES, REWARD_TERMS};
use skein_run::RunDirectory;

use crate::disk::Disk;
use crate::episode::CommittedEpisode;

pub use episodes::{EpisodeRow, EpisodesCsv, EpisodesError, EpisodesExtent};
pub use events::{EventError, EventFile, EventWriter};
pub use faults::fault_points;
pub use scalars::Scalar;
pub use window::MovingAverage;

use messages::SummaryValue;

/// Folder of curves over environment steps, within that of the curves over episodes. TensorBoard
/// shows it as a run of its own.
const OVER_STEPS: &str = "over_steps";

/// Averages over the latest training episodes; part of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpisodeWindows {
    /// Average return.
    pub total_reward: MovingAverage,
    /// Average number of walls passed; decides which snapshots are candidates.
    pub walls_passed: MovingAverage,
}

impl EpisodeWindows {
    /// Empty averages over `episodes` episodes.
    pub fn new(episodes: usize) -> Self {
        Self {
            total_reward: MovingAverage::new(episodes),
            walls_passed: MovingAverage::new(episodes),
        }
    }

    /// `true` if both averages are over `episodes` episodes, see [`MovingAverage::is_over`].
    pub fn are_over(&self, episodes: usize) -> bool {
        self.total_reward.is_over(episodes) && self.walls_passed.is_over(episodes)
    }
}

/// Extent of a run's metrics; part of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MetricsState {
    /// Number of rows in `episodes.csv`.
    pub episodes: u64,
    /// Length and checksum of those rows.
    pub episodes_extent: EpisodesExtent,
    /// Event files with their lengths.
    pub events: Vec<EventFile>,
    /// Averages over the latest episodes.
    pub windows: EpisodeWindows,
}

impl MetricsState {
    /// State of a new run, with averages over `window_episodes` episodes.
    pub fn new(window_episodes: usize) -> Self {
        Self {
            episodes: 0,
            episodes_extent: EpisodesExtent::empty(),
            events: Vec::new(),
            windows: EpisodeWindows::new(window_episodes),
        }
    }
}

impl MetricsState {
    /// Checks that `episodes.csv` of `run` begins with the content it had when this state was
    /// taken.
    ///
    /// # Errors
    /// [`MetricsError::Episodes`] says what is wrong with the file.
    pub fn check(&self, run: &RunDirectory) -> Result<(), MetricsError> {
        Ok(self
            .episodes_extent
            .check(&run.episodes_csv(), self.episodes)?)
    }
}

/// Writes all metrics of a training run.
#[derive(Debug)]
pub struct Metrics {
    run: RunDirectory,
    rows: u64,
    episodes: EpisodesCsv,
    events: EventWriter,
    /// The windows' curves over environment steps.
    events_over_steps: EventWriter,
    /// Environment steps of all rows.
    steps: u64,
    windows: EpisodeWindows,
    /// Episodes of the window that reached the end: 1 or 0. Read from the rows when a run resumes.
    successes: MovingAverage,
}

/// Reason why metrics cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    /// Error of `episodes.csv`.
    #[error(transparent)]
    Episodes(#[from] EpisodesError),
    /// Error of the event file.
    #[error(transparent)]
    Events(#[from] EventError),
    /// A picture cannot be encoded.
    #[error("cannot draw a picture for TensorBoard: {0}")]
    Picture(#[from] png::EncodingError),
}

impl Metrics {
    /// Continues from `state`. Everything written later is dropped, so that nothing is recorded
    /// twice; for a new run, that is everything.
    ///
    /// # Errors
    /// [`MetricsError`] names the file. `episodes.csv` must begin with the content it had when
    /// `state` was taken.
    pub fn resume(
        run: &RunDirectory,
        state: MetricsState,
        disk: &Disk,
    ) -> Result<Self, MetricsError> {
        state.check(run)?;
        let MetricsState {
            episodes,
            episodes_extent: _,
            events,
            windows,
        } = state;
        let prefix = format!("{OVER_STEPS}/");
        let (over_steps, events): (Vec<_>, Vec<_>) = events
            .into_iter()
            .partition(|file| file.name.starts_with(&prefix));
        let over_steps = over_steps.into_iter().map(|file| EventFile {
            name: file.name.replacen(&prefix, "", 1),
            ..file
        });
        let mut successes = MovingAverage::new(windows.total_reward.window());
        let mut steps = 0;
        let episodes_csv = EpisodesCsv::resume(&run.episodes_csv(), episodes, disk, |row| {
            steps += row.steps as u64;
            successes.push(success(row.outcome));
        })?;
        let tensorboard = run.tensorboard();
        let folder = tensorboard.join(OVER_STEPS);
        Ok(Self {
            run: run.clone(),
            rows: episodes,
            episodes: episodes_csv,
            events: EventWriter::resume(&tensorboard, events, episodes, disk)?,
            events_over_steps: EventWriter::resume(&folder, over_steps.collect(), steps, disk)?,
            steps,
            windows,
            successes,
        })
    }

    /// Describes the run to TensorBoard: its configuration as text, and the settings that differ
    /// from the defaults as hyperparameters.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn describe(&mut self, config: &Config) -> Result<(), MetricsError> {
        let curves = [
            Scalar::WindowReturn,
            Scalar::WindowWallsPassed,
            Scalar::WindowSuccessRate,
            Scalar::EvaluationWallsPassed,
        ];
        let changed = config.changed_settings();
        let curves = curves.map(Scalar::tag);
        let mut values = Vec::from(SummaryValue::hyperparameters(
            &changed,
            &curves,
            events::now_secs(),
        ));
        let toml = format!("```toml\n{}```\n", config.to_toml());
        values.push(SummaryValue::text("configuration", toml));
        Ok(self.events.summary(self.rows, values)?)
    }

    /// Adds depth images above their reconstructions, `[n, 72, 128]` each, at training episode
    /// `episode`.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn reconstructions(
        &mut self,
        episode: u64,
        depth: &[u8],
        reconstruction: &[u8],
    ) -> Result<(), MetricsError> {
        let picture = pictures::above_each_other(depth, reconstruction)?;
        let value = SummaryValue::picture(pictures::TAG, picture.size, picture.png);
        Ok(self.events.summary(episode, vec![value])?)
    }

    /// Appends a point to each course's curves, `evaluation/COURSE/…`, at training episode
    /// `episode`.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn evaluation(
        &mut self,
        episode: u64,
        report: &EvaluationReport,
    ) -> Result<(), MetricsError> {
        let points: Vec<(String, f64)> = report
            .courses
            .iter()
            .flat_map(|course| {
                let tag = |what: &str| format!("evaluation/{}/{what}", course.course);
                [
                    (tag("walls_passed_rate"), course.r),
                    (tag("completed"), course.completed),
                    (tag("return"), course.mean_return),
                ]
            })
            .collect();
        let points: Vec<_> = points
            .iter()
            .map(|(tag, value)| (tag.as_str(), *value))
            .collect();
        Ok(self.events.scalars(episode, &points)?)
    }

    /// Returns the present extent. It holds for the files once they are [flushed](Metrics::flush).
    pub fn state(&self) -> MetricsState {
        MetricsState {
            episodes: self.rows,
            episodes_extent: self.episodes.extent(),
            events: self.event_files(),
            windows: self.windows.clone(),
        }
    }

    /// Files on whose content a checkpoint of the [state](Metrics::state) relies.
    pub fn files(&self) -> Vec<PathBuf> {
        let folder = self.run.tensorboard();
        let events = self.event_files();
        let events = events.iter().map(|file| folder.join(&file.name));
        // A lost file cannot be relied on.
        let events = events.filter(|path| path.exists());
        std::iter::once(self.run.episodes_csv())
            .chain(events)
            .collect()
    }

    /// Returns the event files with their lengths; names are relative to the folder of the curves.
    fn event_files(&self) -> Vec<EventFile> {
        let over_steps = self.events_over_steps.files().iter();
        let over_steps = over_steps.map(|file| EventFile {
            name: format!("{OVER_STEPS}/{}", file.name),
            bytes: file.bytes,
        });
        self.events
            .files()
            .iter()
            .cloned()
            .chain(over_steps)
            .collect()
    }

    /// Records a committed training episode. Call in episode order.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn episode(&mut self, episode: &CommittedEpisode) -> Result<(), MetricsError> {
        let row = EpisodeRow::from(episode);
        self.episodes.write(&row)?;
        self.rows += 1;
        self.windows.total_reward.push(row.total_reward);
        self.windows.walls_passed.push(f32::from(row.walls_passed));
        let window = |average: &MovingAverage| average.mean().unwrap_or_default();
        let terms = reward_parts(&episode.reward_terms);
        let mut points = vec![
            (Scalar::Return.tag(), row.total_reward.into()),
            (Scalar::WallsPassed.tag(), row.walls_passed.into()),
            (Scalar::Steps.tag(), row.steps as f64),
        ];
        points.extend(terms.iter().map(|(tag, part)| (tag.as_str(), *part)));
        self.successes.push(success(row.outcome));
        self.steps += row.steps as u64;
        let means = [
            (Scalar::WindowReturn, &self.windows.total_reward),
            (Scalar::WindowWallsPassed, &self.windows.walls_passed),
            (Scalar::WindowSuccessRate, &self.successes),
        ]
        .map(|(scalar, average)| (scalar.tag(), window(average)));
        self.events_over_steps.scalars(self.steps, &means)?;
        points.extend(means);
        Ok(self.events.scalars(row.episode, &points)?)
    }

    /// Appends a point to some curves, at training episode `episode`.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn scalars(&mut self, episode: u64, values: &[(Scalar, f64)]) -> Result<(), MetricsError> {
        let values: Vec<_> = values
            .iter()
            .map(|&(scalar, value)| (scalar.tag(), value))
            .collect();
        Ok(self.events.scalars(episode, &values)?)
    }

    /// Hands everything written to the operating system. Called once per epoch, and before a
    /// checkpoint that relies on it.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn flush(&mut self) -> Result<(), MetricsError> {
        self.episodes.flush()?;
        self.events_over_steps.flush()?;
        Ok(self.events.flush()?)
    }

    /// Averages over the latest episodes.
    pub fn windows(&self) -> &EpisodeWindows {
        &self.windows
    }
}

/// Returns 1 for an episode that reached the end.
fn success(outcome: Outcome) -> f32 {
    f32::from(u8::from(outcome == Outcome::ReachedEnd))
}

/// Returns the part of each reward term in the return, with its curve's name.
fn reward_parts(steps: &[[f32; REWARD_TERMS]]) -> [(String, f64); REWARD_TERMS] {
    std::array::from_fn(|index| {
        let part = steps.iter().map(|terms| f64::from(terms[index])).sum();
        (format!("reward/{}", REWARD_TERM_NAMES[index]), part)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::episode::samples;

    fn run() -> (tempfile::TempDir, RunDirectory) {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        (directory, run)
    }

    fn feed(metrics: &mut Metrics, episodes: std::ops::Range<u64>) {
        for number in episodes {
            let outcome = match number % 3 {
                0 => Outcome::ReachedEnd,
                _ => Outcome::Collided,
            };
            let mut episode = samples::episode(number, 4, outcome);
            episode.walls_passed = (number % 4) as u8;
            metrics.episode(&episode).unwrap();
        }
        metrics.flush().unwrap();
    }

    fn metrics(run: &RunDirectory, state: MetricsState) -> Metrics {
        Metrics::resume(run, state, &Disk::new(std::sync::Arc::default())).unwrap()
    }

    fn new() -> MetricsState {
        MetricsState::new(5)
    }

    /// Every point of every curve, ordered by tag and step.
    fn points(run: &RunDirectory) -> Vec<(String, i64, u32)> {
        let mut points = Vec::new();
        for folder in [run.tensorboard(), run.tensorboard().join(OVER_STEPS)] {
            let entries = std::fs::read_dir(folder).unwrap();
            let paths = entries.map(|entry| entry.unwrap().path());
            for file in paths.filter(|path| path.is_file()) {
                let bytes = std::fs::read(file).unwrap();
                points.extend(events::testing::points(&bytes));
            }
        }
        points.sort();
        points
    }

    #[test]
    fn a_resumed_run_has_the_rows_points_and_averages_of_one_never_interrupted() {
        let ((_whole, whole_run), (_resumed, resumed_run)) = (run(), run());
        let mut whole = metrics(&whole_run, new());
        feed(&mut whole, 0..20);

        let mut first = metrics(&resumed_run, new());
        feed(&mut first, 0..12);
        let at_checkpoint = first.state();
        feed(&mut first, 12..17);
        drop(first);
        // An incarnation that leaves no checkpoint leaves no point.
        let mut lost = metrics(&resumed_run, at_checkpoint.clone());
        feed(&mut lost, 12..19);
        drop(lost);
        let mut last = metrics(&resumed_run, at_checkpoint);
        feed(&mut last, 12..20);

        assert_eq!(last.windows(), whole.windows());
        assert_eq!((last.steps, &last.successes), (80, &whole.successes));
        assert_eq!(whole.windows().walls_passed.mean(), Some(9.0 / 5.0));
        let read = |run: &RunDirectory| std::fs::read_to_string(run.episodes_csv()).unwrap();
        assert_eq!(read(&resumed_run), read(&whole_run));
        assert_eq!(read(&whole_run).lines().count(), 21);
        assert_eq!(points(&resumed_run), points(&whole_run));
        assert_eq!(
            last.files().len(),
            5,
            "episodes.csv, and two event files for each axis"
        );
    }

    #[test]
    fn every_reward_term_has_a_curve_of_its_part_in_the_return() {
        let (_directory, run) = run();
        let mut metrics = metrics(&run, new());
        let mut episode = samples::episode(0, 2, Outcome::Collided);
        let of_step = |step: f32| std::array::from_fn(|index| step * (index as f32 + 1.0));
        episode.reward_terms = vec![of_step(1.0), of_step(-4.0)];
        metrics.episode(&episode).unwrap();
        metrics.flush().unwrap();
        let parts = points(&run)
            .into_iter()
            .filter(|(tag, ..)| tag.starts_with("reward/"))
            .map(|(tag, _, bits)| (tag, f32::from_bits(bits)));
        let expected: std::collections::BTreeMap<_, _> = (1u8..)
            .zip(REWARD_TERM_NAMES)
            .map(|(number, name)| (format!("reward/{name}"), -3.0 * f32::from(number)))
            .collect();
        assert!(parts.eq(expected));
    }

    #[test]
    fn an_incarnation_killed_before_its_first_checkpoint_leaves_nothing() {
        let (_directory, run) = run();
        feed(&mut metrics(&run, new()), 0..7);
        std::fs::write(run.tensorboard().join("notes.txt"), "not ours").unwrap();
        let mut again = metrics(&run, new());
        again.flush().unwrap();
        assert_eq!(std::fs::read_to_string(run.episodes_csv()).unwrap(), "");
        assert_eq!(
            std::fs::read_dir(run.tensorboard()).unwrap().count(),
            3,
            "the new file, the folder of curves over steps, and the foreign file"
        );
    }

    #[test]
    fn a_lost_event_file_does_not_prevent_training() {
        let (_directory, run) = run();
        let mut first = metrics(&run, new());
        feed(&mut first, 0..3);
        let state = first.state();
        std::fs::remove_dir_all(run.tensorboard()).unwrap();
        let mut second = metrics(&run, state);
        feed(&mut second, 3..6);
        assert_eq!(second.files().len(), 3);
        assert_eq!(points(&run).len(), 3 * (6 + 3 + REWARD_TERMS));
    }
}
