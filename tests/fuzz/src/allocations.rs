//! Holds readers to bounded memory: no input is large, so no single allocation has a reason to be.
//!
//! A length that a reader believes before it has seen as many bytes shows here, whether or not the
//! system would have granted the memory.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Most bytes that may be asked for at once: the largest snapshot and its mesh stay far below.
pub const LARGEST_ALLOCATION: usize = 64 << 20;

thread_local! {
    /// The largest allocation of this thread since [`forget`] was called, in bytes.
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

/// Forgets what this thread allocated so far.
pub fn forget() {
    LARGEST.set(0);
}

/// Panics if this thread asked for more than [`LARGEST_ALLOCATION`] at once since [`forget`].
///
/// # Panics
/// So that it is reported like any other broken promise.
pub fn check() {
    let largest = LARGEST.get();
    assert!(
        largest <= LARGEST_ALLOCATION,
        "{largest} bytes were allocated at once"
    );
}

fn note(bytes: usize) {
    // Plain data that needs no destructor: there from the first to the last moment of a thread.
    LARGEST.set(LARGEST.get().max(bytes));
}

/// The system's allocator, watched.
struct Watched;

#[global_allocator]
static ALLOCATOR: Watched = Watched;

// SAFETY: every call goes to the system's allocator unchanged; noting a number allocates nothing.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above; the pointer came from the system's allocator.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note(size);
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }
}
