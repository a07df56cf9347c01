//! Delayed learning: all episodes of an epoch follow the snapshot determined by the epoch's number
//! and the policy lag, and no episode follows two.
//!
//! A test beside the assembly shows that a record with another version within an episode is
//! refused.

use skein_tests::RunRecipe;

/// Episodes per epoch in the configuration used here.
const EPISODES_PER_EPOCH: u64 = 10;

#[test]
fn every_episode_of_an_epoch_follows_the_snapshot_that_the_lag_names() {
    for lag in [0, 1] {
        let run = RunRecipe::small()
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
    let run = RunRecipe::small()
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
