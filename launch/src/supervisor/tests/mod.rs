//! Supervises small shell scripts that behave, or misbehave, like a learner and its actors.

mod incarnations;

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use tempfile::TempDir;
use tokio::sync::mpsc;

use super::dismissal::ACTOR_GRACE;
use super::*;
use skein_protocol::config::Config;

/// Everything that was shown to the user.
#[derive(Default)]
struct Seen {
    episodes: Vec<u64>,
    warnings: String,
    restarts: Restarts,
}

impl Watcher for Seen {
    fn progress(&mut self, progress: &ProgressReport, restarts: Restarts) {
        self.episodes.push(progress.episodes);
        self.restarts = restarts;
    }

    fn warn(&mut self, text: &str) {
        self.warnings.push_str(text);
        self.warnings.push('\n');
    }
}

/// A shell function that reports `$1` updates and the live actors `$2`, by default both.
const REPORT: &str = r#"report() {
  printf '{"phase":"flying","episodes":7,"total_episodes":9,"evaluation_episodes":[0,0],'
  printf '"steps":1,"updates":%s,"vae_updates":0,"steps_per_sec":1.0,"updates_per_sec":0.0,' "$1"
  printf '"walls_passed":null,"mean_return":null,"temperature":null,"vae_loss":null,"actors":2,'
  printf '"live_actors":%s,"elapsed_secs":1.0}\n' "${2:-[0,1]}"
}"#;

/// An actor that flies until the learner's script creates `stop`.
const FAITHFUL_ACTOR: &str = "while [ ! -e $dir/stop ]; do sleep 0.02; done";
/// A learner that runs until it gets SIGTERM.
const ENDLESS_LEARNER: &str =
    "trap 'touch $dir/saved $dir/stop; exit 0' TERM; report 0; while :; do sleep 0.02; done";

struct ScriptedRun {
    directory: TempDir,
    plan: SupervisionPlan,
}

impl ScriptedRun {
    /// Creates a run of two actors and a learner, given as shell commands that find the run's
    /// directory in `$dir` and the actor's id in `$id`. Each records its process id in the
    /// directory.
    fn new(learner: &str, actor: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        fs::create_dir(run.logs()).unwrap();
        let script = |name: &str, body: &str| {
            let path = directory.path().join(name);
            fs::write(
                &path,
                format!("#!/bin/sh\ndir=$2 id=$4\necho $$ >> $dir/pids\n{REPORT}\n{body}\n"),
            )
            .unwrap();
            fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
            path
        };
        let programs = Programs {
            learner: script("learner", learner),
            actor: script("actor", actor),
        };
        let plan = SupervisionPlan {
            run,
            programs,
            actors: vec![ActorId(0), ActorId(1)],
            learner_threads: 1,
            deadlines: Deadlines::of(&Config::default()),
        };
        Self { directory, plan }
    }

    fn has(&self, name: &str) -> bool {
        self.directory.path().join(name).exists()
    }

    /// Supervises the run; `interrupt` gets the sender of interruptions.
    fn run<F: Future<Output = ()> + Send + 'static>(
        &self,
        interrupt: impl FnOnce(mpsc::Sender<()>) -> F,
    ) -> (Result<Ended, SupervisorError>, Seen) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        let mut seen = Seen::default();
        let result = runtime.block_on(async {
            let (sender, mut interrupts) = mpsc::channel(4);
            tokio::spawn(interrupt(sender));
            run(&self.plan, &mut interrupts, &mut seen).await
        });
        self.assert_nothing_is_left();
        (result, seen)
    }

    /// Attaches the actors to a run whose learner this supervisor did not start.
    fn attach(&self) -> (Result<Ended, SupervisorError>, Seen) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        let mut seen = Seen::default();
        let (_sender, mut interrupts) = mpsc::channel(1);
        let is_under_way = || !self.has("over");
        let result = runtime.block_on(attach(&self.plan, is_under_way, &mut interrupts, &mut seen));
        self.assert_nothing_is_left();
        (result, seen)
    }

    /// Number of processes that were started.
    fn processes(&self) -> usize {
        fs::read_to_string(self.directory.path().join("pids"))
            .map_or(0, |pids| pids.lines().count())
    }

    /// Asserts that no started process is left, not even as a zombie.
    fn assert_nothing_is_left(&self) {
        let pids = fs::read_to_string(self.directory.path().join("pids")).unwrap();
        for pid in pids.lines() {
            assert!(
                !Path::new("/proc").join(pid).exists(),
                "process {pid} is left"
            );
        }
    }
}

async fn until(condition: impl Fn() -> bool) {
    while !condition() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

async fn never(_: mpsc::Sender<()>) {}

#[test]
fn a_run_ends_when_its_learner_does() {
    let scripted = ScriptedRun::new("report 0; echo a remark; touch $dir/stop", FAITHFUL_ACTOR);
    let (result, seen) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert_eq!(seen.episodes, [7]);
    assert_eq!(seen.warnings, "a remark\n");
}

#[test]
fn a_dead_learner_is_not_started_again_during_a_stop() {
    let dies_when_stopped = "trap 'kill -9 $$' TERM; report 0; while :; do sleep 0.02; done";
    let scripted = ScriptedRun::new(dies_when_stopped, FAITHFUL_ACTOR);
    let pids = scripted.plan.run.root().join("pids");
    let (result, _) = scripted.run(|interrupts| interrupt_when_all_fly(pids, interrupts));
    let error = result.unwrap_err().to_string();
    assert!(error.contains("was killed by signal 9"), "{error}");
    assert_eq!(scripted.processes(), 3);
}

#[test]
fn an_interruption_between_two_incarnations_of_the_learner_ends_the_run() {
    let scripted = ScriptedRun::new("report 1; kill -9 $$", FAITHFUL_ACTOR);
    let pids = scripted.plan.run.root().join("pids");
    let begun = std::time::Instant::now();
    let (result, _) = scripted.run(|interrupts| async move {
        // Two incarnations of the learner, two actors; the third begins after a pause of a second.
        until(|| fs::read_to_string(&pids).is_ok_and(|pids| pids.lines().count() == 4)).await;
        tokio::time::sleep(Duration::from_millis(500)).await;
        interrupts.send(()).await.unwrap();
        interrupts.send(()).await.unwrap();
        interrupts.send(()).await.unwrap();
    });
    assert_eq!(result.unwrap(), Ended::Interrupted);
    assert!(begun.elapsed() < ACTOR_GRACE, "took {:?}", begun.elapsed());
}

#[test]
fn an_interruption_before_the_learner_knows_of_signals_ends_the_run_in_order() {
    let scripted = ScriptedRun::new("exec sleep 60", FAITHFUL_ACTOR);
    let pids = scripted.plan.run.root().join("pids");
    let (result, _) = scripted.run(|interrupts| async move {
        until(|| pids.exists()).await;
        tokio::time::sleep(Duration::from_millis(100)).await;
        interrupts.send(()).await.unwrap();
    });
    assert_eq!(result.unwrap(), Ended::Interrupted);
}

#[test]
fn a_learner_that_fails_ends_the_run_and_its_last_words_are_printed() {
    let scripted = ScriptedRun::new(
        "report 0; echo 'no such device' >&2; exit 3",
        "while :; do sleep 0.02; done",
    );
    let (result, _) = scripted.run(never);
    let error = result.unwrap_err().to_string();
    assert!(
        error.contains("exited with status 3") && error.contains("learner.log"),
        "{error}"
    );
    assert!(error.contains("no such device"), "{error}");
}

#[test]
fn actors_that_keep_dying_end_the_run_but_what_was_learned_is_saved() {
    let scripted = ScriptedRun::new(ENDLESS_LEARNER, "echo 'cannot fly' >&2; exit 1");
    let (result, _) = scripted.run(never);
    let error = result.unwrap_err().to_string();
    assert!(
        error.contains("no actor is left") && error.contains("cannot fly"),
        "{error}"
    );
    assert!(scripted.has("saved"));
}

#[test]
fn the_first_interruption_stops_in_order() {
    let scripted = ScriptedRun::new(ENDLESS_LEARNER, FAITHFUL_ACTOR);
    let learner_up = scripted.plan.run.root().join("pids");
    let (result, _) = scripted.run(|interrupts| async move {
        until(|| fs::read_to_string(&learner_up).is_ok_and(|pids| pids.lines().count() == 3)).await;
        tokio::time::sleep(Duration::from_millis(200)).await;
        interrupts.send(()).await.unwrap();
    });
    assert_eq!(result.unwrap(), Ended::Interrupted);
    assert!(
        scripted.has("saved"),
        "the learner was not given time to save"
    );
}

#[test]
fn the_second_interruption_stops_at_once() {
    let deaf = "trap '' TERM; report 0; while :; do sleep 0.02; done";
    let scripted = ScriptedRun::new(deaf, deaf);
    let pids = scripted.plan.run.root().join("pids");
    let begun = std::time::Instant::now();
    let (result, _) = scripted.run(|interrupts| async move {
        until(|| fs::read_to_string(&pids).is_ok_and(|pids| pids.lines().count() == 3)).await;
        interrupts.send(()).await.unwrap();
        interrupts.send(()).await.unwrap();
    });
    assert_eq!(result.unwrap(), Ended::Interrupted);
    assert!(begun.elapsed() < ACTOR_GRACE, "took {:?}", begun.elapsed());
}

#[test]
fn a_program_that_cannot_be_started_leaves_nothing_behind() {
    let mut scripted = ScriptedRun::new(ENDLESS_LEARNER, "");
    let missing = tempfile::tempdir().unwrap().path().join("skein-actor");
    scripted.plan.programs.actor = missing.clone();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let (_sender, mut interrupts) = mpsc::channel(1);
    let error = runtime
        .block_on(run(&scripted.plan, &mut interrupts, &mut Seen::default()))
        .unwrap_err();
    assert!(
        error.to_string().contains(missing.to_str().unwrap()),
        "{error}"
    );
    if scripted.has("pids") {
        scripted.assert_nothing_is_left();
    }
}

#[test]
fn a_learner_that_cannot_start_is_quoted_once_and_no_actor_starts() {
    let scripted = ScriptedRun::new(
        "echo '2026-01-01 ERROR no such device' >&2; echo 'learner: no such device' >&2; exit 1",
        FAITHFUL_ACTOR,
    );
    let (result, seen) = scripted.run(never);
    assert_eq!(
        result.unwrap_err().to_string(),
        "the learner cannot start: no such device"
    );
    assert_eq!((&*seen.warnings, scripted.processes()), ("", 1));
}

#[test]
fn actors_that_find_no_learner_are_not_started_again() {
    let scripted = ScriptedRun::new("", "exit 3");
    let (result, _) = scripted.attach();
    let error = result.unwrap_err().to_string();
    assert_eq!(
        error,
        format!(
            "the learner of the run in {} has ended",
            scripted.directory.path().display()
        )
    );
    assert_eq!(scripted.processes(), 2);
}

#[test]
fn attached_actors_that_cannot_leave_are_ended_after_the_run() {
    let mut scripted = ScriptedRun::new("", "touch $dir/over; kill -STOP $$");
    scripted.plan.deadlines.actor_silence = Duration::from_millis(100);
    let (result, _) = scripted.attach();
    assert_eq!(result.unwrap(), Ended::Finished);
}

/// A learner that keeps reporting for a second after SIGTERM, with `$n` counting up, and then
/// saves.
fn slow_to_stop(report: &str) -> ScriptedRun {
    let learner = format!(
        "trap 'stopping=1' TERM; n=0; report 0; while [ -z $stopping ]; do sleep 0.02; done
        while [ $n -lt 10 ]; do n=$((n+1)); {report}; sleep 0.1; done; touch $dir/saved $dir/stop"
    );
    let mut scripted = ScriptedRun::new(&learner, FAITHFUL_ACTOR);
    scripted.plan.deadlines.learner_stop = Duration::from_millis(500);
    scripted
}

#[test]
fn a_learner_that_still_updates_is_given_time_to_save() {
    let scripted = slow_to_stop("report $n");
    let pids = scripted.plan.run.root().join("pids");
    let (result, seen) = scripted.run(|interrupts| interrupt_when_all_fly(pids, interrupts));
    assert_eq!(result.unwrap(), Ended::Interrupted);
    assert!(scripted.has("saved"));
    assert_eq!(
        seen.warnings
            .matches("finishing the updates of this epoch, then saving; press Ctrl-C again")
            .count(),
        1
    );
}

#[test]
fn a_stopping_learner_without_progress_is_killed() {
    let scripted = slow_to_stop("report 0");
    let pids = scripted.plan.run.root().join("pids");
    let (result, seen) = scripted.run(|interrupts| interrupt_when_all_fly(pids, interrupts));
    assert!(
        matches!(result, Err(SupervisorError::LearnerFailed { .. })),
        "{result:?}"
    );
    assert!(
        !scripted.has("saved") && seen.warnings.contains("does not stop: killing it"),
        "{}",
        seen.warnings
    );
}

async fn interrupt_when_all_fly(pids: PathBuf, interrupts: mpsc::Sender<()>) {
    until(|| fs::read_to_string(&pids).is_ok_and(|pids| pids.lines().count() == 3)).await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    interrupts.send(()).await.unwrap();
}
