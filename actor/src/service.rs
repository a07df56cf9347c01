//! The incarnation of an actor process: join the learner, take a ticket, fly it, until the run is
//! over.
//!
//! Whatever happens on the way is survived by doing nothing about it: an episode that is lost is
//! flown again on a new ticket, by this actor or another; a learner that is lost is looked for
//! until it lives again. Only the end of the run, a signal, or no heartbeat from any learner for
//! too long end the process.

mod line;
#[cfg(test)]
mod tests;

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::status::ActorState;
use skein_protocol::ticket::Ticket;
use skein_run::fault::{FaultPoint, pass};
use skein_run::{LearnerIncarnation, RunIdentity};
use skein_transport::{ActorPorts, JoinError, ServiceError};
use tracing::{debug, info, info_span, warn};

use self::line::LearnerLine;
use skein_inference::Network;
use skein_rollout::environment_loop::{EnvironmentLoop, EpisodeError};

/// Longest time between two looks for a learner, and between two looks whether to end meanwhile.
const SEEK_INTERVAL: Duration = Duration::from_millis(100);

/// Serves the learners of a run, one incarnation after the other.
#[derive(Debug)]
pub struct Service<'a> {
    identity: &'a RunIdentity,
    config: &'a Config,
    actor: ActorId,
    /// Looked at between two steps and between two looks for a learner.
    told_to_end: &'a AtomicBool,
    incarnation: ActorIncarnation,
    /// When a learner last sent a heartbeat; at first, when this service began.
    last_sign: Instant,
    newest_learner: Option<LearnerIncarnation>,
}

/// Why an actor leaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// The learner said that the run is over.
    Stopped,
    /// This process was told to end.
    Signalled,
    /// No learner of this run sent a heartbeat for `transport.learner_silence_secs`.
    LearnerSilent,
}

/// Why an actor lets go of the learner it has joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Parting {
    /// The actor leaves.
    Leave(Ending),
    /// That learner is dead, or another incarnation of it has begun.
    LearnerGone,
    /// This process was stopped for so long that the learner has given it up: its tickets are
    /// others' now.
    Overslept,
    /// The learner hears nothing of what this actor flies.
    AskedToRejoin,
}

impl<'a> Service<'a> {
    /// A service of `actor` that has not joined a learner yet.
    pub fn new(
        identity: &'a RunIdentity,
        config: &'a Config,
        actor: ActorId,
        told_to_end: &'a AtomicBool,
    ) -> Self {
        Self {
            identity,
            config,
            actor,
            told_to_end,
            incarnation: ActorIncarnation(0),
            last_sign: Instant::now(),
            newest_learner: None,
        }
    }

    /// Flies tickets as they come, until the run is over for this actor.
    ///
    /// # Errors
    /// [`JoinError`] when no learner of this run can be joined by this process, now or later, or
    /// one that is there could not for `transport.learner_silence_secs`. A lost episode or learner
    /// is none.
    pub fn serve(mut self, environment_loop: &mut EnvironmentLoop) -> Result<Ending, JoinError> {
        loop {
            let ports = match self.seek()? {
                Ok(ports) => ports,
                Err(ending) => return Ok(ending),
            };
            self.incarnation = next_incarnation(self.incarnation);
            info!(actor = %self.actor, incarnation = %self.incarnation, learner_incarnation = %ports.incarnation(), "learner joined");
            pass(FaultPoint::ActorJoined);
            environment_loop.begin_incarnation(self.incarnation);
            let mut line = LearnerLine::new(&self, ports);
            let parting = serve_incarnation(environment_loop, &mut line);
            self.last_sign = line.last_sign();
            match parting {
                Ok(Parting::Leave(ending)) => return Ok(ending),
                Ok(Parting::LearnerGone) => {
                    warn!("the learner is gone; looking for its next incarnation")
                }
                Ok(Parting::Overslept) => {
                    warn!("this process was stopped for too long; joining anew")
                }
                Ok(Parting::AskedToRejoin) => {
                    warn!("nothing that was flown has arrived; joining anew")
                }
                Err(error) => {
                    warn!(%error, "the line to the learner is broken; joining anew");
                    sleep(SEEK_INTERVAL);
                }
            }
        }
    }

    /// Looks for a learner until it has joined one, or there is a reason to leave.
    fn seek(&mut self) -> Result<Result<ActorPorts, Ending>, JoinError> {
        let mut last_refusal = None;
        let interval = SEEK_INTERVAL.min(self.config.transport.heartbeat());
        loop {
            if self.told_to_end.load(Ordering::Relaxed) {
                return Ok(Err(Ending::Signalled));
            }
            match ActorPorts::join(self.identity, self.config) {
                Ok(ports) => {
                    // An incarnation that was not there before shows that a learner incarnations.
                    // To join the same one again shows nothing.
                    if self
                        .newest_learner
                        .is_none_or(|newest| newest < ports.incarnation())
                    {
                        self.newest_learner = Some(ports.incarnation());
                        self.last_sign = Instant::now();
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
                    if self.last_sign.elapsed()
                        > Duration::from_secs_f64(self.config.transport.learner_silence_secs)
                    {
                        return match error {
                            JoinError::NoLearner(_) => Ok(Err(Ending::LearnerSilent)),
                            error => Err(error),
                        };
                    }
                }
            }
            sleep(interval);
        }
    }
}

/// A number that no earlier incarnation of this actor had, as far as the clock tells, and none of
/// this process.
fn next_incarnation(last: ActorIncarnation) -> ActorIncarnation {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanos = since_1970.map_or(0, |elapsed| elapsed.as_nanos() as u64);
    ActorIncarnation(nanos.max(last.0 + 1))
}

/// Serves the learner that was joined.
fn serve_incarnation(
    environment_loop: &mut EnvironmentLoop,
    line: &mut LearnerLine<'_>,
) -> Result<Parting, ServiceError> {
    line.report(ActorState::Serving)?;
    let parting = loop {
        line.listen()?;
        if let Some(parting) = line.parting() {
            break parting;
        }
        match line.take_ticket() {
            Some((ticket, network)) => fly(environment_loop, &ticket, &network, line)?,
            None => line.wait()?,
        }
    };
    info!(?parting, episodes = line.episodes_flown, "leaving");
    if parting != Parting::LearnerGone {
        line.report(ActorState::Leaving)?;
    }
    Ok(parting)
}

fn fly(
    environment_loop: &mut EnvironmentLoop,
    ticket: &Ticket,
    network: &Network,
    line: &mut LearnerLine<'_>,
) -> Result<(), ServiceError> {
    let span = info_span!("episode", episode = %ticket.episode, attempt = %ticket.attempt, policy = %ticket.policy_version);
    let _entered = span.enter();
    match environment_loop.fly(ticket, network, line) {
        Ok(None) => debug!(steps = ticket.first_step(), "segment flown"),
        Ok(Some(score)) => {
            line.episodes_flown += 1;
            debug!(
                walls = score.walls_passed,
                outcome = score.outcome.name(),
                reward = score.episode_return,
                "flown"
            );
        }
        Err(EpisodeError::Abandoned) => info!("episode abandoned"),
        Err(EpisodeError::Fault(fault)) => warn!(%fault, "episode failed"),
        // The ticket's deadline makes good for it.
        Err(EpisodeError::Link(error)) => warn!(%error, "episode lost"),
    }
    // Here, so that the times of an episode that is taken in are known too.
    line.wake_learner()
}
