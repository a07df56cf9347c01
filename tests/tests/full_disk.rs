//! A disk that fills up pauses a run, and costs nothing but time.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::path::Path;
use std::process::{Command, Stdio};

use skein_tests::Recipe;
use tempfile::TempDir;

/// A file system of its own, in memory.
struct SmallDisk(TempDir);

impl SmallDisk {
    /// One of this size; `None` where this user may not mount any.
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
        // Lazily: whatever a test that failed has left there may still be open.
        let _ = Command::new("umount").arg("-l").arg(self.folder()).status();
    }
}

/// Starts a run on a disk of this `size`, makes room when the user is told that there is none, and
/// requires that nothing else has come of it.
fn waits_for_room_and_comes_to_the_same(size: &str) {
    let Some(disk) = SmallDisk::of(size) else {
        eprintln!("skipped: this user may not mount a file system");
        return;
    };
    let mut run = Recipe::small().within(disk.folder()).start();
    run.until("it was told that the disk is full", |run| {
        run.stderr()
            .contains("nothing moves: waiting for room on the disk")
            .then_some(())
    });
    disk.resize("1g");
    run.finish().assert_same_as(&Recipe::small().finish());
}

#[test]
fn a_run_whose_disk_fills_up_waits_for_room() {
    waits_for_room_and_comes_to_the_same("600k");
}

#[test]
fn a_run_whose_disk_is_full_from_the_first_file_of_its_learner_waits_for_room() {
    waits_for_room_and_comes_to_the_same("24k");
}
