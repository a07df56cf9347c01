//! Shared memory that is used up during a run: whoever touches a page for which there is no room
//! dies of SIGBUS.

use rustix::process::Signal;

use super::process::Exit;

/// With less room than this, in bytes, shared memory is full.
const FULL: u64 = 8 << 20;

/// What to tell of a process that ended with `exit` because shared memory with `free` bytes left is
/// full; `None` when it ended for another reason.
pub(super) fn want_of_memory(exit: &Exit, free: Option<u64>) -> Option<String> {
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
    fn only_a_bus_error_while_memory_is_full_is_for_want_of_it() {
        let told = want_of_memory(&Exit::Signal(7), Some(FULL - 1)).unwrap();
        assert_eq!(told, ": shared memory (/dev/shm) is full: 7 MiB free");
        assert_eq!(want_of_memory(&Exit::Signal(7), Some(FULL)), None);
        assert_eq!(want_of_memory(&Exit::Signal(11), Some(0)), None);
        assert_eq!(want_of_memory(&Exit::Signal(7), None), None);
    }
}
