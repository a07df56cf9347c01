//! Where time goes: every stage of the data's way, and what each thread has spent on it.
//!
//! A [`LapTimer`] is never stopped: each lap books the time since the one before to a stage. So a
//! thread's stages are its whole time and their shares sum to one, and a lap costs a single reading
//! of the clock. Nothing that is learned depends on any of it.

use std::time::{Duration, Instant};

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// Whose time it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Thread {
    /// All actors together; each has one thread.
    Actors,
    /// The learner's receiving thread.
    Receiving,
    /// The learner's training thread.
    Training,
}

impl Thread {
    /// In the summary.
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
        /// What a thread is at, in the order of the data's way. The first sentence of each says
        /// what is done, the second what is counted.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Stage { $($($(#[$doc])* $stage),*),* }

        impl Stage {
            /// All of them, in the order of the data's way.
            pub const ALL: &[Self] = &[$($(Self::$stage),*),*];

            /// In the summary and the table; a thread has it once.
            pub const fn name(self) -> &'static str {
                match self { $($(Self::$stage => $name),*),* }
            }

            /// Whose it is.
            pub const fn thread(self) -> Thread {
                match self { $($(Self::$stage => Thread::$thread),*),* }
            }
        }
    };
}

stages! {
    Actors {
        /// Snapshots are taken in and made ready to fly with. Snapshots.
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
        /// The learner is listened to, and given heartbeats. Looks.
        ActorControl => "control",
        /// There is no ticket, or its snapshot is not there yet. Waits.
        ActorIdle => "idle",
    }
    Receiving {
        /// Records are checked, put together into episodes, and delivered. Records.
        Assemble => "assemble",
        /// Orders are taken; tickets, snapshots and heartbeats go out. Rounds.
        HandOut => "hand out",
        /// Nobody has sent anything. Waits.
        ReceivingIdle => "idle",
    }
    Training {
        /// Episodes go into replay and metrics. Episodes, segments.
        TakeIn => "take in",
        /// A minibatch of depth images is gathered. Minibatches.
        SampleImages => "sample images",
        /// A step of the VAE. Steps.
        VaeStep => "VAE step",
        /// Stored codes are made anew by the trained VAE. Once.
        Recode => "recode",
        /// A minibatch of transitions is gathered. Minibatches.
        Sample => "sample",
        /// An update of critic and policy. Updates.
        PolicyUpdate => "policy update",
        /// The parameters are copied into a snapshot and handed over. Snapshots.
        Publish => "publish",
        /// Evaluation episodes are waited for. Episodes.
        Evaluate => "evaluation",
        /// The state is copied for a checkpoint and handed over. Checkpoints.
        Checkpoint => "checkpoint",
        /// The start, orders, curves, the files at the end, waits that were broken off. Not
        /// counted.
        OtherTraining => "other",
        /// Training episodes are waited for. Waits.
        TrainingIdle => "idle",
    }
}

const STAGES: usize = Stage::ALL.len();

/// The stages of an actor: the first of [`Stage::ALL`].
pub const ACTOR_STAGES: usize = {
    let mut stages = 0;
    while matches!(Stage::ALL[stages].thread(), Thread::Actors) {
        stages += 1;
    }
    stages
};

/// Time, and what was done in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Tally {
    /// How often.
    pub count: u64,
    /// How long, in nanoseconds.
    pub nanos: u64,
}

// Lies in shared memory: two 8-byte fields, no padding.
const _: () = assert!(size_of::<Tally>() == 16);

impl Tally {
    /// More than any thread comes to: nine years, in nanoseconds.
    const BEYOND: u64 = 1 << 58;

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

    /// In seconds.
    pub fn secs(self) -> f64 {
        self.nanos as f64 / 1e9
    }
}

/// What was spent on each stage.
///
/// Stored as a list, without stages that did not occur: `thread`, `stage`, `count`, `secs`. Stages
/// of another version are left out when it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<Row>", into = "Vec<Row>")]
pub struct Times([Tally; STAGES]);

impl Default for Times {
    fn default() -> Self {
        Self([Tally::default(); STAGES])
    }
}

impl Times {
    /// What was spent on `stage`.
    pub fn of(&self, stage: Stage) -> Tally {
        self.0[stage as usize]
    }

    /// What `thread` has spent in all, in nanoseconds.
    pub fn total_nanos(&self, thread: Thread) -> u64 {
        let own = Stage::ALL.iter().filter(|stage| stage.thread() == thread);
        own.fold(0, |sum, stage| sum.saturating_add(self.of(*stage).nanos))
    }

    /// Adds to `stage`.
    pub fn add(&mut self, stage: Stage, count: u64, time: Duration) {
        let nanos = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        let tally = &mut self.0[stage as usize];
        *tally = tally.plus(Tally { count, nanos });
    }

    /// Both together.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self(std::array::from_fn(|stage| {
            self.0[stage].plus(other.0[stage])
        }))
    }

    /// What has come since `earlier`; nothing where that is more.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|stage| {
            self.0[stage].minus(earlier.0[stage])
        }))
    }

    /// An actor's stages, on the wire.
    pub(crate) fn of_actor(&self) -> [Tally; ACTOR_STAGES] {
        std::array::from_fn(|stage| self.0[stage])
    }

    /// What an actor says of itself, or `None` when it cannot be.
    pub(crate) fn read_actor(tallies: &[Tally; ACTOR_STAGES]) -> Option<Self> {
        let mut times = Self::default();
        times.0[..ACTOR_STAGES].copy_from_slice(tallies);
        let possible = |tally: &Tally| tally.count < Tally::BEYOND && tally.nanos < Tally::BEYOND;
        tallies.iter().all(possible).then_some(times)
    }

    /// Stages that occurred.
    pub fn occurred(&self) -> impl Iterator<Item = (Stage, Tally)> {
        let all = Stage::ALL.iter().map(|stage| (*stage, self.of(*stage)));
        all.filter(|(_, tally)| *tally != Tally::default())
    }
}

/// A stage of [`Times`] in a file.
#[derive(Serialize, Deserialize)]
struct Row {
    thread: String,
    stage: String,
    count: u64,
    secs: f64,
}

impl From<Times> for Vec<Row> {
    fn from(times: Times) -> Self {
        let row = |(stage, tally): (Stage, Tally)| Row {
            thread: stage.thread().name().to_owned(),
            stage: stage.name().to_owned(),
            count: tally.count,
            secs: tally.secs(),
        };
        times.occurred().map(row).collect()
    }
}

impl From<Vec<Row>> for Times {
    fn from(rows: Vec<Row>) -> Self {
        let mut times = Self::default();
        for row in rows {
            let is_of =
                |stage: &&Stage| stage.thread().name() == row.thread && stage.name() == row.stage;
            if let Some(stage) = Stage::ALL.iter().find(is_of) {
                // Saturates: whatever a file says is a time.
                let nanos = (row.secs * 1e9).round() as u64;
                times.add(*stage, row.count, Duration::from_nanos(nanos));
            }
        }
        times
    }
}

/// Books one thread's time, lap by lap.
#[derive(Debug, Clone)]
pub struct LapTimer {
    times: Times,
    last: Instant,
}

impl LapTimer {
    /// Runs from now on.
    pub fn start() -> Self {
        Self {
            times: Times::default(),
            last: Instant::now(),
        }
    }

    /// Books the time since the last lap to `stage`, in which `count` were done; 0 for a part of
    /// what is counted elsewhere.
    pub fn lap(&mut self, stage: Stage, count: u64) {
        let now = Instant::now();
        self.times.add(stage, count, now - self.last);
        self.last = now;
    }

    /// All laps so far.
    pub fn times(&self) -> &Times {
        &self.times
    }
}

#[cfg(test)]
mod tests;
