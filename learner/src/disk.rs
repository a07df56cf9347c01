//! A full disk pauses the learner and loses nothing.
//!
//! A writer that finds no room warns, waits, and tries again until there is room or the run must
//! stop. What was learned stays in memory meanwhile. [`Disk::with_room`] repeats the write of a
//! whole file; [`PatientWriter`] continues a file that is appended to, so that nothing is written
//! twice. Every other failure is returned to the caller.

use std::error::Error;
use std::io::{self, ErrorKind, Write};
use std::iter::successors;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

/// Time between two attempts to write.
const PAUSE: Duration = Duration::from_secs(1);
/// Time between two warnings.
const WARN_EVERY: Duration = Duration::from_secs(60);

/// The run's disk, shared by all who write to it.
#[derive(Debug, Clone)]
pub struct Disk {
    stop: Arc<AtomicBool>,
    waiting: Arc<Mutex<Option<String>>>,
    pause: Duration,
}

impl Disk {
    /// Returns the disk of a learner that ends when `stop` is set; then no writer waits any longer.
    pub fn new(stop: Arc<AtomicBool>) -> Self {
        Self {
            stop,
            waiting: Arc::default(),
            pause: PAUSE,
        }
    }

    /// Description of the write that waits for room at the moment.
    pub fn waiting(&self) -> Option<String> {
        self.waiting
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Repeats `attempt`, which writes all of `path` each time, as long as the disk is full.
    ///
    /// # Errors
    /// Returns any other failure at once, and the full disk itself once the run must stop.
    pub fn with_room<T, E: Error + 'static>(
        &self,
        path: &Path,
        mut attempt: impl FnMut() -> Result<T, E>,
    ) -> Result<T, E> {
        let mut wait = None;
        loop {
            match attempt() {
                Err(error) if is_full(&error) && !self.stop.load(Ordering::Relaxed) => {
                    wait.get_or_insert_with(|| Wait::of(self))
                        .once_more(path, &error);
                }
                result => return result,
            }
        }
    }

    /// Returns a writer to the file at `path` that waits for room.
    pub fn patient<W: Write>(&self, path: &Path, inner: W) -> PatientWriter<W> {
        PatientWriter {
            disk: self.clone(),
            path: path.to_owned(),
            inner,
        }
    }
}

/// `true` if `error`, or one of its causes, is a full disk or an exceeded quota.
fn is_full(error: &(dyn Error + 'static)) -> bool {
    successors(Some(error), |&error| error.source())
        .filter_map(|error| error.downcast_ref::<io::Error>())
        .any(|error| {
            matches!(
                error.kind(),
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded
            )
        })
}

/// A write that waits for room.
struct Wait<'a> {
    disk: &'a Disk,
    warned: Option<Instant>,
}

impl<'a> Wait<'a> {
    fn of(disk: &'a Disk) -> Self {
        Self { disk, warned: None }
    }

    fn once_more(&mut self, path: &Path, error: &dyn Error) {
        if self
            .warned
            .is_none_or(|warned| warned.elapsed() >= WARN_EVERY)
        {
            self.warned = Some(Instant::now());
            tracing::warn!(path = %path.display(), %error, "disk full: training waits for room");
        }
        let text = format!("waiting for room on the disk to write {}", path.display());
        *self
            .disk
            .waiting
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = Some(text);
        thread::sleep(self.disk.pause);
    }
}

impl Drop for Wait<'_> {
    fn drop(&mut self) {
        // Another waiting writer sets its own text again within one pause.
        *self
            .disk
            .waiting
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = None;
    }
}

/// A writer that waits for room instead of failing: see [`Disk::patient`].
#[derive(Debug)]
pub struct PatientWriter<W> {
    disk: Disk,
    path: PathBuf,
    inner: W,
}

impl<W: Write> Write for PatientWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Self { disk, path, inner } = self;
        // The system reports a full disk only if it took none of these bytes.
        disk.with_room(path, || inner.write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        let Self { disk, path, inner } = self;
        disk.with_room(path, || inner.flush())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disk that has room again after `refusals` attempts.
    struct SmallDisk {
        written: Vec<u8>,
        refusals: usize,
    }

    impl Write for SmallDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.written.len() >= 5 && self.refusals > 0 {
                self.refusals -= 1;
                return Err(ErrorKind::StorageFull.into());
            }
            // Never all bytes at once, like a disk that is nearly full.
            let taken = bytes.len().min(3);
            self.written.extend_from_slice(&bytes[..taken]);
            Ok(taken)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn disk() -> Disk {
        Disk {
            pause: Duration::from_millis(1),
            ..Disk::new(Arc::default())
        }
    }

    #[test]
    fn what_waited_for_room_is_written_once() {
        let disk = disk();
        let small = SmallDisk {
            written: Vec::new(),
            refusals: 4,
        };
        let mut writer =
            io::BufWriter::with_capacity(4, disk.patient(Path::new("episodes.csv"), small));
        for text in ["one,", "two,", "three,", "four"] {
            writer.write_all(text.as_bytes()).unwrap();
        }
        writer.flush().unwrap();
        assert_eq!(writer.get_ref().inner.written, b"one,two,three,four");
        assert_eq!(writer.get_ref().inner.refusals, 0, "there was always room");
        assert_eq!(disk.waiting(), None);
    }

    #[test]
    fn a_waiting_write_is_reported_until_the_run_stops() {
        let disk = disk();
        let for_thread = disk.clone();
        let waiting = thread::spawn(move || {
            for_thread.with_room(Path::new("/somewhere/episode-3"), || {
                Err::<(), _>(io::Error::from(ErrorKind::QuotaExceeded))
            })
        });
        let end = Instant::now() + Duration::from_secs(10);
        while disk.waiting().is_none() && Instant::now() < end {
            thread::sleep(Duration::from_millis(1));
        }
        assert!(disk.waiting().unwrap().contains("/somewhere/episode-3"));
        disk.stop.store(true, Ordering::Relaxed);
        assert_eq!(
            waiting.join().unwrap().unwrap_err().kind(),
            ErrorKind::QuotaExceeded
        );
    }

    #[test]
    fn other_failures_are_not_waited_for() {
        // No room appears beyond the process's limit of file sizes.
        for failure in [ErrorKind::PermissionDenied, ErrorKind::FileTooLarge] {
            let mut attempts = 0;
            let error = disk().with_room(Path::new("x"), || {
                attempts += 1;
                Err::<(), _>(io::Error::from(failure))
            });
            assert_eq!((error.unwrap_err().kind(), attempts), (failure, 1));
        }
    }
}
