//! No process outlives the one that started it and answers for it.

use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;

use rustix::process::{Signal, getppid, set_parent_process_death_signal};

/// The process that `command` starts gets `signal` from the kernel when the *thread* that started
/// it ends, however that comes about; it is not started at all if that is so already.
pub fn signal_when_orphaned(command: &mut Command, signal: Signal) {
    let parent = rustix::process::getpid();
    // SAFETY: between fork and exec only system calls are made (prctl, getppid), no memory is
    // allocated and no lock is taken.
    unsafe {
        command.pre_exec(move || {
            set_parent_process_death_signal(Some(signal))?;
            // It may have died in between, and no signal would come.
            if getppid() == Some(parent) {
                Ok(())
            } else {
                Err(io::ErrorKind::NotConnected.into())
            }
        });
    }
}
