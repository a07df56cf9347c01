//! Evaluation of a snapshot without a learner, entry by entry: single courses, or the entries of a
//! suite.
//!
//! It flies episodes with the environment loop, on tickets of its own: mode actions, start of level
//! 1, seeds derived from the run's. Episodes are spread over all cores; the result does not depend
//! on the threads.

use std::convert::Infallible;
use std::io;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::Zeroable;
use skein_protocol::config::Config;
use skein_protocol::evaluation::{CourseEvaluation, EpisodeScore, EvaluationReport};
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, RunId};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_protocol::transition::{Outcome, TransitionRecord};

use crate::agent::Agent;
use crate::courses::{Courses, Simulators};
use crate::environment_loop::{Directive, EnvironmentLoop, EpisodeError, EpisodeFault, RecordLink};
use skein_inference::Network;

/// Most threads of an evaluation: more than the cores of any known machine, few enough for every
/// system's limits.
pub const MAX_THREADS: usize = 512;

/// An evaluation to fly.
#[derive(Debug)]
pub struct Evaluation<'a> {
    /// The policy.
    pub snapshot: &'a Snapshot,
    /// The configuration it was trained with.
    pub config: &'a Config,
    /// Courses; each evaluation entry is flown as often as it says.
    pub courses: Arc<Courses>,
    /// Most threads to fly on. The result does not depend on it. See [`Evaluation::threads`].
    pub threads: NonZeroUsize,
    /// Data to keep of the episodes.
    pub keep: Keep,
}

/// Data to keep of the episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Scores only.
    Scores,
    /// Also the positions in the first so many episodes of each entry, 12 bytes per step.
    Positions(u64),
    /// Also all positions and, of episodes that did not reach the end wall, the last records: the
    /// closing one and so many before it.
    Failures(usize),
    /// Every record and position, 9.3 KiB per step, with what the oracle would have done.
    Records,
}

/// Result of an evaluation.
#[derive(Debug)]
pub struct EvaluationResult {
    /// Report, entry by entry.
    pub report: EvaluationReport,
    /// Episodes, entry by entry.
    pub episodes: Vec<Vec<EvaluatedEpisode>>,
}

/// One episode of an evaluation.
#[derive(Debug, Clone)]
pub struct EvaluatedEpisode {
    /// Score.
    pub score: EpisodeScore,
    /// Positions of the drone at each step and at the end, world frame, metres, if they are kept.
    pub positions_m: Vec<[f32; 3]>,
    /// Its steps and its closing record, if they are kept.
    pub records: Vec<Box<TransitionRecord>>,
}

/// Reason why an evaluation failed.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// An episode cannot be flown.
    #[error("course \"{course}\", episode {episode}: {fault}")]
    Episode {
        /// The course or entry.
        course: String,
        /// The episode's number in that entry, from 0.
        episode: u64,
        /// Cause.
        #[source]
        fault: EpisodeFault,
    },
    /// The system cannot start so many threads.
    #[error("cannot start thread {thread} of {threads}: {source}; ask for fewer")]
    Thread {
        /// The thread's number, from 1.
        thread: usize,
        /// Number of threads wanted.
        threads: usize,
        /// Cause.
        source: io::Error,
    },
}

impl Evaluation<'_> {
    /// Returns the number of threads: at most one per episode and [`MAX_THREADS`].
    pub fn threads(&self) -> usize {
        let episodes = usize::try_from(self.total()).unwrap_or(usize::MAX);
        self.threads.get().min(episodes).min(MAX_THREADS)
    }

    /// Flies all episodes.
    ///
    /// # Errors
    /// [`EvaluationError`] names the first episode, in entry and episode order, that cannot be
    /// flown, or the thread that cannot be started.
    pub fn run(&self) -> Result<EvaluationResult, EvaluationError> {
        self.run_and_tell(&|_| {})
    }

    /// As [`Evaluation::run`]; calls `tell` with the number of episodes flown, each time it grows,
    /// from several threads.
    ///
    /// # Errors
    /// As for [`Evaluation::run`].
    pub fn run_and_tell(
        &self,
        tell: &(dyn Fn(u64) + Sync),
    ) -> Result<EvaluationResult, EvaluationError> {
        let mut episodes = self.fly_all(tell)?.into_iter();
        let mut courses = Vec::new();
        let mut by_course = Vec::new();
        for entry in self.courses.evaluation() {
            let episodes: Vec<_> = episodes
                .by_ref()
                .take(entry.episodes as usize)
                .collect::<Result<_, _>>()?;
            let scores: Vec<_> = episodes
                .iter()
                .map(|episode: &EvaluatedEpisode| episode.score)
                .collect();
            courses.push(CourseEvaluation::of(&entry.name, &scores));
            by_course.push(episodes);
        }
        let report = EvaluationReport {
            policy_version: self.snapshot.version,
            policy_sha256: self.snapshot.sha256(),
            courses,
        };
        Ok(EvaluationResult {
            report,
            episodes: by_course,
        })
    }

    /// Flies all episodes; returns them in entry and episode order.
    fn fly_all(
        &self,
        tell: &(dyn Fn(u64) + Sync),
    ) -> Result<Vec<Result<EvaluatedEpisode, EvaluationError>>, EvaluationError> {
        let network = Network::new(self.snapshot, &SnapshotLayout::of(self.config));
        let counts = Counts {
            next: AtomicU64::new(0),
            flown: AtomicU64::new(0),
            tell,
        };
        let threads = self.threads();
        let mut flown: Vec<_> = std::thread::scope(|scope| {
            let start = |thread: usize| {
                std::thread::Builder::new()
                    .name(format!("evaluation-{thread}"))
                    .spawn_scoped(scope, || self.fly_next_until_done(&network, &counts))
                    .map_err(|source| {
                        // Running threads find no episode left.
                        counts.next.store(self.total(), Ordering::Relaxed);
                        EvaluationError::Thread {
                            thread,
                            threads,
                            source,
                        }
                    })
            };
            let started = (1..=threads).map(start).collect::<Result<Vec<_>, _>>()?;
            Ok(started
                .into_iter()
                .flat_map(|thread| {
                    thread
                        .join()
                        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))
                })
                .collect())
        })?;
        flown.sort_by_key(|(index, _)| *index);
        Ok(flown.into_iter().map(|(_, episode)| episode).collect())
    }

    /// Returns the number of episodes of all entries.
    pub fn total(&self) -> u64 {
        self.courses.evaluation().map(|entry| entry.episodes).sum()
    }

    /// Returns entry and episode of the episode `index` of all, from 0.
    fn entry_and_episode(&self, mut index: u64) -> Option<(u32, u64)> {
        for (entry, number) in self.courses.evaluation().zip(0..) {
            if index < entry.episodes {
                return Some((number, index));
            }
            index -= entry.episodes;
        }
        None
    }

    /// Work of one thread: flies the next episode until none is left.
    fn fly_next_until_done(
        &self,
        network: &Network,
        counts: &Counts<'_>,
    ) -> Vec<(u64, Result<EvaluatedEpisode, EvaluationError>)> {
        let simulators = Simulators::new(Arc::clone(&self.courses));
        let agent = Agent::new(self.config.observation_layout());
        let mut environment_loop =
            EnvironmentLoop::new(ActorId(0), ActorIncarnation(0), simulators, agent);
        let mut flown = Vec::new();
        loop {
            let index = counts.next.fetch_add(1, Ordering::Relaxed);
            let Some((entry, episode)) = self.entry_and_episode(index) else {
                return flown;
            };
            flown.push((
                index,
                self.fly(&mut environment_loop, network, entry, episode),
            ));
            (counts.tell)(counts.flown.fetch_add(1, Ordering::Relaxed) + 1);
        }
    }

    fn fly(
        &self,
        environment_loop: &mut EnvironmentLoop,
        network: &Network,
        entry: u32,
        episode: u64,
    ) -> Result<EvaluatedEpisode, EvaluationError> {
        let ticket = Ticket {
            run: RunId(0),
            episode: EpisodeId(EpisodeId::FIRST_EVALUATION.0 + episode),
            attempt: Attempt(0),
            policy_version: self.snapshot.version,
            course: CourseChoice::Evaluation(entry),
            start_level: 1,
            exploration: Exploration::Mode,
            seed: derive(self.config.run.seed, Purpose::EvaluationEpisode, episode),
            // The oracle is asked for recordings alone, and never flies.
            teacher_share: (self.keep == Keep::Records).then_some(0.0),
            segment: None,
        };
        let mut memory = MemoryLink {
            keep: match self.keep {
                Keep::Positions(first) if episode >= first => Keep::Scores,
                keep => keep,
            },
            positions_m: Vec::new(),
            spare: Vec::new(),
            sent: Vec::new(),
        };
        match environment_loop.fly(&ticket, network, &mut memory) {
            Ok(Some(score)) => Ok(EvaluatedEpisode {
                score,
                positions_m: memory.positions_m,
                records: match (memory.keep, score.outcome) {
                    (Keep::Failures(_), Outcome::ReachedEnd) => Vec::new(),
                    _ => memory.sent,
                },
            }),
            Err(EpisodeError::Fault(fault)) => {
                let names = self.courses.evaluation().map(|entry| entry.name.clone());
                let course = names.into_iter().nth(entry as usize).unwrap_or_default();
                Err(EvaluationError::Episode {
                    course,
                    episode,
                    fault,
                })
            }
            Err(EpisodeError::Link(never)) => match never {},
            Ok(None) => unreachable!("the ticket is for a whole episode"),
            Err(EpisodeError::Abandoned | EpisodeError::Foreign(_)) => {
                unreachable!("an evaluation is never abandoned, nor flown elsewhere")
            }
        }
    }
}

/// Episodes of all entries, counted by all threads.
struct Counts<'a> {
    /// The next one to fly.
    next: AtomicU64,
    flown: AtomicU64,
    tell: &'a (dyn Fn(u64) + Sync),
}

/// Link that keeps records in plain memory.
struct MemoryLink {
    keep: Keep,
    positions_m: Vec<[f32; 3]>,
    spare: Vec<Box<TransitionRecord>>,
    sent: Vec<Box<TransitionRecord>>,
}

impl RecordLink for MemoryLink {
    type Loan = Box<TransitionRecord>;
    type Error = Infallible;

    fn loan(&mut self) -> Result<Box<TransitionRecord>, Infallible> {
        Ok(self
            .spare
            .pop()
            .unwrap_or_else(|| Box::new(TransitionRecord::zeroed())))
    }

    fn send(&mut self, record: Box<TransitionRecord>) -> Result<(), Infallible> {
        if self.keep != Keep::Scores {
            self.positions_m.push(record.position_m);
        }
        match self.keep {
            Keep::Scores | Keep::Positions(_) => self.spare.push(record),
            Keep::Failures(before_end) => {
                self.sent.push(record);
                if self.sent.len() > before_end + 1 {
                    self.spare.push(self.sent.remove(0));
                }
            }
            Keep::Records => self.sent.push(record),
        }
        Ok(())
    }

    fn directive(&mut self) -> Result<Directive, Infallible> {
        Ok(Directive::Continue)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{config, random_snapshot};

    /// Calls `look` with an evaluation on two courses.
    fn look_at<T>(
        episodes: u64,
        threads: usize,
        keep: Keep,
        look: impl Fn(&Evaluation<'_>) -> T,
    ) -> T {
        let mut config = config("");
        config.courses.evaluation.truncate(2);
        look(&Evaluation {
            snapshot: &random_snapshot(&SnapshotLayout::of(&config), 3),
            config: &config,
            courses: Arc::new(
                Courses::of_files(&config, &config.courses.evaluation)
                    .unwrap()
                    .with_episodes(episodes),
            ),
            threads: NonZeroUsize::new(threads).unwrap(),
            keep,
        })
    }

    fn evaluated(threads: usize, keep: Keep) -> EvaluationResult {
        look_at(5, threads, keep, |evaluation| evaluation.run().unwrap())
    }

    #[test]
    fn threads_are_limited_by_episodes_and_absolutely() {
        let threads = |episodes, threads| {
            look_at(episodes, threads, Keep::Scores, |evaluation| {
                evaluation.threads()
            })
        };
        assert_eq!(threads(5, 3), 3);
        assert_eq!(threads(5, 100_000), 10);
        assert_eq!(threads(1_000_000, 100_000), MAX_THREADS);
    }

    #[test]
    fn each_flown_episode_is_reported_once() {
        let told = std::sync::Mutex::new(Vec::new());
        look_at(5, 3, Keep::Scores, |evaluation| {
            let tell = |flown| told.lock().unwrap().push(flown);
            evaluation.run_and_tell(&tell).unwrap()
        });
        let mut told = told.into_inner().unwrap();
        told.sort_unstable();
        assert_eq!(told, (1..=10).collect::<Vec<_>>());
    }

    #[test]
    fn the_number_of_threads_changes_nothing() {
        let one = evaluated(1, Keep::Records);
        let bytes = |evaluated: &EvaluationResult| {
            let records = evaluated
                .episodes
                .iter()
                .flatten()
                .flat_map(|episode| &episode.records);
            records
                .flat_map(|record| bytemuck::bytes_of(&**record).to_vec())
                .collect::<Vec<u8>>()
        };
        for threads in [2, 7] {
            let many = evaluated(threads, Keep::Records);
            assert_eq!(many.report, one.report);
            assert!(bytes(&many) == bytes(&one));
        }
    }

    #[test]
    fn keeping_records_changes_no_score_and_every_course_has_its_episodes() {
        let (scores, records) = (evaluated(2, Keep::Scores), evaluated(2, Keep::Records));
        assert_eq!(scores.report, records.report);
        assert_eq!(
            scores
                .report
                .courses
                .iter()
                .map(|course| course.episodes)
                .collect::<Vec<_>>(),
            [5, 5]
        );
        assert_ne!(
            scores.report.courses[0].course,
            scores.report.courses[1].course
        );
        assert!(
            scores
                .episodes
                .iter()
                .flatten()
                .all(|episode| episode.records.is_empty())
        );
        let positions = evaluated(2, Keep::Positions(3));
        assert_eq!(positions.report, records.report);
        for (some, all) in positions.episodes.iter().zip(&records.episodes) {
            for (number, (some, all)) in some.iter().zip(all).enumerate() {
                let recorded: Vec<_> = all.records.iter().map(|at| at.position_m).collect();
                assert_eq!(all.positions_m, recorded);
                let kept = if number < 3 { recorded } else { Vec::new() };
                assert_eq!((&some.positions_m, some.records.len()), (&kept, 0));
            }
        }
        let failures = evaluated(2, Keep::Failures(2));
        assert_eq!(failures.report, records.report);
        let of_both = failures.episodes.iter().zip(&records.episodes);
        for (some, all) in of_both.flat_map(|(some, all)| some.iter().zip(all)) {
            assert_eq!(some.positions_m, all.positions_m);
            let last = match some.score.outcome {
                Outcome::ReachedEnd => &[],
                _ => &all.records[all.records.len().saturating_sub(3)..],
            };
            let steps = |records: &[Box<TransitionRecord>]| -> Vec<u32> {
                records.iter().map(|record| record.step).collect()
            };
            assert_eq!(steps(&some.records), steps(last));
        }
        let starts: Vec<_> = records.episodes[0]
            .iter()
            .map(|episode| episode.records[0].position_m)
            .collect();
        assert!(
            starts.windows(2).all(|pair| pair[0] != pair[1]),
            "all episodes differ"
        );
    }
}
