//! Ends the actors of a run that is over.

use std::pin::pin;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::sleep;

use super::SupervisorEvent;
use super::crew::Crew;
use super::process::ProcessOrder;

/// Time in which actors must react to the learner's announcement that the run is over.
pub(super) const ACTOR_GRACE: Duration = Duration::from_secs(5);
/// Time in which actors must react to SIGTERM.
const TERMINATE_GRACE: Duration = Duration::from_secs(5);

/// Waits until no actor is left. Actors that do not end by themselves get SIGTERM, then SIGKILL. An
/// interruption skips the waiting.
pub(super) async fn dismiss(
    crew: &mut Crew<'_>,
    inbox: &mut mpsc::Receiver<SupervisorEvent>,
    interrupts: &mut mpsc::Receiver<()>,
) {
    crew.let_go();
    for (grace, next) in [
        (ACTOR_GRACE, ProcessOrder::Terminate),
        (TERMINATE_GRACE, ProcessOrder::Kill),
    ] {
        let mut expired = pin!(sleep(grace));
        while crew.is_alive() {
            tokio::select! {
                Some(event) = inbox.recv() => note_exit(crew, event),
                () = &mut expired => break,
                Some(()) = interrupts.recv() => break,
            }
        }
        crew.order(next);
    }
    while crew.is_alive() {
        match inbox.recv().await {
            Some(event) => note_exit(crew, event),
            None => return,
        }
    }
}

fn note_exit(crew: &mut Crew<'_>, event: SupervisorEvent) {
    if let SupervisorEvent::ActorExited(number, exit) = event {
        crew.exited(number, &exit);
    }
}
