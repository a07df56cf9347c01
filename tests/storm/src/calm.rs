//! The run in peace: everything learned, in order, computed without actors.

use std::collections::BTreeMap;

use skein_learner::checkpoint::EpochOrder;
use skein_learner::curriculum;
use skein_learner::episodes::assembly::KeptData;
use skein_protocol::Action;
use skein_protocol::config::Config;
use skein_protocol::ids::{Epoch, PolicyVersion};
use skein_protocol::snapshot::Snapshot;
use skein_protocol::ticket::Exploration;

use crate::flight::{digest_of_ticket, mix};
use crate::shape::RUN;

/// Everything that learning has made so far, as hashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Learned {
    /// Everything taken in, in order.
    pub(crate) replay: u64,
    /// Parameters of the networks.
    pub(crate) params: u64,
    /// Confirmations flown, in order.
    pub(crate) judged: u64,
}

impl Learned {
    /// Before the first episode.
    pub(crate) fn nothing() -> Self {
        Self {
            replay: 1,
            params: 2,
            judged: 3,
        }
    }

    /// Takes in an episode or segment of this digest.
    pub(crate) fn take_in(&mut self, digest: u64) {
        self.replay = mix(self.replay, digest);
    }

    /// Does the updates that are due; returns their number, which may be 0.
    pub(crate) fn update(&mut self) -> u64 {
        let updates = self.replay % 3;
        for _ in 0..updates {
            self.params = mix(self.params, self.replay);
        }
        updates
    }

    /// Judges the confirmation episodes of these digests.
    pub(crate) fn judge(&mut self, digests: impl Iterator<Item = u64>) {
        self.judged = digests.fold(self.judged, mix);
    }

    /// `true` if the present snapshot is a candidate, unless it was confirmed.
    pub(crate) fn is_candidate(&self) -> bool {
        self.params.is_multiple_of(3)
    }

    /// `true` if the candidate just judged is the best so far.
    pub(crate) fn is_best(&self) -> bool {
        self.judged.is_multiple_of(2)
    }

    /// The present parameters as a snapshot.
    pub(crate) fn snapshot(&self, version: PolicyVersion) -> Snapshot {
        // Numbers of sixteen bits, which a single holds exactly.
        let pieces = (0..4).map(|piece| (self.params >> (16 * piece) & 0xffff) as f32);
        Snapshot {
            version,
            values: pieces.collect(),
        }
    }
}

/// Parameters in a snapshot.
pub(crate) fn policy_of(snapshot: &Snapshot) -> u64 {
    let pieces = snapshot.values.iter().rev();
    pieces.fold(0, |policy, piece| policy << 16 | *piece as u64)
}

/// Everything that a calm run learns.
#[derive(Debug)]
pub(crate) struct Calm {
    /// Digest of each episode or segment, in order, and what was learned when it had been taken in.
    pub(crate) taken: Vec<(u64, Learned)>,
    /// Digests of the confirmation episodes, by number of the evaluation.
    pub(crate) judged: Vec<Vec<u64>>,
    /// Everything learned, at the end.
    pub(crate) end: Learned,
    /// Rows of the results.
    pub(crate) results: String,
}

/// Order of `epoch` with the snapshot of this version.
pub(crate) fn order(epoch: u64, version: PolicyVersion) -> EpochOrder {
    EpochOrder {
        epoch,
        policy_version: version.0,
        exploration: Exploration::Sample,
        teacher_share: None,
        keep: KeptData::Latents,
    }
}

/// Row of the results for an episode, given its number and what was learned with it.
pub(crate) fn row(episode: u64, learned: &Learned) -> String {
    format!("{episode},{:016x}\n", learned.replay)
}

impl Calm {
    /// Run of `config`.
    pub(crate) fn of(config: &Config) -> Self {
        let mut run = CalmRun {
            config,
            version: PolicyVersion(0),
            policies: BTreeMap::from([(0, Learned::nothing().params)]),
            calm: Self {
                taken: Vec::new(),
                judged: Vec::new(),
                end: Learned::nothing(),
                results: String::new(),
            },
        };
        run.confirm(0);
        for epoch in 0..curriculum::epochs(config) {
            match config.learning.in_segments() {
                true => run.fly_in_segments(epoch),
                false => run.fly_whole(epoch),
            }
            let done = (epoch + 1) * config.learning.episodes_per_epoch;
            run.confirm(done.min(config.run.episodes));
        }
        run.calm
    }
}

struct CalmRun<'a> {
    config: &'a Config,
    version: PolicyVersion,
    policies: BTreeMap<u64, u64>,
    calm: Calm,
}

impl CalmRun<'_> {
    fn fly_whole(&mut self, epoch: u64) {
        let version = PolicyVersion(epoch.saturating_sub(self.config.learning.policy_lag));
        for ticket in curriculum::training(self.config, RUN, &order(epoch, version), &[]) {
            let policy = self.policies[&version.0];
            let digest = digest_of_ticket(&ticket, Epoch(epoch), policy).digest;
            self.take_in(digest);
            self.end_episode(ticket.episode.0);
        }
        self.calm.end.update();
        self.publish();
    }

    fn fly_in_segments(&mut self, epoch: u64) {
        let mut actions: Vec<Action> = Vec::new();
        loop {
            let order = order(epoch, self.version);
            let ticket = curriculum::training(self.config, RUN, &order, &actions).remove(0);
            let policy = self.policies[&self.version.0];
            let flown = digest_of_ticket(&ticket, Epoch(epoch), policy);
            self.take_in(flown.digest);
            actions.extend(flown.actions.iter().map(|action| {
                let mut whole = Action::default();
                whole[0] = *action;
                whole
            }));
            let is_over = flown.outcome.is_some();
            if is_over {
                self.end_episode(ticket.episode.0);
            }
            let updates = self.calm.end.update();
            if is_over || updates > 0 {
                self.publish();
            }
            if is_over {
                return;
            }
        }
    }

    fn take_in(&mut self, digest: u64) {
        self.calm.end.take_in(digest);
        self.calm.taken.push((digest, self.calm.end));
    }

    fn end_episode(&mut self, episode: u64) {
        self.calm.results += &row(episode, &self.calm.end);
    }

    fn publish(&mut self) {
        self.version.0 += 1;
        self.policies.insert(self.version.0, self.calm.end.params);
    }

    fn confirm(&mut self, episodes: u64) {
        if !self.calm.end.is_candidate() && episodes < self.config.run.episodes {
            return;
        }
        let number = self.calm.judged.len() as u64;
        let tickets = curriculum::confirmation(self.config, RUN, number, self.version);
        let epoch = episodes.div_ceil(self.config.learning.episodes_per_epoch);
        let policy = self.policies[&self.version.0];
        let digests: Vec<u64> = tickets
            .iter()
            .map(|ticket| digest_of_ticket(ticket, Epoch(epoch), policy).digest)
            .collect();
        self.calm.end.judge(digests.iter().copied());
        self.calm.judged.push(digests);
    }
}
