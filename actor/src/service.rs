//! The actor process: joins the learner, takes a ticket, flies it, until the run is over.
//!
//! It recovers from failures by starting over: a lost episode is flown again on a new ticket, by
//! this actor or another; a lost learner is looked for until it is back. The process ends only at
//! the end of the run, on a signal, or after a long time without a heartbeat from any learner.

mod connection;
#[cfg(test)]
mod tests;

use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::status::ActorState;
use skein_protocol::ticket::Ticket;
use skein_run::fault::{FaultPoint, die_if_armed};
use skein_run::{LearnerIncarnation, RunIdentity};
use skein_transport::{ActorPorts, JoinError, ServiceError};
use tracing::{debug, info, info_span, warn};

use self::connection::LearnerConnection;
use crate::recorder::Recorder;
use crate::session::DisconnectReason;
use skein_inference::Network;
use skein_rollout::environment_loop::{EnvironmentLoop, EpisodeError};
use skein_rollout::world::Worlds;

pub use crate::session::ExitReason;

/// Longest time between two tries to join a learner, and between two checks of the exit request
/// meanwhile.
const JOIN_INTERVAL: Duration = Duration::from_millis(100);

/// Serves the learners of a run, one incarnation after the other.
pub struct Service<'a> {
    identity: &'a RunIdentity,
    config: &'a Config,
    actor: ActorId,
    /// Asked between two steps, between two tries to join, and after each wait.
    exit_requested: &'a dyn Fn() -> bool,
    incarnation: ActorIncarnation,
    /// Time of the last heartbeat from a learner; at first, the start of this service.
    last_heard: Instant,
    newest_learner: Option<LearnerIncarnation>,
    recorder: Option<Recorder>,
}

impl<'a> Service<'a> {
    /// Creates a service of `actor` that has not joined a learner yet.
    pub fn new(
        identity: &'a RunIdentity,
        config: &'a Config,
        actor: ActorId,
        exit_requested: &'a dyn Fn() -> bool,
    ) -> Self {
        Self {
            identity,
            config,
            actor,
            exit_requested,
            incarnation: ActorIncarnation(0),
            last_heard: Instant::now(),
            newest_learner: None,
            recorder: None,
        }
    }

    /// Also records episodes, if there is a `recorder`.
    #[must_use]
    pub fn with_recorder(mut self, recorder: Option<Recorder>) -> Self {
        self.recorder = recorder;
        self
    }

    /// Flies tickets as they arrive, until there is a reason to exit.
    ///
    /// # Errors
    /// [`JoinError`] if this process can never join a learner of this run, or could not join the
    /// existing one for `transport.learner_silence_secs`. A lost episode or learner is not an
    /// error.
    pub fn serve<W: Worlds>(
        mut self,
        environment_loop: &mut EnvironmentLoop<W>,
    ) -> Result<ExitReason, JoinError> {
        loop {
            let ports = match self.find_learner()? {
                Ok(ports) => ports,
                Err(ending) => return Ok(ending),
            };
            self.incarnation = next_incarnation(self.incarnation);
            info!(
                actor = %self.actor,
                incarnation = %self.incarnation,
                learner_incarnation = %ports.incarnation(),
                "learner joined"
            );
            die_if_armed(FaultPoint::ActorJoined);
            environment_loop.begin_incarnation(self.incarnation);
            let mut connection = LearnerConnection::new(&self, ports);
            let recorder = self.recorder.as_mut();
            let disconnect_reason = serve_learner(environment_loop, &mut connection, recorder);
            self.last_heard = connection.last_heard();
            match disconnect_reason {
                Ok(DisconnectReason::Exit(ending)) => return Ok(ending),
                Ok(DisconnectReason::LearnerGone) => {
                    warn!("the learner is gone; looking for its next incarnation")
                }
                Ok(DisconnectReason::Suspended) => {
                    warn!("this process was suspended for too long; joining again")
                }
                Ok(DisconnectReason::RejoinRequested) => {
                    warn!("the learner receives no records; joining again")
                }
                Err(error) => {
                    warn!(%error, "the connection to the learner is broken; joining again");
                    sleep(JOIN_INTERVAL);
                }
            }
        }
    }

    /// Tries to join a learner until it succeeds, or there is a reason to exit.
    fn find_learner(&mut self) -> Result<Result<ActorPorts, ExitReason>, JoinError> {
        let mut last_refusal = None;
        let interval = JOIN_INTERVAL.min(self.config.transport.heartbeat());
        loop {
            if (self.exit_requested)() {
                return Ok(Err(ExitReason::Signalled));
            }
            match ActorPorts::join(self.identity, self.config) {
                Ok(ports) => {
                    // A new incarnation proves that a learner is alive. Joining the same one again
                    // proves nothing.
                    if self
                        .newest_learner
                        .is_none_or(|newest| newest < ports.incarnation())
                    {
                        self.newest_learner = Some(ports.incarnation());
                        self.last_heard = Instant::now();
                    }
                    return Ok(Ok(ports));
                }
                Err(error) if error.is_final() => return Err(error),
                Err(error) => {
                    let refusal = error.to_string();
                    if last_refusal.as_ref() != Some(&refusal) {
                        info!(error = refusal, "no learner joined yet");
                        last_refusal = Some(refusal);
                    }
                    if self.last_heard.elapsed()
                        > Duration::from_secs_f64(self.config.transport.learner_silence_secs)
                    {
                        return match error {
                            JoinError::NoLearner(_) => Ok(Err(ExitReason::LearnerSilent)),
                            error => Err(error),
                        };
                    }
                }
            }
            sleep(interval);
        }
    }
}

/// Returns an incarnation that no earlier start of this actor had, as far as the clock shows, and
/// that is new in this process.
fn next_incarnation(last: ActorIncarnation) -> ActorIncarnation {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanos = since_1970.map_or(0, |elapsed| elapsed.as_nanos() as u64);
    ActorIncarnation(nanos.max(last.0 + 1))
}

/// Serves the joined learner.
fn serve_learner<W: Worlds>(
    environment_loop: &mut EnvironmentLoop<W>,
    connection: &mut LearnerConnection<'_>,
    mut recorder: Option<&mut Recorder>,
) -> Result<DisconnectReason, ServiceError> {
    connection.report(ActorState::Serving)?;
    let disconnect_reason = loop {
        connection.listen()?;
        if let Some(disconnect_reason) = connection.disconnect_reason() {
            break disconnect_reason;
        }
        match connection.take_ticket() {
            Some((ticket, network)) => {
                let recorder = recorder.as_deref_mut();
                fly(environment_loop, &ticket, &network, connection, recorder)?;
            }
            None => connection.wait()?,
        }
    };
    info!(
        ?disconnect_reason,
        episodes = connection.episodes_flown,
        "disconnecting"
    );
    if disconnect_reason != DisconnectReason::LearnerGone {
        connection.report(ActorState::Leaving)?;
    }
    Ok(disconnect_reason)
}

fn fly<W: Worlds>(
    environment_loop: &mut EnvironmentLoop<W>,
    ticket: &Ticket,
    network: &Network,
    connection: &mut LearnerConnection<'_>,
    mut recorder: Option<&mut Recorder>,
) -> Result<(), ServiceError> {
    let span = info_span!(
        "episode",
        episode = %ticket.episode,
        attempt = %ticket.attempt,
        policy = %ticket.policy_version
    );
    let _entered = span.enter();
    let flown = match &mut recorder {
        Some(recorder) => {
            environment_loop.fly(ticket, network, &mut recorder.tap(ticket, connection))
        }
        None => environment_loop.fly(ticket, network, connection),
    };
    match flown {
        Ok(None) => debug!(steps = ticket.first_step(), "segment flown"),
        Ok(Some(score)) => {
            connection.episodes_flown += 1;
            if let Some(recorder) = recorder {
                recorder.keep(ticket, score);
            }
            debug!(
                walls = score.walls_passed,
                outcome = score.outcome.name(),
                reward = score.episode_return,
                "flown"
            );
        }
        Err(EpisodeError::Abandoned) => info!("episode abandoned"),
        Err(EpisodeError::Fault(fault)) => warn!(%fault, "episode failed"),
        // Whoever flies in such an environment also requests the exit.
        Err(EpisodeError::Foreign(fault)) => warn!(fault, "the environment failed"),
        // The ticket's deadline covers it.
        Err(EpisodeError::Link(error)) => warn!(%error, "episode lost"),
    }
    // Woken here, so that the learner also gets the times of this episode.
    connection.wake_learner()
}
