//! The world of one storm: processes, links and clocks, advanced event by event.

mod actors;
mod learner;
mod mishaps;
mod network;

use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BinaryHeap};
use std::path::Path;
use std::rc::Rc;
use std::time::{Duration, Instant};

use skein_learner::checkpoint::Storage;
use skein_protocol::ids::ActorIncarnation;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::status::StatusRecord;
use skein_protocol::ticket::ControlMessage;
use skein_protocol::transition::TransitionRecord;
use skein_run::show;

use crate::actor::ActorProcess;
use crate::checkpoints::load;
use crate::dice::Dice;
use crate::flight::mix;
use crate::learner::LearnerProcess;
use crate::mutant::Mutant;
use crate::shape::{CHECKPOINTS, FOLDER, SHAPES, Shape};
use crate::weather::{SECOND, Weather};

/// Time after the storm in which the run must be complete: many of the longest deadlines.
const PATIENCE: u64 = 300 * SECOND;

/// Result of a storm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// Number that any difference between two storms changes.
    pub trace: u64,
    /// Events.
    pub events: u64,
    /// Faults that the learners repaired, by reason.
    pub faults: BTreeMap<String, u64>,
    /// Violated promise; `None` if the run has the calm run's results.
    pub failure: Option<String>,
}

/// A process or place where an event happens, with the number that makes it void once the process
/// is another, or its next operation is due at another time.
#[derive(Debug)]
enum Event {
    Actor {
        actor: usize,
        number: u64,
    },
    Server {
        number: u64,
    },
    Training {
        number: u64,
    },
    Writer {
        number: u64,
    },
    Arrival(Box<Arrival>),
    Strike,
    StartActor(usize),
    StartLearner,
    Heal(usize),
    NoticeCut {
        actor: usize,
        status: Box<StatusRecord>,
    },
    MakeRoom,
    MendPorts,
    EndStorm,
}

/// A message that arrives.
#[derive(Debug)]
struct Arrival {
    actor: usize,
    session: ActorIncarnation,
    life: u64,
    content: Content,
}

#[derive(Debug, Clone)]
enum Content {
    Status(StatusRecord),
    Record(Rc<TransitionRecord>),
    Message(Rc<ControlMessage>),
    Snapshot(Rc<Snapshot>),
    Wake,
}

impl Content {
    /// Channel whose messages usually arrive in order.
    fn channel(&self) -> usize {
        match self {
            Self::Status(_) => 0,
            Self::Record(_) => 1,
            Self::Message(_) => 2,
            Self::Snapshot(_) => 3,
            Self::Wake => 4,
        }
    }

    /// Name in the log.
    fn name(&self) -> &'static str {
        match self {
            Self::Status(_) => "from actor: a heartbeat",
            Self::Record(_) => "from actor: a record of episode, step",
            Self::Message(_) => "to actor: a message",
            Self::Snapshot(_) => "to actor: a snapshot of version",
            Self::Wake => "to actor: a wake-up",
        }
    }

    /// Numbers in the log.
    fn numbers(&self) -> [u64; 2] {
        match self {
            Self::Record(record) => [record.episode, record.step.into()],
            Self::Snapshot(snapshot) => [snapshot.version.0, 0],
            Self::Status(_) | Self::Message(_) | Self::Wake => [0, 0],
        }
    }
}

#[derive(Debug)]
struct Scheduled {
    at: u64,
    number: u64,
    event: Event,
}

impl Scheduled {
    fn key(&self) -> (u64, u64) {
        (self.at, self.number)
    }
}

impl PartialEq for Scheduled {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for Scheduled {}

impl PartialOrd for Scheduled {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Scheduled {
    fn cmp(&self, other: &Self) -> Ordering {
        self.key().cmp(&other.key())
    }
}

/// The next operation of a thread, and the time at which it is due.
#[derive(Debug, Clone, Copy, Default)]
struct Due {
    number: u64,
    at: u64,
}

struct ActorSlot {
    host: usize,
    process: Option<ActorProcess>,
    due: Due,
    frozen_until: u64,
    muted_until: u64,
    is_poisoned: bool,
    /// Nanoseconds that the host's clock is behind.
    behind: u64,
    /// Time at which the last message of each channel arrives.
    last_arrivals: [u64; 5],
}

struct LearnerSlot<'a> {
    process: Option<LearnerProcess<'a>>,
    server: Due,
    training: Due,
    writer: Due,
    frozen_until: u64,
    history: Vec<Rc<Snapshot>>,
}

/// One storm.
pub(crate) struct World<'a> {
    shape: &'a Shape,
    mutant: Option<Mutant>,
    dice: Dice,
    weather: Weather,
    start: Instant,
    now: u64,
    events: BinaryHeap<Reverse<Scheduled>>,
    numbers: u64,
    learner: LearnerSlot<'a>,
    actors: Vec<ActorSlot>,
    /// The learner's life as it looks from each host; `None` while it is gone there.
    lives: Vec<Option<u64>>,
    is_cut: Vec<bool>,
    newest_life: u64,
    is_stormy: bool,
    is_complete: bool,
    poisoned: BTreeMap<u64, u32>,
    faults: BTreeMap<String, u64>,
    failure: Option<String>,
    trace: u64,
    is_logged: bool,
}

impl<'a> World<'a> {
    /// Storm of `seed` over `shapes`, with a planted bug.
    pub(crate) fn new(shapes: &'a [Shape], seed: u64, mutant: Option<Mutant>) -> Self {
        let mut dice = Dice::new(seed);
        let shape = &shapes[dice.below(SHAPES) as usize];
        let weather = Weather::of(&mut dice);
        let slot = |host: &usize| ActorSlot {
            host: *host,
            process: None,
            due: Due::default(),
            frozen_until: 0,
            muted_until: 0,
            is_poisoned: false,
            behind: 0,
            last_arrivals: [0; 5],
        };
        let hosts = weather.links.len();
        Self {
            shape,
            mutant,
            dice,
            start: Instant::now(),
            now: 0,
            events: BinaryHeap::new(),
            numbers: 0,
            learner: LearnerSlot {
                process: None,
                server: Due::default(),
                training: Due::default(),
                writer: Due::default(),
                frozen_until: 0,
                history: Vec::new(),
            },
            actors: weather.host_of_actor.iter().map(slot).collect(),
            weather,
            lives: vec![None; hosts],
            is_cut: vec![false; hosts],
            newest_life: 0,
            is_stormy: true,
            is_complete: false,
            poisoned: BTreeMap::new(),
            faults: BTreeMap::new(),
            failure: None,
            trace: seed,
            is_logged: false,
        }
    }

    /// Prints every event.
    pub(crate) fn logged(mut self) -> Self {
        self.is_logged = true;
        self
    }

    /// Lets the storm pass, until the run is complete.
    pub(crate) fn pass(mut self) -> Outcome {
        self.shape.disk.clear();
        for folder in [FOLDER, CHECKPOINTS] {
            self.set_up(|disk| disk.create_directory(Path::new(folder)));
        }
        self.set_up(|disk| disk.sync(Path::new(FOLDER)));
        self.schedule(0, Event::StartLearner);
        for actor in 0..self.actors.len() {
            let delay = self.dice.below(SECOND / 2);
            self.schedule(delay, Event::StartActor(actor));
        }
        self.schedule(0, Event::Strike);
        self.schedule(self.weather.duration, Event::EndStorm);
        let end = self.weather.duration + PATIENCE;
        let mut events = 0;
        while !self.is_complete && self.failure.is_none() {
            let Some(Reverse(next)) = self.events.pop() else {
                self.fail("nothing happens any more".to_owned());
                break;
            };
            self.now = next.at;
            events += 1;
            if self.now > end {
                self.fail(self.describe_stall());
                break;
            }
            self.happen(next.event);
        }
        if self.is_complete && self.failure.is_none() {
            self.check_after_power_cut();
        }
        self.count_faults();
        Outcome {
            trace: self.trace,
            events,
            faults: self.faults,
            failure: self.failure,
        }
    }

    fn set_up(&mut self, operation: impl Fn(&crate::disk::VirtualDisk) -> std::io::Result<()>) {
        if let Err(error) = operation(&self.shape.disk) {
            self.fail(error.to_string());
        }
    }

    fn describe_stall(&self) -> String {
        let episodes = self
            .learner
            .process
            .as_ref()
            .map(|learner| learner.training.episodes());
        format!(
            "no end {} s after the storm: {episodes:?} episodes",
            PATIENCE / SECOND
        )
    }

    /// A complete run is on the disk.
    fn check_after_power_cut(&mut self) {
        self.shape.disk.cut_power(&mut self.dice);
        self.shape.disk.revive();
        let episodes = self.shape.config.run.episodes;
        match load(self.shape) {
            Ok(Some(state)) if state.progress.episodes == episodes => {}
            Ok(state) => {
                let found = state.map(|state| state.progress.episodes);
                self.fail(format!(
                    "the complete run was lost in a power cut: {found:?}"
                ));
            }
            Err(trouble) => self.fail(format!("{trouble:?}")),
        }
    }

    fn fail(&mut self, what: String) {
        self.note("failure", [0, 0, 0]);
        if self.is_logged {
            show!("{what}");
        }
        self.failure.get_or_insert(what);
    }

    /// Records that something happened.
    fn note(&mut self, what: &'static str, numbers: [u64; 3]) {
        let name = what.bytes().fold(0, |name, byte| mix(name, byte.into()));
        self.trace = mix(mix(self.trace, self.now), name);
        self.trace = numbers.into_iter().fold(self.trace, mix);
        if self.is_logged {
            show!("{:>12.6} s  {what} {numbers:?}", self.now as f64 / 1e9);
        }
    }

    fn instant(&self) -> Instant {
        self.start + Duration::from_nanos(self.now)
    }

    fn schedule(&mut self, delay: u64, event: Event) -> u64 {
        self.numbers += 1;
        let number = self.numbers;
        self.events.push(Reverse(Scheduled {
            at: self.now + delay,
            number,
            event,
        }));
        number
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Actor { actor, number } => self.act(actor, number),
            Event::Server { number } => self.serve(number),
            Event::Training { number } => self.train(number),
            Event::Writer { number } => self.write(number),
            Event::Arrival(arrival) => self.arrive(*arrival),
            Event::Strike => self.strike(),
            Event::StartActor(actor) => self.start_actor(actor),
            Event::StartLearner => self.start_learner(),
            Event::Heal(host) => self.heal(host),
            Event::NoticeCut { actor, status } => self.notice_cut(actor, *status),
            Event::MakeRoom => self.shape.disk.make_room(),
            Event::MendPorts => self.mend_ports(),
            Event::EndStorm => self.end_storm(),
        }
    }
}
