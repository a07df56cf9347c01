//! Plots of a run, drawn from the files it left.
//!
//! Nothing here asks a running process: whatever a run wrote before it ended, however it ended, can be drawn again later.

mod canvas;
mod curves;
mod flight_paths;
mod reconstructions;

use std::io;
use std::path::PathBuf;

use skein_protocol::run::RunDirectory;
use skein_simulator::course::Course;

/// Why a plot could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A file does not hold what it should.
    #[error("{} cannot be plotted: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and where.
        problem: String,
    },
    /// The plotting library failed.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// A picture cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The picture.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
}

/// Draws every plot whose input the run left, and returns the pictures. A run that ended early has fewer.
///
/// `courses` are those of the final evaluation; `window` is the number of flights averaged over.
///
/// # Errors
/// [`ReportError`] names the file that is there but cannot be used, or the picture that cannot be written.
pub fn draw_all(run: &RunDirectory, courses: &[Course], window: usize) -> Result<Vec<PathBuf>, ReportError> {
    let mut pictures = Vec::new();
    let mut picture = |name: &str| {
        let path = run.plots().join(name);
        pictures.push(path.clone());
        path
    };
    if let Some(path) = existing(run.flights_csv()) {
        let flights = curves::read_flights(&path)?;
        // An evaluation course stands for the training course here: all start levels in turn leave (n + 1) / 2 walls on average.
        let walls = courses.first().map_or(0, |course| course.walls().len());
        curves::draw_return(&flights, window, &picture("return.png"))?;
        curves::draw_walls_passed(&flights, window, (walls + 1) as f64 / 2.0, &picture("walls_passed.png"))?;
    }
    if let Some(path) = existing(run.reconstructions()) {
        reconstructions::draw(&reconstructions::Pairs::read(&path)?, &picture("reconstructions.png"))?;
    }
    if let Some(path) = existing(run.evaluation_paths_csv()) {
        flight_paths::draw(courses, &flight_paths::read_paths(&path)?, &picture("flight_paths.png"))?;
    }
    Ok(pictures)
}

fn existing(path: PathBuf) -> Option<PathBuf> {
    path.exists().then_some(path)
}
