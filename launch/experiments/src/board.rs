//! The progress of all runs of an experiment in one place.
//!
//! A terminal gets one bar for the whole experiment with a line for each run under way; anything
//! else a plain line now and then. What a run itself says goes to a file beside its directory.

use std::fmt::Write;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;

use skein_reports::Clock;

/// Between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(30);

/// What is done for a run, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// It is trained, and flies its evaluation courses.
    Training,
    /// Its best snapshot flies the experiment's suite.
    Suite,
}

/// How far one run has come.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// The run.
    pub name: String,
    /// What is done for it.
    pub stage: Stage,
    /// Training episodes learned from.
    pub episodes: u64,
    /// Training episodes of the whole run.
    pub total_episodes: u64,
    /// Walls passed an episode over the last window; `None` before there is an episode.
    pub walls_passed: Option<f64>,
}

/// How far an experiment has come.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// Runs that are complete.
    pub complete: usize,
    /// Runs in the whole experiment.
    pub runs: usize,
    /// Training episodes learned from, in all runs.
    pub episodes: u64,
    /// Training episodes of the whole experiment.
    pub total_episodes: u64,
    /// The runs under way.
    pub under_way: Vec<Standing>,
}

/// Shows how an experiment gets on.
pub struct Board {
    surface: Surface,
    started: Instant,
    /// Episodes that were there when it started.
    first_episodes: Option<u64>,
}

enum Surface {
    Terminal(ProgressBar),
    Plain { last: Option<Instant> },
}

impl Board {
    /// A board on `bar`, which is on a terminal; without one, on this process's standard error.
    pub fn new(bar: Option<ProgressBar>) -> Self {
        Self {
            surface: bar.map_or(Surface::Plain { last: None }, Surface::Terminal),
            started: Instant::now(),
            first_episodes: None,
        }
    }

    /// Shows where the experiment is.
    pub fn show(&mut self, progress: &Progress) {
        let first = *self.first_episodes.get_or_insert(progress.episodes);
        let head = head(progress, self.started.elapsed().as_secs_f64(), first);
        match &mut self.surface {
            Surface::Terminal(bar) => {
                bar.set_length(progress.total_episodes);
                bar.set_position(progress.episodes);
                bar.set_message(format!("{head}{}", lines(&progress.under_way)));
            }
            Surface::Plain { last } => {
                if last.is_none_or(|when| when.elapsed() >= LINE_INTERVAL) {
                    *last = Some(Instant::now());
                    let runs: Vec<_> = progress.under_way.iter().map(Standing::brief).collect();
                    eprintln!("{}", [&[head], runs.as_slice()].concat().join(" · "));
                }
            }
        }
    }

    /// Says something that stays.
    pub fn say(&self, text: &str) {
        match &self.surface {
            Surface::Terminal(bar) => bar.suspend(|| eprintln!("skein: {text}")),
            Surface::Plain { .. } => eprintln!("skein: {text}"),
        }
    }

    /// Removes the bar, so that other things can be printed.
    pub fn finish(&self) {
        if let Surface::Terminal(bar) = &self.surface {
            bar.finish_and_clear();
        }
    }
}

fn head(progress: &Progress, elapsed_secs: f64, first_episodes: u64) -> String {
    let Progress {
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
        let _ = write!(text, ", some {} left", Clock(left / pace));
    }
    text
}

/// A line for each run, under the bar.
fn lines(under_way: &[Standing]) -> String {
    let width = under_way
        .iter()
        .map(|run| run.name.chars().count())
        .max()
        .unwrap_or(0);
    let line = |run: &Standing| format!("\n  {:width$}  {}", run.name, run.figures());
    under_way.iter().map(line).collect()
}

impl Standing {
    fn brief(&self) -> String {
        format!("{} {}", self.name, self.figures())
    }

    fn figures(&self) -> String {
        if self.stage == Stage::Suite {
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
    fn what_is_left_follows_from_the_episodes_of_this_session() {
        let progress = Progress {
            complete: 3,
            runs: 12,
            episodes: 600,
            total_episodes: 1100,
            under_way: vec![
                Standing {
                    name: "none/seed-2".to_owned(),
                    stage: Stage::Training,
                    episodes: 50,
                    total_episodes: 100,
                    walls_passed: Some(1.234),
                },
                Standing {
                    name: "half/seed-10".to_owned(),
                    stage: Stage::Training,
                    episodes: 100,
                    total_episodes: 100,
                    walls_passed: None,
                },
                Standing {
                    name: "half/seed-9".to_owned(),
                    stage: Stage::Suite,
                    episodes: 100,
                    total_episodes: 100,
                    walls_passed: Some(4.5),
                },
            ],
        };
        // 300 episodes were there before; the other 300 took 60 s.
        assert_eq!(
            head(&progress, 60.0, 300),
            "3 of 12 runs complete · 1:00, some 1:40 left"
        );
        assert_eq!(head(&progress, 60.0, 600), "3 of 12 runs complete · 1:00");
        assert_eq!(
            lines(&progress.under_way),
            "\n  none/seed-2   episode 50/100, walls passed 1.23\n  half/seed-10  evaluating\n  half/seed-9   flying the suite"
        );
    }
}
