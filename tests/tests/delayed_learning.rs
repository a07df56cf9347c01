//! Delayed learning: an epoch's flights all follow the one snapshot that its number and the policy lag name, and no flight is flown with two.
//!
//! That a record of another version within a flight is refused is tested beside the assembler.

use skein_tests::Recipe;

/// Flights of an epoch in the configuration used here.
const FLIGHTS_PER_EPOCH: u64 = 10;

#[test]
fn every_flight_of_an_epoch_follows_the_snapshot_that_the_lag_names() {
    for lag in [0, 1] {
        let run = Recipe::small()
            .actors(3)
            .set(&format!("learning.policy_lag={lag}"))
            .finish();
        let flights = run.flights();
        assert_eq!(flights.len(), 40);
        for (number, flight) in (0..).zip(&flights) {
            assert_eq!(flight.flight, number, "flights are not in flight order");
            assert_eq!(flight.epoch, number / FLIGHTS_PER_EPOCH, "{flight:?}");
            assert_eq!(
                flight.policy_version,
                flight.epoch.saturating_sub(lag),
                "lag {lag}: {flight:?}"
            );
        }
    }
}

#[test]
fn one_flight_an_epoch_is_one_snapshot_a_flight() {
    let run = Recipe::small()
        .set("learning.flights_per_epoch=1")
        .set("run.flights=15")
        .finish();
    let versions: Vec<_> = run.flights().iter().map(|flight| flight.policy_version).collect();
    assert_eq!(versions, (0..15).collect::<Vec<_>>());
}
