//! The actors of one supervisor: started, restarted when they die, told to end.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::path::Path;
use std::time::Instant;

use skein_protocol::ids::ActorId;
use skein_protocol::run::RunDirectory;
use tokio::sync::{mpsc, watch};
use tokio::time::sleep;

use super::log_tail::log_tail;
use super::process::{Exit, Launch, Order, Orphaned, Output, reap};
use super::restarts::{MAX_DEATHS, Restarts, Verdict, WINDOW};
use super::{Event, SupervisorError};

/// The actors of one supervisor.
pub(super) struct Crew<'a> {
    run: &'a RunDirectory,
    program: &'a Path,
    orders: watch::Sender<Order>,
    events: mpsc::Sender<Event>,
    members: Vec<Member>,
    after_death: AfterDeath,
    last_failure: Option<GivenUp>,
    /// What the user should be told, oldest first.
    warnings: VecDeque<String>,
}

/// One actor.
struct Member {
    id: ActorId,
    state: State,
    restarts: Restarts,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// A process is alive.
    Flying,
    /// Died; will be started again.
    Resting,
    /// Not started, ended, or given up.
    Gone,
}

/// Why an actor is not started again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum GivenUp {
    /// It found no learner: another life would find none either.
    LearnerGone,
    /// It died too often.
    KeepsDying(String),
}

impl fmt::Display for GivenUp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::LearnerGone => f.write_str("the last heard nothing of the learner"),
            Self::KeepsDying(how) => f.write_str(how),
        }
    }
}

/// What becomes of an actor that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AfterDeath {
    /// It is started again, within limits.
    Restart,
    /// Nothing: the run is over.
    LetGo,
}

impl<'a> Crew<'a> {
    /// A crew of `actors`, none of them started yet. Their ends will come as [`Event`]s, numbered as in `actors`.
    pub(super) fn new(
        run: &'a RunDirectory,
        program: &'a Path,
        actors: &[ActorId],
        events: mpsc::Sender<Event>,
    ) -> Self {
        let (orders, _) = watch::channel(Order::Run);
        let member = |&id| Member {
            id,
            state: State::Gone,
            restarts: Restarts::default(),
        };
        Self {
            run,
            program,
            orders,
            events,
            members: actors.iter().map(member).collect(),
            after_death: AfterDeath::Restart,
            last_failure: None,
            warnings: VecDeque::new(),
        }
    }

    /// Starts a process for each actor.
    ///
    /// # Errors
    /// When one cannot be started; those started before it are told to end at once.
    pub(super) fn start(&mut self) -> Result<(), SupervisorError> {
        for number in 0..self.members.len() {
            if let Err(source) = self.start_member(number) {
                self.order(Order::Kill);
                return Err(SupervisorError::Start {
                    program: self.program.to_owned(),
                    source,
                });
            }
        }
        Ok(())
    }

    fn start_member(&mut self, number: usize) -> io::Result<()> {
        let member = &mut self.members[number];
        let launch = Launch {
            program: self.program,
            arguments: vec![
                "--run".into(),
                self.run.root().into(),
                "--id".into(),
                member.id.to_string().into(),
            ],
            threads: 1,
            log: self.run.actor_log(member.id),
            output: Output::Logged,
            orphaned: Orphaned::Kill,
        };
        let child = launch.start()?;
        member.state = State::Flying;
        let (orders, events) = (self.orders.subscribe(), self.events.clone());
        tokio::spawn(async move {
            let exit = reap(child, orders).await;
            // Nobody listens only when the supervisor itself has ended.
            let _ = events.send(Event::ActorExited(number, exit)).await;
        });
        Ok(())
    }

    /// Takes note that an actor ended. One that failed will be started again after a pause, unless it fails too often or the run is over.
    pub(super) fn exited(&mut self, number: usize, exit: &Exit) {
        let member = &mut self.members[number];
        member.state = State::Gone;
        if self.after_death == AfterDeath::LetGo || *exit == Exit::Success {
            return;
        }
        if *exit == Exit::LearnerGone {
            self.last_failure = Some(GivenUp::LearnerGone);
            self.warnings
                .push_back(format!("actor {} heard nothing of the learner and left", member.id));
            return;
        }
        let log = self.run.actor_log(member.id);
        match member.restarts.died(Instant::now()) {
            Verdict::RestartAfter(pause) => {
                member.state = State::Resting;
                let pause_secs = pause.as_secs_f64();
                self.warnings.push_back(format!(
                    "actor {} ended with {exit}; it is started again in {pause_secs} s ({})",
                    member.id,
                    log.display()
                ));
                let events = self.events.clone();
                tokio::spawn(async move {
                    sleep(pause).await;
                    let _ = events.send(Event::RestartDue(number)).await;
                });
            }
            Verdict::GiveUp => {
                let failure = format!(
                    "actor {} died {MAX_DEATHS} times within {} s, the last time with {exit}, and is given up; its log {} ends with\n{}",
                    member.id,
                    WINDOW.as_secs(),
                    log.display(),
                    log_tail(&log)
                );
                self.last_failure = Some(GivenUp::KeepsDying(failure.clone()));
                self.warnings.push_back(failure);
            }
        }
    }

    /// Starts an actor again whose pause is over.
    pub(super) fn restart(&mut self, number: usize) {
        if self.members[number].state != State::Resting {
            return;
        }
        if let Err(error) = self.start_member(number) {
            self.exited(number, &Exit::Failure(format!("a failed start: {error}")));
        }
    }

    /// Tells all actors to end. None is started again.
    pub(super) fn order(&mut self, order: Order) {
        self.let_go();
        self.orders.send_replace(order);
    }

    /// Starts none again from now on.
    pub(super) fn let_go(&mut self) {
        self.after_death = AfterDeath::LetGo;
        for member in self.members.iter_mut().filter(|member| member.state == State::Resting) {
            member.state = State::Gone;
        }
    }

    /// Whether a process is alive or will be again.
    pub(super) fn is_alive(&self) -> bool {
        self.members.iter().any(|member| member.state != State::Gone)
    }

    /// Why the last actor that was given up was; `None` if none was.
    pub(super) fn last_failure(&self) -> Option<&GivenUp> {
        self.last_failure.as_ref()
    }

    /// The next thing to tell the user.
    pub(super) fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front()
    }
}
