//! Runs side by side: as many at a time as there are cores for, each by a `skein run` of its own, exactly as a user would start it.
//!
//! A run that fails is told and the others go on. An interruption is passed on to every run under way, which stops in order and can be gone on with; no
//! other is begun then.

use std::collections::VecDeque;
use std::fs::{self, OpenOptions};
use std::io;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use skein_protocol::run::RunDirectory;
use tokio::process::{Child, Command};
use tokio::sync::mpsc;
use tokio::time::sleep;

use super::board::{Board, Progress, Standing};
use super::definition::Experiment;
use super::plan::{ACTORS, Plan, PlannedRun, State};
use crate::display::Clock;
use crate::experiments::results::RunResult;
use crate::interrupts::INTERRUPTED;
use crate::orphans::signal_when_orphaned;
use crate::reports::curves::{FlightRow, trailing_mean};
use crate::supervisor::log_tail::log_tail;

/// Between two looks at the runs under way.
const LOOK: Duration = Duration::from_millis(200);
/// Looks between two updates of the board.
const LOOKS_A_UPDATE: u32 = 5;

/// How the runs of an experiment are carried out.
#[derive(Debug, Clone, Copy)]
pub struct Manner<'a> {
    /// The program `skein`.
    pub skein: &'a Path,
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
    child: Child,
}

/// Carries out what is not complete of `plan`. Each message on `interrupts` is one interruption by the user: the first stops every run in order, the second
/// at once; should a `skein run` not heed it, the third kills it.
pub async fn run(
    experiment: &Experiment,
    plan: &Plan,
    manner: Manner<'_>,
    interrupts: &mut mpsc::Receiver<()>,
    board: &mut Board,
) -> Session {
    let mut session = Session::default();
    // Of an earlier session that was killed before it came to it.
    for run in plan.runs.iter().filter(|run| run.state == State::Complete) {
        remove_checkpoints(run, board);
    }
    let incomplete = |(_, run): &(usize, &PlannedRun)| run.state != State::Complete;
    let mut waiting: VecDeque<_> = plan.runs.iter().enumerate().filter(incomplete).collect();
    let mut under_way: Vec<UnderWay<'_>> = Vec::new();
    let mut tally = Tally::of(plan);
    for look in 0_u32.. {
        while under_way.len() < manner.jobs
            && session.interruptions == 0
            && let Some((place, run)) = waiting.pop_front()
        {
            match start(experiment, run, manner.skein) {
                Ok(child) => under_way.push(UnderWay { place, run, child }),
                Err(error) => session.fail(run, &format!("cannot be started: {error}"), board),
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
                let ending = session.ended(one.run, status.code(), board);
                tally.ended(one, ending);
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

/// Starts a run, or goes on with it. Whatever it says goes to the file beside its directory.
///
/// It leads a process group of its own: Ctrl-C in the terminal reaches this process alone, which passes it on once. Should this process die, the kernel
/// interrupts it, and it stops in order.
fn start(experiment: &Experiment, run: &PlannedRun, skein: &Path) -> io::Result<Child> {
    let said = run.said();
    if let Some(folder) = said.parent() {
        fs::create_dir_all(folder)?;
    }
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
    let log = log.create(true).open(said)?;
    command
        .args(["--actors", &ACTORS.to_string()])
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
                board.say("stopping in order: every run finishes the updates of its epoch; Ctrl-C again stops at once, without saving");
                Signal::INT
            }
            2 => Signal::INT,
            _ => Signal::KILL,
        };
        for one in under_way {
            // A child that is not reaped keeps its number, so the signal cannot reach a stranger; and that it has just ended is no error.
            if let Some(pid) = one.child.id().and_then(|id| Pid::from_raw(id.cast_signed())) {
                let _ = kill_process(pid, signal);
            }
        }
    }

    fn ended(&mut self, run: &PlannedRun, code: Option<i32>, board: &Board) -> State {
        let how = match code {
            Some(0) => return self.completed(run, board),
            Some(code) if code == i32::from(INTERRUPTED) && self.interruptions > 0 => return State::Begun,
            None if self.interruptions > 2 => return State::Begun,
            Some(code) => format!("its `skein run` exited with status {code}"),
            None => "its `skein run` was killed".to_owned(),
        };
        let said = run.said();
        self.fail(
            run,
            &format!("{how}; {} ends with\n{}", said.display(), log_tail(&said)),
            board,
        );
        State::Begun
    }

    fn completed(&mut self, run: &PlannedRun, board: &Board) -> State {
        let result = match RunResult::of(run) {
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
        board.say(&format!("{} is complete after {wall}{flown}", run.name));
        remove_checkpoints(run, board);
        State::Complete
    }

    fn fail(&mut self, run: &PlannedRun, why: &str, board: &Board) {
        board.say(&format!("{} failed: {why}", run.name));
        self.failed.push(run.name.clone());
    }
}

/// What there is of every run.
struct Tally {
    complete: usize,
    /// Training flights learned from, by the place of the run in the plan.
    flights: Vec<u64>,
}

impl Tally {
    fn of(plan: &Plan) -> Self {
        let flights = |run: &PlannedRun| match run.state {
            State::Complete => run.config.run.flights,
            State::New => 0,
            State::Begun | State::UnderWay => flown(&run.directory).len() as u64,
        };
        Self {
            complete: plan.count(State::Complete),
            flights: plan.runs.iter().map(flights).collect(),
        }
    }

    fn ended(&mut self, one: &UnderWay<'_>, state: State) {
        self.flights[one.place] = flown(&one.run.directory).len() as u64;
        self.complete += usize::from(state == State::Complete);
    }

    fn progress(&mut self, plan: &Plan, under_way: &[UnderWay<'_>]) -> Progress {
        let mut standings = Vec::with_capacity(under_way.len());
        for &UnderWay { place, run, .. } in under_way {
            let walls = flown(&run.directory);
            self.flights[place] = walls.len() as u64;
            standings.push(Standing {
                name: run.name.clone(),
                flights: walls.len() as u64,
                total_flights: run.config.run.flights,
                walls_passed: trailing_mean(&walls, run.config.evaluation.window_flights as usize).pop(),
            });
        }
        Progress {
            complete: self.complete,
            runs: plan.runs.len(),
            flights: self.flights.iter().sum(),
            total_flights: plan.runs.iter().map(|run| run.config.run.flights).sum(),
            under_way: standings,
        }
    }
}

/// Walls passed in each flight that a run has learned from so far. A row that is being written is left out.
fn flown(run: &RunDirectory) -> Vec<f64> {
    let text = fs::read_to_string(run.flights_csv()).unwrap_or_default();
    let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
    csv::Reader::from_reader(whole.as_bytes())
        .deserialize()
        .map_while(|row: Result<FlightRow, _>| row.ok())
        .map(|flight| f64::from(flight.walls_passed))
        .collect()
}

/// Nothing goes on from a run that is complete, and its checkpoints are most of what it takes of the disk.
fn remove_checkpoints(run: &PlannedRun, board: &Board) {
    let checkpoints = run.directory.checkpoints();
    match fs::remove_dir_all(&checkpoints) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            board.say(&format!("{} cannot be removed: {error}", checkpoints.display()));
        }
        _ => {}
    }
}
