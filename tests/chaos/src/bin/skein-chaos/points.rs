//! Arms one fault point after another during a run.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result};
use serde_json::json;
use skein_run::fault::FaultPoint;

use crate::plan::Disturbance;
use crate::storm::{Script, Storm};

/// Share of the run's episodes after which the next point is armed as well. Some points are reached
/// rarely, and the last ones only at the end.
const PATIENCE: f64 = 1.0 / 6.0;

/// Fault points, in the order of arming.
#[derive(Debug)]
pub(crate) struct Points {
    folder: PathBuf,
    total_episodes: u64,
    /// Points still to arm, the next one last.
    to_arm: Vec<FaultPoint>,
    /// Armed points, with the highest number of episodes learned from at that time.
    armed: Vec<(FaultPoint, u64)>,
    fired: Vec<FaultPoint>,
    /// Highest number of episodes learned from when a point fired, until there are more.
    recovering_from: Option<u64>,
}

impl Points {
    /// Creates a script that arms all points in `folder`, over a run of this many episodes.
    ///
    /// # Errors
    /// Returns an error if the folder cannot be created.
    pub(crate) fn new(folder: PathBuf, total_episodes: u64) -> Result<Self> {
        fs::create_dir_all(&folder)
            .with_context(|| format!("cannot create {}", folder.display()))?;
        Ok(Self {
            folder,
            total_episodes,
            to_arm: order_of_arming().into_iter().rev().collect(),
            armed: Vec::new(),
            fired: Vec::new(),
            recovering_from: None,
        })
    }

    /// Points at which a process died.
    pub(crate) fn fired(&self) -> &[FaultPoint] {
        &self.fired
    }

    /// Points at which no process died.
    pub(crate) fn unfired(&self) -> Vec<FaultPoint> {
        let unfired = |point: &&FaultPoint| !self.fired.contains(point);
        FaultPoint::ALL.iter().filter(unfired).copied().collect()
    }

    fn note_fired(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        let folder = &self.folder;
        let (armed, fired): (Vec<_>, Vec<_>) = std::mem::take(&mut self.armed)
            .into_iter()
            .partition(|(point, _)| folder.join(point.name()).exists());
        self.armed = armed;
        for (point, _) in fired {
            storm.note("fired", &json!({ "point": point.name() }))?;
            self.fired.push(point);
            self.recovering_from = Some(storm.highest());
        }
        Ok(())
    }

    /// Returns `true` if the run has progressed since the last point fired. Deaths without progress
    /// would only lead to longer and longer pauses. After the last episode no progress can follow.
    fn has_recovered(&mut self, storm: &Storm<'_>) -> bool {
        let total = self.total_episodes;
        let recovering = |&from: &u64| storm.highest() <= from && from < total;
        self.recovering_from = self.recovering_from.filter(recovering);
        self.recovering_from.is_none()
    }
}

/// Returns all points, first those that may only be reached early in a run: the first candidate for
/// the best snapshot always replaces none; all later ones may be worse.
fn order_of_arming() -> Vec<FaultPoint> {
    let mut points = FaultPoint::ALL.to_vec();
    points.sort_by_key(|&point| point != FaultPoint::LearnerBestSaved);
    points
}

impl Script for Points {
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        self.note_fired(storm)?;
        let recovered = self.has_recovered(storm);
        let patience = (self.total_episodes as f64 * PATIENCE) as u64;
        let patient = self
            .armed
            .iter()
            .any(|&(_, armed_at)| storm.highest() < armed_at + patience);
        let at_the_end = storm.episodes() >= self.total_episodes;
        if recovered
            && (!patient || at_the_end)
            && let Some(point) = self.to_arm.pop()
        {
            let path = self.folder.join(point.name());
            fs::write(&path, "").with_context(|| format!("cannot arm {}", path.display()))?;
            storm.note("armed", &json!({ "point": point.name() }))?;
            self.armed.push((point, storm.highest()));
            if point == FaultPoint::LearnerStarted {
                // Only a starting learner reaches this point.
                storm.disturb(Disturbance::KillLearner)?;
            }
        }
        Ok(())
    }
}
