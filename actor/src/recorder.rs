//! Recordings of a run's episodes, `run.record_every`: copies of their records, written as MCAP by
//! a thread of their own.
//!
//! Flying never waits for it. A recording that the thread cannot take, or the disk has no room for,
//! is left out. The folder keeps the newest recordings, up to a number and a size.

use std::fs::{self, DirBuilder};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime};

use rustix::process::setpriority_process;
use skein_protocol::config::Config;
use skein_protocol::evaluation::EpisodeScore;
use skein_protocol::ids::EpisodeId;
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::stages::Stage;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{Outcome, RecordLengths, TransitionRecord};
use skein_recordings::{Episode, Recording};
use skein_rollout::courses::Courses;
use skein_rollout::environment_loop::{Directive, RecordLink};
use tracing::{debug, warn};

/// Most recordings in the folder.
pub const MOST_RECORDINGS: usize = 200;
/// Most bytes of the recordings in the folder.
pub const MOST_BYTES: u64 = 256 << 20;
/// Episodes that wait to be written, each at most 2.5 MB.
const QUEUE: usize = 2;
/// Longest time that the end of the process waits for the last recordings.
const ENDING_PATIENCE: Duration = Duration::from_secs(3);
/// A low priority: flying and learning come first. With the lowest, a busy machine would record
/// nothing.
const NICE: i32 = 10;
const EXTENSION: &str = "mcap";
/// Extension of a recording that is not complete.
const UNFINISHED: &str = "mcap.tmp";

/// Records the episodes that an actor flies, as far as the run asks for it.
#[derive(Debug)]
pub struct Recorder {
    choice: Choice,
    /// Records of the present episode; the memory is used again.
    tape: Vec<TransitionRecord>,
    to_writer: Option<SyncSender<Flown>>,
    writer: Option<JoinHandle<()>>,
}

/// Decides which episodes are recorded, by their tickets.
#[derive(Debug)]
struct Choice {
    every: u64,
    /// Seed of the first episode that an evaluation flies on each course.
    first_seed: u64,
}

/// Answer of a [`Choice`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Recorded {
    Never,
    Always,
    /// Unless the drone reaches the end.
    IfFailed,
}

/// An episode to write.
#[derive(Debug)]
struct Flown {
    ticket: Ticket,
    score: EpisodeScore,
    records: Vec<TransitionRecord>,
}

impl Recorder {
    /// Starts the writing thread, which writes to `folder`; `None` if the run records nothing.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub fn start(
        config: &Config,
        folder: PathBuf,
        courses: Arc<Courses>,
    ) -> io::Result<Option<Self>> {
        let Some(every) = config.run.record_every else {
            return Ok(None);
        };
        let (to_writer, inbox) = sync_channel(QUEUE);
        let lengths = config.record_lengths();
        let writer = thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || write_all(&inbox, &folder, &courses, lengths))?;
        Ok(Some(Self {
            choice: Choice {
                every,
                first_seed: derive(config.run.seed, Purpose::EvaluationEpisode, 0),
            },
            tape: Vec::new(),
            to_writer: Some(to_writer),
            writer: Some(writer),
        }))
    }

    /// Returns `link` with a copy of the records of `ticket` if they may be needed.
    pub(crate) fn tap<'a, L>(&'a mut self, ticket: &Ticket, link: &'a mut L) -> Tapped<'a, L> {
        self.tape.clear();
        let tape = match self.choice.of(ticket) {
            Recorded::Never => None,
            Recorded::Always | Recorded::IfFailed => Some(&mut self.tape),
        };
        Tapped { link, tape }
    }

    /// Hands the episode of `ticket`, flown to its end through [`Recorder::tap`], to the writing
    /// thread if it is to be recorded.
    pub(crate) fn keep(&mut self, ticket: &Ticket, score: EpisodeScore) {
        let keeps = match self.choice.of(ticket) {
            Recorded::Never => false,
            Recorded::Always => true,
            Recorded::IfFailed => score.outcome != Outcome::ReachedEnd,
        };
        let Some(writer) = self.to_writer.as_ref().filter(|_| keeps) else {
            return;
        };
        let flown = Flown {
            ticket: ticket.clone(),
            score,
            records: std::mem::take(&mut self.tape),
        };
        match writer.try_send(flown) {
            Ok(()) => {}
            Err(TrySendError::Full(flown)) => {
                warn!(episode = %flown.ticket.episode, "not recorded: the writer is busy");
                self.tape = flown.records;
            }
            Err(TrySendError::Disconnected(_)) => warn!("not recorded: the writer has ended"),
        }
    }
}

impl Drop for Recorder {
    /// Waits for the recordings under way, for a short time.
    fn drop(&mut self) {
        self.to_writer = None;
        let Some(writer) = self.writer.take() else {
            return;
        };
        let deadline = Instant::now() + ENDING_PATIENCE;
        while !writer.is_finished() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Choice {
    fn of(&self, ticket: &Ticket) -> Recorded {
        let is_evaluation = ticket.episode >= EpisodeId::FIRST_EVALUATION;
        match is_evaluation {
            // A later segment lacks the records of those before.
            _ if ticket.segment.is_some() => Recorded::Never,
            false if ticket.episode.0.is_multiple_of(self.every) => Recorded::Always,
            false => Recorded::Never,
            true if ticket.seed == self.first_seed => Recorded::Always,
            true => Recorded::IfFailed,
        }
    }
}

/// Link that copies records before they are sent.
pub(crate) struct Tapped<'a, L> {
    link: &'a mut L,
    tape: Option<&'a mut Vec<TransitionRecord>>,
}

impl<L: RecordLink> RecordLink for Tapped<'_, L> {
    type Loan = L::Loan;
    type Error = L::Error;

    fn loan(&mut self) -> Result<L::Loan, L::Error> {
        self.link.loan()
    }

    fn send(&mut self, record: L::Loan) -> Result<(), L::Error> {
        if let Some(tape) = &mut self.tape {
            tape.push(*record);
        }
        self.link.send(record)
    }

    fn directive(&mut self) -> Result<Directive, L::Error> {
        self.link.directive()
    }

    fn lap(&mut self, stage: Stage) {
        self.link.lap(stage);
    }
}

/// Body of the writing thread.
fn write_all(inbox: &Receiver<Flown>, folder: &Path, courses: &Courses, lengths: RecordLengths) {
    // On Linux, a priority is the thread's own.
    if let Err(error) = setpriority_process(None, NICE) {
        debug!(%error, "the recorder keeps its priority");
    }
    for flown in inbox {
        let name = name(&flown.ticket, &flown.score);
        if let Err(error) = write(&flown, &folder.join(&name), courses, lengths) {
            warn!(%error, recording = name, "not recorded");
        }
        if let Err(error) = drop_oldest(folder, MOST_RECORDINGS, MOST_BYTES) {
            warn!(%error, "old recordings are not removed");
        }
    }
}

/// Returns the name of a recording, which says what became of the episode.
fn name(ticket: &Ticket, score: &EpisodeScore) -> String {
    let episode = match ticket.episode.in_evaluation() {
        Some((evaluation, number)) => format!("evaluation-{evaluation}-{number}"),
        None => format!("training-{}", ticket.episode),
    };
    let EpisodeScore {
        walls_passed,
        walls,
        outcome,
        ..
    } = score;
    let outcome = outcome.name();
    format!("{episode}-{outcome}-{walls_passed}of{walls}.{EXTENSION}")
}

fn write(flown: &Flown, path: &Path, courses: &Courses, lengths: RecordLengths) -> io::Result<()> {
    let (course, settings) = courses.course(&flown.ticket).map_err(io::Error::other)?;
    let (title, number) = match flown.ticket.episode.in_evaluation() {
        Some((evaluation, number)) => (
            format!(
                "{}, evaluation {evaluation}, episode {number}",
                course.name()
            ),
            number as i32,
        ),
        None => (format!("training episode {}", flown.ticket.episode), 0),
    };
    if let Some(folder) = path.parent() {
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(folder)?;
    }
    // Several actors write to the folder: the process keeps their unfinished files apart.
    let unfinished = path.with_extension(format!("{}.{UNFINISHED}", std::process::id()));
    let episode = Episode {
        title: &title,
        course: (&course, 0),
        number,
        lengths,
        score: flown.score,
    };
    let written = Recording::create(
        &unfinished,
        settings,
        lengths.action,
        &[course.name()],
        None,
    )
    .and_then(|mut recording| {
        recording.add(&episode, flown.records.iter())?;
        recording.finish()
    })
    .and_then(|()| fs::rename(&unfinished, path));
    if written.is_err() {
        // If there is none, removing it does nothing.
        let _ = fs::remove_file(&unfinished);
    }
    written
}

/// Removes the oldest recordings of `folder` until `most` of at most `most_bytes` are left. Removes
/// what dead actors left unfinished too.
fn drop_oldest(folder: &Path, most: usize, most_bytes: u64) -> io::Result<()> {
    let mut recordings: Vec<(SystemTime, u64, PathBuf)> = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let is_unfinished = path.extension().is_some_and(|extension| extension == "tmp");
        let is_recording = path
            .extension()
            .is_some_and(|extension| extension == EXTENSION);
        // Another actor may have removed or renamed it.
        let Ok(about) = fs::metadata(&path) else {
            continue;
        };
        let Ok(changed) = about.modified() else {
            continue;
        };
        if is_recording {
            recordings.push((changed, about.len(), path));
        } else if is_unfinished && changed.elapsed().is_ok_and(|age| age > ABANDONED) {
            remove(&path)?;
        }
    }
    recordings.sort_unstable_by(|one, other| other.cmp(one));
    let mut bytes = 0;
    for (number, (_, length, path)) in recordings.iter().enumerate() {
        bytes += length;
        if number >= most || bytes > most_bytes {
            remove(path)?;
        }
    }
    Ok(())
}

/// Age at which nobody writes to an unfinished recording any more.
const ABANDONED: Duration = Duration::from_secs(600);

/// Removes a file that another actor may have removed.
fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::ids::{Attempt, PolicyVersion, RunId};
    use skein_protocol::segment::Segment;
    use skein_protocol::ticket::{CourseChoice, Exploration};

    use super::*;

    fn ticket(episode: u64, seed: u64) -> Ticket {
        Ticket {
            run: RunId(1),
            episode: EpisodeId(episode),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Mode,
            seed,
            teacher_share: None,
            segment: None,
        }
    }

    #[test]
    fn every_nth_episode_each_courses_first_and_what_failed_is_recorded() {
        let choice = Choice {
            every: 50,
            first_seed: 7,
        };
        let training: Vec<_> = (0..120)
            .filter(|&episode| choice.of(&ticket(episode, 7)) == Recorded::Always)
            .collect();
        assert_eq!(training, [0, 50, 100]);
        assert_eq!(choice.of(&ticket(51, 7)), Recorded::Never);
        let evaluation = EpisodeId::FIRST_EVALUATION.0 + 33;
        assert_eq!(choice.of(&ticket(evaluation, 7)), Recorded::Always);
        assert_eq!(choice.of(&ticket(evaluation, 8)), Recorded::IfFailed);
        let segment = Ticket {
            segment: Some(Segment {
                steps: 5,
                prior_actions: [].into(),
            }),
            ..ticket(50, 7)
        };
        assert_eq!(choice.of(&segment), Recorded::Never);
    }

    fn courses() -> Arc<Courses> {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../configs/courses/training.toml"
        );
        let course = skein_simulator::course::Course::load(path).unwrap();
        let settings = skein_simulator::simulator::SimulatorSettings::default();
        Arc::new(Courses::of_courses(settings, vec![Arc::new(course)]))
    }

    /// Records an evaluation episode that failed, and waits for the writing thread.
    fn record_one(folder: &Path) {
        let mut config = Config::default();
        config.run.record_every = Some(1);
        let mut recorder = Recorder::start(&config, folder.to_owned(), courses())
            .unwrap()
            .unwrap();
        let ticket = Ticket {
            course: CourseChoice::Evaluation(0),
            ..ticket(EpisodeId::FIRST_EVALUATION.0 + 3, 8)
        };
        let score = EpisodeScore {
            walls_passed: 2,
            walls: 5,
            episode_return: 0.0,
            outcome: Outcome::Collided,
            hit_wall: Some(3),
        };
        recorder.tape = vec![bytemuck::Zeroable::zeroed(); 2];
        recorder.keep(&ticket, score);
    }

    #[test]
    fn a_recording_says_in_its_name_what_became_of_the_episode() {
        let folder = tempfile::tempdir().unwrap();
        let recordings = folder.path().join("recordings");
        record_one(&recordings);
        let path = recordings.join("evaluation-0-3-collided-2of5.mcap");
        let flights = skein_recordings::read(&fs::read(path).unwrap()).unwrap();
        assert_eq!(flights[0].title, "training, evaluation 0, episode 3");
        assert_eq!((flights[0].steps.len(), flights[0].walls.len()), (2, 5));
        assert_eq!(fs::read_dir(recordings).unwrap().count(), 1);
    }

    #[test]
    fn a_folder_that_cannot_be_written_holds_nothing_up() {
        let folder = tempfile::tempdir().unwrap();
        let taken = folder.path().join("recordings");
        fs::write(&taken, "a file").unwrap();
        let begun = Instant::now();
        record_one(&taken);
        assert!(begun.elapsed() < ENDING_PATIENCE);
        assert_eq!(fs::read(&taken).unwrap(), b"a file");
    }

    #[test]
    fn the_folder_keeps_the_newest_recordings_within_number_and_size() {
        let folder = tempfile::tempdir().unwrap();
        let write = |number: u64, bytes: usize| {
            let path = folder.path().join(format!("training-{number}.mcap"));
            fs::write(&path, vec![0; bytes]).unwrap();
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1000 + number);
            fs::File::options()
                .write(true)
                .open(&path)
                .unwrap()
                .set_modified(time)
                .unwrap();
        };
        let kept = || {
            let entries = fs::read_dir(folder.path()).unwrap();
            let mut names: Vec<_> = entries
                .map(|entry| entry.unwrap().file_name().into_string().unwrap())
                .collect();
            names.sort();
            names
        };
        (0..5).for_each(|number| write(number, 100));
        drop_oldest(folder.path(), 3, 1000).unwrap();
        assert_eq!(
            kept(),
            ["training-2.mcap", "training-3.mcap", "training-4.mcap"]
        );
        fs::write(folder.path().join("notes.txt"), "not ours").unwrap();
        drop_oldest(folder.path(), 3, 250).unwrap();
        assert_eq!(kept(), ["notes.txt", "training-3.mcap", "training-4.mcap"]);
    }
}
