//! Actors of one supervisor: starts, watches, restarts and ends them.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::path::Path;
use std::time::Duration;

use skein_protocol::ids::ActorId;
use skein_run::RunDirectory;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep};

use super::memory::{MemoryShortage, MemoryWatch};
use super::process::{Exit, Output, ProcessLaunch, ProcessOrder, reap};
use super::restarts::{ActorDeaths, IncarnationUse, RestartDecision};
use super::work::WorkDone;
use super::{SupervisorError, SupervisorEvent};
use skein_run::log_tail::log_tail;

/// An incarnation that lasted this long started successfully, even if no reports prove it.
const GOOD_START: Duration = Duration::from_secs(10);

/// The actors of one supervisor.
pub(super) struct Crew<'a> {
    run: &'a RunDirectory,
    program: &'a Path,
    events: mpsc::Sender<SupervisorEvent>,
    members: Vec<Member>,
    /// Work done by the run as last reported; `None` while no learner reports, or if this
    /// supervisor does not listen to it.
    work: Option<WorkDone>,
    after_death: AfterDeath,
    last_failure: Option<GivenUp>,
    restarts: u64,
    /// Warnings for the user, oldest first.
    warnings: VecDeque<String>,
    memory: MemoryWatch,
}

/// One actor, across all its incarnations.
struct Member {
    id: ActorId,
    state: MemberState,
    deaths: ActorDeaths,
    standing: ActorStanding,
    /// Work done by the run when the present incarnation began.
    work_before: Option<WorkDone>,
}

enum MemberState {
    /// A process is alive.
    Flying(ActorProcess),
    /// Died; restarts after a pause.
    Resting,
    /// Was dismissed, found no learner, or failed too often; restarts when a learner reports for
    /// the first time.
    Stranded,
    /// Not started, or ended.
    Gone,
}

struct ActorProcess {
    orders: watch::Sender<ProcessOrder>,
    started: Instant,
    /// Time when the learner last counted it among its actors; initially its start.
    heard_of: Instant,
}

/// Evidence that an actor works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ActorStanding {
    /// No incarnation of it has done useful work yet.
    Unknown,
    /// At least one incarnation of it has worked.
    Proven,
}

/// Reason why an actor is not restarted for now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum GivenUp {
    /// It found no learner, and another incarnation would not find one either.
    LearnerGone,
    /// It failed too often.
    KeepsDying(String),
}

impl fmt::Display for GivenUp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::LearnerGone => f.write_str("the last one found no learner"),
            Self::KeepsDying(how) => f.write_str(how),
        }
    }
}

/// Treatment of actors that fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AfterDeath {
    /// They restart, within limits.
    Restart,
    /// They stay dead: the run is over.
    LetGo,
}

impl<'a> Crew<'a> {
    /// Creates a crew of `actors`, all still to be started. Their ends arrive as
    /// [`SupervisorEvent`]s, numbered as in `actors`.
    pub(super) fn new(
        run: &'a RunDirectory,
        program: &'a Path,
        actors: &[ActorId],
        events: mpsc::Sender<SupervisorEvent>,
        memory: MemoryWatch,
    ) -> Self {
        let member = |&id| Member {
            id,
            state: MemberState::Stranded,
            deaths: ActorDeaths::default(),
            standing: ActorStanding::Unknown,
            work_before: None,
        };
        Self {
            run,
            program,
            events,
            members: actors.iter().map(member).collect(),
            work: None,
            after_death: AfterDeath::Restart,
            last_failure: None,
            restarts: 0,
            warnings: VecDeque::new(),
            memory,
        }
    }

    /// Starts a process for each actor that waits for a learner: at first all, later those that
    /// left or were given up.
    ///
    /// # Errors
    /// Returns an error if one cannot be started; the others are killed.
    pub(super) fn start(&mut self) -> Result<(), SupervisorError> {
        if self.after_death == AfterDeath::LetGo {
            return Ok(());
        }
        for number in 0..self.members.len() {
            if !matches!(self.members[number].state, MemberState::Stranded) {
                continue;
            }
            self.members[number].deaths = ActorDeaths::default();
            if let Err(source) = self.start_member(number) {
                self.order(ProcessOrder::Kill);
                return Err(SupervisorError::Start {
                    program: self.program.to_owned(),
                    source,
                });
            }
        }
        self.last_failure = None;
        Ok(())
    }

    fn start_member(&mut self, number: usize) -> io::Result<()> {
        let member = &mut self.members[number];
        let launch = ProcessLaunch {
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
        };
        let child = launch.start()?;
        let (orders, receiver) = watch::channel(ProcessOrder::Run);
        let now = Instant::now();
        member.state = MemberState::Flying(ActorProcess {
            orders,
            started: now,
            heard_of: now,
        });
        member.work_before = self.work;
        let events = self.events.clone();
        tokio::spawn(async move {
            let exit = reap(child, receiver).await;
            // Sending fails only when the supervisor itself has ended.
            let _ = events
                .send(SupervisorEvent::ActorExited(number, exit))
                .await;
        });
        Ok(())
    }

    /// Records a report of the learner: the run has done `work`, and `live` are its actors. An
    /// actor whose process is alive but of which the learner has not heard for `patience` is
    /// frozen; it is killed and then restarted like any that died.
    pub(super) fn reported(&mut self, work: WorkDone, live: &[u32], patience: Duration) {
        let now = Instant::now();
        let is_first = self.work.replace(work).is_none();
        for member in &mut self.members {
            let MemberState::Flying(process) = &mut member.state else {
                continue;
            };
            // A learner that has just started has had no time to hear of any actor.
            if live.contains(&member.id.0) {
                process.heard_of = now;
                member.standing = ActorStanding::Proven;
            } else if is_first {
                process.heard_of = now;
            } else if now.duration_since(process.heard_of) > patience {
                // Restarts the wait, so that the kill is repeated only if it has no effect.
                process.heard_of = now;
                process.orders.send_replace(ProcessOrder::Kill);
                self.warnings.push_back(format!(
                    "the learner has not heard of actor {} for {} s although its process is \
                     alive: killing it",
                    member.id,
                    patience.as_secs()
                ));
            }
        }
    }

    /// Records that the learner is dead. Until the next one reports, failures of an actor do not
    /// count against it.
    pub(super) fn learner_died(&mut self) {
        self.work = None;
    }

    /// Records that an actor ended. One that failed restarts after a pause, unless it fails too
    /// often or the run is over.
    pub(super) fn exited(&mut self, number: usize, exit: &Exit) {
        let (work, learner_reports) = (self.work, self.work.is_some());
        let member = &mut self.members[number];
        let (age, last_order) = match std::mem::replace(&mut member.state, MemberState::Gone) {
            MemberState::Flying(process) => (process.started.elapsed(), *process.orders.borrow()),
            MemberState::Resting | MemberState::Stranded | MemberState::Gone => {
                (Duration::ZERO, ProcessOrder::Run)
            }
        };
        if self.after_death == AfterDeath::LetGo {
            return;
        }
        if *exit == Exit::SUCCESS {
            // The learner announced the end of the run. If it dies before that end, its next
            // incarnation needs actors again.
            member.state = MemberState::Stranded;
            return;
        }
        if exit.found_no_learner() && !learner_reports {
            member.state = MemberState::Stranded;
            self.last_failure = Some(GivenUp::LearnerGone);
            self.warnings
                .push_back(format!("actor {} found no learner and left", member.id));
            return;
        }
        if age >= GOOD_START {
            member.standing = ActorStanding::Proven;
        }
        let shortage = self.memory.shortage(exit);
        let is_excused = match &shortage {
            Some(MemoryShortage::Shared(_)) => true,
            // The next incarnation needs as much memory.
            Some(MemoryShortage::Own(_)) => false,
            None => exit.was_killed() && last_order == ProcessOrder::Run,
        };
        let incarnation = match member.judge(work) {
            // A signal excuses the actor unless the supervisor sent it: it kills only frozen
            // processes.
            IncarnationUse::Useless if is_excused => IncarnationUse::Interrupted,
            incarnation => incarnation,
        };
        let how = format!(
            "{exit}{}",
            shortage.as_ref().map_or("", MemoryShortage::text)
        );
        match member.deaths.died(Instant::now(), incarnation) {
            RestartDecision::RestartAfter(pause) => self.rest(number, &how, pause),
            RestartDecision::GiveUp => self.give_up(number, &how),
        }
    }

    /// Schedules the restart of a member after `pause`.
    fn rest(&mut self, number: usize, how: &str, pause: Duration) {
        let member = &mut self.members[number];
        member.state = MemberState::Resting;
        self.warnings.push_back(format!(
            "actor {} {how}; restarting it in {} s (log: {})",
            member.id,
            pause.as_secs_f64(),
            self.run.actor_log(member.id).display()
        ));
        let events = self.events.clone();
        tokio::spawn(async move {
            sleep(pause).await;
            let _ = events.send(SupervisorEvent::ActorDue(number)).await;
        });
    }

    fn give_up(&mut self, number: usize, how: &str) {
        let member = &mut self.members[number];
        member.state = MemberState::Stranded;
        let log = self.run.actor_log(member.id);
        let failure = format!(
            "gave up on actor {}: it died {} times without doing useful work, the last time it \
             {how}; its log {} ends with\n{}",
            member.id,
            ActorDeaths::MAX_USELESS,
            log.display(),
            log_tail(&log)
        );
        self.last_failure = Some(GivenUp::KeepsDying(failure.clone()));
        self.warnings.push_back(failure);
    }

    /// Restarts an actor whose pause is over.
    pub(super) fn restart(&mut self, number: usize) {
        if !matches!(self.members[number].state, MemberState::Resting) {
            return;
        }
        self.restarts += 1;
        if let Err(error) = self.start_member(number) {
            self.exited(
                number,
                &Exit::Unknown(format!("could not be started: {error}")),
            );
        }
    }

    /// Sends `order` to all actors. None is restarted afterwards.
    pub(super) fn order(&mut self, order: ProcessOrder) {
        self.let_go();
        for member in &self.members {
            if let MemberState::Flying(process) = &member.state {
                process.orders.send_replace(order);
            }
        }
    }

    /// Stops restarting actors.
    pub(super) fn let_go(&mut self) {
        self.after_death = AfterDeath::LetGo;
        for member in &mut self.members {
            if !matches!(member.state, MemberState::Flying(_)) {
                member.state = MemberState::Gone;
            }
        }
    }

    /// Returns `true` while some actor's process is alive or waits for its restart.
    pub(super) fn is_alive(&self) -> bool {
        self.members
            .iter()
            .any(|member| matches!(member.state, MemberState::Flying(_) | MemberState::Resting))
    }

    /// Returns the reason of the last actor that was given up; `None` if none was.
    pub(super) fn last_failure(&self) -> Option<&GivenUp> {
        self.last_failure.as_ref()
    }

    /// Number of restarts of actors.
    pub(super) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Returns the next warning for the user.
    pub(super) fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front()
    }
}

impl Member {
    /// Judges an incarnation of this member that ended when the run had done `work`.
    fn judge(&self, work: Option<WorkDone>) -> IncarnationUse {
        match (work, self.standing) {
            (None, ActorStanding::Proven) => IncarnationUse::Interrupted,
            (Some(_), ActorStanding::Proven) if self.work_before != work => IncarnationUse::Served,
            _ => IncarnationUse::Useless,
        }
    }
}
