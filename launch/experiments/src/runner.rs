//! Runs side by side: as many at a time as there are cores for, each by a `skein run` of its own,
//! exactly as a user would start it. Once one is trained, its best snapshot flies the experiment's
//! suite, by a `skein-evaluate` of its own.
//!
//! A run that fails is told and the others go on. An interruption is passed on to every run under
//! way, which stops in order and can be gone on with; no other is begun then. A suite that was not
//! flown to its end is flown from its beginning the next time.

use std::collections::VecDeque;
use std::fs::{self, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{self, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use skein_run::RunDirectory;
use skein_run::durable;
use skein_run::failure::EXIT_INTERRUPTED;
use tokio::process::{Child, Command};
use tokio::sync::mpsc;
use tokio::time::sleep;

use super::board::{Board, Progress, Stage, Standing};
use super::definition::{Experiment, FlownSuite};
use super::plan::{ACTORS, Plan, PlannedRun, State};
use crate::results::{RunResult, of_suite};
use skein_reports::Clock;
use skein_reports::curves::{EpisodeRow, trailing_mean};
use skein_run::log_tail::log_tail;
use skein_run::orphans::signal_when_orphaned;

/// Between two looks at the runs under way.
const LOOK: Duration = Duration::from_millis(200);
/// Looks between two updates of the board.
const LOOKS_A_UPDATE: u32 = 5;

/// How the runs of an experiment are carried out.
#[derive(Debug, Clone, Copy)]
pub struct Manner<'a> {
    /// The program `skein`.
    pub skein: &'a Path,
    /// The program `skein-evaluate`.
    pub evaluate: &'a Path,
    /// Runs at a time.
    pub jobs: usize,
}

/// How it went.
#[derive(Debug, Default)]
pub struct Session {
    /// Runs that failed, by name.
    pub failed: Vec<String>,
    /// Times the user asked to end it.
    pub interruptions: u32,
}

struct UnderWay<'a> {
    /// Its place in the plan.
    place: usize,
    run: &'a PlannedRun,
    stage: Stage,
    child: Child,
}

/// Carries out what is not complete of `plan`. Each message on `interrupts` is one interruption by
/// the user: the first stops every run in order, the second at once; should a `skein run` not heed
/// it, the third kills it.
pub async fn run(
    experiment: &Experiment,
    plan: &Plan,
    manner: Manner<'_>,
    interrupts: &mut mpsc::Receiver<()>,
    board: &mut Board,
) -> Session {
    let mut session = Session::default();
    // Of an earlier session that was killed before it came to it.
    let is_trained = |run: &&PlannedRun| [State::Trained, State::Complete].contains(&run.state);
    for run in plan.runs.iter().filter(is_trained) {
        remove_checkpoints(run, board);
    }
    let mut waiting = waiting(plan);
    let mut under_way: Vec<UnderWay<'_>> = Vec::new();
    let mut tally = Tally::of(plan);
    for look in 0_u32.. {
        while under_way.len() < manner.jobs
            && session.interruptions == 0
            && let Some((place, run, stage)) = waiting.pop_front()
        {
            let (what, started) = match (stage, &experiment.suite) {
                (Stage::Suite, Some(suite)) => ("its suite", fly(suite, run, manner.evaluate)),
                _ => ("it", train(experiment, run, manner.skein)),
            };
            match started {
                Ok(child) => under_way.push(UnderWay {
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
                if (one.stage, ending) == (Stage::Training, State::Trained) {
                    waiting.push_front((one.place, one.run, Stage::Suite));
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

/// What is to be done, in the order of `plan`. What is trained needs the suite alone.
fn waiting(plan: &Plan) -> VecDeque<(usize, &PlannedRun, Stage)> {
    let stage = |run: &PlannedRun| match run.state {
        State::Complete => None,
        State::Trained => Some(Stage::Suite),
        State::New | State::Begun | State::UnderWay => Some(Stage::Training),
    };
    let runs = plan.runs.iter().enumerate();
    runs.filter_map(|(place, run)| Some((place, run, stage(run)?)))
        .collect()
}

/// Starts a run, or goes on with it.
fn train(experiment: &Experiment, run: &PlannedRun, skein: &Path) -> io::Result<Child> {
    let mut command = Command::new(skein);
    command.arg("run");
    let mut log = OpenOptions::new();
    if run.state == State::Begun {
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

/// Flies the suite with the best snapshot of a run. What comes of it is brought to its place when
/// it is whole: see [`Session::flown`].
fn fly(suite: &FlownSuite, run: &PlannedRun, evaluate: &Path) -> io::Result<Child> {
    // It is read again by the other program, and training takes hours.
    if FlownSuite::load(&suite.path, suite.each).as_ref() != Ok(suite) {
        let file = suite.path.display();
        return Err(io::Error::other(format!(
            "{file} is not what it was when the experiment was begun: begin it again"
        )));
    }
    let result = run.directory.suite_json(&suite.result_name);
    if let Some(folder) = result.parent() {
        durable::create_private_directory(folder)?;
    }
    let mut command = Command::new(evaluate);
    command.arg("--run").arg(run.directory.root());
    command.arg("--suite").arg(&suite.path);
    if let Some(each) = suite.each {
        command.args(["--episodes", &each.to_string()]);
    }
    command.arg("--json").arg(unfinished(&result));
    command.args(["--threads", "1"]);
    spawn(command, OpenOptions::new().append(true), run)
}

/// What `skein-evaluate` writes, before it is known to be whole. Another experiment may fly the
/// same suite for the same run, to which it has a link.
fn unfinished(result: &Path) -> PathBuf {
    result.with_extension(format!("part-{}", process::id()))
}

/// Starts a program for a run. Whatever it says goes to the file beside the run's directory.
///
/// It leads a process group of its own: Ctrl-C in the terminal reaches this process alone, which
/// passes it on once. Should this process die, the kernel interrupts it, and it stops in order.
fn spawn(mut command: Command, log: &OpenOptions, run: &PlannedRun) -> io::Result<Child> {
    let said = run.said();
    if let Some(folder) = said.parent() {
        fs::create_dir_all(folder)?;
    }
    let log = log.clone().create(true).open(said)?;
    command
        .stdin(Stdio::null())
        .stdout(log.try_clone()?)
        .stderr(log)
        .process_group(0);
    signal_when_orphaned(command.as_std_mut(), Signal::INT);
    command.spawn()
}

impl Session {
    fn interrupt(&mut self, under_way: &[UnderWay<'_>], board: &Board) {
        self.interruptions += 1;
        let signal = match self.interruptions {
            1 => {
                board.say("stopping in order: every training finishes the updates of its epoch; Ctrl-C again stops at once, without saving");
                Signal::INT
            }
            2 => Signal::INT,
            _ => Signal::KILL,
        };
        for one in under_way {
            // A child that is not reaped keeps its number, so the signal cannot reach a stranger;
            // and that it has just ended is no error.
            if let Some(pid) = one
                .child
                .id()
                .and_then(|id| Pid::from_raw(id.cast_signed()))
            {
                let _ = kill_process(pid, signal);
            }
        }
    }

    /// What is there of a run after one of its programs ended.
    fn ended(&mut self, one: &UnderWay<'_>, code: Option<i32>, board: &Board) -> State {
        let UnderWay { run, stage, .. } = *one;
        // `skein-evaluate` has nothing to put in order: the first interruption ends it.
        let (program, before, kills) = match stage {
            Stage::Training => ("skein run", State::Begun, 3),
            Stage::Suite => ("skein-evaluate", State::Trained, 1),
        };
        let how = match (code, stage) {
            (Some(0), Stage::Training) => return self.trained(run, board),
            (Some(0), Stage::Suite) => return self.flown(run, board),
            (Some(code), _) if code == i32::from(EXIT_INTERRUPTED) && self.interruptions > 0 => {
                return before;
            }
            (None, _) if self.interruptions >= kills => return before,
            (Some(code), _) => format!("its `{program}` exited with status {code}"),
            (None, _) => format!("its `{program}` was killed"),
        };
        let said = run.said();
        self.fail(
            run,
            &format!("{how}; {} ends with\n{}", said.display(), log_tail(&said)),
            board,
        );
        before
    }

    fn trained(&mut self, run: &PlannedRun, board: &Board) -> State {
        let result = match RunResult::trained(run) {
            Ok(result) => result,
            Err(error) => {
                self.fail(run, &error.to_string(), board);
                return State::Begun;
            }
        };
        let flown = result.evaluation.courses.first();
        let flown = flown.map_or(String::new(), |course| {
            format!(", R {:.3} on {}", course.r, course.course)
        });
        let wall = Clock(result.summary.wall_secs);
        let (what, state) = match &run.suite_json {
            None => ("complete", State::Complete),
            Some(_) => ("trained", State::Trained),
        };
        board.say(&format!("{} is {what} after {wall}{flown}", run.name));
        remove_checkpoints(run, board);
        state
    }

    /// Brings the result of a suite to its place: a file that is there is whole.
    fn flown(&mut self, run: &PlannedRun, board: &Board) -> State {
        let Some(result) = &run.suite_json else {
            return State::Complete;
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
                State::Complete
            }
            Err(problem) => {
                self.fail(run, &problem, board);
                State::Trained
            }
        }
    }

    fn fail(&mut self, run: &PlannedRun, why: &str, board: &Board) {
        board.say(&format!("{} failed: {why}", run.name));
        self.failed.push(run.name.clone());
    }
}

/// What there is of every run.
struct Tally {
    complete: usize,
    /// Training episodes learned from, by the place of the run in the plan.
    episodes: Vec<u64>,
}

impl Tally {
    fn of(plan: &Plan) -> Self {
        let episodes = |run: &PlannedRun| match run.state {
            State::Trained | State::Complete => run.config.run.episodes,
            State::New => 0,
            State::Begun | State::UnderWay => flown(&run.directory).len() as u64,
        };
        Self {
            complete: plan.count(State::Complete),
            episodes: plan.runs.iter().map(episodes).collect(),
        }
    }

    fn ended(&mut self, one: &UnderWay<'_>, state: State) {
        self.episodes[one.place] = flown(&one.run.directory).len() as u64;
        self.complete += usize::from(state == State::Complete);
    }

    fn progress(&mut self, plan: &Plan, under_way: &[UnderWay<'_>]) -> Progress {
        let mut standings = Vec::with_capacity(under_way.len());
        for &UnderWay {
            place, run, stage, ..
        } in under_way
        {
            let walls = flown(&run.directory);
            self.episodes[place] = walls.len() as u64;
            standings.push(Standing {
                name: run.name.clone(),
                stage,
                episodes: walls.len() as u64,
                total_episodes: run.config.run.episodes,
                walls_passed: trailing_mean(&walls, run.config.evaluation.window_episodes as usize)
                    .pop(),
            });
        }
        Progress {
            complete: self.complete,
            runs: plan.runs.len(),
            episodes: self.episodes.iter().sum(),
            total_episodes: plan.runs.iter().map(|run| run.config.run.episodes).sum(),
            under_way: standings,
        }
    }
}

/// Walls passed in each episode that a run has learned from so far. A row that is being written is
/// left out.
fn flown(run: &RunDirectory) -> Vec<f64> {
    let text = fs::read_to_string(run.episodes_csv()).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    csv::Reader::from_reader(whole.as_bytes())
        .deserialize()
        .map_while(|row: Result<EpisodeRow, _>| row.ok())
        .map(|episode| f64::from(episode.walls_passed))
        .collect()
}

/// Nothing goes on from a run that is trained, and its checkpoints are most of what it takes of the
/// disk.
fn remove_checkpoints(run: &PlannedRun, board: &Board) {
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
