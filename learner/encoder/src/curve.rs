//! The loss over the steps, as a table and as a picture.

use std::path::Path;

use anyhow::{Context, Result};
use skein_reports::comparison::{BandPoint, ComparedLine, Comparison};
use skein_run::durable;

/// Steps that a point of the curve is the mean of.
pub(crate) const STEPS_PER_POINT: u64 = 100;

/// Numbers of a point: its last step, the loss and its parts.
pub(crate) const COLUMNS: usize = 5;
const HEADER: &str = "step,loss,squared_error,divergence,geometry";

/// A point of the curve, in the order of the columns.
pub(crate) type CurvePoint = [f64; COLUMNS];

/// Writes the curve to `path`, a row per point.
pub(crate) fn write(curve: &[CurvePoint], path: &Path) -> Result<()> {
    let row = |point: &CurvePoint| {
        let [step, parts @ ..] = point;
        let parts = parts.map(|part| format!(",{part:.4}")).concat();
        format!("{step}{parts}\n")
    };
    let rows: String = curve.iter().map(row).collect();
    let table = format!("{HEADER}\n{rows}");
    durable::replace(path, table.as_bytes()).with_context(|| path.display().to_string())
}

/// Draws the curve to `path`.
pub(crate) fn draw(curve: &[CurvePoint], path: &Path) -> Result<()> {
    let line = |label, column: usize| ComparedLine {
        label,
        points: curve
            .iter()
            .map(|point| BandPoint {
                x: point[0],
                value: point[column],
                interval: None,
            })
            .collect(),
    };
    let picture = Comparison {
        title: format!("Loss of the encoder's training, mean of {STEPS_PER_POINT} steps"),
        x: "VAE step",
        y: "loss of an image",
        level: None,
        lines: vec![
            line("loss", 1),
            line("squared error", 2),
            line("divergence, nats", 3),
            line("geometry", 4),
        ],
    };
    picture.draw(path)?;
    Ok(())
}
