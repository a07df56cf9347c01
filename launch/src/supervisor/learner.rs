//! Learner of a run, across all its incarnations.

use std::time::Duration;

use skein_protocol::progress::ProgressReport;
use skein_run::failure::EXIT_RESTART;
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::ChildStdout;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep, timeout};

use super::memory::{MemoryShortage, MemoryWatch};
use super::process::{Exit, Output, ProcessLaunch, ProcessOrder, reap};
use super::restarts::{DeathCause, LearnerDeaths, RestartDecision};
use super::work::WorkDone;
use super::{SupervisionPlan, SupervisorError, SupervisorEvent};
use skein_run::log_tail::{last_words, log_tail};

/// Time to wait for the last output of a learner that ended. Another process may hold its pipe
/// open, which must not block forever.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// Learner of a run.
pub(super) struct LearnerProcess<'a> {
    plan: &'a SupervisionPlan,
    events: mpsc::Sender<SupervisorEvent>,
    state: LearnerState,
    deaths: LearnerDeaths,
    restarts: u64,
    memory: MemoryWatch,
}

enum LearnerState {
    /// A process is alive and has not reported yet.
    Starting {
        orders: watch::Sender<ProcessOrder>,
        since: Instant,
    },
    /// It has reported.
    Reporting {
        orders: watch::Sender<ProcessOrder>,
        heard: Instant,
        work: WorkDone,
    },
    /// It was killed, and its end has not arrived yet.
    Killed,
    /// No process exists.
    Dead,
}

/// Change that a report shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum News {
    /// The first report of this incarnation: the learner is up.
    Up,
    /// More work is done than in the last report.
    GetsOn,
    /// No change.
    Nothing,
}

impl<'a> LearnerProcess<'a> {
    /// Starts the learner of `plan`. Its output and its end arrive as [`SupervisorEvent`]s.
    ///
    /// # Errors
    /// [`SupervisorError::Start`].
    pub(super) fn start(
        plan: &'a SupervisionPlan,
        events: mpsc::Sender<SupervisorEvent>,
        memory: MemoryWatch,
    ) -> Result<Self, SupervisorError> {
        let mut learner = Self {
            plan,
            events,
            state: LearnerState::Dead,
            deaths: LearnerDeaths::new(plan.deadlines.learner_pause),
            restarts: 0,
            memory,
        };
        learner.launch()?;
        Ok(learner)
    }

    /// Restarts it. A failed start counts as a death.
    pub(super) fn start_again(&mut self) {
        self.restarts += 1;
        if let Err(error) = self.launch() {
            let events = self.events.clone();
            let exit = Exit::Unknown(error.to_string());
            tokio::spawn(async move { events.send(SupervisorEvent::LearnerExited(exit)).await });
        }
    }

    fn launch(&mut self) -> Result<(), SupervisorError> {
        let launch = ProcessLaunch {
            program: &self.plan.programs.learner,
            arguments: vec!["--run".into(), self.plan.run.root().into()],
            threads: self.plan.learner_threads,
            log: self.plan.run.learner_log(),
            output: Output::Piped,
        };
        let mut child = launch.start().map_err(|source| SupervisorError::Start {
            program: self.plan.programs.learner.clone(),
            source,
        })?;
        let said = child.stdout.take().map(|output| {
            tokio::spawn(listen(BufReader::new(output).lines(), self.events.clone()))
        });
        let (orders, receiver) = watch::channel(ProcessOrder::Run);
        let events = self.events.clone();
        tokio::spawn(async move {
            let exit = reap(child, receiver).await;
            if let Some(mut said) = said {
                let _ = timeout(LAST_WORDS, &mut said).await;
                // Output of this incarnation must not be attributed to the next.
                said.abort();
            }
            let _ = events.send(SupervisorEvent::LearnerExited(exit)).await;
        });
        self.state = LearnerState::Starting {
            orders,
            since: Instant::now(),
        };
        Ok(())
    }

    /// Records a report.
    pub(super) fn reported(&mut self, progress: &ProgressReport) -> News {
        let (heard, done) = (Instant::now(), WorkDone::of(progress));
        self.deaths.reached(done);
        match std::mem::replace(&mut self.state, LearnerState::Dead) {
            LearnerState::Starting { orders, .. } => {
                self.state = LearnerState::Reporting {
                    orders,
                    heard,
                    work: done,
                };
                News::Up
            }
            LearnerState::Reporting { orders, work, .. } => {
                self.state = LearnerState::Reporting {
                    orders,
                    heard,
                    work: done,
                };
                if done == work {
                    News::Nothing
                } else {
                    News::GetsOn
                }
            }
            state @ (LearnerState::Killed | LearnerState::Dead) => {
                self.state = state;
                News::Nothing
            }
        }
    }

    /// Returns the time at which its silence becomes too long.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let deadlines = &self.plan.deadlines;
        match self.state {
            LearnerState::Starting { since, .. } => Some(since + deadlines.learner_start),
            LearnerState::Reporting { heard, .. } => Some(heard + deadlines.learner_silence),
            LearnerState::Killed | LearnerState::Dead => None,
        }
    }

    /// Restarts the wait for a report: the supervisor itself was held up and did not listen.
    pub(super) fn forgive_silence(&mut self) {
        let now = Instant::now();
        match &mut self.state {
            LearnerState::Starting { since, .. } => *since = now,
            LearnerState::Reporting { heard, .. } => *heard = now,
            LearnerState::Killed | LearnerState::Dead => {}
        }
    }

    /// Sends it `order`, if its process is alive.
    pub(super) fn order(&mut self, order: ProcessOrder) {
        if let LearnerState::Starting { orders, .. } | LearnerState::Reporting { orders, .. } =
            &self.state
        {
            orders.send_replace(order);
        }
    }

    /// Kills it.
    pub(super) fn kill(&mut self) {
        self.order(ProcessOrder::Kill);
        if !self.is_dead() {
            self.state = LearnerState::Killed;
        }
    }

    /// Returns `true` if no process exists.
    pub(super) fn is_dead(&self) -> bool {
        matches!(self.state, LearnerState::Dead)
    }

    /// Returns `true` if its process is alive and has reported.
    pub(super) fn is_reporting(&self) -> bool {
        matches!(self.state, LearnerState::Reporting { .. })
    }

    /// Number of its restarts.
    pub(super) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Records its end. If a restart may help, schedules [`SupervisorEvent::LearnerDue`] and
    /// returns a message for the user.
    ///
    /// # Errors
    /// Returns the reason why it is not restarted.
    pub(super) fn exited(&mut self, exit: &Exit) -> Result<String, SupervisorError> {
        let state = std::mem::replace(&mut self.state, LearnerState::Dead);
        if self.is_directory_gone() {
            return Err(self.failed(exit.to_string()));
        }
        if !exit.may_recover() {
            return Err(
                match last_words(&self.plan.run.learner_log(), &self.plan.programs.learner) {
                    Some(words) if matches!(state, LearnerState::Starting { .. }) => {
                        SupervisorError::LearnerCannotStart(words)
                    }
                    _ => self.failed(exit.to_string()),
                },
            );
        }
        // The supervisor kills only a frozen learner, so that counts as a failure.
        let shortage = self.memory.shortage(exit);
        let killed_from_outside = exit.was_killed() && !matches!(state, LearnerState::Killed);
        let cause = match &shortage {
            // The next incarnation needs as much memory.
            Some(MemoryShortage::Own(_)) => DeathCause::Failure,
            Some(MemoryShortage::Shared(_)) => DeathCause::Outside,
            None if killed_from_outside => DeathCause::Outside,
            None => DeathCause::Failure,
        };
        let shortage = shortage.as_ref().map_or("", MemoryShortage::text);
        match self.deaths.died(cause) {
            RestartDecision::GiveUp => Err(self.failed(format!(
                "died {} times without making progress, the last time it {exit}{shortage}",
                LearnerDeaths::MAX_WITHOUT_PROGRESS
            ))),
            RestartDecision::RestartAfter(pause) => {
                let events = self.events.clone();
                tokio::spawn(async move {
                    sleep(pause).await;
                    let _ = events.send(SupervisorEvent::LearnerDue).await;
                });
                let when = match pause {
                    Duration::ZERO => "now".to_owned(),
                    pause => format!("in {} s", pause.as_secs()),
                };
                Ok(format!(
                    "the learner {exit}{}{shortage}; restarting it {when}, {}",
                    self.reason_given(exit),
                    self.restart_point()
                ))
            }
        }
    }

    /// Returns the reason given by a learner that asks for a restart.
    fn reason_given(&self, exit: &Exit) -> String {
        (*exit == Exit::Status(EXIT_RESTART.into()))
            .then(|| last_words(&self.plan.run.learner_log(), &self.plan.programs.learner))
            .flatten()
            .map_or(String::new(), |words| format!(" (\"{words}\")"))
    }

    /// Returns the point from which its next incarnation continues.
    fn restart_point(&self) -> &'static str {
        match self.plan.run.newest_checkpoint() {
            Some(_) => "from its newest checkpoint",
            None => "from the beginning: there is no checkpoint yet",
        }
    }

    /// Returns `true` if the run's directory was removed or moved. A learner that was about to save
    /// may have created part of it again.
    pub(super) fn is_directory_gone(&self) -> bool {
        !self.plan.run.logs().is_dir()
    }

    /// Returns the error for its end, described by `how`.
    pub(super) fn failed(&self, how: String) -> SupervisorError {
        if self.is_directory_gone() {
            return SupervisorError::DirectoryGone(self.plan.run.root().to_owned());
        }
        let log = self.plan.run.learner_log();
        SupervisorError::LearnerFailed {
            how,
            tail: log_tail(&log),
            log,
        }
    }
}

async fn listen(mut lines: Lines<BufReader<ChildStdout>>, events: mpsc::Sender<SupervisorEvent>) {
    while let Ok(Some(line)) = lines.next_line().await {
        if events
            .send(SupervisorEvent::LearnerSaid(line))
            .await
            .is_err()
        {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use rustix::process::Signal;
    use skein_protocol::config::Config;
    use skein_run::RunDirectory;

    use super::super::{Deadlines, Programs};
    use super::*;

    #[tokio::test]
    async fn a_learner_for_which_memory_ran_out_ten_times_is_given_up() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path());
        fs::create_dir(run.logs()).unwrap();
        let kills = folder.path().join("kills");
        let count = |kills_so_far: u32| {
            fs::write(&kills, format!("oom_kill {kills_so_far}\n")).unwrap();
        };
        count(0);
        let memory = MemoryWatch::on(vec![kills.clone()], Vec::new());
        let plan = SupervisionPlan {
            run,
            programs: Programs {
                learner: Path::new("learner").to_owned(),
                actor: Path::new("actor").to_owned(),
            },
            actors: Vec::new(),
            learner_threads: 1,
            deadlines: Deadlines::of(&Config::default()),
        };
        let (events, _received) = mpsc::channel(1);
        let mut learner = LearnerProcess {
            plan: &plan,
            events,
            state: LearnerState::Dead,
            deaths: LearnerDeaths::new(Duration::ZERO),
            restarts: 0,
            memory,
        };
        let killed = Exit::Signal(Signal::KILL.as_raw());
        // A user's kill is no failure, however often it happens.
        for _ in 0..20 {
            learner.exited(&killed).unwrap();
        }
        for death in 1..LearnerDeaths::MAX_WITHOUT_PROGRESS {
            count(death);
            let said = learner.exited(&killed).unwrap();
            assert!(said.contains("out of memory"), "{said}");
        }
        count(LearnerDeaths::MAX_WITHOUT_PROGRESS);
        let error = learner.exited(&killed).unwrap_err().to_string();
        for part in [
            "died 10 times without making progress",
            "out of memory",
            "--actors",
        ] {
            assert!(error.contains(part), "{part} is missing in {error}");
        }
    }
}
