//! Processes that die, freeze or keep dying, and the incarnations that replace them.

use super::*;

#[test]
fn a_dead_actor_is_started_again() {
    let actor = format!(
        "if mkdir $dir/died-$id 2>/dev/null; then kill -9 $$; fi; touch $dir/second-life-$id; \
         {FAITHFUL_ACTOR}"
    );
    let learner = "report 0; while [ ! -e $dir/second-life-0 ] || [ ! -e $dir/second-life-1 ]; do \
                   sleep 0.02; done; touch $dir/stop";
    let (result, seen) = ScriptedRun::new(learner, &actor).run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert!(
        seen.warnings
            .contains("actor 1 was killed by signal 9; restarting it"),
        "{}",
        seen.warnings
    );
}

/// A learner that runs `first` once, then runs to its end.
fn first_incarnation(first: &str) -> String {
    format!("report 1; if mkdir $dir/died 2>/dev/null; then {first}; fi; report 2; touch $dir/stop")
}

#[test]
fn a_learner_that_dies_is_started_again_and_its_actors_stay() {
    for (death, message) in [
        (
            "kill -9 $$",
            "the learner was killed by signal 9; restarting it now",
        ),
        ("exit 101", "the learner panicked; restarting it now"),
        (
            "exit 4",
            "the learner exited with status 4; restarting it now",
        ),
    ] {
        let scripted = ScriptedRun::new(
            &first_incarnation(&format!("sleep 0.1; {death}")),
            FAITHFUL_ACTOR,
        );
        fs::create_dir_all(scripted.plan.run.checkpoints().join("episode-40")).unwrap();
        fs::create_dir(scripted.plan.run.checkpoints().join(".writing")).unwrap();
        let (result, seen) = scripted.run(never);
        assert_eq!(result.unwrap(), Ended::Finished);
        assert_eq!(
            seen.warnings,
            format!("{message}, from its newest checkpoint\n"),
            "{death}"
        );
        assert_eq!(
            seen.restarts,
            Restarts {
                learner: 1,
                actors: 0
            }
        );
        assert_eq!(scripted.processes(), 4, "two learners, two actors");
    }
}

#[test]
fn a_learner_without_progress_fails_the_run() {
    let mut scripted =
        ScriptedRun::new("report 1; echo 'always here' >&2; exit 101", FAITHFUL_ACTOR);
    scripted.plan.deadlines.learner_pause = Duration::from_millis(10);
    let (result, seen) = scripted.run(never);
    let error = result.unwrap_err().to_string();
    assert!(
        error.contains("died 10 times without making progress") && error.contains("always here"),
        "{error}"
    );
    assert_eq!((seen.restarts.learner, scripted.processes()), (9, 12));
}

#[test]
fn a_learner_killed_any_number_of_times_is_always_restarted() {
    let learner = "echo >> $dir/starts; report 1
        if [ $(wc -l < $dir/starts) -le 12 ]; then kill -9 $$; fi; touch $dir/stop";
    let mut scripted = ScriptedRun::new(learner, FAITHFUL_ACTOR);
    scripted.plan.deadlines.learner_pause = Duration::from_millis(10);
    let (result, seen) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert_eq!(seen.restarts.learner, 12);
}

#[test]
fn an_actor_killed_before_it_is_useful_is_always_restarted() {
    let actor = format!(
        "echo >> $dir/starts-$id; if [ $(wc -l < $dir/starts-$id) -le 5 ]; then kill -$((9 + 6 * \
         id)) $$; fi; touch $dir/up-$id; {FAITHFUL_ACTOR}"
    );
    let learner = "report 1; while [ ! -e $dir/up-0 ] || [ ! -e $dir/up-1 ]; do sleep 0.02; done; \
                   touch $dir/stop";
    let (result, seen) = ScriptedRun::new(learner, &actor).run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert!(!seen.warnings.contains("gave up"), "{}", seen.warnings);
}

#[test]
fn a_frozen_learner_is_killed_and_started_again() {
    for first in [
        "kill -STOP $$",
        "trap '' TERM; while :; do sleep 0.02; done",
    ] {
        let mut scripted = ScriptedRun::new(&first_incarnation(first), FAITHFUL_ACTOR);
        scripted.plan.deadlines.learner_silence = Duration::from_millis(300);
        let (result, seen) = scripted.run(never);
        assert_eq!(result.unwrap(), Ended::Finished);
        assert!(
            seen.warnings
                .contains("has not reported for 0 s: killing it"),
            "{}",
            seen.warnings
        );
        assert_eq!(seen.restarts.learner, 1);
    }
}

#[test]
fn a_learner_that_hangs_before_its_first_report_is_started_again() {
    let hangs_once =
        "if mkdir $dir/died 2>/dev/null; then kill -STOP $$; fi; report 2; touch $dir/stop";
    let mut scripted = ScriptedRun::new(hangs_once, FAITHFUL_ACTOR);
    scripted.plan.deadlines.learner_start = Duration::from_millis(300);
    let (result, seen) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert_eq!(seen.restarts.learner, 1);
}

#[test]
fn actors_that_found_no_learner_come_back_with_it() {
    // The first incarnation of the actors ends with that of the learner, which takes a while to
    // come back.
    let actor = format!(
        "while [ ! -e $dir/died ]; do sleep 0.02; done; if mkdir $dir/left-$id 2>/dev/null; then \
         exit 3; fi; touch $dir/back-$id; {FAITHFUL_ACTOR}"
    );
    let learner = "if mkdir $dir/died 2>/dev/null; then
            rmdir $dir/died; report 1; sleep 0.2; mkdir $dir/died; kill -9 $$; fi
        while [ ! -e $dir/left-0 ] || [ ! -e $dir/left-1 ]; do sleep 0.02; done; sleep 0.2; report 1
        while [ ! -e $dir/back-0 ] || [ ! -e $dir/back-1 ]; do sleep 0.02; done; touch $dir/stop";
    let (result, seen) = ScriptedRun::new(learner, &actor).run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert!(
        seen.warnings.contains("actor 0 found no learner and left"),
        "{}",
        seen.warnings
    );
}

#[test]
fn dismissed_actors_come_back_with_a_learner_that_died_before_the_end() {
    let actor = "while [ ! -e $dir/stop ]; do sleep 0.02; done; touch $dir/home-$id";
    let learner = "if mkdir $dir/died 2>/dev/null; then
            report 1; sleep 0.1; touch $dir/stop
            while [ ! -e $dir/home-0 ] || [ ! -e $dir/home-1 ]; do sleep 0.02; done
            sleep 0.2; kill -9 $$
        fi
        rm $dir/stop $dir/home-*; report 1; sleep 0.2; touch $dir/stop
        while [ ! -e $dir/home-0 ] || [ ! -e $dir/home-1 ]; do sleep 0.02; done";
    let scripted = ScriptedRun::new(learner, actor);
    let (result, _) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert_eq!(
        scripted.processes(),
        6,
        "two learners, and two actors for each"
    );
}

#[test]
fn an_actor_unheard_of_for_long_is_killed_and_restarted() {
    let actor = format!(
        "if mkdir $dir/frozen-$id 2>/dev/null; then kill -STOP $$; fi; touch \
         $dir/second-life-$id; {FAITHFUL_ACTOR}"
    );
    let learner = "while [ ! -e $dir/second-life-0 ] || [ ! -e $dir/second-life-1 ]; do report 1 \
                   []; sleep 0.05; done; report 1; touch $dir/stop";
    let mut scripted = ScriptedRun::new(learner, &actor);
    scripted.plan.deadlines.actor_silence = Duration::from_millis(400);
    let (result, seen) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert!(
        seen.warnings
            .contains("the learner has not heard of actor 1"),
        "{}",
        seen.warnings
    );
    assert_eq!(seen.restarts.actors, 2);
}

#[test]
fn useful_actors_are_restarted_after_any_number_of_deaths() {
    // Five deaths of one actor while the run makes progress; a useless actor is given up after as
    // many.
    let actor = format!("if [ $id = 0 ]; then sleep 0.1; kill -9 $$; fi; {FAITHFUL_ACTOR}");
    let learner = "n=0; while [ $(wc -l < $dir/pids) -lt 8 ]; do n=$((n+1)); report $n; sleep \
                   0.05; done; touch $dir/stop";
    let scripted = ScriptedRun::new(learner, &actor);
    let (result, seen) = scripted.run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert!(
        scripted.processes() >= 8 && !seen.warnings.contains("gave up"),
        "{}",
        seen.warnings
    );
}

#[test]
fn a_stall_is_reported_once() {
    let learner = r#"report 1
        for i in 1 2 3; do report 1 '[0,1],"stalled":"the learner waits for a disk"'; done
        report 2; touch $dir/stop"#;
    let (result, seen) = ScriptedRun::new(learner, FAITHFUL_ACTOR).run(never);
    assert_eq!(result.unwrap(), Ended::Finished);
    assert_eq!(seen.warnings, "no progress: the learner waits for a disk\n");
}
