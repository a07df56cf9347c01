//! The learner of a run, through all its incarnations.

use std::time::Duration;

use skein_protocol::progress::ProgressReport;
use skein_run::failure::EXIT_RESTART;
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::ChildStdout;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep, timeout};

use super::memory::want_of_memory;
use super::process::{Exit, Launch, Order, Output, reap};
use super::restarts::{Cause, LearnerDeaths, Verdict};
use super::work::Work;
use super::{Event, Plan, SupervisorError};
use skein_prepare::room::free_shared_memory;
use skein_run::log_tail::{last_words, log_tail};

/// Last words come before the end; a pipe that somebody else holds open must not delay that for
/// ever.
const LAST_WORDS: Duration = Duration::from_secs(1);

/// The learner of a run.
pub(super) struct Learner<'a> {
    plan: &'a Plan,
    events: mpsc::Sender<Event>,
    state: State,
    deaths: LearnerDeaths,
    restarts: u64,
}

enum State {
    /// A process is alive and has not reported yet.
    Starting {
        orders: watch::Sender<Order>,
        since: Instant,
    },
    /// It reports.
    Reporting {
        orders: watch::Sender<Order>,
        heard: Instant,
        work: Work,
    },
    /// It is as good as dead.
    Killed,
    /// There is none.
    Dead,
}

/// What a report shows beyond its figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum News {
    /// The learner is up: it is this incarnation's first report.
    Up,
    /// More has been done since the last one.
    GetsOn,
    /// Nothing.
    Nothing,
}

impl<'a> Learner<'a> {
    /// Starts the learner of `plan`. What it says and its end will come as [`Event`]s.
    ///
    /// # Errors
    /// [`SupervisorError::Start`].
    pub(super) fn start(
        plan: &'a Plan,
        events: mpsc::Sender<Event>,
    ) -> Result<Self, SupervisorError> {
        let mut learner = Self {
            plan,
            events,
            state: State::Dead,
            deaths: LearnerDeaths::new(plan.deadlines.learner_pause),
            restarts: 0,
        };
        learner.launch()?;
        Ok(learner)
    }

    /// Starts it again. A start that fails counts as a death.
    pub(super) fn start_again(&mut self) {
        self.restarts += 1;
        if let Err(error) = self.launch() {
            let events = self.events.clone();
            let exit = Exit::Unknown(error.to_string());
            tokio::spawn(async move { events.send(Event::LearnerExited(exit)).await });
        }
    }

    fn launch(&mut self) -> Result<(), SupervisorError> {
        let launch = Launch {
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
        let (orders, receiver) = watch::channel(Order::Run);
        let events = self.events.clone();
        tokio::spawn(async move {
            let exit = reap(child, receiver).await;
            if let Some(mut said) = said {
                let _ = timeout(LAST_WORDS, &mut said).await;
                // Nothing of this incarnation may be taken for a word of the next.
                said.abort();
            }
            let _ = events.send(Event::LearnerExited(exit)).await;
        });
        self.state = State::Starting {
            orders,
            since: Instant::now(),
        };
        Ok(())
    }

    /// Takes note of a report.
    pub(super) fn reported(&mut self, progress: &ProgressReport) -> News {
        let (heard, done) = (Instant::now(), Work::of(progress));
        self.deaths.reached(done);
        match std::mem::replace(&mut self.state, State::Dead) {
            State::Starting { orders, .. } => {
                self.state = State::Reporting {
                    orders,
                    heard,
                    work: done,
                };
                News::Up
            }
            State::Reporting { orders, work, .. } => {
                self.state = State::Reporting {
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
            state @ (State::Killed | State::Dead) => {
                self.state = state;
                News::Nothing
            }
        }
    }

    /// When it will have been silent for too long.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let deadlines = &self.plan.deadlines;
        match self.state {
            State::Starting { since, .. } => Some(since + deadlines.learner_start),
            State::Reporting { heard, .. } => Some(heard + deadlines.learner_silence),
            State::Killed | State::Dead => None,
        }
    }

    /// Lets its silence begin now: it was the supervisor that did not listen.
    pub(super) fn forgive_silence(&mut self) {
        let now = Instant::now();
        match &mut self.state {
            State::Starting { since, .. } => *since = now,
            State::Reporting { heard, .. } => *heard = now,
            State::Killed | State::Dead => {}
        }
    }

    /// Tells it something, if it is there.
    pub(super) fn order(&mut self, order: Order) {
        if let State::Starting { orders, .. } | State::Reporting { orders, .. } = &self.state {
            orders.send_replace(order);
        }
    }

    /// Kills it.
    pub(super) fn kill(&mut self) {
        self.order(Order::Kill);
        if !self.is_dead() {
            self.state = State::Killed;
        }
    }

    /// Whether there is no process.
    pub(super) fn is_dead(&self) -> bool {
        matches!(self.state, State::Dead)
    }

    /// Whether a process is there and has reported.
    pub(super) fn is_reporting(&self) -> bool {
        matches!(self.state, State::Reporting { .. })
    }

    /// How often it was started again.
    pub(super) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Takes note of its end, and has it started again if that may help: [`Event::LearnerDue`] will
    /// say when. Returns what the user is told.
    ///
    /// # Errors
    /// Why it is not started again.
    pub(super) fn exited(&mut self, exit: &Exit) -> Result<String, SupervisorError> {
        let state = std::mem::replace(&mut self.state, State::Dead);
        if !exit.may_pass() {
            return Err(
                match last_words(&self.plan.run.learner_log(), &self.plan.programs.learner) {
                    Some(words) if matches!(state, State::Starting { .. }) => {
                        SupervisorError::LearnerCannotStart(words)
                    }
                    _ => self.failed(exit.to_string()),
                },
            );
        }
        // The supervisor kills only what no longer moves: that counts as a failure.
        let want = want_of_memory(exit, free_shared_memory());
        let cause = if want.is_some() || exit.is_a_kill() && !matches!(state, State::Killed) {
            Cause::Outside
        } else {
            Cause::Failure
        };
        match self.deaths.died(cause) {
            Verdict::GiveUp => Err(self.failed(format!(
                "died {} times without getting any further, the last time it {exit}",
                LearnerDeaths::MAX_WITHOUT_PROGRESS
            ))),
            Verdict::RestartAfter(pause) => {
                let events = self.events.clone();
                tokio::spawn(async move {
                    sleep(pause).await;
                    let _ = events.send(Event::LearnerDue).await;
                });
                let when = match pause {
                    Duration::ZERO => "at once".to_owned(),
                    pause => format!("in {} s", pause.as_secs()),
                };
                Ok(format!(
                    "the learner {exit}{}{}; it is started again {when}, {}",
                    self.reason_given(exit),
                    want.unwrap_or_default(),
                    self.whence()
                ))
            }
        }
    }

    /// What a learner that asks for another incarnation says about it.
    fn reason_given(&self, exit: &Exit) -> String {
        (*exit == Exit::Status(EXIT_RESTART.into()))
            .then(|| last_words(&self.plan.run.learner_log(), &self.plan.programs.learner))
            .flatten()
            .map_or(String::new(), |words| format!(" (\"{words}\")"))
    }

    /// What its next incarnation begins from.
    fn whence(&self) -> &'static str {
        match self.plan.run.newest_checkpoint() {
            Some(_) => "from its newest checkpoint",
            None => "from the beginning: there is no checkpoint yet",
        }
    }

    /// That it ended, of which `how` tells.
    pub(super) fn failed(&self, how: String) -> SupervisorError {
        let log = self.plan.run.learner_log();
        SupervisorError::LearnerFailed {
            how,
            tail: log_tail(&log),
            log,
        }
    }
}

async fn listen(mut lines: Lines<BufReader<ChildStdout>>, events: mpsc::Sender<Event>) {
    while let Ok(Some(line)) = lines.next_line().await {
        if events.send(Event::LearnerSaid(line)).await.is_err() {
            return;
        }
    }
}
