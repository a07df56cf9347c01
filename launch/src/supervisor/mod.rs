//! Starts, watches, stops and reaps the processes of a run.
//!
//! The learner comes first, and the actors once it has reported for the first time: what keeps it from starting is then told once, and nobody waits for
//! a learner that will not come.
//!
//! The order of a stop matters: the learner is told first, because it abandons the flights in the air, saves what was learned and tells the actors
//! itself; only actors that are still there afterwards are ended from here. Every wait has a deadline, so that a stop always comes to an end, and
//! every way out of this module leaves no process behind.
//!
//! Who may interrupt, and what is done with the progress, is the caller's: see [`Watcher`].

mod crew;
mod log_tail;
mod process;
mod restarts;
mod stop;
#[cfg(test)]
mod tests;

use std::io;
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use skein_protocol::ids::ActorId;
use skein_protocol::progress::Progress;
use skein_protocol::run::RunDirectory;
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::ChildStdout;
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep_until, timeout};

use crew::{Crew, GivenUp};
use log_tail::{last_words, log_tail};
use process::{Exit, Launch, Order, Orphaned, Output, reap};
use stop::{Stop, Work};

/// How long the learner may show no progress once it is told to stop: it finishes the updates of its epoch, which show, and saves, which does not.
pub const LEARNER_GRACE: Duration = Duration::from_secs(90);
/// How long actors may take to follow the learner's word that the run is over.
const ACTOR_GRACE: Duration = Duration::from_secs(5);
/// How long actors may take to follow SIGTERM.
const TERMINATE_GRACE: Duration = Duration::from_secs(5);
/// Events that wait at most; a child that says more waits itself.
const EVENTS: usize = 64;

/// The programs that a run consists of.
#[derive(Debug, Clone)]
pub struct Programs {
    /// Takes `--run DIR`; writes [`Progress`] as JSON lines on its standard output.
    pub learner: PathBuf,
    /// Takes `--run DIR --id K`.
    pub actor: PathBuf,
}

impl Programs {
    /// Those that lie beside the running program.
    ///
    /// # Errors
    /// [`SupervisorError::Missing`] names what is not there.
    pub fn beside_this() -> Result<Self, SupervisorError> {
        let this = std::env::current_exe().map_err(SupervisorError::Setup)?;
        let beside = |name: &str| {
            let path = this.with_file_name(name);
            if path.is_file() {
                Ok(path)
            } else {
                Err(SupervisorError::Missing(path))
            }
        };
        Ok(Self {
            learner: beside("skein-learner")?,
            actor: beside("skein-actor")?,
        })
    }
}

/// A run to be supervised.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Its directory, created; an absolute path.
    pub run: RunDirectory,
    /// What is started.
    pub programs: Programs,
    /// The actors to start, their ids claimed.
    pub actors: Vec<ActorId>,
    /// Threads of the learner's tensor operations.
    pub learner_threads: usize,
    /// [`LEARNER_GRACE`].
    pub learner_grace: Duration,
}

/// How supervision ended, when nothing failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The run came to its end.
    Finished,
    /// The user stopped it.
    Interrupted,
}

/// Why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum SupervisorError {
    /// A program is not where it should be.
    #[error("{} is missing: build it with `cargo build --release --workspace --bins`", .0.display())]
    Missing(PathBuf),
    /// The supervisor's own needs cannot be met.
    #[error("cannot start: {0}")]
    Setup(#[source] io::Error),
    /// A program cannot be started.
    #[error("cannot start {}: {source}", program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The learner ended before it had reported once.
    #[error("the learner cannot start: {0}")]
    LearnerCannotStart(String),
    /// The learner ended where it should not have.
    #[error("the learner ended with {exit}; its log {} ends with\n{tail}", log.display())]
    LearnerFailed {
        /// How it ended.
        exit: String,
        /// Its log file.
        log: PathBuf,
        /// The log's last lines.
        tail: String,
    },
    /// The learner of a run that actors were added to is no more.
    #[error("the learner of {} is gone", .0.display())]
    LearnerGone(PathBuf),
    /// No actor is left.
    #[error("no actor is left: {0}")]
    NoActors(String),
}

/// Who looks on while a run is supervised.
pub trait Watcher {
    /// The learner reported.
    fn progress(&mut self, progress: &Progress);
    /// Something the user should know.
    fn warn(&mut self, text: &str);
}

/// What happens to a supervisor.
#[derive(Debug)]
enum Event {
    /// The learner printed a line.
    LearnerSaid(String),
    /// The learner ended.
    LearnerExited(Exit),
    /// The actor of this number ended.
    ActorExited(usize, Exit),
    /// The pause of the actor of this number is over.
    RestartDue(usize),
}

/// Supervises a learner and its actors until the run ends. Each message on `interrupts` is one interruption by the user: the first stops in order,
/// the second at once.
///
/// # Errors
/// [`SupervisorError`] names the program, its log and the log's last lines. No process is left in any case.
pub async fn run(
    plan: &Plan,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let learner = start_learner(plan, events.clone())?;
    let mut crew = Crew::new(&plan.run, &plan.programs.actor, &plan.actors, events);

    // While the learner is there.
    let mut work: Option<Work> = None;
    let mut stop = Stop::NotYet;
    let mut failure = None;
    let exit = loop {
        let deadline = stop.deadline();
        tokio::select! {
            Some(event) = inbox.recv() => match event {
                Event::LearnerSaid(line) => {
                    let Some(progress) = heed(&line, watcher) else { continue };
                    let done = Work::of(&progress);
                    if work.is_none() && stop == Stop::NotYet && let Err(error) = crew.start() {
                        failure = Some(error);
                        stop = Stop::AtOnce;
                        learner.send_replace(Order::Kill);
                    }
                    if work.replace(done) != Some(done) {
                        stop = stop.progressed(plan.learner_grace);
                    }
                }
                Event::LearnerExited(exit) => break exit,
                Event::ActorExited(number, exit) => crew.exited(number, &exit),
                Event::RestartDue(number) => crew.restart(number),
            },
            Some(()) = interrupts.recv() => {
                stop = stop.interrupted(plan.learner_grace);
                match stop {
                    Stop::AtOnce => { learner.send_replace(Order::Kill); crew.order(Order::Kill); }
                    _ => {
                        watcher.warn("stopping in order: finishing the updates of this epoch; Ctrl-C again stops at once, without saving");
                        learner.send_replace(Order::Terminate);
                    }
                }
            }
            () = sleep_until(deadline.unwrap_or_else(Instant::now)), if deadline.is_some() => {
                watcher.warn("the learner does not stop: it is killed");
                stop = Stop::AtOnce;
                failure = Some(learner_failed(plan, "no answer to the request to stop".to_owned()));
                learner.send_replace(Order::Kill);
            }
        }
        while let Some(warning) = crew.next_warning() {
            watcher.warn(&warning);
        }
        if stop == Stop::NotYet
            && !crew.is_alive()
            && let Some(reason) = crew.last_failure()
        {
            failure = Some(SupervisorError::NoActors(reason.to_string()));
            stop = Stop::InOrder {
                deadline: Instant::now() + plan.learner_grace,
            };
            learner.send_replace(Order::Terminate);
        }
    };

    // The learner is gone, and so should be the actors.
    if exit != Exit::Success && stop != Stop::AtOnce {
        crew.order(Order::Terminate);
        failure.get_or_insert_with(|| match work {
            Some(_) => learner_failed(plan, exit.to_string()),
            None => learner_cannot_start(plan, &exit),
        });
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match failure {
        Some(error) => Err(error),
        None if stop == Stop::NotYet => Ok(Ended::Finished),
        None => Ok(Ended::Interrupted),
    }
}

/// Supervises actors that join a run under way, until they end.
///
/// # Errors
/// As [`run`].
pub async fn attach(
    plan: &Plan,
    interrupts: &mut mpsc::Receiver<()>,
    watcher: &mut impl Watcher,
) -> Result<Ended, SupervisorError> {
    let (events, mut inbox) = mpsc::channel(EVENTS);
    let mut crew = Crew::new(&plan.run, &plan.programs.actor, &plan.actors, events);
    if let Err(error) = crew.start() {
        dismiss(&mut crew, &mut inbox, interrupts).await;
        return Err(error);
    }
    let mut ended = Ended::Finished;
    while crew.is_alive() && ended == Ended::Finished {
        tokio::select! {
            Some(event) = inbox.recv() => match event {
                Event::ActorExited(number, exit) => crew.exited(number, &exit),
                Event::RestartDue(number) => crew.restart(number),
                Event::LearnerSaid(_) | Event::LearnerExited(_) => {}
            },
            Some(()) = interrupts.recv() => {
                crew.order(Order::Terminate);
                ended = Ended::Interrupted;
            }
        }
        while let Some(warning) = crew.next_warning() {
            watcher.warn(&warning);
        }
    }
    dismiss(&mut crew, &mut inbox, interrupts).await;
    match crew.last_failure() {
        Some(reason) if ended == Ended::Finished => Err(match reason {
            GivenUp::LearnerGone => SupervisorError::LearnerGone(plan.run.root().to_owned()),
            GivenUp::KeepsDying(_) => SupervisorError::NoActors(reason.to_string()),
        }),
        _ => Ok(ended),
    }
}

fn start_learner(plan: &Plan, events: mpsc::Sender<Event>) -> Result<watch::Sender<Order>, SupervisorError> {
    let launch = Launch {
        program: &plan.programs.learner,
        arguments: vec!["--run".into(), plan.run.root().into()],
        threads: plan.learner_threads,
        log: plan.run.learner_log(),
        output: Output::Piped,
        orphaned: Orphaned::Terminate,
    };
    let mut child = launch.start().map_err(|source| SupervisorError::Start {
        program: plan.programs.learner.clone(),
        source,
    })?;
    let said = child
        .stdout
        .take()
        .map(|output| tokio::spawn(listen(BufReader::new(output).lines(), events.clone())));
    let (orders, receiver) = watch::channel(Order::Run);
    tokio::spawn(async move {
        let exit = reap(child, receiver).await;
        // Its last words come before its end; a pipe that somebody else holds open must not delay that for ever.
        if let Some(said) = said {
            let _ = timeout(Duration::from_secs(1), said).await;
        }
        let _ = events.send(Event::LearnerExited(exit)).await;
    });
    Ok(orders)
}

async fn listen(mut lines: Lines<BufReader<ChildStdout>>, events: mpsc::Sender<Event>) {
    while let Ok(Some(line)) = lines.next_line().await {
        if events.send(Event::LearnerSaid(line)).await.is_err() {
            return;
        }
    }
}

/// Passes a line of the learner on, and returns it if it is a report. What is none is shown as it is: somebody meant it to be read.
fn heed(line: &str, watcher: &mut impl Watcher) -> Option<Progress> {
    let Ok(progress) = serde_json::from_str(line) else {
        watcher.warn(line);
        return None;
    };
    watcher.progress(&progress);
    Some(progress)
}

/// The learner's own words if it had any, else all that its log shows.
fn learner_cannot_start(plan: &Plan, exit: &Exit) -> SupervisorError {
    match last_words(&plan.run.learner_log(), &plan.programs.learner) {
        Some(words) => SupervisorError::LearnerCannotStart(words),
        None => learner_failed(plan, exit.to_string()),
    }
}

fn learner_failed(plan: &Plan, exit: String) -> SupervisorError {
    let log = plan.run.learner_log();
    SupervisorError::LearnerFailed {
        exit,
        tail: log_tail(&log),
        log,
    }
}

/// Sees to it that no actor is left: those that do not end by themselves are told, those that do not listen are killed. An interruption skips the
/// waiting.
async fn dismiss(crew: &mut Crew<'_>, inbox: &mut mpsc::Receiver<Event>, interrupts: &mut mpsc::Receiver<()>) {
    crew.let_go();
    for (grace, next) in [(ACTOR_GRACE, Order::Terminate), (TERMINATE_GRACE, Order::Kill)] {
        let mut expired = pin!(tokio::time::sleep(grace));
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
