//! Progress of a training on standard error: a bar on a terminal, plain lines elsewhere.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use skein_reports::Clock;
use skein_run::note;
use skein_run::terminal::{can_redraw, stderr_columns, wrapped};

use crate::curve::CurvePoint;

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Columns for the bar beside its text.
const LEAST_BAR: usize = 4;

/// Display of a training's progress.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    steps: u64,
    begun: (Instant, u64),
    last_line: Option<Instant>,
}

impl Progress {
    /// Starts a display of a training of `steps` that has done `done` already.
    pub(crate) fn start(done: u64, steps: u64) -> Self {
        let bar = can_redraw().then(|| {
            let style = ProgressStyle::with_template("{wide_bar:.blue/white.dim} {msg}")
                .expect("the template is well-formed");
            ProgressBar::new(steps).with_style(style.progress_chars("━━─"))
        });
        Self {
            bar,
            steps,
            begun: (Instant::now(), done),
            last_line: None,
        }
    }

    /// Shows the newest point of the curve.
    pub(crate) fn show(&mut self, point: &CurvePoint) {
        let [step, loss, squared_error, divergence, geometry] = *point;
        let (begun, done) = self.begun;
        let elapsed_secs = begun.elapsed().as_secs_f64();
        let left_secs = elapsed_secs * (self.steps as f64 - step) / (step - done as f64);
        let text = format!(
            "step {step}/{} · {}, {} left · loss {loss:.1} · squared error {squared_error:.1} · \
             divergence {divergence:.1} · geometry {geometry:.2}",
            self.steps,
            Clock(elapsed_secs),
            Clock(left_secs)
        );
        match &self.bar {
            Some(bar) => {
                bar.set_position(step as u64);
                bar.set_message(wrapped(&text, stderr_columns().saturating_sub(LEAST_BAR)));
            }
            None if self
                .last_line
                .is_none_or(|line| line.elapsed() >= LINE_INTERVAL) =>
            {
                self.last_line = Some(Instant::now());
                note!("{}", wrapped(&text, stderr_columns()));
            }
            None => {}
        }
    }

    /// Removes the bar, so that other text can be printed.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
