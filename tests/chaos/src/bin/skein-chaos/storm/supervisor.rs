//! The supervisor of a run under fire: its end is told from its death, and after its death the run
//! is resumed.

use std::process::{Child, ExitStatus};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;
use skein_chaos::Role;

use super::{Storm, await_death, pid};
use crate::plan::Reach;

/// How long a killed run's processes may keep it from being resumed: a learner that was orphaned
/// ends its epoch and saves.
const RESUME: Duration = Duration::from_secs(120);
/// Between two attempts to resume.
const RESUME_PAUSE: Duration = Duration::from_millis(500);
/// Status of a process that was interrupted, as shells report it: 128 + SIGINT.
const INTERRUPTED: i32 = 130;

/// Who supervises the run.
#[derive(Debug)]
pub(super) enum Supervisor {
    /// A process of ours.
    Running { child: Child, told_to_stop: Told },
    /// Nobody, until it is resumed.
    Killed {
        resume_at: Instant,
        give_up_at: Instant,
        actors: u32,
    },
    /// Was started again, and may find that the orphans of the one before are still ending.
    Resuming {
        child: Child,
        give_up_at: Instant,
        actors: u32,
    },
    /// Nobody any more: the run has ended.
    Ended,
}

/// Whether a supervisor was interrupted from here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Told {
    Nothing,
    ToStop,
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
    /// When the supervisor is not there to be told.
    pub(crate) fn interrupt(&mut self) -> Result<()> {
        let Supervisor::Running {
            child,
            told_to_stop,
        } = &mut self.supervisor
        else {
            bail!("there is no supervisor to be told to stop");
        };
        *told_to_stop = Told::ToStop;
        let pid = Pid::from_raw(child.id().cast_signed()).context("a process has a number")?;
        kill_process(pid, Signal::INT).context("cannot interrupt the supervisor")?;
        self.note("interrupted", &())
    }

    pub(super) fn watch_supervisor(&mut self) -> Result<()> {
        self.supervisor = match std::mem::replace(&mut self.supervisor, Supervisor::Ended) {
            Supervisor::Ended => Supervisor::Ended,
            Supervisor::Running {
                mut child,
                told_to_stop,
            } => match child.try_wait()? {
                None => Supervisor::Running {
                    child,
                    told_to_stop,
                },
                Some(status) => {
                    self.ended(status, told_to_stop)?;
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
            // It starts actors once its learner has reported: then nothing of the former
            // incarnation is in its way any more.
            let accepted = self.stage.processes().iter().any(|process| {
                process.role() == Role::Actor && process.parent() == Some(child.id())
            });
            return Ok(if accepted {
                self.note("resumed", &json!({ "pid": child.id(), "actors": actors }))?;
                Supervisor::Running {
                    child,
                    told_to_stop: Told::Nothing,
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
        let said = self.stage.last_words();
        let said = said.lines().last().unwrap_or_default();
        if Instant::now() > give_up_at {
            bail!("the run cannot be resumed: {said}");
        }
        self.note("not resumed yet", &json!({ "said": said }))?;
        Ok(Supervisor::Killed {
            resume_at: Instant::now() + RESUME_PAUSE,
            give_up_at,
            actors,
        })
    }

    fn ended(&mut self, status: ExitStatus, told: Told) -> Result<()> {
        self.note("ended", &json!({ "status": status.to_string() }))?;
        match (status.code(), told) {
            (Some(0), _) | (Some(INTERRUPTED), Told::ToStop) => Ok(()),
            _ => bail!(
                "the run ended with {status} after {} episodes; the last that was said:\n{}",
                self.episodes,
                self.stage.last_words()
            ),
        }
    }
}
