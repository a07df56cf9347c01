//! Carries out a plan.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use anyhow::Result;

use crate::plan::{Disturbance, Planned, When};
use crate::storm::{Attempt, Script, Storm};

/// A plan, as far as it is not carried out yet.
#[derive(Debug)]
pub(crate) struct Planning {
    left: VecDeque<Planned>,
    episodes_per_epoch: u64,
    epoch: Duration,
    last_done: Instant,
}

impl Planning {
    /// For a run whose epochs have so many episodes and take about so long.
    pub(crate) fn new(plan: Vec<Planned>, episodes_per_epoch: u64, epoch: Duration) -> Self {
        Self {
            left: plan.into(),
            episodes_per_epoch,
            epoch,
            last_done: Instant::now(),
        }
    }

    /// How much of it was not carried out.
    pub(crate) fn left(&self) -> usize {
        self.left.len()
    }

    fn is_due(&self, when: When, storm: &Storm<'_>) -> bool {
        match when {
            When::Episode { episode, share } => {
                let long_past = storm.highest() >= episode + self.episodes_per_epoch;
                long_past
                    || storm.highest() >= episode
                        && storm.since_moved() >= self.epoch.mul_f64(share)
            }
            When::After { secs } => self.last_done.elapsed().as_secs_f64() >= secs,
        }
    }
}

impl Script for Planning {
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()> {
        while let Some(&next) = self.left.front()
            && self.is_due(next.when, storm)
        {
            // Processes that are missing will be back; a crew that is gone, with all others by a
            // power cut perhaps, will not.
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
