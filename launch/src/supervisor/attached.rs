//! Actors added to a run that is under way. They find its learner, and later incarnations of the
//! learner, on their own; their supervisor does not manage it.

use tokio::sync::mpsc;
use tokio::time::{Duration, Instant, interval};

use super::crew::{Crew, GivenUp};
use super::dismissal::dismiss;
use super::memory::MemoryWatch;
use super::process::ProcessOrder;
use super::{EVENTS, Ended, SupervisionPlan, SupervisorError, SupervisorEvent, Watcher};

/// Time between two checks whether the run is still under way.
const LOOK: Duration = Duration::from_secs(1);

/// Supervises actors that join a run under way, until they end. Actors end by themselves when the
/// run does. Any that remain are ended once `is_under_way` has returned `false` for
/// [`Deadlines::actor_silence`](super::Deadlines).
///
/// # Errors
/// As [`run`](super::run).
pub async fn attach(
    plan: &SupervisionPlan,
    is_under_way: impl Fn() -> bool,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let mut crew = Crew::new(
        &plan.run,
        &plan.programs.actor,
        &plan.actors,
        events,
        MemoryWatch::new(),
    );
    if let Err(error) = crew.start() {
        dismiss(&mut crew, &mut inbox, interrupts).await;
        return Err(error);
    }
    let mut ended = Ended::Finished;
    let (mut look, mut last_under_way) = (interval(LOOK), Instant::now());
    while crew.is_alive() && ended == Ended::Finished {
        tokio::select! {
            Some(event) = inbox.recv() => match event {
                SupervisorEvent::ActorExited(number, exit) => crew.exited(number, &exit),
                SupervisorEvent::ActorDue(number) => crew.restart(number),
                SupervisorEvent::LearnerSaid(_)
                | SupervisorEvent::LearnerExited(_)
                | SupervisorEvent::LearnerDue => {}
            },
            Some(()) = interrupts.recv() => {
                crew.order(ProcessOrder::Terminate);
                ended = Ended::Interrupted;
            }
            _ = look.tick() => {
                if is_under_way() {
                    last_under_way = Instant::now();
                } else if last_under_way.elapsed() > plan.deadlines.actor_silence {
                    break;
                }
            }
        }
        while let Some(warning) = crew.next_warning() {
            watcher.warn(&warning);
        }
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match crew.last_failure() {
        // An actor that started or restarted while the run ended was not notified of the end.
        Some(GivenUp::LearnerGone) if plan.run.summary().is_some() => Ok(ended),
        Some(reason) if ended == Ended::Finished => Err(match reason {
            GivenUp::LearnerGone => SupervisorError::LearnerGone(plan.run.root().to_owned()),
            GivenUp::KeepsDying(_) => SupervisorError::NoActors(reason.to_string()),
        }),
        _ => Ok(ended),
    }
}
