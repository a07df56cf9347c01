//! Independent jobs on several threads, which end with the call.

use std::sync::{Mutex, PoisonError};
use std::thread;

/// Does `work` on each of `jobs`, on `threads` threads. Each takes the next job when it is done
/// with one: episodes in wide courses take longer than others.
pub(crate) fn for_each<T: Send>(
    threads: usize,
    jobs: impl ExactSizeIterator<Item = T> + Send,
    work: impl Fn(T) + Sync,
) {
    let helpers = threads.min(jobs.len()).saturating_sub(1);
    if helpers == 0 {
        jobs.for_each(work);
        return;
    }
    let jobs = Mutex::new(jobs);
    let next = || jobs.lock().unwrap_or_else(PoisonError::into_inner).next();
    let work_on = || {
        while let Some(job) = next() {
            work(job);
        }
    };
    thread::scope(|scope| {
        for number in 0..helpers {
            let named = thread::Builder::new().name(format!("skein-fly-{number}"));
            // Without another thread, this one does all of it.
            let _ = named.spawn_scoped(scope, work_on);
        }
        work_on();
    });
}
