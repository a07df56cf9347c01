//! The actors of one supervisor: started, watched, restarted when they die, told to end.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::path::Path;
use std::time::Duration;

use skein_protocol::ids::ActorId;
use skein_run::RunDirectory;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep};

use super::memory::want_of_memory;
use super::process::{Exit, Launch, Order, Output, reap};
use super::restarts::{ActorDeaths, LearnerIncarnation, Verdict};
use super::work::Work;
use super::{Event, SupervisorError};
use skein_prepare::room::free_shared_memory;
use skein_run::log_tail::log_tail;

/// An incarnation that lasted so long was a good start, whether or not there are reports that show
/// it.
const GOOD_START: Duration = Duration::from_secs(10);

/// The actors of one supervisor.
pub(super) struct Crew<'a> {
    run: &'a RunDirectory,
    program: &'a Path,
    events: mpsc::Sender<Event>,
    members: Vec<Member>,
    /// What the learner last reported; `None` while there is none that reports, or nobody listens
    /// to it.
    work: Option<Work>,
    after_death: AfterDeath,
    last_failure: Option<GivenUp>,
    restarts: u64,
    /// What the user should be told, oldest first.
    warnings: VecDeque<String>,
}

/// One actor, through all its incarnations.
struct Member {
    id: ActorId,
    state: State,
    deaths: ActorDeaths,
    standing: Standing,
    /// What the run had done when the present incarnation began.
    work_before: Option<Work>,
}

enum State {
    /// A process is alive.
    Flying(Process),
    /// Died; will be started again.
    Resting,
    /// Was sent home, found no learner, or failed too often; will be started again when a learner
    /// reports for the first time.
    Stranded,
    /// Not started, or ended.
    Gone,
}

struct Process {
    orders: watch::Sender<Order>,
    started: Instant,
    /// When the learner last counted it among its actors; its start, before that.
    heard_of: Instant,
}

/// What is known of an actor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Standing {
    /// No incarnation of it has ever served.
    Unknown,
    /// It can do its work: some incarnation of it has.
    Proven,
}

/// Why an actor is not started again for the time being.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum GivenUp {
    /// It found no learner: another incarnation would find none either.
    LearnerGone,
    /// It failed too often.
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
    /// A crew of `actors`, none of them started yet. Their ends will come as [`Event`]s, numbered
    /// as in `actors`.
    pub(super) fn new(
        run: &'a RunDirectory,
        program: &'a Path,
        actors: &[ActorId],
        events: mpsc::Sender<Event>,
    ) -> Self {
        let member = |&id| Member {
            id,
            state: State::Stranded,
            deaths: ActorDeaths::default(),
            standing: Standing::Unknown,
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
        }
    }

    /// Starts a process for each actor that waits for a learner: all of them the first time, later
    /// those that left or were given up.
    ///
    /// # Errors
    /// When one cannot be started; the others are told to end at once.
    pub(super) fn start(&mut self) -> Result<(), SupervisorError> {
        if self.after_death == AfterDeath::LetGo {
            return Ok(());
        }
        for number in 0..self.members.len() {
            if !matches!(self.members[number].state, State::Stranded) {
                continue;
            }
            self.members[number].deaths = ActorDeaths::default();
            if let Err(source) = self.start_member(number) {
                self.order(Order::Kill);
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
        };
        let child = launch.start()?;
        let (orders, receiver) = watch::channel(Order::Run);
        let now = Instant::now();
        member.state = State::Flying(Process {
            orders,
            started: now,
            heard_of: now,
        });
        member.work_before = self.work;
        let events = self.events.clone();
        tokio::spawn(async move {
            let exit = reap(child, receiver).await;
            // Nobody listens only when the supervisor itself has ended.
            let _ = events.send(Event::ActorExited(number, exit)).await;
        });
        Ok(())
    }

    /// Takes note of a report of the learner: it has done `work`, and counts `live` among its
    /// actors. An actor whose process lives but of which the learner has heard nothing for
    /// `patience` is frozen or hangs: it is killed, and then started again as any that died.
    pub(super) fn reported(&mut self, work: Work, live: &[u32], patience: Duration) {
        let now = Instant::now();
        let is_first = self.work.replace(work).is_none();
        for member in &mut self.members {
            let State::Flying(process) = &mut member.state else {
                continue;
            };
            // A learner that has just come has had no time to hear of anybody.
            if live.contains(&member.id.0) {
                process.heard_of = now;
                member.standing = Standing::Proven;
            } else if is_first {
                process.heard_of = now;
            } else if now.duration_since(process.heard_of) > patience {
                // Told again only if even that has no effect.
                process.heard_of = now;
                process.orders.send_replace(Order::Kill);
                self.warnings.push_back(format!(
                    "actor {} is there, but the learner has not heard of it for {} s: it is killed",
                    member.id,
                    patience.as_secs()
                ));
            }
        }
    }

    /// Takes note that the learner is dead: until the next one reports, nothing that happens to an
    /// actor is held against it.
    pub(super) fn learner_died(&mut self) {
        self.work = None;
    }

    /// Takes note that an actor ended. One that failed will be started again after a pause, unless
    /// it fails too often or the run is over.
    pub(super) fn exited(&mut self, number: usize, exit: &Exit) {
        let (work, learner_reports) = (self.work, self.work.is_some());
        let member = &mut self.members[number];
        let (age, told) = match std::mem::replace(&mut member.state, State::Gone) {
            State::Flying(process) => (process.started.elapsed(), *process.orders.borrow()),
            State::Resting | State::Stranded | State::Gone => (Duration::ZERO, Order::Run),
        };
        if self.after_death == AfterDeath::LetGo {
            return;
        }
        if *exit == Exit::SUCCESS {
            // The learner said that the run is over. Should it die before it is, the next one needs
            // actors again.
            member.state = State::Stranded;
            return;
        }
        if exit.is_for_want_of_a_learner() && !learner_reports {
            member.state = State::Stranded;
            self.last_failure = Some(GivenUp::LearnerGone);
            self.warnings.push_back(format!(
                "actor {} heard nothing of the learner and left",
                member.id
            ));
            return;
        }
        if age >= GOOD_START {
            member.standing = Standing::Proven;
        }
        let want = want_of_memory(exit, free_shared_memory());
        let incarnation = match member.judge(work) {
            // Unless it was the supervisor, which kills only what no longer moves.
            LearnerIncarnation::InVain
                if want.is_some() || exit.is_a_kill() && told == Order::Run =>
            {
                LearnerIncarnation::Interrupted
            }
            incarnation => incarnation,
        };
        match member.deaths.died(Instant::now(), incarnation) {
            Verdict::RestartAfter(pause) => self.rest(
                number,
                &format!("{exit}{}", want.unwrap_or_default()),
                pause,
            ),
            Verdict::GiveUp => self.give_up(number, exit),
        }
    }

    /// Has a member started again after `pause`.
    fn rest(&mut self, number: usize, how: &str, pause: Duration) {
        let member = &mut self.members[number];
        member.state = State::Resting;
        self.warnings.push_back(format!(
            "actor {} {how}; it is started again in {} s ({})",
            member.id,
            pause.as_secs_f64(),
            self.run.actor_log(member.id).display()
        ));
        let events = self.events.clone();
        tokio::spawn(async move {
            sleep(pause).await;
            let _ = events.send(Event::ActorDue(number)).await;
        });
    }

    fn give_up(&mut self, number: usize, exit: &Exit) {
        let member = &mut self.members[number];
        member.state = State::Stranded;
        let log = self.run.actor_log(member.id);
        let failure = format!(
            "actor {} died {} times without having been of use, the last time it {exit}, and is given up; its log {} ends with\n{}",
            member.id,
            ActorDeaths::MAX_IN_VAIN,
            log.display(),
            log_tail(&log)
        );
        self.last_failure = Some(GivenUp::KeepsDying(failure.clone()));
        self.warnings.push_back(failure);
    }

    /// Starts an actor again whose pause is over.
    pub(super) fn restart(&mut self, number: usize) {
        if !matches!(self.members[number].state, State::Resting) {
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

    /// Tells all actors to end. None is started again.
    pub(super) fn order(&mut self, order: Order) {
        self.let_go();
        for member in &self.members {
            if let State::Flying(process) = &member.state {
                process.orders.send_replace(order);
            }
        }
    }

    /// Starts none again from now on.
    pub(super) fn let_go(&mut self) {
        self.after_death = AfterDeath::LetGo;
        for member in &mut self.members {
            if !matches!(member.state, State::Flying(_)) {
                member.state = State::Gone;
            }
        }
    }

    /// Whether a process is alive or will be again by itself.
    pub(super) fn is_alive(&self) -> bool {
        self.members
            .iter()
            .any(|member| matches!(member.state, State::Flying(_) | State::Resting))
    }

    /// Why the last actor that was given up was; `None` if none was.
    pub(super) fn last_failure(&self) -> Option<&GivenUp> {
        self.last_failure.as_ref()
    }

    /// How often an actor was started again.
    pub(super) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// The next thing to tell the user.
    pub(super) fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front()
    }
}

impl Member {
    /// What an incarnation of this member was good for that ended when the run had done `work`.
    fn judge(&self, work: Option<Work>) -> LearnerIncarnation {
        match (work, self.standing) {
            (None, Standing::Proven) => LearnerIncarnation::Interrupted,
            (Some(_), Standing::Proven) if self.work_before != work => LearnerIncarnation::Served,
            _ => LearnerIncarnation::InVain,
        }
    }
}
