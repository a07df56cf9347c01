//! Shared memory that runs out during a run. A process that touches a page for which no memory is
//! left dies of SIGBUS.

use rustix::process::Signal;

use super::process::Exit;

/// Shared memory with less free space than this, in bytes, counts as full.
const FULL: u64 = 8 << 20;

/// Returns an explanation for a process that ended with `exit` because shared memory, with `free`
/// bytes left, is full; `None` if it ended for another reason.
pub(super) fn memory_shortage(exit: &Exit, free: Option<u64>) -> Option<String> {
    let free = free.filter(|&free| free < FULL)?;
    (*exit == Exit::Signal(Signal::BUS.as_raw())).then(|| {
        format!(
            ": shared memory (/dev/shm) is full: {} MiB free",
            free >> 20
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_bus_error_while_memory_is_full_counts_as_a_shortage() {
        let message = memory_shortage(&Exit::Signal(7), Some(FULL - 1)).unwrap();
        assert_eq!(message, ": shared memory (/dev/shm) is full: 7 MiB free");
        assert_eq!(memory_shortage(&Exit::Signal(7), Some(FULL)), None);
        assert_eq!(memory_shortage(&Exit::Signal(11), Some(0)), None);
        assert_eq!(memory_shortage(&Exit::Signal(7), None), None);
    }
}
