//! Checks that readers use bounded memory. Inputs are small, so no single allocation may be large.
//!
//! A reader that trusts a stated length before it has read as many bytes fails here, even if the
//! system would have granted the memory.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Largest allowed allocation, in bytes. The largest snapshot and its mesh stay far below.
pub const LARGEST_ALLOCATION: usize = 64 << 20;

thread_local! {
    /// Largest allocation of this thread since [`forget`] was called, in bytes.
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

/// Resets the record of this thread's allocations.
pub fn forget() {
    LARGEST.set(0);
}

/// Panics if this thread has requested more than [`LARGEST_ALLOCATION`] at once since [`forget`].
///
/// # Panics
/// Panics so that the violation is reported like any other.
pub fn check() {
    let largest = LARGEST.get();
    assert!(
        largest <= LARGEST_ALLOCATION,
        "{largest} bytes were allocated at once"
    );
}

fn note(bytes: usize) {
    // Plain data without destructor is accessible during the whole lifetime of a thread.
    LARGEST.set(LARGEST.get().max(bytes));
}

/// The system's allocator with a record of the largest request.
struct Watched;

#[global_allocator]
static ALLOCATOR: Watched = Watched;

// SAFETY: every call goes to the system's allocator unchanged; recording a number allocates
// nothing.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        // SAFETY: the caller gives the guarantees that the system allocator requires.
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
