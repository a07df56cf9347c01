//! What a training run tells about itself: `flights.csv`, TensorBoard curves, averages over the latest flights.
//!
//! All three are keyed by committed flight, not by time: two runs of one configuration have the same curves whatever machines flew them, and a
//! resumed run continues where its checkpoint was taken.

mod events;
mod flights;
mod scalars;
mod window;

use serde::{Deserialize, Serialize};
use skein_protocol::run::RunDirectory;

use crate::flight::CommittedFlight;

pub use events::{EventError, EventWriter};
pub use flights::{FlightRow, FlightsCsv, FlightsError};
pub use scalars::Scalar;
pub use window::MovingAverage;

/// Averages over the latest training flights; part of a checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Windows {
    /// Of the return.
    pub total_reward: MovingAverage,
    /// Of the walls passed; candidates for the best snapshot are chosen by it.
    pub walls_passed: MovingAverage,
}

impl Windows {
    /// Empty ones over `flights` flights.
    pub fn new(flights: usize) -> Self {
        Self {
            total_reward: MovingAverage::new(flights),
            walls_passed: MovingAverage::new(flights),
        }
    }
}

/// Writes all metrics of a training run.
#[derive(Debug)]
pub struct Metrics {
    flights: FlightsCsv,
    events: EventWriter,
    windows: Windows,
}

/// Why metrics cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    /// `flights.csv`.
    #[error(transparent)]
    Flights(#[from] FlightsError),
    /// The event file.
    #[error(transparent)]
    Events(#[from] EventError),
}

impl Metrics {
    /// Begins the metrics of a new run, averaged over `window_flights` flights.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn create(run: &RunDirectory, window_flights: usize) -> Result<Self, MetricsError> {
        Self::resume(run, 0, Windows::new(window_flights))
    }

    /// Continues after `flights` committed flights with the averages as they were then. What was written about later flights is dropped.
    ///
    /// # Errors
    /// [`MetricsError`] names the file; `flights.csv` must hold those flights.
    pub fn resume(run: &RunDirectory, flights: u64, windows: Windows) -> Result<Self, MetricsError> {
        Ok(Self {
            flights: FlightsCsv::resume(&run.flights_csv(), flights)?,
            events: EventWriter::create(&run.tensorboard(), flights)?,
            windows,
        })
    }

    /// Takes in a committed training flight; called in flight order.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn flight(&mut self, flight: &CommittedFlight) -> Result<(), MetricsError> {
        let row = FlightRow::from(flight);
        self.flights.write(&row)?;
        self.windows.total_reward.push(row.total_reward);
        self.windows.walls_passed.push(f32::from(row.walls_passed));
        let term = |index: usize| {
            flight
                .reward_terms
                .iter()
                .map(|terms| f64::from(terms[index]))
                .sum::<f64>()
        };
        self.scalars(
            row.flight,
            &[
                (Scalar::Return, row.total_reward.into()),
                (Scalar::WallsPassed, row.walls_passed.into()),
                (Scalar::Steps, row.steps as f64),
                (Scalar::RewardCollision, term(0)),
                (Scalar::RewardLevelUp, term(1)),
                (Scalar::RewardDestination, term(2)),
                (Scalar::RewardAction, term(3)),
                (
                    Scalar::WindowReturn,
                    self.windows.total_reward.mean().unwrap_or_default(),
                ),
                (
                    Scalar::WindowWallsPassed,
                    self.windows.walls_passed.mean().unwrap_or_default(),
                ),
            ],
        )
    }

    /// Appends a point to each of some curves, at training flight `flight`.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn scalars(&mut self, flight: u64, values: &[(Scalar, f64)]) -> Result<(), MetricsError> {
        let values: Vec<_> = values.iter().map(|&(scalar, value)| (scalar.tag(), value)).collect();
        Ok(self.events.scalars(flight, &values)?)
    }

    /// Hands everything written to the operating system; called once an epoch, and before a checkpoint that counts on it.
    ///
    /// # Errors
    /// [`MetricsError`] names the file.
    pub fn flush(&mut self) -> Result<(), MetricsError> {
        self.flights.flush()?;
        Ok(self.events.flush()?)
    }

    /// Averages over the latest flights.
    pub fn windows(&self) -> &Windows {
        &self.windows
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::transition::Outcome;

    use super::*;
    use crate::flight::samples;

    fn run() -> (tempfile::TempDir, RunDirectory) {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        (directory, run)
    }

    fn feed(metrics: &mut Metrics, flights: std::ops::Range<u64>) {
        for number in flights {
            let mut flight = samples::flight(number, 4, Outcome::Collided);
            flight.walls_passed = (number % 4) as u8;
            metrics.flight(&flight).unwrap();
        }
        metrics.flush().unwrap();
    }

    #[test]
    fn a_resumed_run_has_the_rows_and_averages_of_one_never_interrupted() {
        let ((_whole, whole_run), (_resumed, resumed_run)) = (run(), run());
        let mut whole = Metrics::create(&whole_run, 5).unwrap();
        feed(&mut whole, 0..20);

        let mut first = Metrics::create(&resumed_run, 5).unwrap();
        feed(&mut first, 0..12);
        let at_checkpoint = first.windows().clone();
        feed(&mut first, 12..17);
        drop(first);
        let mut second = Metrics::resume(&resumed_run, 12, at_checkpoint).unwrap();
        feed(&mut second, 12..20);

        assert_eq!(second.windows(), whole.windows());
        assert_eq!(whole.windows().walls_passed.mean(), Some(9.0 / 5.0));
        let read = |run: &RunDirectory| std::fs::read_to_string(run.flights_csv()).unwrap();
        assert_eq!(read(&resumed_run), read(&whole_run));
        assert_eq!(read(&whole_run).lines().count(), 21);
    }
}
