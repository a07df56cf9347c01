//! The receiving thread: owns the transport's ports, feeds the desk, delivers flights in the order they were ordered.
//!
//! The training thread speaks to it through [`Reception`]: it orders batches of flights, publishes snapshots, and takes flights out of a [`Batch`] one by
//! one. While the training thread updates the networks, records are taken in, tickets handed out and signs of life given here.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender, TryRecvError};
use std::sync::{Arc, PoisonError, RwLock};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use skein_protocol::config::Config;
use skein_protocol::ids::Epoch;
use skein_protocol::run::RunIdentity;
use skein_protocol::services::{LearnerPorts, LearnerWaker, ServiceError};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::{ControlRecord, Ticket};

use super::assembly::Keep;
use super::desk::{Desk, Faults, Order, Place};
use crate::flight::CommittedFlight;

/// How often a waiting training thread looks whether it should stop.
const STOP_CHECK: Duration = Duration::from_millis(100);
/// Records taken in before anything else gets its turn.
const RECORDS_AT_ONCE: usize = 1024;

/// The training thread's end.
#[derive(Debug)]
pub struct Reception {
    commands: Sender<Command>,
    waker: LearnerWaker,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
    next_batch: u64,
}

/// What the receiving thread tells at any time.
#[derive(Debug, Default)]
pub struct Shared {
    /// Actors that live, in ascending order.
    live_actors: RwLock<Vec<u32>>,
    /// Tickets issued again.
    pub reissued: AtomicU64,
    /// Records refused.
    pub refused: AtomicU64,
    /// Why the receiving thread ended before it was told to.
    failure: RwLock<Option<String>>,
}

/// Flights ordered together, to be taken out in order.
#[derive(Debug)]
pub struct Batch {
    flights: Receiver<CommittedFlight>,
    remaining: usize,
    shared: Arc<Shared>,
}

/// Why no flight comes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReceptionError {
    /// The run was told to stop.
    #[error("told to stop")]
    Stopped,
    /// The receiving thread ended.
    #[error("{0}")]
    Failed(String),
}

#[derive(Debug)]
enum Command {
    Publish(Snapshot),
    Fly {
        batch: u64,
        epoch: Epoch,
        keep: Keep,
        tickets: Vec<Ticket>,
        deliver: Sender<CommittedFlight>,
    },
    Finish,
}

impl Reception {
    /// Starts the receiving thread and returns once actors can attach.
    ///
    /// # Errors
    /// [`ReceptionError::Failed`] when the services cannot be opened.
    pub fn start(identity: &RunIdentity, config: &Config) -> Result<Self, ReceptionError> {
        let failed = |error: &dyn std::error::Error| ReceptionError::Failed(error.to_string());
        let (commands, inbox) = mpsc::channel();
        let (ready, is_ready) = mpsc::channel();
        let shared = Arc::new(Shared::default());
        let (thread_identity, thread_config, thread_shared) = (identity.clone(), config.clone(), shared.clone());
        let thread = thread::Builder::new()
            .name("reception".to_owned())
            .spawn(move || serve(&thread_identity, &thread_config, &inbox, &thread_shared, &ready))
            .map_err(|error| failed(&error))?;
        match is_ready.recv() {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(failed(&error)),
            Err(error) => return Err(failed(&error)),
        }
        let waker = LearnerWaker::open(identity, config).map_err(|error| failed(&error))?;
        Ok(Self {
            commands,
            waker,
            thread: Some(thread),
            shared,
            next_batch: 0,
        })
    }

    /// What the receiving thread tells at any time.
    pub fn shared(&self) -> Arc<Shared> {
        self.shared.clone()
    }

    /// Publishes `snapshot` to all actors, those still to come included.
    ///
    /// # Errors
    /// [`ReceptionError::Failed`] when the receiving thread has ended.
    pub fn publish(&self, snapshot: Snapshot) -> Result<(), ReceptionError> {
        self.send(Command::Publish(snapshot))
    }

    /// Orders flights; they are flown after those ordered before, and delivered in the order of `tickets`.
    ///
    /// # Errors
    /// [`ReceptionError::Failed`] when the receiving thread has ended.
    pub fn fly(&mut self, epoch: Epoch, keep: Keep, tickets: Vec<Ticket>) -> Result<Batch, ReceptionError> {
        let (deliver, flights) = mpsc::channel();
        let remaining = tickets.len();
        let batch = self.next_batch;
        self.next_batch += 1;
        self.send(Command::Fly {
            batch,
            epoch,
            keep,
            tickets,
            deliver,
        })?;
        Ok(Batch {
            flights,
            remaining,
            shared: self.shared.clone(),
        })
    }

    /// Tells all actors to stop, and ends the receiving thread.
    pub fn finish(mut self) {
        if self.send(Command::Finish).is_ok()
            && let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the receiving thread panicked");
        }
    }

    fn send(&self, command: Command) -> Result<(), ReceptionError> {
        self.commands.send(command).map_err(|_| self.shared.failed())?;
        self.waker
            .wake()
            .map_err(|error| ReceptionError::Failed(error.to_string()))
    }
}

impl Shared {
    /// The numbers of the actors that live, in ascending order.
    pub fn live_actors(&self) -> Vec<u32> {
        self.live_actors.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn failed(&self) -> ReceptionError {
        let failure = self.failure.read().unwrap_or_else(PoisonError::into_inner);
        ReceptionError::Failed(
            failure
                .clone()
                .unwrap_or_else(|| "the receiving thread has ended".to_owned()),
        )
    }

    fn fail(&self, error: &dyn std::error::Error) {
        tracing::error!(%error, "receiving thread failed");
        *self.failure.write().unwrap_or_else(PoisonError::into_inner) = Some(error.to_string());
    }

    fn update(&self, desk: &Desk) {
        let Faults { reissued, refused } = desk.faults();
        let mut live = self.live_actors.write().unwrap_or_else(PoisonError::into_inner);
        if !desk.actors().map(|actor| actor.0).eq(live.iter().copied()) {
            *live = desk.actors().map(|actor| actor.0).collect();
        }
        self.reissued.store(reissued, Ordering::Relaxed);
        self.refused.store(refused, Ordering::Relaxed);
    }
}

impl Batch {
    /// Flights that were not taken out yet.
    pub fn remaining(&self) -> usize {
        self.remaining
    }

    /// Waits for the next flight, in order; `None` after the last.
    ///
    /// # Errors
    /// [`ReceptionError`] when `stop` is set or the receiving thread has ended.
    pub fn next(&mut self, stop: &AtomicBool) -> Result<Option<CommittedFlight>, ReceptionError> {
        while self.remaining > 0 {
            if stop.load(Ordering::Relaxed) {
                return Err(ReceptionError::Stopped);
            }
            match self.flights.recv_timeout(STOP_CHECK) {
                Ok(flight) => {
                    self.remaining -= 1;
                    return Ok(Some(flight));
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.shared.failed()),
            }
        }
        Ok(None)
    }
}

/// The receiving thread.
fn serve(
    identity: &RunIdentity,
    config: &Config,
    inbox: &Receiver<Command>,
    shared: &Shared,
    ready: &Sender<Result<(), ServiceError>>,
) {
    let ports = match LearnerPorts::open(identity, config) {
        Ok(ports) => ports,
        Err(error) => {
            // The starter waits for exactly this word; if it is gone, nobody needs it.
            let _ = ready.send(Err(error));
            return;
        }
    };
    let _ = ready.send(Ok(()));
    let mut server = Server {
        identity,
        desk: Desk::new(&config.transport),
        deliveries: BTreeMap::new(),
        ports,
        heartbeat: config.transport.heartbeat(),
        last_heartbeat: None,
    };
    if let Err(error) = server.run(inbox, shared) {
        shared.fail(error.as_ref());
    }
    // Whoever waits is told by its channel's end.
}

struct Server<'a> {
    identity: &'a RunIdentity,
    desk: Desk,
    deliveries: BTreeMap<u64, Delivery>,
    ports: LearnerPorts,
    heartbeat: Duration,
    last_heartbeat: Option<Instant>,
}

/// Flights of one batch that wait for an earlier one.
struct Delivery {
    next: usize,
    count: usize,
    early: BTreeMap<usize, CommittedFlight>,
    to: Sender<CommittedFlight>,
}

type ServerError = Box<dyn std::error::Error + Send + Sync>;

impl Server<'_> {
    fn run(&mut self, inbox: &Receiver<Command>, shared: &Shared) -> Result<(), ServerError> {
        loop {
            if !self.take_commands(inbox)? {
                return self.say_stop();
            }
            let now = Instant::now();
            self.take_status(now)?;
            let more = self.take_records(now)?;
            self.desk.on_time(now);
            self.hand_out(now)?;
            self.give_sign_of_life(now)?;
            shared.update(&self.desk);
            if !more {
                self.ports.wait(self.heartbeat)?;
            }
        }
    }

    /// Carries out what the training thread wants; false when that is the end.
    fn take_commands(&mut self, inbox: &Receiver<Command>) -> Result<bool, ServiceError> {
        loop {
            match inbox.try_recv() {
                Ok(Command::Publish(snapshot)) => {
                    self.ports.publish(&snapshot)?;
                    self.ports.wake_actors()?;
                }
                Ok(Command::Fly {
                    batch,
                    epoch,
                    keep,
                    tickets,
                    deliver,
                }) => {
                    let count = tickets.len();
                    self.deliveries.insert(
                        batch,
                        Delivery {
                            next: 0,
                            count,
                            early: BTreeMap::new(),
                            to: deliver,
                        },
                    );
                    for (index, ticket) in tickets.into_iter().enumerate() {
                        self.desk.order(Order {
                            ticket,
                            epoch,
                            keep,
                            place: Place { batch, index },
                        });
                    }
                }
                Ok(Command::Finish) | Err(TryRecvError::Disconnected) => return Ok(false),
                Err(TryRecvError::Empty) => return Ok(true),
            }
        }
    }

    fn take_status(&mut self, now: Instant) -> Result<(), ServiceError> {
        while let Some(record) = self.ports.receive_status()? {
            match record.read(self.identity.run) {
                Some(status) => self.desk.on_status(&status, now),
                None => tracing::warn!(?record, "status record refused"),
            }
        }
        Ok(())
    }

    /// Takes records in; whether there may be more.
    fn take_records(&mut self, now: Instant) -> Result<bool, ServerError> {
        for _ in 0..RECORDS_AT_ONCE {
            let Some(record) = self.ports.receive_transition()? else {
                return Ok(false);
            };
            if let Some((place, flight)) = self.desk.on_record(&record, now)? {
                self.deliver(place, flight);
                self.hand_out(now)?;
            }
        }
        Ok(true)
    }

    /// Passes on what is next in its batch, and keeps what is early.
    fn deliver(&mut self, place: Place, flight: CommittedFlight) {
        let Some(delivery) = self.deliveries.get_mut(&place.batch) else {
            return;
        };
        delivery.early.insert(place.index, flight);
        while let Some(flight) = delivery.early.remove(&delivery.next) {
            delivery.next += 1;
            // A training thread that no longer waits has been told to stop.
            let _ = delivery.to.send(flight);
        }
        if delivery.next == delivery.count {
            self.deliveries.remove(&place.batch);
        }
    }

    fn hand_out(&mut self, now: Instant) -> Result<(), ServiceError> {
        let tickets = self.desk.issue(now);
        if tickets.is_empty() {
            return Ok(());
        }
        for ticket in tickets {
            self.ports.send_control(ticket)?;
        }
        self.ports.wake_actors()
    }

    fn give_sign_of_life(&mut self, now: Instant) -> Result<(), ServiceError> {
        if self
            .last_heartbeat
            .is_some_and(|last| now.duration_since(last) < self.heartbeat)
        {
            return Ok(());
        }
        self.last_heartbeat = Some(now);
        self.ports.maintain()?;
        self.ports.send_control(ControlRecord::heartbeat(self.identity.run))
    }

    fn say_stop(&self) -> Result<(), ServerError> {
        self.ports.send_control(ControlRecord::stop(self.identity.run))?;
        self.ports.wake_actors()?;
        Ok(())
    }
}
