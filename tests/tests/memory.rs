//! Memory of an actor, whatever the number of snapshots.

use skein_tests::{Role, RunRecipe};

/// Largest resident memory of an actor, in bytes, including shared memory.
const MOST: u64 = 30_000_000;
/// With policy lag 1 an actor holds one more snapshot: 32 to 36 MB were measured.
const MOST_WITH_LAG: u64 = 38_000_000;

#[test]
fn an_actor_stays_small_whatever_the_number_of_snapshots() {
    assert_actors_stay_below(MOST, 0);
}

#[test]
fn an_actor_takes_one_snapshot_more_with_policy_lag() {
    assert_actors_stay_below(MOST_WITH_LAG, 1);
}

fn assert_actors_stay_below(bytes: u64, policy_lag: u64) {
    // Networks as wide as in local.toml, and three times as many snapshots as there are slots.
    let mut run = RunRecipe::small()
        .set("sac.hidden_width=256")
        .set("learning.episodes_per_epoch=2")
        .set(&format!("learning.policy_lag={policy_lag}"))
        .set("run.episodes=60")
        .start();
    run.until_episodes(48);
    let actors = run.processes(Role::Actor);
    assert_eq!(actors.len(), 2);
    for actor in actors {
        let most = actor
            .usage()
            .expect("the actor is alive")
            .most_resident_bytes;
        println!(
            "actor {}: {most} bytes with policy lag {policy_lag}",
            actor.pid()
        );
        assert!(most <= bytes, "actor {} took {most} bytes", actor.pid());
    }
    run.finish();
}
