//! Direct updates: the weights are refreshed within an episode, and the result is still a function
//! of configuration and seed.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use rustix::process::Signal;
use skein_protocol::summary::RunEnding;
use skein_tests::{EndedRun, Role, RunRecipe};

/// A run with an update after every step, and a checkpoint every five episodes.
fn direct() -> RunRecipe {
    in_segments_of(1).set("checkpoints.every_episodes=5")
}

fn in_segments_of(steps: u64) -> RunRecipe {
    RunRecipe::small()
        .set(&format!("learning.segment_steps={steps}"))
        .set("learning.episodes_per_epoch=1")
        .set("run.episodes=40")
}

/// Asserts that the policy was updated within episodes.
fn assert_direct(run: &EndedRun) {
    let (episodes, summary) = (run.episodes(), run.summary());
    assert_eq!(episodes.len(), 40);
    let versions: Vec<_> = episodes
        .iter()
        .map(|episode| episode.policy_version)
        .collect();
    assert!(
        versions.is_sorted_by(|one, next| one < next),
        "{versions:?}"
    );
    assert!(
        summary.final_version.0 > 2 * summary.episodes
            && summary.final_version.0 <= summary.steps + summary.episodes,
        "{summary:?}"
    );
    let steps: u64 = episodes.iter().map(|episode| episode.steps).sum();
    assert_eq!(summary.steps, steps);
}

#[test]
fn one_actor_three_actors_and_an_actor_killed_twice_learn_the_same_bit_for_bit() {
    let alone = direct().actors(1).finish();
    assert_direct(&alone);
    direct().actors(3).finish().assert_same_as(&alone);

    let mut run = direct().actors(2).start();
    for episodes in [8, 20] {
        run.until_episodes(episodes);
        // The victim is the flying actor. The other is in reserve and must repeat what was flown.
        let flyer = run
            .processes(Role::Actor)
            .into_iter()
            .find(|actor| actor.actor() == Some(0));
        flyer.unwrap().signal(Signal::KILL);
        run.until("actor 0 was started again", |run| {
            let actors = run.processes(Role::Actor);
            (actors.len() == 2).then_some(())
        });
    }
    let disturbed = run.finish();
    let deaths = disturbed
        .output
        .stderr
        .matches("killed by signal 9")
        .count();
    assert_eq!(deaths, 2, "{}", disturbed.output.stderr);
    disturbed.assert_same_as(&alone);
}

#[test]
fn a_learner_killed_within_an_episode_resumes_after_a_complete_one() {
    let calm = direct().finish();
    let mut run = direct().start();
    for episodes in [7, 18, 29] {
        run.kill_learner_after(episodes);
    }
    run.finish().assert_same_as(&calm);
}

#[test]
fn a_stopped_run_completes_its_episode_and_loses_nothing() {
    let calm = direct().finish();
    let mut run = direct().set("checkpoints.every_episodes=1000").start();
    run.until_episodes(25);
    run.signal(Signal::INT);
    run.until_ended();
    let summary: skein_protocol::summary::RunSummary =
        serde_json::from_slice(&std::fs::read(run.directory().summary_json()).unwrap()).unwrap();
    assert_eq!(summary.ending, RunEnding::Interrupted);
    assert!(summary.episodes >= 25, "{summary:?}");
    run.resume(3);
    run.finish()
        .learned()
        .assert_same(&calm.learned(), "stopped and resumed");
}

#[test]
fn a_segment_as_long_as_any_episode_is_delayed_learning() {
    let delayed = in_segments_of(0).finish();
    let one_segment = in_segments_of(256).finish();
    one_segment
        .learned()
        .assert_same(&delayed.learned(), "episodes of one segment");
    let segments = in_segments_of(4).finish().learned();
    assert_ne!(segments.policy_sha256(), delayed.learned().policy_sha256());
}
