//! How far an evaluation or its recording is, in one line of the terminal.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use skein_reports::Clock;
use skein_run::terminal::{can_redraw, cut, stderr_columns};
use skein_run::{note, notes};

/// Least time between two lines on a terminal, where a line replaces the one before.
const REDRAW: Duration = Duration::from_millis(200);
/// The same elsewhere, where every line stays.
const PLAIN: Duration = Duration::from_secs(30);

/// Progress of what is done with so many episodes.
pub(crate) struct Progress {
    doing: &'static str,
    episodes: u64,
    begun: Instant,
    redraws: bool,
    /// Time of the last line, and whether there is one to clear.
    last: Mutex<(Instant, bool)>,
}

impl Progress {
    /// Begins. `doing` stands before the number of the episode.
    pub(crate) fn new(doing: &'static str, episodes: u64) -> Self {
        let now = Instant::now();
        Self {
            doing,
            episodes,
            begun: now,
            redraws: can_redraw(),
            last: Mutex::new((now, false)),
        }
    }

    /// Says that `done` episodes are done, if it is time to.
    pub(crate) fn tell(&self, done: u64) {
        let pause = if self.redraws { REDRAW } else { PLAIN };
        // Another thread is writing: its line is as new.
        let Ok(mut last) = self.last.try_lock() else {
            return;
        };
        if last.0.elapsed() < pause {
            return;
        }
        let line = line(self.doing, done, self.episodes, self.begun.elapsed());
        *last = (Instant::now(), self.redraws);
        match self.redraws {
            true => notes::write(format!("\r\x1b[2K{}", cut(&line, stderr_columns()))),
            false => note!("{line}"),
        }
    }

    /// Clears the line.
    pub(crate) fn finish(&self) {
        let last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if last.1 {
            notes::write("\r\x1b[2K".to_owned());
        }
    }
}

fn line(doing: &str, done: u64, episodes: u64, passed: Duration) -> String {
    let left = passed.as_secs_f64() * (episodes - done.min(episodes)) as f64 / done.max(1) as f64;
    format!(
        "{doing} {done}/{episodes} · {}, {} left",
        Clock(passed.as_secs_f64()),
        Clock(left)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_how_far_it_is_and_how_long_it_will_take() {
        let at = |done, secs| line("episode", done, 200, Duration::from_secs(secs));
        assert_eq!(at(50, 35), "episode 50/200 · 0:35, 1:45 left");
        assert_eq!(at(1, 60), "episode 1/200 · 1:00, 3:19:00 left");
        assert_eq!(at(200, 70), "episode 200/200 · 1:10, 0:00 left");
    }
}
