//! How much memory an actor takes, however many snapshots go by.

use skein_tests::{Recipe, Role};

/// Bytes that an actor may have in its memory, all that it shares with others included.
const MOST: u64 = 30 << 20;

#[test]
fn an_actor_stays_small_however_many_snapshots_it_is_sent() {
    // Networks as wide as in local.toml, and three times as many snapshots as there are places for.
    let mut run = Recipe::small()
        .set("sac.hidden_width=256")
        .set("learning.flights_per_epoch=2")
        .set("run.flights=60")
        .start();
    run.until_flights(48);
    let actors = run.processes(Role::Actor);
    assert_eq!(actors.len(), 2);
    for actor in actors {
        let most = actor.usage().unwrap().most_resident_bytes;
        assert!(most <= MOST, "actor {} took {most} bytes", actor.pid());
    }
    run.finish();
}
