//! Carries out the runs of an experiment: as many at a time as there are cores, each as a separate
//! `skein run`, exactly as a user would start it. Once a run is trained, its best snapshot flies
//! the experiment's suite in a separate `skein evaluate`.
//!
//! A run that fails is reported, and the others continue. An interruption is forwarded to every
//! active run, which stops in order and can be resumed; no further run starts. An incomplete suite
//! is flown again from its beginning the next time.

use std::collections::VecDeque;
use std::fs::{self, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{self, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use skein_protocol::files::{self, TABLE_BYTES};
use skein_run::RunDirectory;
use skein_run::durable;
use skein_run::failure::EXIT_INTERRUPTED;
use tokio::process::{Child, Command};
use tokio::sync::mpsc;
use tokio::time::sleep;

use super::board::{ExperimentDisplay, ExperimentProgress, RunProgress, RunStage};
use super::definition::{Experiment, FlownSuite};
use super::plan::{ACTORS, ExperimentPlan, PlannedRun, RunState};
use crate::results::{RunResult, of_suite};
use skein_reports::Clock;
use skein_reports::curves::{PlottedEpisode, trailing_mean};
use skein_run::log_tail::log_tail;
use skein_run::orphans::signal_when_orphaned;
use skein_run::signals::heed;

/// Time between two checks of the active runs.
const LOOK: Duration = Duration::from_millis(200);
/// Number of checks between two updates of the display.
const LOOKS_A_UPDATE: u32 = 5;

/// Programs and parallelism for the runs of an experiment.
#[derive(Debug, Clone, Copy)]
pub struct RunnerOptions<'a> {
    /// The program `skein`.
    pub skein: &'a Path,
    /// Number of simultaneous runs.
    pub jobs: usize,
}

/// Outcome of a session.
#[derive(Debug, Default)]
pub struct SessionOutcome {
    /// Names of the runs that failed.
    pub failed: Vec<String>,
    /// Number of interruptions by the user.
    pub interruptions: u32,
}

struct ActiveRun<'a> {
    /// Index in the plan.
    place: usize,
    run: &'a PlannedRun,
    stage: RunStage,
    child: Child,
}

/// Carries out the incomplete runs of `plan`. Each message on `interrupts` is an interruption by
/// the user: the first stops every run in order, the second immediately. If a `skein run` ignores
/// these, the third kills it.
pub async fn run(
    experiment: &Experiment,
    plan: &ExperimentPlan,
    manner: RunnerOptions<'_>,
    interrupts: &mut mpsc::Receiver<()>,
    board: &mut ExperimentDisplay,
) -> SessionOutcome {
    let mut session = SessionOutcome::default();
    // An earlier session may have been killed before it removed them.
    let is_trained =
        |run: &&PlannedRun| [RunState::Trained, RunState::Complete].contains(&run.state);
    for run in plan.runs.iter().filter(is_trained) {
        remove_checkpoints(run, board);
    }
    let mut waiting = waiting(plan);
    let mut under_way: Vec<ActiveRun<'_>> = Vec::new();
    let mut tally = RunTally::of(plan);
    for look in 0_u32.. {
        while under_way.len() < manner.jobs
            && session.interruptions == 0
            && let Some((place, run, stage)) = waiting.pop_front()
        {
            let (what, started) = match (stage, &experiment.suite) {
                (RunStage::Suite, Some(suite)) => ("its suite", fly(suite, run, manner.skein)),
                _ => ("it", train(experiment, run, manner.skein)),
            };
            match started {
                Ok(child) => under_way.push(ActiveRun {
                    place,
                    run,
                    stage,
                    child,
                }),
                Err(error) => {
                    session.fail(run, &format!("{what} cannot be started: {error}"), board)
                }
            }
        }
        if under_way.is_empty() {
            break;
        }
        tokio::select! {
            Some(()) = interrupts.recv() => session.interrupt(&under_way, board),
            () = sleep(LOOK) => {}
        }
        under_way.retain_mut(|one| match one.child.try_wait() {
            Ok(None) => true,
            Ok(Some(status)) => {
                let ending = session.ended(one, status.code(), board);
                tally.ended(one, ending);
                if (one.stage, ending) == (RunStage::Training, RunState::Trained) {
                    waiting.push_front((one.place, one.run, RunStage::Suite));
                }
                false
            }
            Err(error) => {
                session.fail(one.run, &format!("cannot be waited for: {error}"), board);
                false
            }
        });
        if look % LOOKS_A_UPDATE == 0 {
            board.show(&tally.progress(plan, &under_way));
        }
    }
    session
}

/// Returns the open work in the order of `plan`. A trained run only needs its suite.
fn waiting(plan: &ExperimentPlan) -> VecDeque<(usize, &PlannedRun, RunStage)> {
    let stage = |run: &PlannedRun| match run.state {
        RunState::Complete => None,
        RunState::Trained => Some(RunStage::Suite),
        RunState::New | RunState::Begun | RunState::UnderWay => Some(RunStage::Training),
    };
    let runs = plan.runs.iter().enumerate();
    runs.filter_map(|(place, run)| Some((place, run, stage(run)?)))
        .collect()
}

/// Starts or resumes a run.
fn train(experiment: &Experiment, run: &PlannedRun, skein: &Path) -> io::Result<Child> {
    let mut command = Command::new(skein);
    command.arg("run");
    let mut log = OpenOptions::new();
    if run.state == RunState::Begun {
        command.arg("--resume").arg(run.directory.root());
        log.append(true);
    } else {
        command.arg("--config").arg(&experiment.base);
        command.arg("--run-dir").arg(run.directory.root());
        command.args(run.overrides.iter().flat_map(|setting| ["--set", setting]));
        log.write(true).truncate(true);
    }
    command.args(["--actors", &ACTORS.to_string()]);
    spawn(command, &log, run)
}

/// Flies the suite with the best snapshot of a run. The result is moved to its final path once it
/// is complete: see [`SessionOutcome::flown`].
fn fly(suite: &FlownSuite, run: &PlannedRun, skein: &Path) -> io::Result<Child> {
    // The other program reads the file again, possibly hours later.
    if FlownSuite::load(&suite.path, suite.each).as_ref() != Ok(suite) {
        let file = suite.path.display();
        return Err(io::Error::other(format!(
            "{file} has changed since the experiment started: start the experiment again"
        )));
    }
    let result = run.directory.suite_json(&suite.result_name);
    if let Some(folder) = result.parent() {
        durable::create_private_directory(folder)?;
    }
    let mut command = Command::new(skein);
    command
        .arg("evaluate")
        .arg("--run")
        .arg(run.directory.root());
    command.arg("--suite").arg(&suite.path);
    if let Some(each) = suite.each {
        command.args(["--episodes", &each.to_string()]);
    }
    command.arg("--json").arg(unfinished(&result));
    command.args(["--threads", "1"]);
    spawn(command, OpenOptions::new().append(true), run)
}

/// Returns the path of an incomplete suite result. It contains the process id because another
/// experiment may fly the same suite for the same run, to which it has a link.
fn unfinished(result: &Path) -> PathBuf {
    result.with_extension(format!("part-{}", process::id()))
}

/// Starts a program for a run. Its output goes to the log beside the run's directory.
///
/// It leads a process group of its own, so that Ctrl-C in the terminal reaches only this process,
/// which forwards it once. If this process dies, the kernel interrupts the program, which then
/// stops in order.
fn spawn(mut command: Command, options: &OpenOptions, run: &PlannedRun) -> io::Result<Child> {
    let path = run.log();
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder)?;
    }
    let log = options.clone().create(true).open(path)?;
    command
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .process_group(0);
    signal_when_orphaned(command.as_std_mut(), Signal::INT);
    heed(command.as_std_mut(), Signal::INT);
    command.spawn()
}

impl SessionOutcome {
    fn interrupt(&mut self, under_way: &[ActiveRun<'_>], board: &ExperimentDisplay) {
        self.interruptions += 1;
        let signal = match self.interruptions {
            1 => {
                board.say(
                    "stopping: every training finishes the updates of its epoch, then saves; \
                     press Ctrl-C again to stop immediately, without saving",
                );
                Signal::INT
            }
            2 => Signal::INT,
            _ => Signal::KILL,
        };
        for one in under_way {
            // A child that is not reaped keeps its process id, so the signal cannot reach another
            // process. A child that has just ended is not an error.
            if let Some(pid) = one
                .child
                .id()
                .and_then(|id| Pid::from_raw(id.cast_signed()))
            {
                let _ = kill_process(pid, signal);
            }
        }
    }

    /// Returns the state of a run after one of its programs ended.
    fn ended(
        &mut self,
        one: &ActiveRun<'_>,
        code: Option<i32>,
        board: &ExperimentDisplay,
    ) -> RunState {
        let ActiveRun { run, stage, .. } = *one;
        // `skein evaluate` has nothing to save: the first interruption ends it.
        let (program, before, kills) = match stage {
            RunStage::Training => ("skein run", RunState::Begun, 3),
            RunStage::Suite => ("skein evaluate", RunState::Trained, 1),
        };
        let how = match (code, stage) {
            (Some(0), RunStage::Training) => return self.trained(run, board),
            (Some(0), RunStage::Suite) => return self.flown(run, board),
            (Some(code), _) if code == i32::from(EXIT_INTERRUPTED) && self.interruptions > 0 => {
                return before;
            }
            (None, _) if self.interruptions >= kills => return before,
            (Some(code), _) => format!("its `{program}` exited with status {code}"),
            (None, _) => format!("its `{program}` was killed"),
        };
        let log = run.log();
        self.fail(
            run,
            &format!("{how}; {} ends with\n{}", log.display(), log_tail(&log)),
            board,
        );
        before
    }

    fn trained(&mut self, run: &PlannedRun, board: &ExperimentDisplay) -> RunState {
        let result = match RunResult::trained(run) {
            Ok(result) => result,
            Err(error) => {
                self.fail(run, &error.to_string(), board);
                return RunState::Begun;
            }
        };
        let flown = result.evaluation.courses.first();
        let flown = flown.map_or(String::new(), |course| {
            format!(", R {:.3} on {}", course.r, course.course)
        });
        let wall = Clock(result.summary.wall_secs);
        let (what, state) = match &run.suite_json {
            None => ("complete", RunState::Complete),
            Some(_) => ("trained", RunState::Trained),
        };
        board.say(&format!("{} is {what} after {wall}{flown}", run.name));
        remove_checkpoints(run, board);
        state
    }

    /// Moves the result of a suite to its final path, where every file is complete.
    fn flown(&mut self, run: &PlannedRun, board: &ExperimentDisplay) -> RunState {
        let Some(result) = &run.suite_json else {
            return RunState::Complete;
        };
        let unfinished = unfinished(result);
        let report = of_suite(&unfinished).map_err(|error| error.to_string());
        let kept = report.and_then(|report| {
            let moved = durable::sync(&unfinished).and_then(|()| fs::rename(&unfinished, result));
            moved.map_err(|error| format!("{}: {error}", result.display()))?;
            Ok(report)
        });
        match kept {
            Ok(report) => {
                let entries = report.courses.iter();
                let rates: Vec<_> = entries
                    .map(|entry| {
                        format!("{:.1} % of \"{}\"", 100.0 * entry.completed, entry.course)
                    })
                    .collect();
                board.say(&format!(
                    "{} is complete: it completed {}",
                    run.name,
                    rates.join(", ")
                ));
                RunState::Complete
            }
            Err(problem) => {
                self.fail(run, &problem, board);
                RunState::Trained
            }
        }
    }

    fn fail(&mut self, run: &PlannedRun, why: &str, board: &ExperimentDisplay) {
        board.say(&format!("{} failed: {why}", run.name));
        self.failed.push(run.name.clone());
    }
}

/// RunState of all runs.
struct RunTally {
    complete: usize,
    /// Number of training episodes learned from, by the run's index in the plan.
    episodes: Vec<u64>,
}

impl RunTally {
    fn of(plan: &ExperimentPlan) -> Self {
        let episodes = |run: &PlannedRun| match run.state {
            RunState::Trained | RunState::Complete => run.config.run.episodes,
            RunState::New => 0,
            RunState::Begun | RunState::UnderWay => flown(&run.directory).len() as u64,
        };
        Self {
            complete: plan.count(RunState::Complete),
            episodes: plan.runs.iter().map(episodes).collect(),
        }
    }

    fn ended(&mut self, one: &ActiveRun<'_>, state: RunState) {
        self.episodes[one.place] = flown(&one.run.directory).len() as u64;
        self.complete += usize::from(state == RunState::Complete);
    }

    fn progress(
        &mut self,
        plan: &ExperimentPlan,
        under_way: &[ActiveRun<'_>],
    ) -> ExperimentProgress {
        let mut standings = Vec::with_capacity(under_way.len());
        for &ActiveRun {
            place, run, stage, ..
        } in under_way
        {
            let walls = flown(&run.directory);
            self.episodes[place] = walls.len() as u64;
            standings.push(RunProgress {
                name: run.name.clone(),
                stage,
                episodes: walls.len() as u64,
                total_episodes: run.config.run.episodes,
                walls_passed: trailing_mean(&walls, run.config.evaluation.window_episodes as usize)
                    .pop(),
            });
        }
        ExperimentProgress {
            complete: self.complete,
            runs: plan.runs.len(),
            episodes: self.episodes.iter().sum(),
            total_episodes: plan.runs.iter().map(|run| run.config.run.episodes).sum(),
            under_way: standings,
        }
    }
}

/// Returns the walls passed in each episode learned from so far. A row that is still being written
/// is left out.
fn flown(run: &RunDirectory) -> Vec<f64> {
    let text = files::read_text(&run.episodes_csv(), TABLE_BYTES).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    csv::Reader::from_reader(whole.as_bytes())
        .deserialize()
        .map_while(|row: Result<PlottedEpisode, _>| row.ok())
        .map(|episode| f64::from(episode.walls_passed))
        .collect()
}

/// Removes the checkpoints of a trained run, which is never resumed. They take most of its disk
/// space.
fn remove_checkpoints(run: &PlannedRun, board: &ExperimentDisplay) {
    let checkpoints = run.directory.checkpoints();
    match fs::remove_dir_all(&checkpoints) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            board.say(&format!(
                "{} cannot be removed: {error}",
                checkpoints.display()
            ));
        }
        _ => {}
    }
}
