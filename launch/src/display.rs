//! Progress of a run, on a terminal or in a log.
//!
//! A terminal gets a progress bar with figures below it, updated in place. Any other output gets a
//! plain line every few seconds. Both go to standard error, so that standard output holds only the
//! results.

use std::collections::VecDeque;
use std::fmt::{self, Write};
use std::io;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle, TermLike};
use skein_protocol::progress::{LearnerPhase, ProgressReport};
use skein_reports::Clock;
use skein_run::terminal::{can_redraw, stderr_columns, wrapped};
use skein_run::{note, notes};

use crate::supervisor::{Restarts, Watcher};

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Columns for the bar beside the first line of its text, with the space between.
const LEAST_BAR: usize = 4;
/// Time window for the pace from which the remaining time is estimated. A short window matters
/// because the VAE's part of a run is slower than what follows.
const PACE_SECS: f64 = 60.0;

/// Display of a run's progress.
pub struct ProgressDisplay {
    surface: DisplayOutput,
    pace: Pace,
}

enum DisplayOutput {
    Terminal(ProgressBar),
    Plain {
        last: Option<(Instant, LearnerPhase)>,
    },
}

/// Returns a progress bar if standard error is a terminal that can show one.
pub fn bar_on_terminal() -> Option<ProgressBar> {
    if !can_redraw() {
        return None;
    }
    let style = ProgressStyle::with_template("{wide_bar:.blue/white.dim} {msg}")
        .expect("the template is well-formed");
    let target = ProgressDrawTarget::term_like(Box::new(Terminal::default()));
    let bar = ProgressBar::with_draw_target(Some(0), target);
    Some(bar.with_style(style.progress_chars("━━─")))
}

/// Standard error as a terminal that no redraw waits for.
#[derive(Debug, Default)]
struct Terminal {
    /// Text of the present redraw.
    drawn: Mutex<String>,
}

impl Terminal {
    fn push(&self, text: fmt::Arguments<'_>) -> io::Result<()> {
        let mut drawn = self.drawn.lock().unwrap_or_else(PoisonError::into_inner);
        drawn.write_fmt(text).map_err(io::Error::other)
    }

    /// Moves the cursor by the control sequence that ends with `letter`.
    fn move_cursor(&self, by: usize, letter: char) -> io::Result<()> {
        match by {
            0 => Ok(()),
            _ => self.push(format_args!("\x1b[{by}{letter}")),
        }
    }
}

impl TermLike for Terminal {
    fn width(&self) -> u16 {
        stderr_columns().try_into().unwrap_or(u16::MAX)
    }

    fn move_cursor_up(&self, lines: usize) -> io::Result<()> {
        self.move_cursor(lines, 'A')
    }

    fn move_cursor_down(&self, lines: usize) -> io::Result<()> {
        self.move_cursor(lines, 'B')
    }

    fn move_cursor_right(&self, columns: usize) -> io::Result<()> {
        self.move_cursor(columns, 'C')
    }

    fn move_cursor_left(&self, columns: usize) -> io::Result<()> {
        self.move_cursor(columns, 'D')
    }

    fn write_line(&self, text: &str) -> io::Result<()> {
        self.push(format_args!("{text}\n"))
    }

    fn write_str(&self, text: &str) -> io::Result<()> {
        self.push(format_args!("{text}"))
    }

    fn clear_line(&self) -> io::Result<()> {
        self.push(format_args!("\r\x1b[2K"))
    }

    fn flush(&self) -> io::Result<()> {
        let mut drawn = self.drawn.lock().unwrap_or_else(PoisonError::into_inner);
        notes::write(std::mem::take(&mut *drawn));
        Ok(())
    }
}

impl ProgressDisplay {
    /// Returns a display for this process's standard error.
    pub fn new() -> Self {
        let surface =
            bar_on_terminal().map_or(DisplayOutput::Plain { last: None }, DisplayOutput::Terminal);
        Self {
            surface,
            pace: Pace::default(),
        }
    }

    /// Returns a head line (position in the run and remaining time) and a line of figures that show
    /// whether the training makes progress.
    pub fn text(&mut self, progress: &ProgressReport, restarts: Restarts) -> (String, String) {
        let left_secs = self.pace.secs_left(progress);
        let figures = ProgressFigures { progress, restarts };
        (
            ProgressHead {
                progress,
                left_secs,
            }
            .to_string(),
            figures.to_string(),
        )
    }

    /// Removes the bar, so that other text can be printed.
    pub fn finish(&self) {
        if let DisplayOutput::Terminal(bar) = &self.surface {
            bar.finish_and_clear();
        }
    }
}

impl Default for ProgressDisplay {
    fn default() -> Self {
        Self::new()
    }
}

impl Watcher for ProgressDisplay {
    fn progress(&mut self, progress: &ProgressReport, restarts: Restarts) {
        let (head, figures) = self.text(progress, restarts);
        match &mut self.surface {
            DisplayOutput::Terminal(bar) => {
                let (position, length) = match progress.phase {
                    LearnerPhase::Evaluating => progress.evaluation_episodes,
                    LearnerPhase::Flying | LearnerPhase::Learning | LearnerPhase::Finishing => {
                        (progress.episodes, progress.total_episodes)
                    }
                };
                bar.set_length(length);
                bar.set_position(position);
                let columns = stderr_columns();
                let head = wrapped(&head, columns.saturating_sub(LEAST_BAR));
                bar.set_message(format!("{head}\n{}", wrapped(&figures, columns)));
            }
            DisplayOutput::Plain { last } => {
                let due = last.is_none_or(|(when, phase)| {
                    when.elapsed() >= LINE_INTERVAL
                        || (phase == LearnerPhase::Evaluating)
                            != (progress.phase == LearnerPhase::Evaluating)
                });
                if due {
                    *last = Some((Instant::now(), progress.phase));
                    note!(
                        "{}",
                        wrapped(&format!("{head} · {figures}"), stderr_columns())
                    );
                }
            }
        }
    }

    fn warn(&mut self, text: &str) {
        match &self.surface {
            DisplayOutput::Terminal(bar) => bar.suspend(|| note!("skein: {text}")),
            DisplayOutput::Plain { .. } => note!("skein: {text}"),
        }
    }
}

/// Position in the run and remaining time.
struct ProgressHead<'a> {
    progress: &'a ProgressReport,
    left_secs: Option<f64>,
}

impl fmt::Display for ProgressHead<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ProgressReport {
            episodes,
            total_episodes,
            elapsed_secs,
            ..
        } = *self.progress;
        match self.progress.phase {
            LearnerPhase::Evaluating => {
                let (flown, total) = self.progress.evaluation_episodes;
                let what = if episodes < total_episodes {
                    " the newest snapshot"
                } else {
                    ""
                };
                write!(
                    f,
                    "evaluating{what} {flown}/{total} · episode {episodes}/{total_episodes}"
                )?;
            }
            LearnerPhase::Finishing => {
                write!(f, "finishing · episode {episodes}/{total_episodes}")?
            }
            LearnerPhase::Flying | LearnerPhase::Learning => {
                write!(f, "episode {episodes}/{total_episodes}")?
            }
        }
        write!(f, " · {}", Clock(elapsed_secs))?;
        match self.left_secs {
            Some(left) => write!(f, ", {} left", Clock(left)),
            None => Ok(()),
        }
    }
}

/// ProgressFigures of the training, and restarts of its processes.
struct ProgressFigures<'a> {
    progress: &'a ProgressReport,
    restarts: Restarts,
}

impl fmt::Display for ProgressFigures<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let progress = self.progress;
        write!(
            f,
            "{:.0} steps/s · {:.0} updates/s",
            progress.steps_per_sec, progress.updates_per_sec
        )?;
        for (name, value, digits) in [
            ("walls passed", progress.walls_passed, 2),
            ("return", progress.mean_return, 2),
            ("temperature", progress.temperature, 3),
            ("VAE loss", progress.vae_loss, 1),
        ] {
            if let Some(value) = value {
                write!(f, " · {name} {value:.digits$}")?;
            }
        }
        let plural = if progress.actors == 1 { "" } else { "s" };
        write!(f, " · {} actor{plural}", progress.actors)?;
        for (who, times) in [
            ("learner", self.restarts.learner),
            ("actors", self.restarts.actors),
        ] {
            if times > 0 {
                write!(f, " · {who} restarted {times}×")?;
            }
        }
        if progress.stalled.is_some() {
            f.write_str(" · stalled")?;
        }
        Ok(())
    }
}

/// Pace of the training episodes over the last [`PACE_SECS`].
#[derive(Debug, Default)]
struct Pace {
    /// Elapsed seconds and episode counts, oldest first.
    reports: VecDeque<(f64, u64)>,
}

impl Pace {
    /// Returns the seconds until all training episodes are flown at the present pace, or `None`
    /// before a pace is known.
    fn secs_left(&mut self, progress: &ProgressReport) -> Option<f64> {
        let (now_secs, episodes) = (progress.elapsed_secs, progress.episodes);
        // A restarted learner repeats some episodes; they say nothing about the pace.
        if self
            .reports
            .back()
            .is_some_and(|&(secs, flown)| now_secs < secs || episodes < flown)
        {
            self.reports.clear();
        }
        self.reports.push_back((now_secs, episodes));
        while self.reports.len() > 2 && self.reports[1].0 < now_secs - PACE_SECS {
            self.reports.pop_front();
        }
        let &(then_secs, flown) = self.reports.front()?;
        let episodes_per_sec = episodes.checked_sub(flown)? as f64 / (now_secs - then_secs);
        let left = progress.total_episodes.saturating_sub(episodes) as f64;
        (episodes_per_sec > 0.0 && episodes_per_sec.is_finite()).then(|| left / episodes_per_sec)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn progress(elapsed_secs: f64, episodes: u64) -> ProgressReport {
        ProgressReport {
            episodes,
            steps: 10_000,
            updates: 4000,
            vae_updates: 100,
            steps_per_sec: 151.6,
            updates_per_sec: 63.2,
            walls_passed: Some(1.234),
            temperature: Some(0.0512),
            actors: 1,
            live_actors: vec![0],
            elapsed_secs,
            ..ProgressReport::start(2000)
        }
    }

    #[test]
    fn a_plain_line_shows_what_is_known_and_nothing_else() {
        let progress = progress(3725.0, 512);
        let line = format!(
            "{} · {}",
            ProgressHead {
                progress: &progress,
                left_secs: Some(61.0)
            },
            ProgressFigures {
                progress: &progress,
                restarts: Restarts {
                    learner: 2,
                    actors: 0
                },
            }
        );
        let expected = "episode 512/2000 · 1:02:05, 1:01 left · 152 steps/s · 63 updates/s · \
                        walls passed 1.23 · temperature 0.051 · 1 actor · learner restarted 2×";
        assert_eq!(line, expected);
    }

    #[test]
    fn figures_never_exceed_the_terminal_width() {
        let progress = ProgressReport {
            mean_return: Some(-8.69),
            vae_loss: Some(150.1),
            ..progress(3725.0, 512)
        };
        let figures = ProgressFigures {
            progress: &progress,
            restarts: Restarts {
                learner: 12,
                actors: 1234,
            },
        }
        .to_string();
        let head = ProgressHead {
            progress: &progress,
            left_secs: Some(61.0),
        }
        .to_string();
        for columns in 1..200 {
            let lines = wrapped(&format!("{head} · {figures}"), columns);
            assert!(
                lines.lines().all(|line| line.chars().count() <= columns),
                "{lines}"
            );
        }
        for columns in 30..200 {
            let lines = wrapped(&figures, columns);
            assert!(
                lines.lines().all(|line| line.chars().count() <= columns),
                "{lines}"
            );
            assert_eq!(lines.replace('\n', " · "), figures);
        }
        assert!(!wrapped(&figures, figures.chars().count()).contains('\n'));
    }

    #[test]
    fn the_pace_starts_afresh_with_a_restarted_learner() {
        let mut pace = Pace::default();
        for second in 0..100_u32 {
            pace.secs_left(&progress(f64::from(second), 100 * u64::from(second) / 10));
        }
        assert_eq!(pace.secs_left(&progress(0.5, 500)), None);
        assert_eq!(pace.secs_left(&progress(10.5, 600)), Some(140.0));
    }

    #[test]
    fn remaining_time_follows_the_present_pace() {
        let mut pace = Pace::default();
        assert_eq!(pace.secs_left(&progress(0.0, 0)), None);
        assert_eq!(pace.secs_left(&progress(10.0, 100)), Some(190.0));
        // Ten times slower from here on. After a minute the first seconds no longer count.
        for second in 11..=200_u32 {
            pace.secs_left(&progress(f64::from(second), 100 + (u64::from(second) - 10)));
        }
        let left = pace.secs_left(&progress(201.0, 291)).unwrap();
        assert!((left - 1709.0).abs() < 1.0, "{left}");
    }
}
