//! A run that is disturbed while it proceeds.
//!
//! A [`Script`] decides on the disturbances. This module carries them out (it kills, freezes and
//! attaches) and watches supervisor, attached actors and episodes, to distinguish events that
//! happen by themselves from disturbances.

mod supervisor;

use std::collections::BTreeMap;
use std::process::Child;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::Signal;
use serde_json::json;
use skein_chaos::{ListedProcess, Role};

use supervisor::{StopRequest, Supervisor};

use crate::plan::{DetachSignal, Disturbance, Reach};
use crate::recorder::Recorder;
use crate::stage::{EpisodeCount, LOOK, TestedRun, wait};

/// Time without a new episode after which a run is stuck. The longest pause of a sound run is its
/// evaluation.
const STUCK: Duration = Duration::from_secs(300);
/// Time for a killed process to disappear: the kernel frees its memory first.
const DEATH: Duration = Duration::from_secs(2);
/// Time for which `skein attach` processes may outlive the run.
const CREW_GRACE: Duration = Duration::from_secs(40);

/// Source of disturbances.
pub(crate) trait Script {
    /// Called every few milliseconds while the run is under way.
    ///
    /// # Errors
    /// Returns any error that makes continuing pointless.
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()>;
}

/// Script without disturbances.
#[derive(Debug)]
pub(crate) struct Calm;

impl Script for Calm {
    fn step(&mut self, _: &mut Storm<'_>) -> Result<()> {
        Ok(())
    }
}

/// Result of an attempt to disturb.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Attempt {
    /// The disturbance was carried out.
    Done,
    /// No suitable process existed.
    NobodyThere,
}

/// A run under way, with a record of its disturbances.
#[derive(Debug)]
pub(crate) struct Storm<'a> {
    stage: &'a TestedRun,
    supervisor: Supervisor,
    crews: Vec<Child>,
    frozen: Vec<(ListedProcess, Instant)>,
    count: EpisodeCount,
    episodes: u64,
    highest: u64,
    moved: Instant,
    spared: Spared,
    recorder: Recorder,
    tally: BTreeMap<&'static str, u32>,
}

/// Processes that are never disturbed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Spared {
    /// None.
    Nobody,
    /// The actor that was started first.
    ElderActor,
}

impl<'a> Storm<'a> {
    /// Creates the storm over the run of the newly started `supervisor`.
    pub(crate) fn new(
        stage: &'a TestedRun,
        supervisor: Child,
        recorder: Recorder,
        spared: Spared,
    ) -> Self {
        Self {
            stage,
            supervisor: Supervisor::Running {
                child: supervisor,
                stop_request: StopRequest::None,
            },
            crews: Vec::new(),
            frozen: Vec::new(),
            count: EpisodeCount::of(&stage.run),
            episodes: 0,
            highest: 0,
            moved: Instant::now(),
            spared,
            recorder,
            tally: BTreeMap::new(),
        }
    }

    /// Lets `script` disturb the run until it ends. No process is left frozen.
    ///
    /// # Errors
    /// Returns an error if the run fails or is stuck, or the script gives up. The run is killed
    /// then.
    pub(crate) fn run(&mut self, script: &mut impl Script) -> Result<()> {
        let outcome = self.run_script(script);
        self.thaw(Thaw::All);
        if let Err(error) = &outcome {
            let processes: Vec<_> = self
                .stage
                .processes()
                .iter()
                .map(|process| process.command.join(" "))
                .collect();
            self.note(
                "failed",
                &json!({ "error": format!("{error:#}"), "processes": processes }),
            )?;
            self.stage.clear();
        }
        self.reap_crews(Instant::now() + CREW_GRACE)?;
        outcome
    }

    fn run_script(&mut self, script: &mut impl Script) -> Result<()> {
        loop {
            self.thaw(Thaw::Due);
            self.watch_episodes();
            self.reap_crews(Instant::now())?;
            self.watch_supervisor()?;
            if matches!(self.supervisor, Supervisor::Ended) {
                return Ok(());
            }
            if self.moved.elapsed() > STUCK {
                bail!(
                    "no episode was learned from for {} s, after {} episodes; the log ends with\n\
                     {}",
                    STUCK.as_secs(),
                    self.episodes,
                    self.stage.last_words()
                );
            }
            script.step(self)?;
            sleep(LOOK);
        }
    }

    /// Carries out `what`, if a suitable process exists.
    ///
    /// # Errors
    /// Returns an error if a program cannot be started or the recording cannot be written.
    pub(crate) fn disturb(&mut self, what: Disturbance) -> Result<Attempt> {
        let victims = match what {
            Disturbance::KillActor { choice } => self.strike(Role::Actor, choice, Signal::KILL),
            Disturbance::FreezeActor { choice, secs } => self.freeze(Role::Actor, choice, secs),
            Disturbance::KillLearner => self.strike(Role::Learner, 0, Signal::KILL),
            Disturbance::FreezeLearner { secs } => self.freeze(Role::Learner, 0, secs),
            Disturbance::KillSupervisor {
                reach,
                pause_secs,
                actors,
            } => self.kill_supervisor(reach, pause_secs, actors)?,
            Disturbance::Attach { count } => self.attach(count)?,
            Disturbance::Detach { choice, manner } => self.detach(choice, manner),
        };
        if victims.is_empty() {
            return Ok(Attempt::NobodyThere);
        }
        self.note(
            "disturbed",
            &json!({ "disturbance": what, "pids": victims }),
        )?;
        *self.tally.entry(name(&what)).or_default() += 1;
        Ok(Attempt::Done)
    }

    /// Returns the process of `role` selected by `choice` among those alive and not frozen.
    fn choose(&self, role: Role, choice: u32) -> Option<ListedProcess> {
        let spared = usize::from(self.spared == Spared::ElderActor && role == Role::Actor);
        let candidates: Vec<_> = self
            .stage
            .processes()
            .into_iter()
            .filter(|process| process.role() == role)
            .skip(spared)
            .filter(|process| self.frozen.iter().all(|(frozen, _)| frozen != process))
            .collect();
        candidates
            .get(choice as usize % candidates.len().max(1))
            .cloned()
    }

    fn strike(&self, role: Role, choice: u32, signal: Signal) -> Vec<i32> {
        let victim = self.choose(role, choice);
        victim.iter().for_each(|process| process.signal(signal));
        if signal == Signal::KILL {
            await_death(victim.as_slice());
        }
        victim.iter().map(pid).collect()
    }

    fn freeze(&mut self, role: Role, choice: u32, secs: f64) -> Vec<i32> {
        let Some(victim) = self.choose(role, choice) else {
            return Vec::new();
        };
        victim.signal(Signal::STOP);
        let victims = vec![pid(&victim)];
        self.frozen
            .push((victim, Instant::now() + Duration::from_secs_f64(secs)));
        victims
    }

    fn thaw(&mut self, which: Thaw) {
        let now = Instant::now();
        self.frozen.retain(|(process, until)| {
            let frozen = which == Thaw::Due && now < *until;
            if !frozen {
                process.signal(Signal::CONT);
            }
            frozen
        });
    }

    fn attach(&mut self, count: u32) -> Result<Vec<i32>> {
        if !matches!(self.supervisor, Supervisor::Running { .. })
            || self.choose(Role::Learner, 0).is_none()
        {
            return Ok(Vec::new());
        }
        let crew = self.stage.attach(count)?;
        let pids = vec![crew.id().cast_signed()];
        self.crews.push(crew);
        Ok(pids)
    }

    fn detach(&mut self, choice: u32, manner: DetachSignal) -> Vec<i32> {
        let signal = match manner {
            DetachSignal::Interrupt => Signal::INT,
            DetachSignal::Kill => Signal::KILL,
        };
        self.strike(Role::Crew, choice, signal)
    }

    fn watch_episodes(&mut self) {
        let episodes = self.count.now();
        if episodes != self.episodes {
            self.episodes = episodes;
            self.highest = self.highest.max(episodes);
            self.moved = Instant::now();
        }
    }

    /// Returns the present number of episodes learned from.
    pub(crate) fn episodes(&self) -> u64 {
        self.episodes
    }

    /// Returns the highest number of episodes learned from so far.
    pub(crate) fn highest(&self) -> u64 {
        self.highest
    }

    /// Returns the time since the number of episodes last changed.
    pub(crate) fn since_moved(&self) -> Duration {
        self.moved.elapsed()
    }

    /// Returns the number of `skein attach` processes still running.
    pub(crate) fn crews(&self) -> usize {
        self.crews.len()
    }

    /// Returns the run's processes, oldest first.
    pub(crate) fn processes(&self) -> Vec<ListedProcess> {
        self.stage.processes()
    }

    /// Waits for the `skein attach` processes until `deadline`.
    fn reap_crews(&mut self, deadline: Instant) -> Result<()> {
        let mut ended = Vec::new();
        let mut there = Vec::new();
        for mut crew in std::mem::take(&mut self.crews) {
            match wait(&mut crew, deadline)? {
                Some(status) => ended.push((crew.id(), status.to_string())),
                None => there.push(crew),
            }
        }
        self.crews = there;
        for (pid, status) in ended {
            self.note("crew ended", &json!({ "pid": pid, "status": status }))?;
        }
        Ok(())
    }

    /// Returns the number of disturbances of each kind.
    pub(crate) fn tally(&self) -> &BTreeMap<&'static str, u32> {
        &self.tally
    }

    /// Writes `event` into the recording.
    ///
    /// # Errors
    /// Returns an error if it cannot be written.
    pub(crate) fn note(&mut self, event: &str, details: &impl serde::Serialize) -> Result<()> {
        self.recorder
            .note(self.episodes, event, details)
            .context("cannot write the recording")
    }
}

/// Processes to continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Thaw {
    /// Processes whose freeze is over.
    Due,
    /// All frozen processes.
    All,
}

/// Waits until the killed processes are dead, so that none is killed twice. The wait is limited,
/// because the kernel may delay their end.
fn await_death(victims: &[ListedProcess]) {
    let end = Instant::now() + DEATH;
    while victims.iter().any(ListedProcess::is_alive) && Instant::now() < end {
        sleep(Duration::from_millis(1));
    }
}

fn pid(process: &ListedProcess) -> i32 {
    process.pid.as_raw_nonzero().get()
}

/// Returns the name of a disturbance in the table.
fn name(what: &Disturbance) -> &'static str {
    match what {
        Disturbance::KillActor { .. } => "actors killed",
        Disturbance::FreezeActor { .. } => "actors frozen",
        Disturbance::KillLearner => "learners killed",
        Disturbance::FreezeLearner { .. } => "learners frozen",
        Disturbance::KillSupervisor {
            reach: Reach::Alone,
            ..
        } => "supervisors killed",
        Disturbance::KillSupervisor {
            reach: Reach::Everybody,
            ..
        } => "power cuts",
        Disturbance::Attach { .. } => "groups of actors attached",
        Disturbance::Detach { .. } => "groups of actors removed",
    }
}
