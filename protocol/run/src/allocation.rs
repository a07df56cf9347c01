//! How a process's allocator keeps memory.
//!
//! The C library gives most of what is freed back to the system, and fetches it anew page by page,
//! each cleared, with a fault each; and it learns from what is freed to keep larger blocks. Neither
//! fits: a learner needs again and again what it needed once, and an actor only ever frees
//! snapshots.

#[cfg(all(target_os = "linux", target_env = "gnu"))]
use libc::{M_MMAP_THRESHOLD, M_TRIM_THRESHOLD};

/// Bytes from which on a block is the system's again as soon as it is freed, in a learner: more
/// than the largest tensor of an update.
const LARGE_IN_LEARNER: i32 = 1 << 28;
/// The same in an actor: less than a snapshot and its largest layers, more than anything else.
const LARGE_IN_ACTOR: i32 = 1 << 20;

/// Keeps freed memory for the next who needs it, up to 2 GiB of it. To be called before there are
/// threads.
pub fn keep_freed_memory() {
    set(&[
        (M_MMAP_THRESHOLD, LARGE_IN_LEARNER),
        (M_TRIM_THRESHOLD, i32::MAX),
    ]);
}

/// Gives freed blocks of a megabyte and more back to the system at once. To be called before there
/// are threads.
pub fn return_large_blocks() {
    set(&[(M_MMAP_THRESHOLD, LARGE_IN_ACTOR)]);
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn set(settings: &[(i32, i32)]) {
    for &(parameter, value) in settings {
        // SAFETY: it sets a number within the allocator, under the allocator's lock.
        if unsafe { libc::mallopt(parameter, value) } != 1 {
            tracing::debug!(parameter, value, "the allocator refuses a setting");
        }
    }
}

// Other C libraries have no such settings.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
const M_MMAP_THRESHOLD: i32 = 0;
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
const M_TRIM_THRESHOLD: i32 = 0;
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn set(_: &[(i32, i32)]) {}
