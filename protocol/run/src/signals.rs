//! Signals that end a program, and those that it ignores: those ignored when it started, as under
//! `nohup`, and SIGXFSZ.

use std::fs;
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use rustix::process::Signal;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

/// Returns `true` if this process ignores the signal with this number. Ask before a handler is
/// installed: what the shell, `nohup` or a service manager chose to ignore must stay ignored.
pub fn is_ignored(number: i32) -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    is_in_mask(&status, number)
}

/// Returns a flag that SIGTERM, SIGINT and SIGHUP set. One that comes while the flag is set ends
/// the process at once. One that was ignored when this process started stays ignored.
///
/// # Errors
/// If the system installs no handler.
pub fn end_on_signal() -> io::Result<Arc<AtomicBool>> {
    let end = Arc::new(AtomicBool::new(false));
    for number in [SIGTERM, SIGINT, SIGHUP] {
        if !is_ignored(number) {
            // In this order: only the second signal finds the flag set.
            flag::register_conditional_default(number, end.clone())?;
            flag::register(number, end.clone())?;
        }
    }
    Ok(end)
}

/// Lets a write beyond the limit of file sizes (`ulimit -f`) fail with an error, which names its
/// file. Otherwise SIGXFSZ kills the process without a word. Every program calls this first.
pub fn survive_file_size_limit() {
    // SAFETY: ignoring a signal runs no code of this process.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

/// Returns `true` if the signal's bit is set in the line `SigIgn:` of a process's `status`.
fn is_in_mask(status: &str, number: i32) -> bool {
    let line = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = line.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| (1..=64).contains(&number) && mask >> (number - 1) & 1 == 1)
}

/// Makes the process that `command` starts heed `signal`, by which its parent will stop it, even if
/// the parent itself was started with this signal ignored.
pub fn heed(command: &mut Command, signal: Signal) {
    let number = signal.as_raw();
    // SAFETY: between fork and exec only a system call is made, no memory is allocated and no lock
    // is taken.
    unsafe {
        command.pre_exec(move || match libc::signal(number, libc::SIG_DFL) {
            libc::SIG_ERR => Err(std::io::Error::last_os_error()),
            _ => Ok(()),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mask_of_ignored_signals_is_read_by_number() {
        let status = "Name:\tskein\nSigBlk:\tffff\nSigIgn:\t0000000000001001\nSigCgt:\t0\n";
        let ignored: Vec<_> = (0..66)
            .filter(|&number| is_in_mask(status, number))
            .collect();
        assert_eq!(ignored, [1, 13]);
        assert!(!is_in_mask("", 1));
    }

    #[test]
    fn a_signal_ignored_at_the_start_is_found_and_a_child_can_heed_it_again() {
        // Every Rust program ignores SIGPIPE.
        assert!(is_ignored(Signal::PIPE.as_raw()));
        assert!(!is_ignored(Signal::USR2.as_raw()));
        // SAFETY: nothing of this test process sends or expects SIGUSR1.
        unsafe { libc::signal(libc::SIGUSR1, libc::SIG_IGN) };
        assert!(is_ignored(Signal::USR1.as_raw()));
        let ignored_by_child = |prepare: fn(&mut Command)| {
            let mut child = Command::new("cat");
            prepare(child.arg("/proc/self/status"));
            let status = String::from_utf8(child.output().unwrap().stdout).unwrap();
            is_in_mask(&status, Signal::USR1.as_raw())
        };
        assert!(ignored_by_child(|_| {}));
        assert!(!ignored_by_child(|child| heed(child, Signal::USR1)));
    }

    #[test]
    fn a_write_beyond_the_limit_of_file_sizes_kills_no_process() {
        assert!(!is_ignored(libc::SIGXFSZ));
        survive_file_size_limit();
        assert!(is_ignored(libc::SIGXFSZ));
    }
}
