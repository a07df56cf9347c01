//! Settings of the memory allocator, and the end of a process that it refuses memory.
//!
//! By default the C library returns most freed memory to the system and fetches it again page by
//! page, each with a fault and cleared. It also learns to keep larger blocks. Neither fits: a
//! learner needs the same memory again and again, and an actor only ever frees snapshots.

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;

#[cfg(all(target_os = "linux", target_env = "gnu"))]
use libc::{M_MMAP_THRESHOLD, M_TRIM_THRESHOLD};
use rustix::process::{Resource, getrlimit};

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

/// Allocator of a program: the C library's, except that the process ends at once, with the reason
/// on standard error, when memory is refused. The standard library would first collect a backtrace,
/// which needs memory too and may wait forever for a lock that the same thread holds.
#[derive(Debug)]
pub struct EndWithoutMemory {
    /// Name of the program, for the message.
    pub program: &'static str,
    /// Exit status.
    pub status: u8,
}

impl EndWithoutMemory {
    fn granted(&self, block: *mut u8, bytes: usize) -> *mut u8 {
        if block.is_null() {
            self.end(bytes);
        }
        block
    }

    #[cold]
    fn end(&self, bytes: usize) -> ! {
        // Formatted in place: there is no memory.
        let mut text = [0; 256];
        let room = text.len();
        let mut left = &mut text[..];
        // What does not fit is cut.
        let _ = write!(
            left,
            "{}: out of memory: {bytes} bytes refused",
            self.program
        );
        let _ = match memory_limit() {
            Some(limit) => write!(left, "; {}", MemoryLimit(limit)),
            None => write!(left, "; end other programs, or add memory"),
        };
        let _ = writeln!(left);
        let written = room - left.len();
        // Past the standard library's lock, which another thread may hold.
        let _ = rustix::io::write(std::io::stderr(), &text[..written]);
        // SAFETY: `_exit` runs no code of this process.
        unsafe { libc::_exit(self.status.into()) }
    }
}

// SAFETY: every call goes to the system's allocator unchanged, and so does its result.
unsafe impl GlobalAlloc for EndWithoutMemory {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps `GlobalAlloc::alloc`'s contract.
        self.granted(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller keeps `GlobalAlloc::alloc_zeroed`'s contract.
        self.granted(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller keeps `GlobalAlloc::realloc`'s contract.
        self.granted(unsafe { System.realloc(block, layout, size) }, size)
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps `GlobalAlloc::dealloc`'s contract.
        unsafe { System.dealloc(block, layout) }
    }
}

/// Returns the limit on a process's address space (`ulimit -v`) in bytes; `None` without one.
pub fn memory_limit() -> Option<u64> {
    getrlimit(Resource::As).current
}

/// A limit on a process's address space in bytes; shown with its remedy.
#[derive(Debug, Clone, Copy)]
pub struct MemoryLimit(pub u64);

impl std::fmt::Display for MemoryLimit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mib = self.0 >> 20;
        write!(
            f,
            "the shell limits a process to {mib} MiB: raise it with ulimit -v"
        )
    }
}
