//! Costs of a run: time by stage, and losses by reason.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use skein_protocol::stages::StageTimes;

use crate::faults::Faults;

/// Time and losses over all incarnations of the learner, as stored in checkpoints: work lost with a
/// killed learner is not counted.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RunCosts {
    /// Seconds from the learner's start to its end.
    pub wall_secs: f64,
    /// Time of the learner's threads and of the actors, by stage.
    pub stages: StageTimes,
    /// Tickets issued again, by reason.
    pub tickets_reissued: BTreeMap<String, u64>,
    /// Records refused, by reason.
    pub records_refused: BTreeMap<String, u64>,
}

impl RunCosts {
    /// Adds the costs of the present incarnation, started at `started`. `training` is the time of
    /// its training thread, `others` that of all other threads.
    pub fn with_this_incarnation(
        &self,
        started: Instant,
        training: &StageTimes,
        others: &StageTimes,
        faults: &Faults,
    ) -> Self {
        Self {
            wall_secs: self.wall_secs + started.elapsed().as_secs_f64(),
            stages: self.stages.plus(training).plus(others),
            tickets_reissued: sum(&self.tickets_reissued, faults.reissued_by_reason()),
            records_refused: sum(&self.records_refused, faults.refused_by_reason()),
        }
    }
}

fn sum(before: &BTreeMap<String, u64>, more: BTreeMap<String, u64>) -> BTreeMap<String, u64> {
    let mut sum = before.clone();
    for (why, count) in more {
        *sum.entry(why).or_default() += count;
    }
    sum
}
