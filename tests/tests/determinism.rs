//! Training is a function of configuration and seed. The number of actors, the actor of an episode
//! and deaths of actors change nothing.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::BTreeSet;

use rustix::process::Signal;
use skein_run::RunDirectory;
use skein_tests::{EndedRun, ListedProcess, Role, RunRecipe, processes_of};

/// Returns the actors that flew training episodes.
fn crew(run: &EndedRun) -> BTreeSet<u32> {
    run.episodes().iter().map(|episode| episode.actor).collect()
}

#[test]
fn one_two_and_four_actors_and_one_attached_half_way_learn_the_same_bit_for_bit() {
    let alone = RunRecipe::smoke().actors(1).finish();
    for actors in [2, 4] {
        let run = RunRecipe::smoke().actors(actors).finish();
        assert!(
            crew(&run).len() > 1,
            "of {actors} actors only one flew, so the test shows nothing"
        );
        run.learned()
            .assert_same(&alone.learned(), &format!("{actors} actors"));
    }
    let mut run = RunRecipe::smoke().actors(1).start();
    run.until_episodes(alone.episodes().len() / 2);
    run.attach();
    let joined = run.finish();
    assert_eq!(
        crew(&joined),
        BTreeSet::from([0, 1]),
        "the attached actor flew nothing, so the test shows nothing"
    );
    joined
        .learned()
        .assert_same(&alone.learned(), "an actor attached half-way");
}

#[test]
fn actors_that_fly_during_updates_change_nothing() {
    one_actor_equals_three(|| RunRecipe::small().set("learning.policy_lag=1"));
}

fn one_actor_equals_three(recipe: impl Fn() -> RunRecipe) {
    let alone = recipe().actors(1).finish();
    let together = recipe().actors(3).finish();
    assert!(
        crew(&together).len() > 1,
        "only one actor flew, so the test shows nothing"
    );
    together
        .learned()
        .assert_same(&alone.learned(), "three actors");
}

#[test]
fn all_numbers_of_an_action_and_all_parts_of_an_observation_are_learned_bit_for_bit() {
    one_actor_equals_three(|| {
        RunRecipe::small()
            .set("simulator.vehicle.action=velocity+yaw")
            .set("simulator.vehicle.max_speed_mps=2.0")
            .set("simulator.reward.progress=0.1")
            .set("learning.observation=latent+velocity+action+goal")
            .set("learning.critic_input=ground-truth")
            .set("learning.mirror=true")
    });
}

#[test]
fn an_actor_killed_in_the_middle_changes_nothing() {
    // Long enough for the actor's second incarnation.
    let long = || RunRecipe::small().set("run.episodes=150");
    let undisturbed = long().finish();
    let mut run = long().start();
    run.until_episodes(10);
    let victim = actor(run.directory(), 0).unwrap();
    victim.signal(Signal::KILL);
    let successor = run.until("actor 0 was started again", |run| {
        actor(run.directory(), 0).filter(|actor| actor.pid != victim.pid)
    });
    successor.signal(Signal::KILL);
    let disturbed = run.finish();
    assert!(
        disturbed.output.stderr.contains("killed by signal 9"),
        "{}",
        disturbed.output.stderr
    );
    disturbed
        .learned()
        .assert_same(&undisturbed.learned(), "an actor killed twice");
}

fn actor(run: &RunDirectory, id: u32) -> Option<ListedProcess> {
    processes_of(run)
        .into_iter()
        .find(|process| process.role() == Role::Actor && process.actor() == Some(id))
}

#[test]
fn another_seed_has_another_result() {
    let one = RunRecipe::small().set("run.seed=1").finish().learned();
    let two = RunRecipe::small().set("run.seed=2").finish().learned();
    assert_ne!(one.policy_sha256(), two.policy_sha256());
}
