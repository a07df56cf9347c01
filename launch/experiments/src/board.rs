//! Progress of all runs of an experiment.
//!
//! A terminal gets one bar for the whole experiment, with a line for each active run. Any other
//! output gets a plain line every half minute. Output of the runs themselves goes to files beside
//! their directories.

use std::fmt::Write;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;

use skein_reports::Clock;
use skein_run::note;
use skein_run::terminal::{cut, stderr_columns, wrapped};

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(30);
/// Columns for the bar beside the first line of its text, with the space between.
const LEAST_BAR: usize = 4;

/// Stages of a run, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunStage {
    /// The run is trained and flies its evaluation courses.
    Training,
    /// Its best snapshot flies the experiment's suite.
    Suite,
}

/// Progress of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunProgress {
    /// Name of the run.
    pub name: String,
    /// Current stage.
    pub stage: RunStage,
    /// Number of training episodes learned from.
    pub episodes: u64,
    /// Number of training episodes of the complete run.
    pub total_episodes: u64,
    /// Walls passed per episode over the last window; `None` before the first episode.
    pub walls_passed: Option<f64>,
}

/// Progress of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct ExperimentProgress {
    /// Number of complete runs.
    pub complete: usize,
    /// Number of runs.
    pub runs: usize,
    /// Number of training episodes learned from, over all runs.
    pub episodes: u64,
    /// Number of training episodes of the experiment.
    pub total_episodes: u64,
    /// Active runs.
    pub under_way: Vec<RunProgress>,
}

/// Display of an experiment's progress.
pub struct ExperimentDisplay {
    surface: BoardOutput,
    started: Instant,
    /// Number of episodes when this session started.
    first_episodes: Option<u64>,
}

enum BoardOutput {
    Terminal(ProgressBar),
    Plain { last: Option<Instant> },
}

impl ExperimentDisplay {
    /// Returns a display on `bar`, or on this process's standard error if there is none.
    pub fn new(bar: Option<ProgressBar>) -> Self {
        Self {
            surface: bar.map_or(BoardOutput::Plain { last: None }, BoardOutput::Terminal),
            started: Instant::now(),
            first_episodes: None,
        }
    }

    /// Shows the progress.
    pub fn show(&mut self, progress: &ExperimentProgress) {
        let first = *self.first_episodes.get_or_insert(progress.episodes);
        let head = head(progress, self.started.elapsed().as_secs_f64(), first);
        match &mut self.surface {
            BoardOutput::Terminal(bar) => {
                bar.set_length(progress.total_episodes);
                bar.set_position(progress.episodes);
                let columns = stderr_columns();
                let head = wrapped(&head, columns.saturating_sub(LEAST_BAR));
                bar.set_message(format!("{head}{}", lines(&progress.under_way, columns)));
            }
            BoardOutput::Plain { last } => {
                if last.is_none_or(|when| when.elapsed() >= LINE_INTERVAL) {
                    *last = Some(Instant::now());
                    let runs: Vec<_> = progress.under_way.iter().map(RunProgress::brief).collect();
                    let line = [&[head], runs.as_slice()].concat().join(" · ");
                    note!("{}", wrapped(&line, stderr_columns()));
                }
            }
        }
    }

    /// Prints a line that stays visible.
    pub fn say(&self, text: &str) {
        match &self.surface {
            BoardOutput::Terminal(bar) => bar.suspend(|| note!("skein: {text}")),
            BoardOutput::Plain { .. } => note!("skein: {text}"),
        }
    }

    /// Removes the bar, so that other text can be printed.
    pub fn finish(&self) {
        if let BoardOutput::Terminal(bar) = &self.surface {
            bar.finish_and_clear();
        }
    }
}

fn head(progress: &ExperimentProgress, elapsed_secs: f64, first_episodes: u64) -> String {
    let ExperimentProgress {
        complete,
        runs,
        episodes,
        total_episodes,
        ..
    } = *progress;
    let mut text = format!(
        "{complete} of {runs} runs complete · {}",
        Clock(elapsed_secs)
    );
    let pace = episodes.saturating_sub(first_episodes) as f64 / elapsed_secs;
    let left = total_episodes.saturating_sub(episodes) as f64;
    if pace > 0.0 && left > 0.0 {
        let _ = write!(text, ", about {} left", Clock(left / pace));
    }
    text
}

/// Returns a line of at most `columns` per run, for display below the bar.
fn lines(under_way: &[RunProgress], columns: usize) -> String {
    let width = under_way
        .iter()
        .map(|run| run.name.chars().count())
        .max()
        .unwrap_or(0);
    let line = |run: &RunProgress| {
        let text = format!("  {:width$}  {}", run.name, run.figures());
        format!("\n{}", cut(&text, columns))
    };
    under_way.iter().map(line).collect()
}

impl RunProgress {
    fn brief(&self) -> String {
        format!("{} {}", self.name, self.figures())
    }

    fn figures(&self) -> String {
        if self.stage == RunStage::Suite {
            return "flying the suite".to_owned();
        }
        let mut text = match self.episodes >= self.total_episodes {
            true => "evaluating".to_owned(),
            false => format!("episode {}/{}", self.episodes, self.total_episodes),
        };
        if let Some(walls) = self.walls_passed {
            let _ = write!(text, ", walls passed {walls:.2}");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remaining_time_follows_from_the_episodes_of_this_session() {
        let progress = ExperimentProgress {
            complete: 3,
            runs: 12,
            episodes: 600,
            total_episodes: 1100,
            under_way: vec![
                RunProgress {
                    name: "none/seed-2".to_owned(),
                    stage: RunStage::Training,
                    episodes: 50,
                    total_episodes: 100,
                    walls_passed: Some(1.234),
                },
                RunProgress {
                    name: "half/seed-10".to_owned(),
                    stage: RunStage::Training,
                    episodes: 100,
                    total_episodes: 100,
                    walls_passed: None,
                },
                RunProgress {
                    name: "half/seed-9".to_owned(),
                    stage: RunStage::Suite,
                    episodes: 100,
                    total_episodes: 100,
                    walls_passed: Some(4.5),
                },
            ],
        };
        // 300 episodes existed before; the other 300 took 60 s.
        assert_eq!(
            head(&progress, 60.0, 300),
            "3 of 12 runs complete · 1:00, about 1:40 left"
        );
        assert_eq!(head(&progress, 60.0, 600), "3 of 12 runs complete · 1:00");
        assert_eq!(
            lines(&progress.under_way, 80),
            "\n  none/seed-2   episode 50/100, walls passed 1.23\n  half/seed-10  evaluating\n  \
             half/seed-9   flying the suite"
        );
    }
}
