//! A learner and its actors, supervised from the first start to the last exit.

use std::ops::ControlFlow::{self, Break, Continue};
use std::time::Duration;

use skein_protocol::progress::ProgressReport;
use tokio::sync::mpsc;
use tokio::time::{Instant, sleep_until};

use super::crew::Crew;
use super::dismissal::dismiss;
use super::learner::{Learner, News};
use super::process::{Exit, Order};
use super::stop::Stop;
use super::work::Work;
use super::{EVENTS, Ended, Event, Plan, Restarts, SupervisorError, Watcher};

/// Waking so much later than asked for, the supervisor itself was held up, and what it did not hear
/// in that time proves nothing.
const HELD_UP: Duration = Duration::from_secs(1);

/// Supervises a learner and its actors until the run ends. Each message on `interrupts` is one
/// interruption by the user: the first stops in order, the second at once.
///
/// # Errors
/// [`SupervisorError`] names the program, its log and the log's last lines. No process is left in
/// any case.
pub async fn run(
    plan: &Plan,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let mut supervision = Supervision {
        plan,
        watcher,
        learner: Learner::start(plan, events.clone())?,
        crew: Crew::new(&plan.run, &plan.programs.actor, &plan.actors, events),
        stop: Stop::NotYet,
        failure: None,
        stall: Stall::None,
    };
    loop {
        let deadline = supervision.deadline();
        let flow = tokio::select! {
            Some(event) = inbox.recv() => supervision.heed(event),
            Some(()) = interrupts.recv() => supervision.interrupted(),
            () = sleep_until(deadline.unwrap_or_else(Instant::now)), if deadline.is_some() => {
                supervision.deadline_passed();
                Continue(())
            }
        };
        supervision.look_after_crew();
        if flow.is_break() {
            break;
        }
    }
    // The learner is gone, and so should be the actors.
    let Supervision {
        mut crew,
        stop,
        failure,
        ..
    } = supervision;
    if failure.is_some() {
        crew.order(Order::Terminate);
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match failure {
        Some(error) => Err(error),
        None if stop == Stop::NotYet => Ok(Ended::Finished),
        None => Ok(Ended::Interrupted),
    }
}

struct Supervision<'a, W> {
    plan: &'a Plan,
    watcher: &'a mut W,
    learner: Learner<'a>,
    crew: Crew<'a>,
    stop: Stop,
    failure: Option<SupervisorError>,
    stall: Stall,
}

/// Whether the learner says that nothing moves, and the user knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stall {
    None,
    Told,
}

impl<W: Watcher> Supervision<'_, W> {
    /// Takes note of what happened; breaks when the learner is gone for good.
    fn heed(&mut self, event: Event) -> ControlFlow<()> {
        match event {
            Event::LearnerSaid(line) => match serde_json::from_str(&line) {
                Ok(progress) => self.reported(&progress),
                // Somebody meant it to be read.
                Err(_) => self.watcher.warn(&line),
            },
            Event::LearnerExited(exit) => return self.learner_exited(&exit),
            Event::LearnerDue if self.stop == Stop::NotYet => self.learner.start_again(),
            Event::LearnerDue => {}
            Event::ActorExited(number, exit) => self.crew.exited(number, &exit),
            Event::ActorDue(number) => self.crew.restart(number),
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
                self.watcher.warn(&format!("nothing moves: {stalled}"));
                self.stall = Stall::Told;
            }
            (None, Stall::Told) => self.stall = Stall::None,
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
            Work::of(progress),
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

    /// Breaks unless there will be another incarnation.
    fn learner_exited(&mut self, exit: &Exit) -> ControlFlow<()> {
        self.crew.learner_died();
        if *exit == Exit::SUCCESS || self.stop == Stop::AtOnce {
            return Break(());
        }
        if let Stop::InOrder { .. } = self.stop {
            // One that had not even begun had nothing to save, and may have known nothing of
            // signals yet.
            if self.learner.is_reporting() {
                let how = exit.to_string();
                self.failure.get_or_insert_with(|| self.learner.failed(how));
            }
            return Break(());
        }
        match self.learner.exited(exit) {
            Ok(told) => {
                self.watcher.warn(&told);
                Continue(())
            }
            Err(error) => {
                self.failure = Some(error);
                Break(())
            }
        }
    }

    /// Breaks when there is nobody to be waited for.
    fn interrupted(&mut self) -> ControlFlow<()> {
        self.stop = self.stop.interrupted(self.plan.deadlines.learner_stop);
        if self.learner.is_dead() {
            return Break(());
        }
        if self.stop == Stop::AtOnce {
            self.learner.kill();
            self.crew.order(Order::Kill);
        } else {
            self.watcher.warn(
                "stopping in order: finishing the updates of this epoch; Ctrl-C again stops at once, without saving",
            );
            self.learner.order(Order::Terminate);
        }
        Continue(())
    }

    /// When the learner will have done nothing for too long.
    fn deadline(&self) -> Option<Instant> {
        self.stop
            .deadline()
            .into_iter()
            .chain(self.learner.deadline())
            .min()
    }

    /// Kills a learner that has done nothing for too long. Its end will say what follows.
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
                "the learner has not reported for {secs} s: it is killed"
            ));
        } else {
            self.watcher.warn("the learner does not stop: it is killed");
            self.stop = Stop::AtOnce;
            self.failure.get_or_insert_with(|| {
                self.learner
                    .failed("did not stop when it was told to".to_owned())
            });
        }
        self.learner.kill();
    }

    /// Tells what there is to tell of the actors, and stops the run when none is left.
    fn look_after_crew(&mut self) {
        while let Some(warning) = self.crew.next_warning() {
            self.watcher.warn(&warning);
        }
        if self.stop == Stop::NotYet
            && self.learner.is_reporting()
            && !self.crew.is_alive()
            && let Some(reason) = self.crew.last_failure()
        {
            self.failure = Some(SupervisorError::NoActors(reason.to_string()));
            self.stop = self.stop.interrupted(self.plan.deadlines.learner_stop);
            self.learner.order(Order::Terminate);
        }
    }
}
