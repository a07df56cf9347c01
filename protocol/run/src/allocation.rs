//! Settings of the memory allocator.
//!
//! By default the C library returns most freed memory to the system and fetches it again page by
//! page, each with a fault and cleared. It also learns to keep larger blocks. Neither fits: a
//! learner needs the same memory again and again, and an actor only ever frees snapshots.

#[cfg(all(target_os = "linux", target_env = "gnu"))]
use libc::{M_MMAP_THRESHOLD, M_TRIM_THRESHOLD};

/// Block size in bytes from which on a learner returns freed blocks at once: more than the largest
/// tensor of an update.
const LARGE_IN_LEARNER: i32 = 1 << 28;
/// The same for an actor: less than a snapshot and its largest layers, more than anything else.
const LARGE_IN_ACTOR: i32 = 1 << 20;

/// Keeps up to 2 GiB of freed memory for later use. Call it before threads start.
pub fn keep_freed_memory() {
    set(&[
        (M_MMAP_THRESHOLD, LARGE_IN_LEARNER),
        (M_TRIM_THRESHOLD, i32::MAX),
    ]);
}

/// Returns freed blocks of a megabyte and more to the system at once. Call it before threads start.
pub fn return_large_blocks() {
    set(&[(M_MMAP_THRESHOLD, LARGE_IN_ACTOR)]);
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn set(settings: &[(i32, i32)]) {
    for &(parameter, value) in settings {
        // SAFETY: `mallopt` sets a number within the allocator, under the allocator's lock.
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
