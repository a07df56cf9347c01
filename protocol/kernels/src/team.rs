//! Threads that share one piece of work at a time, many thousand times a second.
//!
//! An update is some thirty products of a tenth of a millisecond each; waking a thread through the
//! operating system for each would cost a noticeable share. So a member polls for work for a moment
//! before it sleeps. Which member computes which part depends on numbers alone, and no sum is
//! divided between members: results are the same for any number of them.

use std::marker::PhantomData;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicPtr, AtomicUsize, Ordering};
use std::thread::{self, JoinHandle};

/// Polls for work before a member sleeps: some tens of microseconds, depending on how long the
/// processor pauses. Longer than the time between two products, shorter than that between two
/// epochs.
const POLLS: usize = 4096;

/// Fixed number of threads, the caller's among them.
#[derive(Debug)]
pub struct Team {
    shared: Arc<Round>,
    helpers: Vec<JoinHandle<()>>,
}

#[derive(Debug)]
struct Round {
    /// Increased for each piece of work, after `work` was set.
    round: AtomicUsize,
    /// Points to the caller's reference to the work of this round.
    work: AtomicPtr<TeamWork<'static>>,
    /// Helpers that have not finished this round.
    unfinished: AtomicUsize,
    panicked: AtomicBool,
    over: AtomicBool,
}

type TeamWork<'a> = &'a (dyn Fn(usize) + Sync);

impl Team {
    /// A team of `size` threads, the caller's among them.
    ///
    /// # Panics
    /// If the system cannot start more threads.
    pub fn new(size: usize) -> Self {
        let shared = Arc::new(Round {
            round: AtomicUsize::new(0),
            work: AtomicPtr::new(std::ptr::null_mut()),
            unfinished: AtomicUsize::new(0),
            panicked: AtomicBool::new(false),
            over: AtomicBool::new(false),
        });
        let helpers = (1..size.max(1))
            .map(|member| {
                let shared = Arc::clone(&shared);
                thread::Builder::new()
                    .name(format!("update-{member}"))
                    .spawn(move || help(&shared, member))
                    .expect("the system can start a thread for each member")
            })
            .collect();
        Self { shared, helpers }
    }

    /// Number of members, the caller among them.
    pub fn size(&self) -> usize {
        self.helpers.len() + 1
    }

    /// Calls `work` once in every member, with its number from 0, and waits for all.
    ///
    /// # Panics
    /// If a member panics.
    fn run(&mut self, work: &(dyn Fn(usize) + Sync)) {
        if self.helpers.is_empty() {
            return work(0);
        }
        let shared = &*self.shared;
        let mut work: TeamWork<'_> = work;
        shared
            .unfinished
            .store(self.helpers.len(), Ordering::Relaxed);
        shared.work.store((&raw mut work).cast(), Ordering::Relaxed);
        shared.round.fetch_add(1, Ordering::Release);
        for helper in &self.helpers {
            helper.thread().unpark();
        }
        // No helper may use `work` once this returns, even by a panic.
        let own = catch_unwind(AssertUnwindSafe(|| work(0)));
        let mut polls = 0;
        while shared.unfinished.load(Ordering::Acquire) > 0 {
            pause(&mut polls, thread::yield_now);
        }
        let helper_panicked = shared.panicked.swap(false, Ordering::Relaxed);
        if let Err(panic) = own {
            resume_unwind(panic);
        }
        assert!(
            !helper_panicked,
            "a helper thread panicked; its message is above"
        );
    }

    /// Divides `0..count` among the members, and calls `work` for each part. Parts begin at
    /// multiples of `grain`.
    pub fn split(&mut self, count: usize, grain: usize, work: impl Fn(Range<usize>) + Sync) {
        let size = self.size();
        self.run(&|member| {
            let part = part(count, grain, member, size);
            if !part.is_empty() {
                work(part);
            }
        });
    }

    /// Divides rows of length `len` among the members. `work` receives the number of its first row,
    /// and its rows.
    ///
    /// # Panics
    /// If `rows` are not whole rows.
    pub fn split_rows<T: Send>(
        &mut self,
        rows: &mut [T],
        len: usize,
        grain: usize,
        work: impl Fn(usize, &mut [T]) + Sync,
    ) {
        assert_eq!(rows.len() % len, 0, "whole rows");
        let count = rows.len() / len;
        let rows = Shared::new(rows);
        self.split(count, grain, |part| {
            // SAFETY: the parts of `split` do not overlap.
            let own = unsafe { rows.part(part.start * len..part.end * len) };
            work(part.start, own);
        });
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Release);
        for helper in self.helpers.drain(..) {
            helper.thread().unpark();
            let _ = helper.join();
        }
    }
}

/// Memory that members of a team write, each in other parts.
pub(crate) struct Shared<'a, T> {
    data: *mut T,
    len: usize,
    lent: PhantomData<&'a mut [T]>,
}

impl<'a, T> Shared<'a, T> {
    pub(crate) fn new(data: &'a mut [T]) -> Self {
        Self {
            data: data.as_mut_ptr(),
            len: data.len(),
            lent: PhantomData,
        }
    }

    pub(crate) fn pointer(&self) -> *mut T {
        self.data
    }

    /// Returns a part of the memory.
    ///
    /// # Safety
    /// No other borrow of this part exists meanwhile.
    #[allow(clippy::mut_from_ref, reason = "the caller keeps parts apart")]
    pub(crate) unsafe fn part(&self, part: Range<usize>) -> &mut [T] {
        assert!(
            part.start <= part.end && part.end <= self.len,
            "a part of the memory"
        );
        // SAFETY: within the borrowed memory, as asserted; exclusive, as the caller guarantees.
        unsafe { std::slice::from_raw_parts_mut(self.data.add(part.start), part.len()) }
    }
}

// SAFETY: parts do not overlap, and `T` may be sent to the threads that use them.
unsafe impl<T: Send> Sync for Shared<'_, T> {}

/// Part of `0..count` for `member` of `size` members.
fn part(count: usize, grain: usize, member: usize, size: usize) -> Range<usize> {
    let grains = count.div_ceil(grain);
    let at = |member: usize| (grains * member / size * grain).min(count);
    at(member)..at(member + 1)
}

/// Loop of a helper thread.
fn help(shared: &Round, member: usize) {
    let mut done = 0;
    loop {
        let mut polls = 0;
        while shared.round.load(Ordering::Acquire) == done {
            if shared.over.load(Ordering::Acquire) {
                return;
            }
            pause(&mut polls, thread::park);
        }
        done += 1;
        let work = shared.work.load(Ordering::Relaxed);
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            // SAFETY: `run` has set the pointer before the round. What it points to lives until
            // `run` returns, which is after `unfinished` has become zero.
            let work = unsafe { *work };
            work(member);
        }));
        if outcome.is_err() {
            shared.panicked.store(true, Ordering::Relaxed);
        }
        shared.unfinished.fetch_sub(1, Ordering::Release);
    }
}

/// Waits for a moment; after [`POLLS`] calls, by calling `longer`.
fn pause(polls: &mut usize, longer: fn()) {
    if *polls < POLLS {
        *polls += 1;
        std::hint::spin_loop();
    } else {
        longer();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_is_computed_once_by_any_number_of_members() {
        for size in 1..=5 {
            let mut team = Team::new(size);
            for count in [0, 1, 7, 64, 65] {
                let mut rows = vec![0_u32; 3 * count];
                for _ in 0..50 {
                    team.split_rows(&mut rows, 3, 4, |first, rows| {
                        for (index, row) in rows.chunks_exact_mut(3).enumerate() {
                            row.iter_mut()
                                .for_each(|value| *value += (first + index) as u32);
                        }
                    });
                }
                let expected: Vec<u32> = (0..count as u32).flat_map(|row| [50 * row; 3]).collect();
                assert_eq!(rows, expected, "{size} members");
            }
        }
    }

    #[test]
    fn a_sleeping_member_is_woken() {
        let mut team = Team::new(2);
        for _ in 0..3 {
            thread::sleep(std::time::Duration::from_millis(20));
            let done = AtomicUsize::new(0);
            team.run(&|_| {
                done.fetch_add(1, Ordering::Relaxed);
            });
            assert_eq!(done.into_inner(), 2);
        }
    }

    #[test]
    fn a_panic_of_any_member_reaches_the_caller_and_the_team_still_works() {
        let mut team = Team::new(2);
        for member in 0..2 {
            let outcome = catch_unwind(AssertUnwindSafe(|| {
                team.run(&|number| assert_ne!(number, member, "on purpose"));
            }));
            assert!(outcome.is_err());
        }
        let done = AtomicUsize::new(0);
        team.run(&|_| {
            done.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(done.into_inner(), 2);
    }
}
