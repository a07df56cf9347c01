//! The newest few snapshots of an actor. An episode can use the one its ticket names while the
//! learner publishes the next.

use std::collections::VecDeque;
use std::sync::Arc;

use skein_protocol::config::Config;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

use skein_inference::Network;

/// Cache of the newest snapshots.
#[derive(Debug)]
pub struct SnapshotCache {
    layout: SnapshotLayout,
    capacity: usize,
    /// In order of arrival, the newest last.
    cached: VecDeque<StoredSnapshot>,
}

#[derive(Debug)]
enum StoredSnapshot {
    /// As received. An actor never flies most snapshots, and preparing one takes milliseconds.
    Raw(Snapshot),
    /// Prepared for flying.
    Network(Arc<Network>),
}

impl StoredSnapshot {
    fn version(&self) -> PolicyVersion {
        match self {
            Self::Raw(snapshot) => snapshot.version,
            Self::Network(network) => network.version(),
        }
    }
}

impl SnapshotCache {
    /// Creates an empty cache of at most `capacity` snapshots.
    fn new(layout: SnapshotLayout, capacity: usize) -> Self {
        Self {
            layout,
            capacity,
            cached: VecDeque::with_capacity(capacity),
        }
    }

    /// Creates the cache for a run. Tickets name the newest snapshot, or with policy lag 1 the one
    /// before it: no other is published before their episodes are committed. One more has room
    /// before its ticket arrives.
    pub fn of_run(config: &Config) -> Self {
        let capacity = config.learning.policy_lag as usize + 2;
        Self::new(SnapshotLayout::of(config), capacity)
    }

    /// Adds a snapshot; drops the oldest if the cache is full.
    pub fn insert(&mut self, snapshot: Snapshot) {
        self.cached
            .retain(|cached| cached.version() != snapshot.version);
        if self.cached.len() == self.capacity {
            self.cached.pop_front();
        }
        self.cached.push_back(StoredSnapshot::Raw(snapshot));
    }

    /// Returns the highest version.
    pub fn newest(&self) -> Option<PolicyVersion> {
        self.cached.iter().map(StoredSnapshot::version).max()
    }

    /// Returns `true` if the cache holds this version.
    pub fn holds(&self, version: PolicyVersion) -> bool {
        self.cached.iter().any(|cached| cached.version() == version)
    }

    /// Returns the network of this version, if the cache holds it.
    pub fn network(&mut self, version: PolicyVersion) -> Option<Arc<Network>> {
        let cached = self
            .cached
            .iter_mut()
            .find(|cached| cached.version() == version)?;
        if let StoredSnapshot::Raw(snapshot) = cached {
            *cached = StoredSnapshot::Network(Arc::new(Network::new(snapshot, &self.layout)));
        }
        match cached {
            StoredSnapshot::Network(network) => Some(Arc::clone(network)),
            StoredSnapshot::Raw(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use skein_protocol::config::{Observation, ObservationLayout};

    fn weights(versions: impl IntoIterator<Item = u64>) -> SnapshotCache {
        let layout = SnapshotLayout::new(&ObservationLayout::present(Observation::Latent, 32), 1);
        let values = layout.values();
        let mut weights = SnapshotCache::new(layout, 4);
        for version in versions {
            weights.insert(Snapshot {
                version: PolicyVersion(version),
                values: vec![version as f32; values],
            });
        }
        weights
    }

    #[test]
    fn the_newest_snapshots_are_kept_and_the_oldest_is_dropped() {
        let mut weights = weights(0..6);
        assert_eq!(weights.newest(), Some(PolicyVersion(5)));
        assert!(!weights.holds(PolicyVersion(1)) && weights.holds(PolicyVersion(2)));
        assert!(weights.network(PolicyVersion(1)).is_none());
        assert_eq!(
            weights.network(PolicyVersion(2)).unwrap().version(),
            PolicyVersion(2)
        );
    }

    #[test]
    fn a_network_is_built_once_and_outlives_its_cache_entry() {
        let mut weights = weights(0..4);
        let network = weights.network(PolicyVersion(0)).unwrap();
        assert!(Arc::ptr_eq(
            &network,
            &weights.network(PolicyVersion(0)).unwrap()
        ));
        weights.insert(Snapshot {
            version: PolicyVersion(9),
            values: vec![0.0; weights.layout.values()],
        });
        assert!(!weights.holds(PolicyVersion(0)));
        assert_eq!(network.version(), PolicyVersion(0));
    }

    #[test]
    fn a_version_sent_again_is_stored_once() {
        let mut weights = weights([0, 1, 2, 2, 2, 2]);
        assert!(weights.holds(PolicyVersion(0)));
        assert_eq!(weights.newest(), Some(PolicyVersion(2)));
        assert!(weights.network(PolicyVersion(2)).is_some());
    }
}
