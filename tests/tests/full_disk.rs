//! A full disk pauses a run and costs nothing but time.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::path::Path;
use std::process::{Command, Stdio};

use skein_tests::RunRecipe;
use tempfile::TempDir;

/// A separate file system in memory.
struct SmallDisk(TempDir);

impl SmallDisk {
    /// Mounts one of this size; `None` if this user may not mount.
    fn of(size: &str) -> Option<Self> {
        let disk = Self(tempfile::tempdir().unwrap());
        disk.mount(&format!("size={size}")).then_some(disk)
    }

    fn resize(&self, size: &str) {
        assert!(self.mount(&format!("remount,size={size}")));
    }

    fn mount(&self, options: &str) -> bool {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", options, "skein-test"])
            .arg(self.folder())
            .stderr(Stdio::null())
            .status();
        mounted.is_ok_and(|status| status.success())
    }

    fn folder(&self) -> &Path {
        self.0.path()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Lazily, because a failed test may have left open files.
        let _ = Command::new("umount").arg("-l").arg(self.folder()).status();
    }
}

/// Starts a run on a disk of this `size`, makes room once the full disk is reported, and asserts
/// that the result is unchanged.
fn assert_a_full_disk_only_delays(size: &str) {
    let Some(disk) = SmallDisk::of(size) else {
        eprintln!("skipped: this user may not mount a file system");
        return;
    };
    let mut run = RunRecipe::small().within(disk.folder()).start();
    run.until("the full disk was reported", |run| {
        run.stderr()
            .contains("no progress: waiting for room on the disk")
            .then_some(())
    });
    disk.resize("1g");
    run.finish().assert_same_as(&RunRecipe::small().finish());
}

#[test]
fn a_run_whose_disk_fills_up_waits_for_room() {
    assert_a_full_disk_only_delays("600k");
}

#[test]
fn a_run_whose_disk_is_full_from_the_start_waits_for_room() {
    assert_a_full_disk_only_delays("24k");
}
