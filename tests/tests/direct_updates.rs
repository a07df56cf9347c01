//! Direct updates: the weights are refreshed in the middle of an episode, and what is learned is a
//! function of configuration and seed all the same.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use rustix::process::Signal;
use skein_protocol::summary::RunEnding;
use skein_tests::{Ended, Recipe, Role};

/// Updated after every step, checkpoints every five episodes.
fn direct() -> Recipe {
    in_segments_of(1).set("checkpoints.every_episodes=5")
}

fn in_segments_of(steps: u64) -> Recipe {
    Recipe::small()
        .set(&format!("learning.segment_steps={steps}"))
        .set("learning.episodes_per_epoch=1")
        .set("run.episodes=40")
}

/// That the policy was updated in the middle of episodes.
fn assert_direct(run: &Ended) {
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
fn one_actor_three_and_one_that_is_killed_twice_learn_the_same_bit_for_bit() {
    let alone = direct().actors(1).finish();
    assert_direct(&alone);
    direct().actors(3).finish().assert_same_as(&alone);

    let mut run = direct().actors(2).start();
    for episodes in [8, 20] {
        run.until_episodes(episodes);
        // The one that flies: the other is in reserve, and has to repeat what was flown.
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
    let told = disturbed
        .output
        .stderr
        .matches("killed by signal 9")
        .count();
    assert_eq!(told, 2, "{}", disturbed.output.stderr);
    disturbed.assert_same_as(&alone);
}

#[test]
fn a_learner_killed_in_the_middle_of_an_episode_goes_back_to_one_that_had_ended() {
    let calm = direct().finish();
    let mut run = direct().start();
    for episodes in [7, 18, 29] {
        run.kill_learner_after(episodes);
    }
    run.finish().assert_same_as(&calm);
}

#[test]
fn a_run_that_is_stopped_flies_its_episode_to_the_end_and_loses_nothing() {
    let calm = direct().finish();
    let mut run = direct().set("checkpoints.every_episodes=1000").start();
    run.until_episodes(25);
    run.signal(Signal::INT);
    run.until_ended();
    let summary: skein_protocol::summary::Summary =
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
