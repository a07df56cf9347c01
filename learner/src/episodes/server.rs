//! The rounds of the receiving thread: each takes in what actors send and sends out what the
//! training thread orders.
//!
//! Actors may die at any moment, in the middle of an access to shared memory. So no failure of a
//! service ends a round, let alone the thread. What cannot be received counts as absent. What
//! cannot be sent is tried again in the next round. At every heartbeat, the remains of dead actors
//! are cleaned up. Only a transport that fails in every round for [`TRANSPORT_PATIENCE`] is given
//! up.
//!
//! A round takes the time and the [`Ports`] from outside, so a simulation drives the same code as
//! the thread.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc::{Sender, TryRecvError};
use std::thread::sleep;
use std::time::{Duration, Instant};

use skein_protocol::config::Config;
use skein_protocol::ids::RunId;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::stages::{LapTimer, Stage};
use skein_protocol::ticket::{ControlMessage, ControlRecord};
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_transport::{LearnerPorts, ServiceError};

use super::dispatcher::{BatchPlace, Dispatcher, EpisodeOrder, HopelessEpisode};
use super::exchange::{Command, Inbox, ReceiverError};
use super::ports::Ports;
use crate::episode::CommittedEpisode;

/// Time of failures in every round after which the transport is given up.
pub(super) const TRANSPORT_PATIENCE: Duration = Duration::from_secs(10);
/// Records taken in before other work gets its turn.
const RECORDS_AT_ONCE: usize = 1024;
/// Pause before a failed operation is tried again.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// State of the receiving thread.
pub struct Server<P> {
    run: RunId,
    dispatcher: Dispatcher,
    deliveries: BTreeMap<u64, Delivery>,
    ports: P,
    inbox: Inbox,
    /// Messages and snapshots still to be sent, in this order.
    outbox: VecDeque<Outgoing>,
    /// `true` if something was sent and an actor that may be waiting was not woken yet.
    is_wake_due: bool,
    heartbeat: Duration,
    last_heartbeat: Option<Instant>,
    trouble: Trouble,
    timer: LapTimer,
}

/// Episodes of one batch, of which some may wait for an earlier one.
struct Delivery {
    next: usize,
    count: usize,
    early: BTreeMap<usize, CommittedEpisode>,
    to: Sender<CommittedEpisode>,
}

enum Outgoing {
    Snapshot(Snapshot),
    Message(ControlMessage),
}

/// Request of the training thread, besides its commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Request {
    /// Continue.
    Serve,
    /// Tell the actors to leave, and end.
    Finish,
    /// End quietly: the training thread has panicked. The actors stay, because the learner's next
    /// incarnation needs them.
    Vanish,
}

/// Continuation after a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// Another round at once: there may be more to take in.
    AtOnce,
    /// Another round when something arrives, at the latest after this time.
    Wait(Duration),
    /// Nothing.
    End,
}

impl Server<LearnerPorts> {
    /// Serves until the finish command.
    ///
    /// # Errors
    /// As [`Server::round`].
    pub(super) fn run(&mut self) -> Result<(), ReceiverError> {
        loop {
            match self.round(Instant::now())? {
                Next::AtOnce => {}
                Next::Wait(patience) => self.wait(patience),
                Next::End => return Ok(()),
            }
        }
    }

    fn wait(&mut self, patience: Duration) {
        if self.trouble.unless(self.ports.wait(patience)).is_none() {
            sleep(RETRY_INTERVAL);
        }
        self.timer.lap(Stage::ReceivingIdle, 1);
    }
}

impl<P: Ports> Server<P> {
    /// Starts without actors and orders, which come from `inbox`.
    pub fn new(run: RunId, config: &Config, ports: P, inbox: Inbox) -> Self {
        Self {
            run,
            dispatcher: Dispatcher::new(run, &config.transport, config.record_lengths()),
            deliveries: BTreeMap::new(),
            ports,
            inbox,
            outbox: VecDeque::new(),
            is_wake_due: false,
            heartbeat: config.transport.heartbeat(),
            last_heartbeat: None,
            trouble: Trouble::default(),
            timer: LapTimer::start(),
        }
    }

    /// Does one round at `now`.
    ///
    /// # Errors
    /// [`ReceiverError::Hopeless`] and [`ReceiverError::Transport`].
    pub fn round(&mut self, now: Instant) -> Result<Next, ReceiverError> {
        match self.take_commands() {
            Request::Serve => {}
            Request::Finish => {
                self.say_stop();
                return Ok(Next::End);
            }
            Request::Vanish => return Ok(Next::End),
        }
        self.take_status(now);
        self.timer.lap(Stage::HandOut, 0);
        let may_be_more = self.take_records(now)?;
        self.dispatcher.on_time(now);
        self.hand_out(now);
        self.send_heartbeat(now);
        self.send_out();
        self.wake_actors();
        self.inbox.state.update(&self.dispatcher);
        self.timer.lap(Stage::HandOut, 1);
        if let Some(error) = self.trouble.lasting(now) {
            return Err(ReceiverError::Transport(error));
        }
        Ok(match may_be_more {
            true => Next::AtOnce,
            false => Next::Wait(self.patience()),
        })
    }

    /// Executes the training thread's commands; returns its final request.
    fn take_commands(&mut self) -> Request {
        loop {
            match self.inbox.next() {
                Ok(Command::Publish(snapshot)) => {
                    self.outbox.push_back(Outgoing::Snapshot(snapshot))
                }
                Ok(Command::Fly {
                    batch,
                    epoch,
                    keep,
                    tickets,
                    deliver,
                }) => {
                    let delivery = Delivery {
                        next: 0,
                        count: tickets.len(),
                        early: BTreeMap::new(),
                        to: deliver,
                    };
                    self.deliveries.insert(batch, delivery);
                    for (index, ticket) in tickets.into_iter().enumerate() {
                        self.dispatcher.order(EpisodeOrder {
                            ticket,
                            epoch,
                            keep,
                            place: BatchPlace { batch, index },
                        });
                    }
                }
                Ok(Command::Finish) => return Request::Finish,
                Err(TryRecvError::Disconnected) => return Request::Vanish,
                Err(TryRecvError::Empty) => return Request::Serve,
            }
        }
    }

    fn take_status(&mut self, now: Instant) {
        let (mut heard, mut anyone_empty_handed) = (false, false);
        while let Some(record) = self.trouble.unless(self.ports.receive_status()).flatten() {
            heard = true;
            match record.read(self.run) {
                Some(status) => {
                    anyone_empty_handed |= status.newest_policy.is_none();
                    self.dispatcher.on_status(&status, now);
                }
                None => {
                    tracing::debug!(?record, "status record refused");
                    self.dispatcher.refuse_status();
                }
            }
        }
        if heard {
            self.share_times();
        }
        if anyone_empty_handed {
            // Not only at the next heartbeat: a new actor cannot fly before it has a snapshot.
            self.trouble.unless(self.ports.connect());
            self.is_wake_due = true;
        }
    }

    fn share_times(&self) {
        let shared = &self.inbox.state;
        shared.update_times(self.dispatcher.actor_times().plus(self.timer.times()));
    }

    /// Takes in records, and delivers the episodes that they complete.
    /// Returns `true` if there may be more.
    fn take_records(&mut self, now: Instant) -> Result<bool, HopelessEpisode> {
        let mut unbooked = 0;
        let mut may_be_more = true;
        for _ in 0..RECORDS_AT_ONCE {
            let Some(record) = self
                .trouble
                .unless(self.ports.receive_transition())
                .flatten()
            else {
                may_be_more = false;
                break;
            };
            unbooked += 1;
            if let Some((place, episode)) = self.dispatcher.on_record(&record, now)? {
                self.deliver(place, episode);
                self.timer
                    .lap(Stage::Assemble, std::mem::take(&mut unbooked));
                self.hand_out(now);
                self.send_out();
                self.timer.lap(Stage::HandOut, 0);
            }
        }
        self.timer.lap(Stage::Assemble, unbooked);
        Ok(may_be_more)
    }

    /// Delivers the next episodes of the batch, and keeps early ones.
    fn deliver(&mut self, place: BatchPlace, episode: CommittedEpisode) {
        let Some(delivery) = self.deliveries.get_mut(&place.batch) else {
            return;
        };
        delivery.early.insert(place.index, episode);
        while let Some(episode) = delivery.early.remove(&delivery.next) {
            delivery.next += 1;
            die_if_armed(FaultPoint::LearnerEpisodeCommitted);
            // A training thread that no longer waits has been stopped.
            let _ = delivery.to.send(episode);
        }
        if delivery.next == delivery.count {
            self.deliveries.remove(&place.batch);
        }
    }

    fn hand_out(&mut self, now: Instant) {
        self.outbox.extend(
            self.dispatcher
                .issue(now)
                .into_iter()
                .map(Outgoing::Message),
        );
    }

    /// Sends the outbox, as far as that works.
    fn send_out(&mut self) {
        while let Some(outgoing) = self.outbox.front() {
            let sent = match outgoing {
                Outgoing::Snapshot(snapshot) => self.ports.publish(snapshot),
                Outgoing::Message(message) => self.ports.send(message),
            };
            if self.trouble.unless(sent).is_none() {
                break;
            }
            self.is_wake_due |= matches!(outgoing, Outgoing::Snapshot(_));
            self.outbox.pop_front();
        }
    }

    /// Wakes the actors if something was sent and one of them may be waiting.
    fn wake_actors(&mut self) {
        self.is_wake_due |= self.dispatcher.take_wake();
        // Waking makes no sense before everything is sent.
        if self.is_wake_due && self.outbox.is_empty() {
            self.is_wake_due = self.trouble.unless(self.ports.wake_actors()).is_none();
        }
    }

    fn send_heartbeat(&mut self, now: Instant) {
        let last = self.last_heartbeat;
        if last.is_some_and(|last| now.duration_since(last) < self.heartbeat) {
            return;
        }
        self.last_heartbeat = Some(now);
        let situation = self.dispatcher.situation(now);
        self.inbox.state.update_situation(situation, now);
        self.share_times();
        self.trouble.unless(self.ports.maintain());
        let heartbeat = ControlRecord::heartbeat(self.run);
        self.trouble.unless(self.ports.send_control(heartbeat));
    }

    /// Longest time until the next round, if nothing arrives.
    fn patience(&self) -> Duration {
        if self.outbox.is_empty() && !self.is_wake_due {
            self.heartbeat
        } else {
            RETRY_INTERVAL
        }
    }

    fn say_stop(&mut self) {
        // Actors that miss it leave when this learner ends.
        self.trouble
            .unless(self.ports.send_control(ControlRecord::stop(self.run)));
        self.trouble.unless(self.ports.wake_actors());
    }
}

/// Failures of the services, and their duration.
#[derive(Default)]
struct Trouble {
    /// Start of the first round since which every round has met a failure.
    since: Option<Instant>,
    /// Failure that was logged last; a repetition is not logged.
    logged: String,
    /// Last failure of the present round.
    present: Option<ServiceError>,
}

impl Trouble {
    /// Returns the result; a failure is recorded instead.
    fn unless<T>(&mut self, result: Result<T, ServiceError>) -> Option<T> {
        match result {
            Ok(result) => Some(result),
            Err(error) => {
                self.present = Some(error);
                None
            }
        }
    }

    /// Ends a round that began at `now`; returns the failure if it has lasted for too long.
    fn lasting(&mut self, now: Instant) -> Option<String> {
        let Some(error) = self.present.take() else {
            self.since = None;
            self.logged.clear();
            return None;
        };
        let error = error.to_string();
        if self.logged != error {
            tracing::warn!(error, "a service failed; continuing");
            self.logged.clone_from(&error);
        }
        let since = *self.since.get_or_insert(now);
        (now.duration_since(since) > TRANSPORT_PATIENCE).then_some(error)
    }
}
