//! Supervises a learner and its actors from the first start to the last exit.

use std::ops::ControlFlow::{self, Break, Continue};
use std::time::Duration;

use skein_protocol::progress::ProgressReport;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

use super::crew::Crew;
use super::dismissal::dismiss;
use super::learner::{LearnerProcess, News};
use super::memory::MemoryWatch;
use super::process::{Exit, ProcessOrder};
use super::stop::Stop;
use super::work::WorkDone;
use super::{EVENTS, Ended, Restarts, SupervisionPlan, SupervisorError, SupervisorEvent, Watcher};

/// If the supervisor wakes later than planned by this much, it was itself held up, and silence of
/// other processes during that time proves nothing.
const HELD_UP: Duration = Duration::from_secs(1);

/// Supervises a learner and its actors until the run ends. Each message on `interrupts` is an
/// interruption by the user: the first stops in order, the second immediately.
///
/// # Errors
/// [`SupervisorError`] names the program, its log and the log's last lines. No process is left in
/// any case.
pub async fn run(
    plan: &SupervisionPlan,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let memory = MemoryWatch::new();
    let mut supervision = Supervision {
        plan,
        watcher,
        learner: LearnerProcess::start(plan, events.clone(), memory.clone())?,
        crew: Crew::new(
            &plan.run,
            &plan.programs.actor,
            &plan.actors,
            events,
            memory,
        ),
        stop: Stop::NotYet,
        failure: None,
        stall: Stall::None,
    };
    loop {
        let deadline = supervision.deadline();
        let flow = tokio::select! {
            Some(event) = inbox.recv() => supervision.handle(event),
            Some(()) = interrupts.recv() => supervision.interrupted(),
            () = sleep_until(deadline.unwrap_or_else(Instant::now)), if deadline.is_some() => {
                supervision.deadline_passed();
                Continue(())
            }
        };
        supervision.check_crew();
        if flow.is_break() {
            break;
        }
    }
    // The learner has ended; now the actors must end.
    let Supervision {
        mut crew,
        stop,
        failure,
        ..
    } = supervision;
    if failure.is_some() {
        crew.order(ProcessOrder::Terminate);
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match failure {
        Some(error) => Err(error),
        None if stop == Stop::NotYet => Ok(Ended::Finished),
        None => Ok(Ended::Interrupted),
    }
}

struct Supervision<'a, W> {
    plan: &'a SupervisionPlan,
    watcher: &'a mut W,
    learner: LearnerProcess<'a>,
    crew: Crew<'a>,
    stop: Stop,
    failure: Option<SupervisorError>,
    stall: Stall,
}

/// Stall of the learner, and whether the user knows of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stall {
    None,
    Reported,
}

impl<W: Watcher> Supervision<'_, W> {
    /// Handles an event; breaks when the learner has ended for good.
    fn handle(&mut self, event: SupervisorEvent) -> ControlFlow<()> {
        match event {
            SupervisorEvent::LearnerSaid(line) => match serde_json::from_str(&line) {
                Ok(progress) => self.reported(&progress),
                // Not a report: text for the user.
                Err(_) => self.watcher.warn(&line),
            },
            SupervisorEvent::LearnerExited(exit) => return self.learner_exited(&exit),
            SupervisorEvent::LearnerDue if self.stop == Stop::NotYet => self.learner.start_again(),
            SupervisorEvent::LearnerDue => {}
            SupervisorEvent::ActorExited(number, exit) => self.crew.exited(number, &exit),
            SupervisorEvent::ActorDue(number) => self.crew.restart(number),
        }
        Continue(())
    }

    fn reported(&mut self, progress: &ProgressReport) {
        let restarts = Restarts {
            learner: self.learner.restarts(),
            actors: self.crew.restarts(),
        };
        self.watcher.progress(progress, restarts);
        match (&progress.stalled, self.stall) {
            (Some(stalled), Stall::None) => {
                self.watcher.warn(&format!("no progress: {stalled}"));
                self.stall = Stall::Reported;
            }
            (None, Stall::Reported) => self.stall = Stall::None,
            _ => {}
        }
        let news = self.learner.reported(progress);
        if news != News::Nothing {
            self.stop = self.stop.progressed(self.plan.deadlines.learner_stop);
        }
        if !self.learner.is_reporting() {
            return;
        }
        self.crew.reported(
            WorkDone::of(progress),
            &progress.live_actors,
            self.plan.deadlines.actor_silence,
        );
        if news == News::Up
            && self.stop == Stop::NotYet
            && let Err(error) = self.crew.start()
        {
            self.failure = Some(error);
            self.stop = Stop::AtOnce;
            self.learner.kill();
        }
    }

    /// Breaks unless another incarnation will follow.
    fn learner_exited(&mut self, exit: &Exit) -> ControlFlow<()> {
        self.crew.learner_died();
        if *exit == Exit::SUCCESS || self.stop == Stop::AtOnce {
            return Break(());
        }
        if let Stop::InOrder { .. } = self.stop {
            // A learner that had not reported had nothing to save, and may not have installed its
            // signal handlers yet.
            if self.learner.is_reporting() {
                let how = exit.to_string();
                self.failure.get_or_insert_with(|| self.learner.failed(how));
            }
            return Break(());
        }
        match self.learner.exited(exit) {
            Ok(message) => {
                self.watcher.warn(&message);
                Continue(())
            }
            Err(error) => {
                self.failure = Some(error);
                Break(())
            }
        }
    }

    /// Breaks when no process is left to wait for.
    fn interrupted(&mut self) -> ControlFlow<()> {
        self.stop = self.stop.interrupted(self.plan.deadlines.learner_stop);
        if self.learner.is_dead() {
            return Break(());
        }
        if self.stop == Stop::AtOnce {
            self.learner.kill();
            self.crew.order(ProcessOrder::Kill);
        } else {
            self.watcher.warn(
                "stopping: finishing the updates of this epoch, then saving; \
                     press Ctrl-C again to stop immediately, without saving",
            );
            self.learner.order(ProcessOrder::Terminate);
        }
        Continue(())
    }

    /// Returns the time at which the learner has been idle for too long.
    fn deadline(&self) -> Option<Instant> {
        self.stop
            .deadline()
            .into_iter()
            .chain(self.learner.deadline())
            .min()
    }

    /// Kills a learner that has been idle for too long. The event of its end decides what follows.
    fn deadline_passed(&mut self) {
        if self
            .deadline()
            .is_none_or(|deadline| deadline.elapsed() > HELD_UP)
        {
            self.learner.forgive_silence();
            self.stop = self.stop.progressed(self.plan.deadlines.learner_stop);
            return;
        }
        if self.stop == Stop::NotYet {
            let deadlines = &self.plan.deadlines;
            let secs = if self.learner.is_reporting() {
                deadlines.learner_silence
            } else {
                deadlines.learner_start
            }
            .as_secs();
            self.watcher.warn(&format!(
                "the learner has not reported for {secs} s: killing it"
            ));
        } else {
            self.watcher.warn("the learner does not stop: killing it");
            self.stop = Stop::AtOnce;
            self.failure.get_or_insert_with(|| {
                self.learner.failed("did not stop when asked to".to_owned())
            });
        }
        self.learner.kill();
    }

    /// Forwards warnings about the actors, and stops the run when no actor is left.
    fn check_crew(&mut self) {
        while let Some(warning) = self.crew.next_warning() {
            self.watcher.warn(&warning);
        }
        if self.stop == Stop::NotYet
            && self.learner.is_reporting()
            && !self.crew.is_alive()
            && let Some(reason) = self.crew.last_failure()
        {
            self.failure = Some(match self.learner.is_directory_gone() {
                true => SupervisorError::DirectoryGone(self.plan.run.root().to_owned()),
                false => SupervisorError::NoActors(reason.to_string()),
            });
            self.stop = self.stop.interrupted(self.plan.deadlines.learner_stop);
            self.learner.order(ProcessOrder::Terminate);
        }
    }
}
