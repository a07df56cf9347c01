//! ProgressReport lines on standard output while the learner runs.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use skein_protocol::progress::ProgressReport;

use crate::disk::Disk;
use crate::episodes::ReceiverState;
use crate::watchdog::Watchdog;

/// Time between two lines.
const INTERVAL: Duration = Duration::from_millis(500);
/// Longest wait for the last line.
const LAST_LINE_PATIENCE: Duration = Duration::from_secs(2);
/// Number of intervals that rates are averaged over.
const RATE_INTERVALS: usize = 10;

/// Prints the learner's progress at intervals, whatever the training thread is doing.
#[derive(Debug)]
pub(crate) struct Reporter {
    progress: Arc<Mutex<ProgressReport>>,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Reporter {
    /// Starts reporting, with `progress` as the first line. Its `elapsed_secs` are those of earlier
    /// incarnations; the time of this one is added.
    ///
    /// # Errors
    /// When the system grants no thread.
    pub(crate) fn start(
        progress: ProgressReport,
        receiver: Arc<ReceiverState>,
        disk: Disk,
    ) -> std::io::Result<Self> {
        let progress = Arc::new(Mutex::new(progress));
        let ended = Arc::new(AtomicBool::new(false));
        let (of_thread, end_of_thread) = (progress.clone(), ended.clone());
        let thread = thread::Builder::new()
            .name("progress".to_owned())
            .spawn(move || report(&of_thread, &end_of_thread, &receiver, &disk))?;
        Ok(Self {
            progress,
            ended,
            thread: Some(thread),
        })
    }

    /// Changes the contents of the next line.
    pub(crate) fn update(&self, change: impl FnOnce(&mut ProgressReport)) {
        change(&mut self.progress.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

impl Drop for Reporter {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        let Some(thread) = self.thread.take() else {
            return;
        };
        // The reading process may be frozen and the pipe full. Then the last lines are lost, and
        // the thread ends with the process.
        let deadline = Instant::now() + LAST_LINE_PATIENCE;
        while !thread.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
        if thread.is_finished() {
            // The hook has logged any panic of that thread, and it has no result to lose.
            let _ = thread.join();
        }
    }
}

fn report(
    progress: &Mutex<ProgressReport>,
    ended: &AtomicBool,
    receiver: &ReceiverState,
    disk: &Disk,
) {
    let started = Instant::now();
    let mut watchdog = Watchdog::new(started);
    let mut marks: VecDeque<(f64, u64, u64)> = VecDeque::new();
    loop {
        let last = ended.load(Ordering::Relaxed);
        let mut line = progress
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        line.elapsed_secs += started.elapsed().as_secs_f64();
        line.stalled = watchdog.look(Instant::now(), &line, disk.waiting(), receiver.situation());
        let faults = receiver.faults();
        line.reissued = faults.reissued_by_reason();
        line.refused = faults.refused_by_reason();
        line.live_actors = receiver.live_actors();
        line.actors = line.live_actors.len();
        if marks.len() > RATE_INTERVALS {
            marks.pop_front();
        }
        marks.push_back((line.elapsed_secs, line.steps, line.updates));
        let (since, steps, updates) = marks[0];
        let secs = (line.elapsed_secs - since).max(1e-9);
        if line.elapsed_secs > since {
            line.steps_per_sec = (line.steps - steps) as f64 / secs;
            line.updates_per_sec = (line.updates - updates) as f64 / secs;
        }
        if let Ok(json) = serde_json::to_string(&line) {
            // Standard output may be closed; then the line is not missed.
            let _ = writeln!(std::io::stdout().lock(), "{json}");
        }
        if last {
            return;
        }
        thread::sleep(INTERVAL);
    }
}
