//! Starts, watches, restarts, stops and reaps the processes of a run.
//!
//! The learner starts first; the actors start once it has reported for the first time. An error
//! that keeps the learner from starting is therefore printed once, and no actor waits for a learner
//! that does not come. A process that dies is restarted: a learner resumes from its newest
//! checkpoint, and the actors stay alive and find it again by themselves. A process that is alive
//! but silent is killed first.
//!
//! The order of a stop matters. The learner is stopped first, because it abandons the episodes
//! under way, saves its state and notifies the actors itself; only actors that still run afterwards
//! are ended from here. Every wait has a deadline, so a stop always completes. Every way out of
//! this module leaves no process behind.
//!
//! The caller decides who may interrupt and where progress is shown: see [`Watcher`].

mod attached;
mod crew;
mod dismissal;
mod error;
mod learner;
mod memory;
mod process;
mod restarts;
mod stop;
mod supervision;
#[cfg(test)]
mod tests;
mod work;

use std::path::PathBuf;
use std::time::Duration;

use skein_protocol::config::Config;
use skein_protocol::ids::ActorId;
use skein_protocol::progress::ProgressReport;
use skein_run::RunDirectory;

use process::Exit;

pub use attached::attach;
pub use error::SupervisorError;
pub use supervision::run;

/// Capacity of the event queue; a child that prints more waits.
const EVENTS: usize = 64;

/// Programs of a run.
#[derive(Debug, Clone)]
pub struct Programs {
    /// Takes `--run DIR`; writes [`ProgressReport`] as JSON lines on its standard output.
    pub learner: PathBuf,
    /// Takes `--run DIR --id K`.
    pub actor: PathBuf,
}

impl Programs {
    /// Returns the programs that lie beside the running program.
    ///
    /// # Errors
    /// [`SupervisorError::Missing`] names the missing file.
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

/// A run to supervise.
#[derive(Debug, Clone)]
pub struct SupervisionPlan {
    /// Run directory: it exists, and its path is absolute.
    pub run: RunDirectory,
    /// Programs to start.
    pub programs: Programs,
    /// Actors to start; their ids are claimed.
    pub actors: Vec<ActorId>,
    /// Threads for the learner's tensor operations.
    pub learner_threads: usize,
    /// Limits of all waits.
    pub deadlines: Deadlines,
}

/// Limits of the supervisor's waits.
#[derive(Debug, Clone)]
pub struct Deadlines {
    /// From the learner's start to its first report. It loads its libraries and a checkpoint
    /// meanwhile.
    pub learner_start: Duration,
    /// Between two reports of the learner. A dedicated thread reports twice a second, so a learner
    /// that is silent for longer is frozen.
    pub learner_silence: Duration,
    /// Pause before the restart of a learner that has died twice without progress. The first
    /// restart is immediate; later pauses double, up to eight times this one.
    pub learner_pause: Duration,
    /// Time without progress that a stopping learner is allowed. Finishing its work shows as
    /// progress; saving does not.
    pub learner_stop: Duration,
    /// Time for which the learner may not have heard of an actor whose process is alive.
    pub actor_silence: Duration,
}

impl Deadlines {
    /// Returns the limits for a run with `config`.
    pub fn of(config: &Config) -> Self {
        Self {
            // An overloaded machine may need this long, and killing a slow learner does not help.
            learner_start: Duration::from_secs(120),
            // Actors leave after transport.learner_silence_secs. The rest of that time is left for
            // the next incarnation to start.
            learner_silence: Duration::from_secs_f64(
                (config.transport.learner_silence_secs * 2.0 / 3.0).clamp(5.0, 60.0),
            ),
            // Pauses reach eight seconds at most, well below the time that actors wait.
            learner_pause: Duration::from_secs(1),
            learner_stop: Duration::from_secs(90),
            // Six times the silence after which the learner reissues tickets, and enough time to
            // start.
            actor_silence: Duration::from_secs_f64(
                (config.transport.actor_silence_secs * 6.0).max(30.0),
            ),
        }
    }
}

/// End of a supervision without failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The run completed.
    Finished,
    /// The user stopped it.
    Interrupted,
}

/// Number of process restarts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Restarts {
    /// Restarts of the learner.
    pub learner: u64,
    /// Restarts of all actors together.
    pub actors: u64,
}

/// Observer of a supervised run.
pub trait Watcher {
    /// Handles a report of the learner.
    fn progress(&mut self, progress: &ProgressReport, restarts: Restarts);
    /// Handles a warning for the user.
    fn warn(&mut self, text: &str);
}

/// SupervisorEvent that a supervisor handles.
#[derive(Debug)]
enum SupervisorEvent {
    /// The learner printed a line.
    LearnerSaid(String),
    /// The learner ended.
    LearnerExited(Exit),
    /// The pause before the learner's restart is over.
    LearnerDue,
    /// The actor with this number ended.
    ActorExited(usize, Exit),
    /// The pause before this actor's restart is over.
    ActorDue(usize),
}
