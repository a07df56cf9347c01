//! Many storms on several threads.

use std::num::NonZeroUsize;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

use crate::{Mutant, Sky};

/// Storms that a thread takes at one time.
const AT_ONCE: u64 = 64;

/// A storm that a run does not survive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// Seed of the storm.
    pub seed: u64,
    /// Violated promise.
    pub what: String,
}

/// Number of events in storms that have passed.
#[derive(Debug, Default)]
pub struct Passed {
    /// Number of storms.
    pub storms: AtomicU64,
    /// Number of events in them.
    pub events: AtomicU64,
}

/// Lets the storms of `seeds` pass on `jobs` threads, counting them in `passed`. Returns the lowest
/// seed whose run does not survive; storms of higher seeds may be left out then.
pub fn hunt(
    seeds: Range<u64>,
    jobs: NonZeroUsize,
    mutant: Option<Mutant>,
    passed: &Passed,
) -> Option<Finding> {
    let (next, found) = (AtomicU64::new(seeds.start), AtomicU64::new(u64::MAX));
    let work = || {
        let sky = Sky::new();
        let mut finding: Option<Finding> = None;
        while finding.is_none() {
            let first = next.fetch_add(AT_ONCE, Ordering::Relaxed);
            let end = seeds.end.min(first.saturating_add(AT_ONCE));
            if first >= end || found.load(Ordering::Relaxed) < first {
                break;
            }
            finding = (first..end).find_map(|seed| storm(&sky, seed, mutant, passed));
            if let Some(finding) = &finding {
                found.fetch_min(finding.seed, Ordering::Relaxed);
            }
        }
        finding
    };
    thread::scope(|scope| {
        let threads: Vec<_> = (0..jobs.get()).map(|_| scope.spawn(work)).collect();
        let findings = threads.into_iter().filter_map(|thread| thread.join().ok());
        findings.flatten().min_by_key(|finding| finding.seed)
    })
}

fn storm(sky: &Sky, seed: u64, mutant: Option<Mutant>, passed: &Passed) -> Option<Finding> {
    // The hook has printed the panic's message and place.
    let what = match catch_unwind(AssertUnwindSafe(|| sky.storm(seed, mutant))) {
        Err(_) => "a panic".to_owned(),
        Ok(outcome) => {
            passed.storms.fetch_add(1, Ordering::Relaxed);
            passed.events.fetch_add(outcome.events, Ordering::Relaxed);
            outcome.failure?
        }
    };
    Some(Finding { seed, what })
}
