//! How actors are seen off when their run is over.

use std::pin::pin;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::sleep;

use super::Event;
use super::crew::Crew;
use super::process::Order;

/// How long actors may take to follow the learner's word that the run is over.
pub(super) const ACTOR_GRACE: Duration = Duration::from_secs(5);
/// How long actors may take to follow SIGTERM.
const TERMINATE_GRACE: Duration = Duration::from_secs(5);

/// Sees to it that no actor is left: those that do not end by themselves are told, those that do
/// not listen are killed. An interruption skips the waiting.
pub(super) async fn dismiss(
    crew: &mut Crew<'_>,
    inbox: &mut mpsc::Receiver<Event>,
    interrupts: &mut mpsc::Receiver<()>,
) {
    crew.let_go();
    for (grace, next) in [
        (ACTOR_GRACE, Order::Terminate),
        (TERMINATE_GRACE, Order::Kill),
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

fn note_exit(crew: &mut Crew<'_>, event: Event) {
    if let Event::ActorExited(number, exit) = event {
        crew.exited(number, &exit);
    }
}
