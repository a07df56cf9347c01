//! Carries out a plan.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use anyhow::Result;

use crate::plan::{Disturbance, Moment, PlannedDisturbance};
use crate::storm::{Attempt, Script, Storm};

/// A plan, without the disturbances already carried out.
#[derive(Debug)]
pub(crate) struct PlannedScript {
    left: VecDeque<PlannedDisturbance>,
    episodes_per_epoch: u64,
    epoch: Duration,
    last_done: Instant,
}

impl PlannedScript {
    /// Creates the script for a run with epochs of this many episodes and about this duration.
    pub(crate) fn new(
        plan: Vec<PlannedDisturbance>,
        episodes_per_epoch: u64,
        epoch: Duration,
    ) -> Self {
        Self {
            left: plan.into(),
            episodes_per_epoch,
            epoch,
            last_done: Instant::now(),
        }
    }

    /// Returns the number of disturbances not carried out.
    pub(crate) fn left(&self) -> usize {
        self.left.len()
    }

    fn is_due(&self, when: Moment, storm: &Storm<'_>) -> bool {
        match when {
            Moment::Episode { episode, share } => {
                let long_past = storm.highest() >= episode + self.episodes_per_epoch;
                long_past
                    || storm.highest() >= episode
                        && storm.since_moved() >= self.epoch.mul_f64(share)
            }
            Moment::After { secs } => self.last_done.elapsed().as_secs_f64() >= secs,
        }
    }
}

impl Script for PlannedScript {
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        while let Some(&next) = self.left.front()
            && self.is_due(next.when, storm)
        {
            // Missing processes come back. Attached actors that are gone, perhaps in a power cut,
            // do not.
            let gone_for_good = matches!(next.what, Disturbance::Detach { .. });
            if storm.disturb(next.what)? == Attempt::NobodyThere && !gone_for_good {
                break;
            }
            self.left.pop_front();
            self.last_done = Instant::now();
        }
        Ok(())
    }
}
