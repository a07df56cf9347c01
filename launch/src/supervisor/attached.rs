//! Actors that were added to a run under way. Its learner is none of their supervisor's business: they find it, and its next lives, by themselves.

use tokio::sync::mpsc;

use super::crew::{Crew, GivenUp};
use super::dismissal::dismiss;
use super::process::Order;
use super::{EVENTS, Ended, Event, Plan, SupervisorError, Watcher};

/// Supervises actors that join a run under way, until they end.
///
/// # Errors
/// As [`run`](super::run).
pub async fn attach(
    plan: &Plan,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let mut crew = Crew::new(&plan.run, &plan.programs.actor, &plan.actors, events);
    if let Err(error) = crew.start() {
        dismiss(&mut crew, &mut inbox, interrupts).await;
        return Err(error);
    }
    let mut ended = Ended::Finished;
    while crew.is_alive() && ended == Ended::Finished {
        tokio::select! {
            Some(event) = inbox.recv() => match event {
                Event::ActorExited(number, exit) => crew.exited(number, &exit),
                Event::ActorDue(number) => crew.restart(number),
                Event::LearnerSaid(_) | Event::LearnerExited(_) | Event::LearnerDue => {}
            },
            Some(()) = interrupts.recv() => {
                crew.order(Order::Terminate);
                ended = Ended::Interrupted;
            }
        }
        while let Some(warning) = crew.next_warning() {
            watcher.warn(&warning);
        }
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match crew.last_failure() {
        Some(reason) if ended == Ended::Finished => Err(match reason {
            GivenUp::LearnerGone => SupervisorError::LearnerGone(plan.run.root().to_owned()),
            GivenUp::KeepsDying(_) => SupervisorError::NoActors(reason.to_string()),
        }),
        _ => Ok(ended),
    }
}
