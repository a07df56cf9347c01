//! How this process's allocator keeps memory.
//!
//! The C library gives what is freed back to the system as soon as it can, and fetches it anew: page by page, each cleared, with a fault each. A learner
//! does the same work over and over, so all that it needs once it needs again.

/// Keeps freed memory for the next who needs it, blocks of up to [`LARGEST_KEPT`] bytes, and up to 2 GiB of it. To be called before there are threads.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    for (parameter, bytes) in [
        (libc::M_MMAP_THRESHOLD, LARGEST_KEPT),
        (libc::M_TRIM_THRESHOLD, i32::MAX),
    ] {
        // SAFETY: it sets a number within the allocator, under the allocator's lock.
        if unsafe { libc::mallopt(parameter, bytes) } != 1 {
            tracing::debug!(parameter, bytes, "the allocator refuses a setting");
        }
    }
}

/// Bytes of the largest block that is kept: more than the largest tensor of an update at any batch size that is used.
pub const LARGEST_KEPT: i32 = 1 << 28;
