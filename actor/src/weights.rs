//! The snapshots an actor holds: the newest few, so that an episode may use the one its ticket
//! names while the learner goes on.

use std::collections::VecDeque;
use std::sync::Arc;

use skein_protocol::config::Config;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

use skein_inference::Network;

/// The newest snapshots.
#[derive(Debug)]
pub struct Weights {
    layout: SnapshotLayout,
    most: usize,
    /// In order of arrival, the newest last.
    held: VecDeque<Held>,
}

#[derive(Debug)]
enum Held {
    /// As it came; most are never flown by this actor, and rearranging takes milliseconds.
    Raw(Snapshot),
    /// Ready to be flown.
    Network(Arc<Network>),
}

impl Held {
    fn version(&self) -> PolicyVersion {
        match self {
            Self::Raw(snapshot) => snapshot.version,
            Self::Network(network) => network.version(),
        }
    }
}

impl Weights {
    /// No snapshot yet, and never more than the `most` that came last.
    fn new(layout: SnapshotLayout, most: usize) -> Self {
        Self {
            layout,
            most,
            held: VecDeque::with_capacity(most),
        }
    }

    /// For a run. Tickets name the newest snapshot, an evaluation's too, and with policy lag 1 the
    /// one before it: no other is published before their episodes are committed. One more is there
    /// for what comes before its ticket.
    pub fn of_run(config: &Config) -> Self {
        let most = config.learning.policy_lag as usize + 2;
        Self::new(SnapshotLayout::of(config), most)
    }

    /// Takes in a snapshot; the one that came first goes when there are too many.
    pub fn insert(&mut self, snapshot: Snapshot) {
        self.held.retain(|held| held.version() != snapshot.version);
        if self.held.len() == self.most {
            self.held.pop_front();
        }
        self.held.push_back(Held::Raw(snapshot));
    }

    /// The highest version held.
    pub fn newest(&self) -> Option<PolicyVersion> {
        self.held.iter().map(Held::version).max()
    }

    /// Whether this version is held.
    pub fn holds(&self, version: PolicyVersion) -> bool {
        self.held.iter().any(|held| held.version() == version)
    }

    /// The network of this version, if it is held.
    pub fn network(&mut self, version: PolicyVersion) -> Option<Arc<Network>> {
        let held = self
            .held
            .iter_mut()
            .find(|held| held.version() == version)?;
        if let Held::Raw(snapshot) = held {
            *held = Held::Network(Arc::new(Network::new(snapshot, &self.layout)));
        }
        match held {
            Held::Network(network) => Some(Arc::clone(network)),
            Held::Raw(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use skein_protocol::config::{Observation, View};

    fn weights(versions: impl IntoIterator<Item = u64>) -> Weights {
        let layout = SnapshotLayout::new(&View::present(Observation::Latent, 32), 1);
        let values = layout.values();
        let mut weights = Weights::new(layout, 4);
        for version in versions {
            weights.insert(Snapshot {
                version: PolicyVersion(version),
                values: vec![version as f32; values],
            });
        }
        weights
    }

    #[test]
    fn the_newest_are_held_and_the_first_to_come_goes() {
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
    fn a_network_is_made_once_and_outlives_its_place() {
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
    fn a_version_sent_again_takes_no_second_place() {
        let mut weights = weights([0, 1, 2, 2, 2, 2]);
        assert!(weights.holds(PolicyVersion(0)));
        assert_eq!(weights.newest(), Some(PolicyVersion(2)));
        assert!(weights.network(PolicyVersion(2)).is_some());
    }
}
