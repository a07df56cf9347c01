//! The learner's side: receiver as in a run, with a training thread that only takes episodes out.

use std::collections::VecDeque;
use std::hint::black_box;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::thread::sleep;
use std::time::{Duration, Instant};

use skein_learner::episode::CommittedEpisode;
use skein_learner::episodes::assembly::KeptData;
use skein_learner::episodes::exchange::EpisodeBatch;
use skein_learner::episodes::receiver::EpisodeReceiver;
use skein_learner::threads::cpu_secs;
use skein_protocol::config::Config;
use skein_protocol::ids::{Attempt, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_protocol::transition::TransitionRecord;
use skein_run::{LearnerLock, RunDirectory, RunIdentity};
use tempfile::TempDir;

use crate::SYNTHETIC_ACTOR;
use crate::synthetic::STEPS;

/// Longest time for actors to attach, and to leave.
const PATIENCE: Duration = Duration::from_secs(60);
/// Batches ordered ahead, so that no actor waits for orders.
const BATCHES_AHEAD: usize = 3;

/// Settings of one measurement.
pub(crate) struct Load {
    pub(crate) keep: KeptData,
    pub(crate) warm_up: Duration,
    pub(crate) measured: Duration,
}

/// Results of one measurement.
pub(crate) struct Throughput {
    /// Rate of records in episodes that were taken out of their batches, whole and in order.
    pub(crate) records_per_second: f64,
    /// Processor time per record of the receiving thread.
    pub(crate) thread_micros: f64,
    /// Processor time per record of the whole learner.
    pub(crate) process_micros: f64,
    /// Time to copy a record's bytes in this process.
    pub(crate) copy_micros: f64,
}

/// A learner, its actors, and the episodes it has ordered.
pub(crate) struct Learner {
    identity: RunIdentity,
    directory: RunDirectory,
    receiver: EpisodeReceiver,
    actors: Vec<Child>,
    batches: VecDeque<EpisodeBatch>,
    next_episode: u64,
    // Last, because the others use it.
    _lock: LearnerLock,
    _folder: TempDir,
}

impl Learner {
    /// Starts a learner with a new run, without actors.
    pub(crate) fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let directory = RunDirectory::new(folder.path().canonicalize().unwrap().join("run"));
        let mut config = Config::default();
        // Synthetic actors fly no snapshot.
        config.sac.hidden_width = 8;
        directory.create(&config).unwrap();
        let (identity, config) = directory.open().unwrap();
        let lock = LearnerLock::take(&directory, &identity).unwrap();
        Self {
            receiver: EpisodeReceiver::start(&identity, lock.incarnation(), &config).unwrap(),
            identity,
            directory,
            actors: Vec::new(),
            batches: VecDeque::new(),
            next_episode: 0,
            _lock: lock,
            _folder: folder,
        }
    }

    /// Starts synthetic actors until there are `count`.
    pub(crate) fn start_actors(&mut self, count: u32) {
        for number in self.actors.len()..count as usize {
            let actor = Command::new(std::env::current_exe().unwrap())
                .arg(SYNTHETIC_ACTOR)
                .arg(self.directory.root())
                .arg(number.to_string())
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .spawn()
                .unwrap();
            self.actors.push(actor);
        }
        let deadline = Instant::now() + PATIENCE;
        while self.receiver.state().live_actors().len() < self.actors.len() {
            assert!(
                Instant::now() < deadline,
                "not all of {count} actors have come"
            );
            sleep(Duration::from_millis(5));
        }
    }

    /// Measures the learner's costs under `load`.
    pub(crate) fn throughput(&mut self, load: &Load) -> Throughput {
        let copy_micros = copy_micros(load.measured / 4);
        self.take_episodes(load.keep, load.warm_up);
        let cpu = || {
            let threads = cpu_secs();
            (threads["receiver"], threads.values().sum::<f64>())
        };
        let (began, (thread_before, process_before)) = (Instant::now(), cpu());
        let records = self.take_episodes(load.keep, load.measured) as f64;
        let (took, (thread_after, process_after)) = (began.elapsed(), cpu());
        self.take_rest();

        let faults = self.receiver.state().faults();
        assert!(
            faults
                .reissued_by_reason()
                .values()
                .all(|&count| count == 0),
            "{faults:?}"
        );
        assert!(
            faults.refused_by_reason().values().all(|&count| count == 0),
            "{faults:?}"
        );
        let micros = |secs: f64| secs * 1e6 / records;
        Throughput {
            records_per_second: records / took.as_secs_f64(),
            thread_micros: micros(thread_after - thread_before),
            process_micros: micros(process_after - process_before),
            copy_micros,
        }
    }

    /// Tells the actors to leave, and ends.
    pub(crate) fn finish(mut self) {
        self.receiver.finish();
        await_ends(&mut self.actors);
    }

    /// Orders episodes and takes them out for `time`; returns the number of their records.
    fn take_episodes(&mut self, keep: KeptData, time: Duration) -> usize {
        let end = Instant::now() + time;
        let mut records = 0;
        while Instant::now() < end {
            while self.batches.len() < BATCHES_AHEAD {
                self.order(keep);
            }
            match self.batches[0].next(&AtomicBool::new(false)).unwrap() {
                Some(episode) => records += look_at(&episode, keep),
                None => drop(self.batches.pop_front()),
            }
        }
        records
    }

    /// Takes out what is still ordered.
    fn take_rest(&mut self) {
        for mut batch in self.batches.drain(..) {
            while batch.next(&AtomicBool::new(false)).unwrap().is_some() {}
        }
    }

    fn order(&mut self, keep: KeptData) {
        let episodes = (4 * self.actors.len() as u64).max(16);
        let numbers = self.next_episode..self.next_episode + episodes;
        let ticket = |episode| Ticket {
            run: self.identity.run,
            episode: EpisodeId(episode),
            attempt: Attempt(0),
            policy_version: PolicyVersion(0),
            course: CourseChoice::Training,
            start_level: 1,
            exploration: Exploration::Sample,
            seed: episode,
            teacher_share: None,
            segment: None,
        };
        let tickets = numbers.clone().map(ticket).collect();
        self.batches
            .push_back(self.receiver.fly(Epoch(0), keep, tickets).unwrap());
        self.next_episode = numbers.end;
    }
}

/// Checks that an episode is complete; returns the number of its records.
fn look_at(episode: &CommittedEpisode, keep: KeptData) -> usize {
    episode.check().unwrap();
    assert_eq!(episode.steps(), STEPS as usize);
    assert_eq!(episode.depth.is_some(), keep == KeptData::Depth);
    if let Some(depth) = &episode.depth {
        assert_eq!(
            (depth[0], depth[depth.len() - 1]),
            (episode.actor.0 as u8, episode.actor.0 as u8)
        );
    }
    episode.observations.len()
}

/// Waits for the actors to end; kills those that do not.
fn await_ends(actors: &mut [Child]) {
    let deadline = Instant::now() + PATIENCE;
    for actor in actors {
        while actor.try_wait().unwrap().is_none() {
            if Instant::now() > deadline {
                actor.kill().unwrap();
                panic!("an actor does not end");
            }
            sleep(Duration::from_millis(5));
        }
        assert!(actor.wait().unwrap().success());
    }
}

/// Time to copy a record from memory as large as an actor's into an episode, as [`KeptData::Depth`]
/// does.
fn copy_micros(time: Duration) -> f64 {
    let record = size_of::<TransitionRecord>();
    let (of_actor, of_episode) = (512, STEPS as usize + 1);
    let from = vec![7_u8; of_actor * record];
    let mut into = vec![0_u8; of_episode * record];
    let (began, mut copied) = (Instant::now(), 0_usize);
    while began.elapsed() < time {
        for _ in 0..of_episode {
            let (source, target) = (copied % of_actor * record, copied % of_episode * record);
            into[target..target + record]
                .copy_from_slice(black_box(&from[source..source + record]));
            copied += 1;
        }
        black_box(&mut into);
    }
    began.elapsed().as_secs_f64() * 1e6 / copied as f64
}
