//! Delayed learning: an epoch's episodes all follow the one snapshot that its number and the policy
//! lag name, and no episode is flown with two.
//!
//! That a record of another version within an episode is refused is tested beside the assembler.

use skein_tests::Recipe;

/// Episodes of an epoch in the configuration used here.
const EPISODES_PER_EPOCH: u64 = 10;

#[test]
fn every_episode_of_an_epoch_follows_the_snapshot_that_the_lag_names() {
    for lag in [0, 1] {
        let run = Recipe::small()
            .actors(3)
            .set(&format!("learning.policy_lag={lag}"))
            .finish();
        let episodes = run.episodes();
        assert_eq!(episodes.len(), 40);
        for (number, episode) in (0..).zip(&episodes) {
            assert_eq!(episode.episode, number, "episodes are not in episode order");
            assert_eq!(episode.epoch, number / EPISODES_PER_EPOCH, "{episode:?}");
            assert_eq!(
                episode.policy_version,
                episode.epoch.saturating_sub(lag),
                "lag {lag}: {episode:?}"
            );
        }
    }
}

#[test]
fn one_episode_an_epoch_is_one_snapshot_an_episode() {
    let run = Recipe::small()
        .set("learning.episodes_per_epoch=1")
        .set("run.episodes=15")
        .finish();
    let versions: Vec<_> = run
        .episodes()
        .iter()
        .map(|episode| episode.policy_version)
        .collect();
    assert_eq!(versions, (0..15).collect::<Vec<_>>());
}
