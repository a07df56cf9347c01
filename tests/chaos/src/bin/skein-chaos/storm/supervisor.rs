//! Supervisor of a disturbed run. A normal end is distinguished from a death, and the run is
//! resumed after a death.

use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;
use skein_chaos::Role;

use super::{Storm, await_death, pid};
use crate::plan::Reach;

/// Time for which processes of a killed run may prevent its resumption: an orphaned learner
/// finishes its epoch and saves.
const RESUME: Duration = Duration::from_secs(120);
/// Time between two attempts to resume.
const RESUME_PAUSE: Duration = Duration::from_millis(500);
/// Exit status of an interrupted process, as shells report it: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// State of the run's supervisor.
#[derive(Debug)]
pub(super) enum Supervisor {
    /// Its process was started by this program.
    Running {
        child: Child,
        stop_request: StopRequest,
    },
    /// It was killed, and the run is to be resumed.
    Killed {
        resume_at: Instant,
        give_up_at: Instant,
        actors: u32,
    },
    /// It was restarted, but orphans of its predecessor may still be ending.
    Resuming {
        child: Child,
        give_up_at: Instant,
        actors: u32,
    },
    /// The run has ended.
    Ended,
}

/// Request that this program sent to a supervisor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StopRequest {
    None,
    Sent,
}

impl Storm<'_> {
    pub(super) fn kill_supervisor(
        &mut self,
        reach: Reach,
        pause_secs: f64,
        actors: u32,
    ) -> Result<Vec<i32>> {
        let Supervisor::Running { child, .. } = &mut self.supervisor else {
            return Ok(Vec::new());
        };
        let mut victims = vec![child.id().cast_signed()];
        child.kill().context("cannot kill the supervisor")?;
        child.wait().context("cannot wait for the supervisor")?;
        if reach == Reach::Everybody {
            let others = self.stage.processes();
            others
                .iter()
                .for_each(|process| process.signal(Signal::KILL));
            await_death(&others);
            victims.extend(others.iter().map(pid));
        }
        let now = Instant::now();
        self.supervisor = Supervisor::Killed {
            resume_at: now + Duration::from_secs_f64(pause_secs),
            give_up_at: now + RESUME,
            actors,
        };
        Ok(victims)
    }

    /// Ends the run in order.
    ///
    /// # Errors
    /// Returns an error if no supervisor is running.
    pub(crate) fn interrupt(&mut self) -> Result<()> {
        let Supervisor::Running {
            child,
            stop_request,
        } = &mut self.supervisor
        else {
            bail!("no supervisor is running that could be stopped");
        };
        *stop_request = StopRequest::Sent;
        let pid = Pid::from_raw(child.id().cast_signed()).context("a process has an id")?;
        kill_process(pid, Signal::INT).context("cannot interrupt the supervisor")?;
        self.note("interrupted", &())
    }

    pub(super) fn watch_supervisor(&mut self) -> Result<()> {
        self.supervisor = match std::mem::replace(&mut self.supervisor, Supervisor::Ended) {
            Supervisor::Ended => Supervisor::Ended,
            Supervisor::Running {
                mut child,
                stop_request,
            } => match child.try_wait()? {
                None => Supervisor::Running {
                    child,
                    stop_request,
                },
                Some(status) => {
                    self.ended(status, stop_request)?;
                    Supervisor::Ended
                }
            },
            Supervisor::Killed {
                resume_at,
                give_up_at,
                actors,
            } => {
                if Instant::now() < resume_at {
                    Supervisor::Killed {
                        resume_at,
                        give_up_at,
                        actors,
                    }
                } else {
                    let child = self.stage.resume(actors)?;
                    Supervisor::Resuming {
                        child,
                        give_up_at,
                        actors,
                    }
                }
            }
            Supervisor::Resuming {
                child,
                give_up_at,
                actors,
            } => self.watch_resumption(child, give_up_at, actors)?,
        };
        Ok(())
    }

    fn watch_resumption(
        &mut self,
        mut child: Child,
        give_up_at: Instant,
        actors: u32,
    ) -> Result<Supervisor> {
        let Some(status) = child.try_wait()? else {
            // It starts actors once its learner has reported. From then on nothing of the previous
            // incarnation blocks it.
            let accepted = self.stage.processes().iter().any(|process| {
                process.role() == Role::Actor && process.parent() == Some(child.id())
            });
            return Ok(if accepted {
                self.note("resumed", &json!({ "pid": child.id(), "actors": actors }))?;
                Supervisor::Running {
                    child,
                    stop_request: StopRequest::None,
                }
            } else {
                Supervisor::Resuming {
                    child,
                    give_up_at,
                    actors,
                }
            });
        };
        if status.success() || self.stage.is_complete() {
            self.note("ended", &json!({ "status": status.to_string() }))?;
            return Ok(Supervisor::Ended);
        }
        let log = self.stage.last_words();
        let log = log.lines().last().unwrap_or_default();
        if Instant::now() > give_up_at {
            bail!("the run cannot be resumed: {log}");
        }
        self.note("not resumed yet", &json!({ "log": log }))?;
        Ok(Supervisor::Killed {
            resume_at: Instant::now() + RESUME_PAUSE,
            give_up_at,
            actors,
        })
    }

    fn ended(&mut self, status: ExitStatus, stop_request: StopRequest) -> Result<()> {
        self.note("ended", &json!({ "status": status.to_string() }))?;
        match (status.code(), stop_request) {
            (Some(0), _) | (Some(INTERRUPTED), StopRequest::Sent) => Ok(()),
            _ => bail!(
                "the run ended with {status} after {} episodes; the log ends with\n{}",
                self.episodes,
                self.stage.last_words()
            ),
        }
    }
}
