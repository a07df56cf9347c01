//! How bad a storm is: drawn from its seed.

use crate::dice::Dice;

/// A millisecond, in the nanoseconds of the virtual clock.
pub(crate) const MILLISECOND: u64 = 1_000_000;
/// A second, likewise.
pub(crate) const SECOND: u64 = 1000 * MILLISECOND;

/// Most hosts, the learner's included.
const MOST_HOSTS: u64 = 3;

/// A storm's strength.
#[derive(Debug)]
pub(crate) struct Weather {
    /// Host of each actor; 0 is the learner's.
    pub(crate) host_of_actor: Vec<usize>,
    /// The link to each host, the learner's own included.
    pub(crate) links: Vec<Link>,
    /// Duration of the storm.
    pub(crate) duration: u64,
    /// Mean time between two mishaps.
    pub(crate) between_mishaps: u64,
    /// Mishaps that happen in this storm.
    pub(crate) mishaps: Vec<Mishap>,
    /// Longest time of a step of an episode.
    pub(crate) longest_step: u64,
    /// Thousandths of the messages to or from a dead learner, or through a link that broke since,
    /// that still arrive.
    pub(crate) stale: u64,
}

/// Effect of a link on messages, in thousandths of them.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Link {
    pub(crate) lost: u64,
    pub(crate) doubled: u64,
    pub(crate) reordered: u64,
    pub(crate) late: u64,
    /// Longest time that a message usually takes.
    pub(crate) latency: u64,
}

/// A mishap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mishap {
    /// An actor process is killed.
    KillActor,
    /// An actor process stands still for a while.
    FreezeActor,
    /// All records of an actor are lost for a while.
    MuteActor,
    /// The next record of an actor is not finite.
    PoisonRecord,
    /// The clock of an actor's host is set back.
    TurnClockBack,
    /// The learner process is killed.
    KillLearner,
    /// The learner process stands still for a while.
    FreezeLearner,
    /// The learner process dies in an operation on the disk.
    DieWriting,
    /// All services of the learner fail for a while.
    BreakPorts,
    /// The disk is full for a while.
    FillDisk,
    /// All processes of the learner's host die, and what is not on the disk is lost.
    CutPower,
    /// The link to a host is cut for a while.
    CutLink,
}

impl Mishap {
    pub(crate) const ALL: [Self; 12] = [
        Self::KillActor,
        Self::FreezeActor,
        Self::MuteActor,
        Self::PoisonRecord,
        Self::TurnClockBack,
        Self::KillLearner,
        Self::FreezeLearner,
        Self::DieWriting,
        Self::BreakPorts,
        Self::FillDisk,
        Self::CutPower,
        Self::CutLink,
    ];

    /// Name in the log, where actor, host and duration in nanoseconds follow.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::KillActor => "MISHAP actor is killed",
            Self::FreezeActor => "MISHAP actor stands still",
            Self::MuteActor => "MISHAP records of an actor are lost",
            Self::PoisonRecord => "MISHAP next record is not finite",
            Self::TurnClockBack => "MISHAP clock is set back",
            Self::KillLearner => "MISHAP learner is killed",
            Self::FreezeLearner => "MISHAP learner stands still",
            Self::DieWriting => "MISHAP learner will die at the disk",
            Self::BreakPorts => "MISHAP learner's services fail",
            Self::FillDisk => "MISHAP disk fills",
            Self::CutPower => "MISHAP power is cut",
            Self::CutLink => "MISHAP link is cut",
        }
    }
}

impl Weather {
    /// Draws the weather.
    pub(crate) fn of(dice: &mut Dice) -> Self {
        let hosts = dice.between(1, MOST_HOSTS);
        let actors = dice.between(1, 4);
        // Some kinds only, so that a storm of one kind is not always hidden by the others.
        let mut mishaps = Mishap::ALL.to_vec();
        mishaps.retain(|_| dice.chance(400));
        Self {
            host_of_actor: (0..actors).map(|_| dice.below(hosts) as usize).collect(),
            links: (0..hosts).map(|_| Link::of(dice)).collect(),
            duration: dice.between(SECOND, 8 * SECOND),
            between_mishaps: dice.between(20 * MILLISECOND, 600 * MILLISECOND),
            mishaps,
            longest_step: dice.pick(&[2, 10, 40]) * MILLISECOND,
            stale: dice.pick(&[0, 0, 500]),
        }
    }
}

impl Link {
    fn of(dice: &mut Dice) -> Self {
        let mut rate = |most| match dice.chance(500) {
            true => dice.between(1, most),
            false => 0,
        };
        Self {
            lost: rate(80),
            doubled: rate(60),
            reordered: rate(60),
            late: rate(20),
            latency: dice.pick(&[1, 5, 50]) * MILLISECOND / 2,
        }
    }
}
