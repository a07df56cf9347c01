//! Starts, watches, restarts, stops and reaps the processes of a run.
//!
//! The learner comes first, and the actors once it has reported for the first time: what keeps it
//! from starting is then told once, and nobody waits for a learner that will not come. Whoever dies
//! is started again; a learner goes on from its newest checkpoint, and the actors, who stay alive,
//! find it by themselves. Whoever is alive but gives no sign of it is killed first.
//!
//! The order of a stop matters: the learner is told first, because it abandons the episodes in the
//! air, saves what was learned and tells the actors itself; only actors that are still there
//! afterwards are ended from here. Every wait has a deadline, so that a stop always comes to an
//! end, and every way out of this module leaves no process behind.
//!
//! Who may interrupt, and what is done with the progress, is the caller's: see [`Watcher`].

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

/// Events that wait at most; a child that says more waits itself.
const EVENTS: usize = 64;

/// The programs that a run consists of.
#[derive(Debug, Clone)]
pub struct Programs {
    /// Takes `--run DIR`; writes [`ProgressReport`] as JSON lines on its standard output.
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
    /// How long is waited for what.
    pub deadlines: Deadlines,
}

/// How long is waited for what.
#[derive(Debug, Clone)]
pub struct Deadlines {
    /// From the learner's start to its first report: it loads its libraries and a checkpoint.
    pub learner_start: Duration,
    /// Between two reports of the learner, of which it makes two a second from a thread that does
    /// nothing else. A learner that is silent for longer is frozen.
    pub learner_silence: Duration,
    /// Before a learner is started again that has died twice without getting any further. It is
    /// started at once the first time; later pauses double, up to eight times this one.
    pub learner_pause: Duration,
    /// How long the learner may show no progress once it is told to stop: it finishes what it is
    /// about, which shows, and saves, which does not.
    pub learner_stop: Duration,
    /// How long the learner may have heard nothing of an actor whose process is alive.
    pub actor_silence: Duration,
}

impl Deadlines {
    /// Those for a run with `config`.
    pub fn of(config: &Config) -> Self {
        Self {
            // An overburdened machine may take so long; and killing what only is slow helps nobody.
            learner_start: Duration::from_secs(120),
            // Actors wait for transport.learner_silence_secs and then leave: the rest of that time
            // is for the next incarnation to begin in.
            learner_silence: Duration::from_secs_f64(
                (config.transport.learner_silence_secs * 2.0 / 3.0).clamp(5.0, 60.0),
            ),
            // Eight seconds at the most, well below what actors wait.
            learner_pause: Duration::from_secs(1),
            learner_stop: Duration::from_secs(90),
            // Six times what makes the learner give its tickets to others, and enough to start in.
            actor_silence: Duration::from_secs_f64(
                (config.transport.actor_silence_secs * 6.0).max(30.0),
            ),
        }
    }
}

/// How supervision ended, when nothing failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// The run came to its end.
    Finished,
    /// The user stopped it.
    Interrupted,
}

/// How often processes were started again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Restarts {
    /// The learner.
    pub learner: u64,
    /// Actors, all together.
    pub actors: u64,
}

/// Who looks on while a run is supervised.
pub trait Watcher {
    /// The learner reported.
    fn progress(&mut self, progress: &ProgressReport, restarts: Restarts);
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
    /// The pause of the learner is over.
    LearnerDue,
    /// The actor of this number ended.
    ActorExited(usize, Exit),
    /// The pause of the actor of this number is over.
    ActorDue(usize),
}
