//! Time measurement: the stages of the data flow, and the time that each thread spends in them.
//!
//! A [`LapTimer`] never stops: each lap assigns the time since the last one to a stage. So a
//! thread's stages cover its whole time, their shares sum to one, and a lap costs a single clock
//! reading. Learning depends on none of it.

use std::time::{Duration, Instant};

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// ThreadRole or group of threads that time is measured for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ThreadRole {
    /// All actors together; each has one thread.
    Actors,
    /// The learner's receiving thread.
    Receiving,
    /// The learner's training thread.
    Training,
}

impl ThreadRole {
    /// Returns the name in the summary.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Actors => "actors",
            Self::Receiving => "receiving",
            Self::Training => "training",
        }
    }
}

macro_rules! stages {
    ($($thread:ident { $($(#[$doc:meta])* $stage:ident => $name:literal),* $(,)? })*) => {
        /// A stage of a thread's work, in the order of the data flow. In each description the first
        /// sentence says what is done, the second what is counted.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Stage { $($($(#[$doc])* $stage),*),* }

        impl Stage {
            /// All stages, in the order of the data flow.
            pub const ALL: &[Self] = &[$($(Self::$stage),*),*];

            /// Returns the name in the summary and the table; unique within a thread.
            pub const fn name(self) -> &'static str {
                match self { $($(Self::$stage => $name),*),* }
            }

            /// Returns the thread of the stage.
            pub const fn thread(self) -> ThreadRole {
                match self { $($(Self::$stage => ThreadRole::$thread),*),* }
            }
        }
    };
}

stages! {
    Actors {
        /// Snapshots are received and prepared for flying. Snapshots.
        TakeSnapshot => "snapshot",
        /// The simulator is set to the start of an episode, or to where a segment begins. Episodes,
        /// segments.
        Reset => "reset",
        /// The drone moves until its next decision. Environment steps.
        Physics => "physics",
        /// A depth image is rendered into its record. Observations: one more than steps in each
        /// episode.
        Camera => "camera",
        /// The image is encoded. Observations.
        Encoder => "encoder",
        /// An action is chosen. Environment steps.
        Policy => "policy",
        /// A record is loaned from shared memory, completed by reward and end, and sent. Records.
        Send => "send",
        /// Messages of the learner are read, and heartbeats sent. Reads.
        ActorControl => "control",
        /// No ticket, or no snapshot for it, is available. Waits.
        ActorIdle => "idle",
    }
    Receiving {
        /// Records are checked, assembled into episodes, and delivered. Records.
        Assemble => "assemble",
        /// Orders are received; tickets, snapshots and heartbeats are sent. Rounds.
        HandOut => "hand out",
        /// No record has arrived. Waits.
        ReceivingIdle => "idle",
    }
    Training {
        /// Episodes are stored in replay and metrics. Episodes, segments.
        TakeIn => "take in",
        /// A minibatch of depth images is gathered. Minibatches.
        SampleImages => "sample images",
        /// An update of the VAE. Updates.
        VaeStep => "VAE step",
        /// Stored latent codes are recomputed with the present encoder: every `vae.recode_steps`
        /// steps, and when the VAE is frozen. Times.
        Recode => "recode",
        /// A minibatch of transitions is gathered. Minibatches.
        Sample => "sample",
        /// An update of critic and policy. Updates.
        PolicyUpdate => "policy update",
        /// The parameters are copied into a snapshot and published. Snapshots.
        Publish => "publish",
        /// The trainer waits for evaluation episodes. Episodes.
        Evaluate => "evaluation",
        /// The state is copied for a checkpoint and handed to its writer. Checkpoints.
        Checkpoint => "checkpoint",
        /// Start, orders, curves, final files, interrupted waits. Not counted.
        OtherTraining => "other",
        /// The trainer waits for training episodes. Waits.
        TrainingIdle => "idle",
    }
}

const STAGES: usize = Stage::ALL.len();

/// Number of an actor's stages: the first of [`Stage::ALL`].
pub const ACTOR_STAGES: usize = {
    let mut stages = 0;
    while matches!(Stage::ALL[stages].thread(), ThreadRole::Actors) {
        stages += 1;
    }
    stages
};

/// Count and time of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct StageTime {
    /// Number of times.
    pub count: u64,
    /// Nanoseconds.
    pub nanos: u64,
}

// Part of shared memory: two 8-byte fields, no padding.
const _: () = assert!(size_of::<StageTime>() == 16);

impl StageTime {
    /// Bound of valid values: nine years, in nanoseconds.
    const LIMIT: u64 = 1 << 58;

    fn plus(self, other: Self) -> Self {
        Self {
            count: self.count.saturating_add(other.count),
            nanos: self.nanos.saturating_add(other.nanos),
        }
    }

    fn minus(self, other: Self) -> Self {
        Self {
            count: self.count.saturating_sub(other.count),
            nanos: self.nanos.saturating_sub(other.nanos),
        }
    }

    /// Returns the time in seconds.
    pub fn secs(self) -> f64 {
        self.nanos as f64 / 1e9
    }
}

/// Count and time of every stage.
///
/// Stored as a list without stages that did not occur: `thread`, `stage`, `count`, `secs`. Unknown
/// stages are ignored when it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<StageRow>", into = "Vec<StageRow>")]
pub struct StageTimes([StageTime; STAGES]);

impl Default for StageTimes {
    fn default() -> Self {
        Self([StageTime::default(); STAGES])
    }
}

impl StageTimes {
    /// Returns count and time of `stage`.
    pub fn of(&self, stage: Stage) -> StageTime {
        self.0[stage as usize]
    }

    /// Returns the total time of `thread` in nanoseconds.
    pub fn total_nanos(&self, thread: ThreadRole) -> u64 {
        let own = Stage::ALL.iter().filter(|stage| stage.thread() == thread);
        own.fold(0, |sum, stage| sum.saturating_add(self.of(*stage).nanos))
    }

    /// Adds `count` and `time` to `stage`.
    pub fn add(&mut self, stage: Stage, count: u64, time: Duration) {
        let nanos = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let tally = &mut self.0[stage as usize];
        *tally = tally.plus(StageTime { count, nanos });
    }

    /// Returns the sum of both.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self(std::array::from_fn(|stage| {
            self.0[stage].plus(other.0[stage])
        }))
    }

    /// Returns the difference to `earlier`, zero where that is larger.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|stage| {
            self.0[stage].minus(earlier.0[stage])
        }))
    }

    /// Returns an actor's stages for the wire.
    pub(crate) fn of_actor(&self) -> [StageTime; ACTOR_STAGES] {
        std::array::from_fn(|stage| self.0[stage])
    }

    /// Reads an actor's report; returns `None` if a value is impossible.
    pub(crate) fn read_actor(tallies: &[StageTime; ACTOR_STAGES]) -> Option<Self> {
        let mut times = Self::default();
        times.0[..ACTOR_STAGES].copy_from_slice(tallies);
        let possible =
            |tally: &StageTime| tally.count < StageTime::LIMIT && tally.nanos < StageTime::LIMIT;
        tallies.iter().all(possible).then_some(times)
    }

    /// Returns the stages that occurred.
    pub fn occurred(&self) -> impl Iterator<Item = (Stage, StageTime)> {
        let all = Stage::ALL.iter().map(|stage| (*stage, self.of(*stage)));
        all.filter(|(_, tally)| *tally != StageTime::default())
    }
}

/// A stage of [`StageTimes`] in a file.
#[derive(Serialize, Deserialize)]
struct StageRow {
    thread: String,
    stage: String,
    count: u64,
    secs: f64,
}

impl From<StageTimes> for Vec<StageRow> {
    fn from(times: StageTimes) -> Self {
        let row = |(stage, tally): (Stage, StageTime)| StageRow {
            thread: stage.thread().name().to_owned(),
            stage: stage.name().to_owned(),
            count: tally.count,
            secs: tally.secs(),
        };
        times.occurred().map(row).collect()
    }
}

impl From<Vec<StageRow>> for StageTimes {
    fn from(rows: Vec<StageRow>) -> Self {
        let mut times = Self::default();
        for row in rows {
            let is_of =
                |stage: &&Stage| stage.thread().name() == row.thread && stage.name() == row.stage;
            if let Some(stage) = Stage::ALL.iter().find(is_of) {
                // The cast saturates, so any number in a file becomes a time.
                let nanos = (row.secs * 1e9).round() as u64;
                times.add(*stage, row.count, Duration::from_nanos(nanos));
            }
        }
        times
    }
}

/// Measures one thread's time, lap by lap.
#[derive(Debug, Clone)]
pub struct LapTimer {
    times: StageTimes,
    last: Instant,
}

impl LapTimer {
    /// Starts the timer.
    pub fn start() -> Self {
        Self {
            times: StageTimes::default(),
            last: Instant::now(),
        }
    }

    /// Assigns the time since the last lap to `stage`, which was done `count` times. Use 0 for a
    /// part that is counted in another lap.
    pub fn lap(&mut self, stage: Stage, count: u64) {
        let now = Instant::now();
        self.times.add(stage, count, now - self.last);
        self.last = now;
    }

    /// Returns the times of all laps so far.
    pub fn times(&self) -> &StageTimes {
        &self.times
    }
}

#[cfg(test)]
mod tests;
