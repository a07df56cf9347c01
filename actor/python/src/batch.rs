//! A batch as one block of bytes, of which Python makes arrays without a copy.
//!
//! The block is fresh in every call and belongs to Python: the camera draws into it where it lies.
//! Columns lie one after another, `[n, width]` each, the widest numbers first behind the images, so
//! that all are aligned. `skein_rl/batch.py` reads them in the same order.

use pyo3::prelude::*;
use pyo3::types::PyByteArray;
use skein_protocol::IMAGE_PIXELS;

use crate::environment::Moment;

/// Number of a column.
enum Column {
    F64(fn(&Moment) -> f64),
    I64(fn(&Moment) -> i64),
    F32(&'static dyn Fn(&Moment) -> &[f32]),
    U8(fn(&Moment) -> u8),
}

/// Columns behind images and latent codes: name, as `skein_rl/batch.py` calls it, and content.
const COLUMNS: [(&str, Column); 19] = [
    ("reward", Column::F64(|m| f64::from(m.reward))),
    ("seed", Column::I64(|m| m.seed.cast_signed())),
    ("course_seed", Column::I64(|m| m.course_seed.cast_signed())),
    ("course", Column::I64(|m| m.course.into())),
    ("step", Column::I64(|m| m.step.into())),
    ("level", Column::I64(|m| m.level.into())),
    ("walls_passed", Column::I64(|m| m.walls_passed.into())),
    ("hit_wall", Column::I64(|m| m.hit_wall.into())),
    ("outcome", Column::I64(|m| m.outcome.into())),
    ("velocity", Column::F32(&|m| &m.velocity_mps)),
    ("goal", Column::F32(&|m| &m.goal_m)),
    ("previous_action", Column::F32(&|m| &m.previous_action)),
    ("reward_terms", Column::F32(&|m| &m.reward_terms)),
    ("position_m", Column::F32(&|m| &m.position_m)),
    ("orientation", Column::F32(&|m| &m.orientation)),
    ("ground_truth", Column::F32(&|m| &m.ground_truth)),
    ("latent", Column::F32(&|m| &m.latent)),
    ("terminated", Column::U8(|m| m.terminated.into())),
    ("truncated", Column::U8(|m| m.truncated.into())),
];

/// Names of the columns behind the images, in order.
pub(crate) fn names() -> Vec<&'static str> {
    COLUMNS.iter().map(|(name, _)| *name).collect()
}

/// Makes a batch of `count`: `draw` gets the images and returns the moments.
pub(crate) fn batch<'py>(
    py: Python<'py>,
    count: usize,
    draw: impl FnOnce(&mut [[u8; IMAGE_PIXELS]]) -> PyResult<Vec<Moment>>,
) -> PyResult<Bound<'py, PyByteArray>> {
    PyByteArray::new_with(py, bytes(count), |block| {
        let (images, columns) = block.split_at_mut(count * IMAGE_PIXELS);
        let (images, _) = images.as_chunks_mut();
        write(&draw(images)?, columns);
        Ok(())
    })
}

/// Length of the block.
fn bytes(count: usize) -> usize {
    let of_one: usize = COLUMNS.iter().map(|(_, column)| column.bytes()).sum();
    count * (IMAGE_PIXELS + of_one)
}

fn write(moments: &[Moment], mut block: &mut [u8]) {
    let mut put = |bytes: &[u8]| {
        let (own, rest) = std::mem::take(&mut block).split_at_mut(bytes.len());
        own.copy_from_slice(bytes);
        block = rest;
    };
    for (_, column) in &COLUMNS {
        for moment in moments {
            match column {
                Column::F64(of) => put(&of(moment).to_ne_bytes()),
                Column::I64(of) => put(&of(moment).to_ne_bytes()),
                Column::F32(of) => put(bytemuck::cast_slice(of(moment))),
                Column::U8(of) => put(&[of(moment)]),
            }
        }
    }
}

impl Column {
    /// Bytes of one row.
    fn bytes(&self) -> usize {
        match self {
            Self::F64(_) | Self::I64(_) => 8,
            Self::F32(of) => size_of_val(of(&Moment::EMPTY)),
            Self::U8(_) => 1,
        }
    }
}
