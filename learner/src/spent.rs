//! What a run has cost: time by what it was spent on, and what was lost on the way.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use skein_protocol::stages::Times;

use crate::episodes::receiver::Shared;

/// Time and losses, over all incarnations of the learner as far as checkpoints tell: what a death
/// undid is not in it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Spent {
    /// Seconds from the learner's start to its end.
    pub wall_secs: f64,
    /// Time of the learner's threads and of the actors, by stage.
    pub stages: Times,
    /// Tickets issued again, by reason.
    pub tickets_reissued: BTreeMap<String, u64>,
    /// Records refused, by reason.
    pub records_refused: BTreeMap<String, u64>,
}

impl Spent {
    /// With what the present incarnation, begun at `started`, has come to: `training` is its
    /// training thread's time, that of all others is in `shared`.
    pub fn with_this_incarnation(
        &self,
        started: Instant,
        training: &Times,
        shared: &Shared,
    ) -> Self {
        let faults = shared.faults();
        Self {
            wall_secs: self.wall_secs + started.elapsed().as_secs_f64(),
            stages: self.stages.plus(training).plus(&shared.times()),
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
