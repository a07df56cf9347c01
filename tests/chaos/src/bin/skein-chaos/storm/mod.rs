//! A run that is disturbed while it goes on.
//!
//! What is done to it is a [`Script`]'s business. Here is what every script needs: the hand that
//! kills, freezes and attaches, and the eye on supervisor, crews and episodes, so that what happens
//! by itself is told from what was done.

mod supervisor;

use std::collections::BTreeMap;
use std::process::Child;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rustix::process::Signal;
use serde_json::json;
use skein_chaos::{Process, Role};

use supervisor::{Supervisor, Told};

use crate::plan::{Disturbance, Manner, Reach};
use crate::recorder::Recorder;
use crate::stage::{EpisodeCount, LOOK, Stage, wait};

/// Without a new episode for so long, a run is stuck: the longest pause of a sound one is its
/// evaluation.
const STUCK: Duration = Duration::from_secs(300);
/// How long a killed process may take to be gone: the kernel gives its memory back first.
const DEATH: Duration = Duration::from_secs(2);
/// How long those that attached actors may outlive the run.
const CREW_GRACE: Duration = Duration::from_secs(40);

/// What is done to a run.
pub(crate) trait Script {
    /// Called every few milliseconds while the run is under way.
    ///
    /// # Errors
    /// Whatever makes it pointless to go on.
    fn step(&mut self, storm: &mut Storm<'_>) -> Result<()>;
}

/// Nothing is done.
#[derive(Debug)]
pub(crate) struct Calm;

impl Script for Calm {
    fn step(&mut self, _: &mut Storm<'_>) -> Result<()> {
        Ok(())
    }
}

/// How an attempt to disturb ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Attempt {
    /// It is done.
    Done,
    /// Nobody was there to do it to.
    NobodyThere,
}

/// A run under way, and what was done to it.
#[derive(Debug)]
pub(crate) struct Storm<'a> {
    stage: &'a Stage,
    supervisor: Supervisor,
    crews: Vec<Child>,
    frozen: Vec<(Process, Instant)>,
    count: EpisodeCount,
    episodes: u64,
    highest: u64,
    moved: Instant,
    spared: Spared,
    recorder: Recorder,
    tally: BTreeMap<&'static str, u32>,
}

/// Who is never a victim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Spared {
    /// Nobody is safe.
    Nobody,
    /// The actor that was started first.
    ElderActor,
}

impl<'a> Storm<'a> {
    /// Over the run that `supervisor` has just been started for.
    pub(crate) fn new(
        stage: &'a Stage,
        supervisor: Child,
        recorder: Recorder,
        spared: Spared,
    ) -> Self {
        Self {
            stage,
            supervisor: Supervisor::Running {
                child: supervisor,
                told_to_stop: Told::Nothing,
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

    /// Lets `script` disturb the run until it ends. Nobody is left frozen.
    ///
    /// # Errors
    /// When the run fails or gets stuck, or the script gives up; the run is killed then.
    pub(crate) fn rage(&mut self, script: &mut impl Script) -> Result<()> {
        let outcome = self.rage_on(script);
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

    fn rage_on(&mut self, script: &mut impl Script) -> Result<()> {
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
                    "nothing was learned from for {} s, after {} episodes; the last that was said:\n{}",
                    STUCK.as_secs(),
                    self.episodes,
                    self.stage.last_words()
                );
            }
            script.step(self)?;
            sleep(LOOK);
        }
    }

    /// Does `what`, if there is somebody to do it to.
    ///
    /// # Errors
    /// When a program cannot be started or the recording not be written.
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

    /// The process of `role` that `choice` means, of those that live and are not frozen.
    fn choose(&self, role: Role, choice: u32) -> Option<Process> {
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

    fn detach(&mut self, choice: u32, manner: Manner) -> Vec<i32> {
        let signal = match manner {
            Manner::Interrupt => Signal::INT,
            Manner::Kill => Signal::KILL,
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

    /// Learned from at present.
    pub(crate) fn episodes(&self) -> u64 {
        self.episodes
    }

    /// Learned from at any time.
    pub(crate) fn highest(&self) -> u64 {
        self.highest
    }

    /// Since the number of episodes has changed.
    pub(crate) fn since_moved(&self) -> Duration {
        self.moved.elapsed()
    }

    /// Crews that were attached and have not ended.
    pub(crate) fn crews(&self) -> usize {
        self.crews.len()
    }

    /// The run's processes, oldest first.
    pub(crate) fn processes(&self) -> Vec<Process> {
        self.stage.processes()
    }

    /// Waits for those that attached actors, until `deadline`.
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

    /// How often each thing was done.
    pub(crate) fn tally(&self) -> &BTreeMap<&'static str, u32> {
        &self.tally
    }

    /// Writes `event` into the recording.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(crate) fn note(&mut self, event: &str, details: &impl serde::Serialize) -> Result<()> {
        self.recorder
            .note(self.episodes, event, details)
            .context("cannot write the recording")
    }
}

/// Who is woken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Thaw {
    /// Those whose time has come.
    Due,
    /// Everybody.
    All,
}

/// Waits until those that were killed are dead, so that nobody is killed twice; not for ever,
/// because the kernel may have them in its hands.
fn await_death(victims: &[Process]) {
    let end = Instant::now() + DEATH;
    while victims.iter().any(Process::is_alive) && Instant::now() < end {
        sleep(Duration::from_millis(1));
    }
}

fn pid(process: &Process) -> i32 {
    process.pid.as_raw_nonzero().get()
}

/// What a disturbance is called in the table.
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
        Disturbance::Attach { .. } => "crews attached",
        Disturbance::Detach { .. } => "crews taken away",
    }
}
