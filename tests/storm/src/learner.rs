//! A learner process: the receiving thread's rounds as they are, the training thread as
//! `Training::learn` goes through an epoch, one operation at a time.

use std::collections::{BTreeMap, VecDeque};
use std::io::ErrorKind;
use std::path::Path;
use std::time::Duration;

use skein_learner::checkpoint::{BestSnapshot, CheckpointState, EpochOrder, TrainingProgress};
use skein_learner::curriculum;
use skein_learner::episode::CommittedEpisode;
use skein_learner::episodes::exchange::{EpisodeBatch, Orders};
use skein_learner::episodes::server::Server;
use skein_learner::episodes::{ReceiverError, assembly::KeptData};
use skein_learner::faults::Faults;
use skein_learner::metrics::MetricsState;
use skein_learner::state::{NamedTensor, TensorValues};
use skein_learner::training::plan::{self, Repetition};
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::Ticket;

use crate::calm::{Learned, order, row};
use crate::checkpoints::{Writer, empty_replay, extent, load, read_results};
use crate::disk::VirtualDisk;
use crate::flight::{digest, is_single_flight};
use crate::mutant::Mutant;
use crate::shape::{RESULTS, RUN, Shape};
use crate::wire::VirtualPorts;

/// A running learner process.
pub(crate) struct LearnerProcess<'a> {
    pub(crate) ports: VirtualPorts,
    pub(crate) server: Server<VirtualPorts>,
    pub(crate) training: Training<'a>,
    pub(crate) writer: Writer<'a>,
}

/// Reason why an operation of the learner did not succeed.
#[derive(Debug)]
pub(crate) enum Trouble {
    /// The process died in an operation on the disk.
    Dead,
    /// The receiving thread has ended.
    Receiver(ReceiverError),
    /// Something that must not happen.
    Broken(String),
}

/// Continuation after an operation of the training thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Then {
    /// The next operation.
    GoOn,
    /// Updates, and then the next operation.
    Update,
    /// The same operation, when an episode has arrived or a checkpoint is written.
    Wait,
    /// The same operation, when there may be room on the disk.
    Retry,
    /// Nothing: the run is complete.
    End,
}

impl<'a> LearnerProcess<'a> {
    /// Starts the process.
    pub(crate) fn start(shape: &'a Shape, mutant: Option<Mutant>) -> Self {
        let ports = VirtualPorts::new(RUN, mutant);
        let (orders, inbox) = Orders::new();
        Self {
            server: Server::new(RUN, &shape.config, ports.clone(), inbox),
            training: Training::new(shape, ports.clone(), orders, mutant),
            ports,
            writer: Writer::new(shape, mutant),
        }
    }
}

/// The training thread.
pub(crate) struct Training<'a> {
    shape: &'a Shape,
    disk: VirtualDisk,
    ports: VirtualPorts,
    mutant: Option<Mutant>,
    orders: Orders,
    stage: Stage,
    progress: TrainingProgress,
    saved: TrainingProgress,
    learned: Learned,
    /// Episodes and segments taken in.
    taken: usize,
    snapshots: BTreeMap<PolicyVersion, Snapshot>,
    in_flight: VecDeque<InFlight>,
    open_episode: Option<CommittedEpisode>,
    /// Rows that are not written to the results yet.
    rows: String,
    /// The results as they were written.
    results: String,
}

struct InFlight {
    order: EpochOrder,
    flight: FlightOrder,
}

/// Batches that were ordered together, with the episodes that have arrived.
struct FlightOrder {
    batches: Vec<EpisodeBatch>,
    episodes: Vec<CommittedEpisode>,
}

/// The next operation.
enum Stage {
    Resume,
    Confirm,
    Judge(FlightOrder),
    CheckpointIfDue,
    Order,
    OrderRest,
    Collect,
    TakeIn(Vec<CommittedEpisode>),
    Update,
    EndEpoch,
    SaveAll,
    Finish,
}

impl FlightOrder {
    /// Takes what has arrived through `ports`; returns `true` if that is everything.
    fn collect(&mut self, ports: &VirtualPorts) -> Result<bool, Trouble> {
        for batch in &mut self.batches {
            while let Some(episode) = batch
                .next_within(Duration::ZERO)
                .map_err(Trouble::Receiver)?
            {
                if !is_single_flight(&episode, ports.newest_attempt(episode.episode)) {
                    let number = episode.episode;
                    return Err(Trouble::Broken(format!(
                        "episode {number} is of two flights"
                    )));
                }
                self.episodes.push(episode);
            }
        }
        Ok(self.batches.iter().all(|batch| batch.remaining() == 0))
    }
}

impl<'a> Training<'a> {
    fn new(shape: &'a Shape, ports: VirtualPorts, orders: Orders, mutant: Option<Mutant>) -> Self {
        let start = TrainingProgress::start(shape.config.evaluation.window_episodes as usize);
        Self {
            shape,
            disk: shape.disk.clone(),
            ports,
            mutant,
            orders,
            stage: Stage::Resume,
            progress: start.clone(),
            saved: start,
            learned: Learned::nothing(),
            taken: 0,
            snapshots: BTreeMap::new(),
            in_flight: VecDeque::new(),
            open_episode: None,
            rows: String::new(),
            results: String::new(),
        }
    }

    /// Training episodes learned from.
    pub(crate) fn episodes(&self) -> u64 {
        self.progress.episodes
    }

    /// Faults that the receiving thread has repaired.
    pub(crate) fn faults(&self) -> Faults {
        self.orders.state().faults()
    }

    /// Does the next operation.
    pub(crate) fn step(&mut self, writer: &mut Writer<'_>) -> Result<Then, Trouble> {
        let stage = std::mem::replace(&mut self.stage, Stage::Finish);
        let (stage, then) = match stage {
            Stage::Resume => {
                self.resume()?;
                (Stage::Confirm, Then::GoOn)
            }
            Stage::Confirm if self.is_candidate() => (Stage::Judge(self.confirm()?), Then::GoOn),
            Stage::Confirm => (Stage::CheckpointIfDue, Then::GoOn),
            Stage::Judge(mut flight) => match flight.collect(&self.ports)? {
                true => {
                    self.judge(&flight.episodes)?;
                    (Stage::CheckpointIfDue, Then::GoOn)
                }
                false => (Stage::Judge(flight), Then::Wait),
            },
            Stage::CheckpointIfDue => self.checkpoint_if_due(writer)?,
            Stage::Order => {
                self.order_ahead()?;
                (Stage::Collect, Then::GoOn)
            }
            Stage::OrderRest => {
                self.order(order(self.progress.epochs, self.progress.version()))?;
                (Stage::Collect, Then::GoOn)
            }
            Stage::Collect => match self.collect()? {
                Some(episodes) => (Stage::TakeIn(episodes), Then::GoOn),
                None => (Stage::Collect, Then::Wait),
            },
            Stage::TakeIn(episodes) => {
                for episode in &episodes {
                    self.take_in(episode)?;
                }
                (Stage::Update, Then::Update)
            }
            Stage::Update => {
                let updates = self.learned.update();
                if self.open_episode.is_none() || updates > 0 {
                    self.progress.version += 1;
                    self.publish()?;
                }
                let next = match self.open_episode {
                    Some(_) => Stage::OrderRest,
                    None => Stage::EndEpoch,
                };
                (next, Then::GoOn)
            }
            Stage::EndEpoch => match self.write_results()? {
                true => {
                    self.progress.epochs += 1;
                    (Stage::Confirm, Then::GoOn)
                }
                false => (Stage::EndEpoch, Then::Retry),
            },
            Stage::SaveAll => match self.checkpoint(writer) {
                true => (Stage::Finish, Then::GoOn),
                false => (Stage::SaveAll, Then::Wait),
            },
            Stage::Finish if writer.is_busy() => (Stage::Finish, Then::Wait),
            Stage::Finish => {
                self.orders.finish().map_err(Trouble::Receiver)?;
                self.check_end()?;
                (Stage::Finish, Then::End)
            }
        };
        self.stage = stage;
        Ok(then)
    }

    /// Continues at the newest checkpoint.
    fn resume(&mut self) -> Result<(), Trouble> {
        let newest = load(self.shape)?;
        if let Some(state) = newest {
            self.restore(state)?;
        }
        let bytes = self.progress.metrics.episodes_extent.bytes as usize;
        let cut = self.disk.truncate(Path::new(RESULTS), bytes);
        cut.map_err(|error| self.on_disk(&error))?;
        let mut repetitions: Vec<_> = plan::repetitions(&self.progress).collect();
        if self.mutant == Some(Mutant::ForgottenOrders) {
            repetitions.retain(|repetition| matches!(repetition, Repetition::Publish(_)));
        }
        self.progress.in_flight.clear();
        for repetition in repetitions {
            match repetition {
                Repetition::Order(order) => self.order(order)?,
                Repetition::Publish(present) if present == self.progress.version() => {
                    self.publish()?
                }
                Repetition::Publish(older) => {
                    let kept = self.snapshots.get(&older).cloned();
                    let snapshot = kept.ok_or_else(|| {
                        Trouble::Broken(format!("the checkpoint lacks snapshot {older}"))
                    })?;
                    self.orders.publish(snapshot).map_err(Trouble::Receiver)?;
                }
            }
        }
        Ok(())
    }

    fn restore(&mut self, state: CheckpointState) -> Result<(), Trouble> {
        let broken = |what: &str| Trouble::Broken(format!("a checkpoint holds {what}"));
        let Some(TensorValues::I64(values)) =
            state.tensors.into_iter().next().map(|tensor| tensor.values)
        else {
            return Err(broken("no tensors"));
        };
        let [replay, params, judged, taken] = values[..] else {
            return Err(broken("other tensors"));
        };
        self.learned = Learned {
            replay: replay.cast_unsigned(),
            params: params.cast_unsigned(),
            judged: judged.cast_unsigned(),
        };
        self.taken = taken as usize;
        self.progress = state.progress.clone();
        self.saved = state.progress;
        self.snapshots = state
            .snapshots
            .into_iter()
            .map(|snapshot| (snapshot.version, snapshot))
            .collect();
        self.results = read_results(&self.disk).unwrap_or_default();
        let bytes = self.progress.metrics.episodes_extent.bytes as usize;
        self.results.truncate(bytes);
        self.check_learned()
    }

    /// Error of a disk operation that is neither complete nor lacks room.
    fn on_disk(&self, error: &dyn std::error::Error) -> Trouble {
        match self.disk.is_dead() {
            true => Trouble::Dead,
            false => Trouble::Broken(error.to_string()),
        }
    }

    fn is_candidate(&self) -> bool {
        let episodes = self.progress.episodes;
        self.progress.latest_candidate != Some(episodes)
            && (self.learned.is_candidate() || episodes == self.shape.config.run.episodes)
    }

    fn confirm(&mut self) -> Result<FlightOrder, Trouble> {
        let number = self.progress.evaluations;
        let version = self.progress.version();
        let tickets = curriculum::confirmation(&self.shape.config, RUN, number, version);
        self.fly(Epoch(self.progress.epochs), tickets)
    }

    /// Orders `tickets` together; they come back in their order.
    fn fly(&mut self, epoch: Epoch, tickets: Vec<Ticket>) -> Result<FlightOrder, Trouble> {
        let together = match self.mutant {
            Some(Mutant::ArrivalOrder) => 1,
            _ => tickets.len().max(1),
        };
        let batches = tickets.chunks(together).map(|tickets| {
            let tickets = tickets.to_vec();
            self.orders.fly(epoch, KeptData::Latents, tickets)
        });
        Ok(FlightOrder {
            batches: batches
                .collect::<Result<_, _>>()
                .map_err(Trouble::Receiver)?,
            episodes: Vec::new(),
        })
    }

    fn judge(&mut self, episodes: &[CommittedEpisode]) -> Result<(), Trouble> {
        let digests: Vec<u64> = episodes.iter().map(digest).collect();
        let number = self.progress.evaluations as usize;
        if self.shape.calm.judged.get(number) != Some(&digests) {
            return Err(Trouble::Broken(format!("evaluation {number} differs")));
        }
        self.learned.judge(digests.into_iter());
        self.progress.evaluations += 1;
        self.progress.evaluation_episodes += episodes.len() as u64;
        self.progress.latest_candidate = Some(self.progress.episodes);
        if self.learned.is_best() {
            self.progress.best = Some(BestSnapshot {
                policy_version: self.progress.version,
                episodes: self.progress.episodes,
                window_walls_passed: 0.0,
                confirmed: Vec::new(),
            });
        }
        Ok(())
    }

    fn order_ahead(&mut self) -> Result<(), Trouble> {
        let last_ordered = self.in_flight.back().map(|last| last.order.epoch);
        let done = self.progress.epochs;
        for epoch in plan::epochs_to_order(&self.shape.config, done, last_ordered) {
            self.order(order(epoch, self.progress.version()))?;
        }
        Ok(())
    }

    fn order(&mut self, order: EpochOrder) -> Result<(), Trouble> {
        let open = self.open_episode.as_ref();
        let flown = open.map_or(&[][..], |episode| &episode.actions);
        let tickets = curriculum::training(&self.shape.config, RUN, &order, flown);
        let flight = self.fly(Epoch(order.epoch), tickets)?;
        self.in_flight.push_back(InFlight { order, flight });
        Ok(())
    }

    /// Returns the episodes of the oldest order, if they are complete.
    fn collect(&mut self) -> Result<Option<Vec<CommittedEpisode>>, Trouble> {
        let Some(oldest) = self.in_flight.front_mut() else {
            return Err(Trouble::Broken("nothing is in flight".to_owned()));
        };
        Ok(match oldest.flight.collect(&self.ports)? {
            true => self
                .in_flight
                .pop_front()
                .map(|oldest| oldest.flight.episodes),
            false => None,
        })
    }

    fn take_in(&mut self, flown: &CommittedEpisode) -> Result<(), Trouble> {
        self.learned.take_in(digest(flown));
        self.taken += 1;
        self.check_learned()?;
        let joined = self.open_episode.take().map(|mut episode| {
            episode.extend(flown);
            episode
        });
        if flown.outcome.is_none() {
            self.open_episode = joined.or_else(|| Some(flown.clone()));
            return Ok(());
        }
        self.rows += &row(self.progress.episodes, &self.learned);
        self.progress.episodes += 1;
        Ok(())
    }

    /// Compares what was taken in so far with the calm run.
    fn check_learned(&self) -> Result<(), Trouble> {
        let Some(last) = self.taken.checked_sub(1) else {
            return Ok(());
        };
        let calm = self.shape.calm.taken.get(last);
        match calm.is_some_and(|(_, calm)| calm.replay == self.learned.replay) {
            true => Ok(()),
            false => Err(Trouble::Broken(format!(
                "what was taken in as number {last} differs"
            ))),
        }
    }

    fn publish(&mut self) -> Result<(), Trouble> {
        let snapshot = self.learned.snapshot(self.progress.version());
        let published = self.orders.publish(snapshot.clone());
        published.map_err(Trouble::Receiver)?;
        self.snapshots.insert(snapshot.version, snapshot);
        let (progress, in_flight) = (&self.progress, &self.in_flight);
        self.snapshots.retain(|version, _| {
            plan::is_needed(*version, progress, in_flight.iter().map(|one| &one.order))
        });
        Ok(())
    }

    /// Writes the rows that are not written yet; returns `false` if there is no room.
    fn write_results(&mut self) -> Result<bool, Trouble> {
        match self.disk.append(Path::new(RESULTS), self.rows.as_bytes()) {
            Ok(()) => {
                self.results += &std::mem::take(&mut self.rows);
                Ok(true)
            }
            Err(error) if error.kind() == ErrorKind::StorageFull => Ok(false),
            Err(error) => Err(self.on_disk(&error)),
        }
    }

    fn checkpoint_if_due(&mut self, writer: &mut Writer<'_>) -> Result<(Stage, Then), Trouble> {
        let is_due = plan::is_checkpoint_due(&self.shape.config, &self.progress, &self.saved);
        if is_due && !self.checkpoint(writer) {
            return Ok((Stage::CheckpointIfDue, Then::Wait));
        }
        let is_over = self.progress.epochs == curriculum::epochs(&self.shape.config);
        let next = match is_over {
            true => Stage::SaveAll,
            false => Stage::Order,
        };
        Ok((next, Then::GoOn))
    }

    /// Hands the state to the writing thread, unless the newest checkpoint has it. Returns `false`
    /// if that thread is busy.
    fn checkpoint(&mut self, writer: &mut Writer<'_>) -> bool {
        let (now, saved) = (&self.progress, &self.saved);
        if (now.epochs, now.latest_candidate) == (saved.epochs, saved.latest_candidate) {
            return true;
        }
        if writer.is_busy() {
            return false;
        }
        let progress = TrainingProgress {
            in_flight: self.in_flight.iter().map(|one| one.order).collect(),
            metrics: MetricsState {
                episodes: self.progress.episodes,
                episodes_extent: extent(&self.results),
                ..self.progress.metrics.clone()
            },
            ..self.progress.clone()
        };
        let learned = [
            self.learned.replay,
            self.learned.params,
            self.learned.judged,
            self.taken as u64,
        ];
        writer.hand_over(CheckpointState {
            progress: progress.clone(),
            tensors: vec![NamedTensor {
                name: "learned".to_owned(),
                shape: vec![learned.len()],
                values: TensorValues::I64(learned.map(u64::cast_signed).into()),
            }],
            replay: empty_replay(),
            snapshots: self.snapshots.values().cloned().collect(),
        });
        self.saved = progress;
        true
    }

    /// Compares all results with the calm run's.
    fn check_end(&self) -> Result<(), Trouble> {
        let calm = &self.shape.calm;
        let found = read_results(&self.disk).map_err(|error| self.on_disk(&error))?;
        if self.learned != calm.end {
            return Err(Trouble::Broken("what was learned differs".to_owned()));
        }
        match found == calm.results {
            true => Ok(()),
            false => Err(Trouble::Broken("the results differ".to_owned())),
        }
    }
}
