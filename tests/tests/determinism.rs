//! Training is a function of configuration and seed: who flies, how many fly, and who dies
//! meanwhile, changes nothing.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::BTreeSet;

use rustix::process::Signal;
use skein_run::RunDirectory;
use skein_tests::{Ended, Process, Recipe, Role, processes_of};

/// The actors that flew training episodes.
fn crew(run: &Ended) -> BTreeSet<u32> {
    run.episodes().iter().map(|episode| episode.actor).collect()
}

#[test]
fn one_two_and_four_actors_and_one_attached_half_way_learn_the_same_bit_for_bit() {
    let alone = Recipe::smoke().actors(1).finish();
    for actors in [2, 4] {
        let run = Recipe::smoke().actors(actors).finish();
        assert!(
            crew(&run).len() > 1,
            "of {actors} actors only one flew: nothing was compared"
        );
        run.learned()
            .assert_same(&alone.learned(), &format!("{actors} actors"));
    }
    let mut run = Recipe::smoke().actors(1).start();
    run.until_episodes(alone.episodes().len() / 2);
    run.attach();
    let joined = run.finish();
    assert_eq!(
        crew(&joined),
        BTreeSet::from([0, 1]),
        "the attached actor flew nothing: nothing was compared"
    );
    joined
        .learned()
        .assert_same(&alone.learned(), "an actor attached half-way");
}

#[test]
fn actors_that_fly_while_the_learner_updates_change_nothing_either() {
    let lagging = || Recipe::small().set("learning.policy_lag=1");
    let alone = lagging().actors(1).finish();
    let together = lagging().actors(3).finish();
    assert!(
        crew(&together).len() > 1,
        "only one actor flew: nothing was compared"
    );
    together
        .learned()
        .assert_same(&alone.learned(), "three actors");
}

#[test]
fn an_actor_killed_in_the_middle_changes_nothing() {
    // Long enough that the actor's second incarnation falls into the run.
    let long = || Recipe::small().set("run.episodes=150");
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

fn actor(run: &RunDirectory, id: u32) -> Option<Process> {
    processes_of(run)
        .into_iter()
        .find(|process| process.role() == Role::Actor && process.actor() == Some(id))
}

#[test]
fn another_seed_learns_something_else() {
    let one = Recipe::small().set("run.seed=1").finish().learned();
    let two = Recipe::small().set("run.seed=2").finish().learned();
    assert_ne!(one.policy_sha256(), two.policy_sha256());
}
