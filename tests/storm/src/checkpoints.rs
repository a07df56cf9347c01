//! The thread that writes checkpoints, and the results that these count.

use std::io::{self, ErrorKind, Read};
use std::path::{Path, PathBuf};

use skein_learner::checkpoint::{CheckpointError, CheckpointState, Storage};
use skein_learner::metrics::EpisodesExtent;
use skein_learner::replay::{ReplayState, RingState};

use crate::disk::VirtualDisk;
use crate::flight::mix;
use crate::learner::Trouble;
use crate::mutant::Mutant;
use crate::shape::{RESULTS, Shape};

/// Loads the newest checkpoint of `shape`. None may be damaged: the disk damages nothing that was
/// synced.
pub(crate) fn load(shape: &Shape) -> Result<Option<CheckpointState>, Trouble> {
    let mut passed_over = None;
    let fits = |state: &CheckpointState| {
        let found = read_results(&shape.disk).unwrap_or_default();
        let counted = state.progress.metrics.episodes_extent;
        let rows = found.get(..counted.bytes as usize);
        match rows.is_some_and(|rows| extent(rows) == counted) {
            true => Ok(()),
            false => Err(CheckpointError::Unfit {
                episodes: state.progress.episodes,
                problem: "its results are not there".to_owned(),
            }),
        }
    };
    let newest = shape
        .store
        .load_newest(fits, |error| passed_over = Some(error.to_string()));
    match (newest, passed_over) {
        (Ok(newest), None) => Ok(newest),
        (_, Some(error)) => Err(Trouble::Broken(error)),
        (Err(_), None) if shape.disk.is_dead() => Err(Trouble::Dead),
        (Err(error), None) => Err(Trouble::Broken(error.to_string())),
    }
}

pub(crate) fn read_results(disk: &VirtualDisk) -> io::Result<String> {
    let mut text = String::new();
    disk.open(Path::new(RESULTS), u64::MAX)?
        .read_to_string(&mut text)?;
    Ok(text)
}

pub(crate) fn extent(results: &str) -> EpisodesExtent {
    EpisodesExtent {
        bytes: results.len() as u64,
        xxh3: results.bytes().fold(0, |sum, byte| mix(sum, byte.into())),
    }
}

pub(crate) fn empty_replay() -> ReplayState {
    let ring = || RingState {
        inserted: 0,
        rows: Vec::new(),
        images: Vec::new(),
    };
    ReplayState {
        success: ring(),
        regular: ring(),
        images: None,
    }
}

/// The thread that writes checkpoints.
pub(crate) struct Writer<'a> {
    shape: &'a Shape,
    mutant: Option<Mutant>,
    state: Option<CheckpointState>,
}

impl<'a> Writer<'a> {
    pub(crate) fn new(shape: &'a Shape, mutant: Option<Mutant>) -> Self {
        Self {
            shape,
            mutant,
            state: None,
        }
    }

    /// Hands over a state to write; the thread is not busy.
    pub(crate) fn hand_over(&mut self, state: CheckpointState) {
        self.state = Some(state);
    }

    /// `true` while a checkpoint is to be written.
    pub(crate) fn is_busy(&self) -> bool {
        self.state.is_some()
    }

    /// Writes the checkpoint that was handed over; returns `false` if there is no room.
    pub(crate) fn step(&mut self) -> Result<bool, Trouble> {
        let Some(state) = &self.state else {
            return Ok(true);
        };
        let relied_on = match self.mutant {
            Some(Mutant::EarlyCheckpoint) => None,
            _ => Some(PathBuf::from(RESULTS)),
        };
        let relied_on: Vec<_> = relied_on.into_iter().collect();
        match self.shape.store.save(state, &relied_on) {
            Ok(_) => {
                self.state = None;
                Ok(true)
            }
            Err(_) if self.shape.disk.is_dead() => Err(Trouble::Dead),
            Err(CheckpointError::Io { source, .. }) if source.kind() == ErrorKind::StorageFull => {
                Ok(false)
            }
            Err(error) => Err(Trouble::Broken(error.to_string())),
        }
    }
}
