//! Work due between two epochs, and the files after a stop.

use skein_protocol::transition::Outcome;
use skein_run::LearnerLock;
use tempfile::TempDir;

use super::*;
use crate::checkpoint::{BestSnapshot, EpisodeWalls};
use crate::episode::samples;
use crate::error::UpdateError;
use crate::trainer::MetricMeans;

/// A run that has just begun, without actors.
struct BegunRun {
    _folder: TempDir,
    directory: RunDirectory,
    identity: RunIdentity,
    config: Config,
    lock: LearnerLock,
    stop: Arc<AtomicBool>,
}

impl BegunRun {
    fn new(change: impl FnOnce(&mut Config)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let directory = RunDirectory::new(folder.path());
        let mut config = Config::default();
        config.run.learner_threads = 1;
        config.run.episodes = 40;
        config.learning.episodes_per_epoch = 10;
        config.checkpoints.every_episodes = 20;
        config.transport.max_actors = 1;
        config.sac.hidden_width = 8;
        change(&mut config);
        directory.create(&config).unwrap();
        let (identity, config) = directory.open().unwrap();
        Self {
            lock: LearnerLock::take(&directory, &identity).unwrap(),
            _folder: folder,
            directory,
            identity,
            config,
            stop: Arc::default(),
        }
    }

    fn begin(&self) -> Training<'_> {
        let incarnation = self.lock.incarnation();
        let (directory, identity) = (&self.directory, &self.identity);
        Training::begin(directory, identity, incarnation, &self.config, &self.stop).unwrap()
    }
}

impl Training<'_> {
    /// Does the counting of an epoch that taught nothing.
    fn skip_epoch(&mut self) {
        self.progress.epochs += 1;
        self.progress.episodes += self.config.learning.episodes_per_epoch;
        self.publish_if_due(0).unwrap();
    }

    /// Confirms the present snapshot as the best.
    fn find_best(&mut self) {
        self.progress.latest_candidate = Some(self.progress.episodes);
        self.progress.best = Some(BestSnapshot {
            policy_version: self.progress.version().0,
            episodes: self.progress.episodes,
            window_walls_passed: 1.0,
            confirmed: vec![EpisodeWalls { passed: 1, of: 5 }],
        });
        let best = self.directory.best_snapshot();
        self.save_snapshot(self.progress.version(), &best).unwrap();
    }

    /// Versions in the files of the best and the latest snapshot.
    fn on_disk(&self) -> [Option<u64>; 2] {
        [
            self.directory.best_snapshot(),
            self.directory.latest_snapshot(),
        ]
        .map(|path| {
            path.exists()
                .then(|| Snapshot::load(&path).unwrap().0.version.0)
        })
    }
}

#[test]
fn after_an_abandoned_epoch_all_files_are_those_of_the_checkpoint() {
    let run = BegunRun::new(|_| {});
    let mut training = run.begin();
    training.skip_epoch();
    training.find_best();
    assert_eq!(training.on_disk(), [Some(1), None]);
    // There is no checkpoint yet.
    assert_eq!(training.roll_back().unwrap().best, None);
    assert_eq!(training.on_disk(), [None, None]);

    training.skip_epoch();
    training.find_best();
    training.checkpoint().unwrap();
    training.skip_epoch();
    training.find_best();
    assert_eq!(training.on_disk(), [Some(2), Some(1)]);
    let progress = training.roll_back().unwrap();
    assert_eq!(progress.best.as_ref().unwrap().policy_version, 1);
    assert_eq!(training.on_disk(), [Some(1), Some(1)]);
    let end = Ok((RunEnding::Interrupted, progress));
    let summary = training.conclude(end).unwrap();
    assert_eq!(summary.best_version, Some(PolicyVersion(1)));
    assert_eq!(summary.final_version, PolicyVersion(1));
}

#[test]
fn a_policy_to_start_from_is_the_first_candidate() {
    let folder = tempfile::tempdir().unwrap();
    let run = BegunRun::new(|config| {
        let path = folder.path().join("policy.safetensors");
        let layout = SnapshotLayout::of(config);
        let snapshot = Snapshot {
            version: PolicyVersion(7),
            values: vec![0.0; layout.values()],
        };
        std::fs::write(&path, snapshot.to_file(&layout, config)).unwrap();
        config.vae.train_steps = 0;
        config.vae.start_from = Some(path.clone());
        config.learning.start_from = Some(path);
    });
    let mut training = run.begin();
    assert!(training.is_candidate());
    training.progress.latest_candidate = Some(0);
    assert!(!training.is_candidate(), "it is flown once");
    let other = BegunRun::new(|_| {});
    assert!(!other.begin().is_candidate());
}

#[test]
fn a_checkpoint_is_due_every_so_many_episodes_since_the_last() {
    let run = BegunRun::new(|_| {});
    let mut training = run.begin();
    let mut saved = Vec::new();
    for _ in 0..4 {
        training.skip_epoch();
        training.checkpoint_if_due().unwrap();
        saved.push(training.saved.episodes);
    }
    assert_eq!(saved, [0, 20, 20, 40]);
}

/// A run stopped after a confirmation must not fly it again.
#[test]
fn a_checkpoint_holds_the_last_candidate_even_if_no_epoch_followed_the_one_before() {
    let run = BegunRun::new(|_| {});
    let mut training = run.begin();
    training.skip_epoch();
    training.checkpoint().unwrap();
    assert_eq!(training.saved.latest_candidate, None);
    training.find_best();
    training.checkpoint().unwrap();
    assert_eq!(training.saved.latest_candidate, Some(10));
    assert_eq!(training.saved.best, training.progress.best);
}

#[test]
fn as_many_epochs_are_ordered_ahead_as_the_policy_lags_and_none_beyond_the_end() {
    for (lag, expected) in [
        (0, [vec![(0, 0)], vec![(1, 1)], vec![(2, 2)], vec![(3, 3)]]),
        (
            1,
            [
                vec![(0, 0), (1, 0)],
                vec![(1, 0), (2, 1)],
                vec![(2, 1), (3, 2)],
                vec![(3, 2)],
            ],
        ),
    ] {
        let run = BegunRun::new(|config| config.learning.policy_lag = lag);
        let mut training = run.begin();
        for orders in expected {
            training.order_ahead().unwrap();
            let in_flight = training.in_flight.iter().map(|epoch| epoch.order);
            let in_flight: Vec<_> = in_flight
                .map(|order| (order.epoch, order.policy_version))
                .collect();
            assert_eq!(in_flight, orders, "epochs with their versions, lag {lag}");
            training.in_flight.pop_front();
            training.skip_epoch();
        }
    }
}

#[test]
fn a_snapshot_follows_every_epoch_and_within_an_episode_every_update() {
    let run = BegunRun::new(|_| {});
    let mut training = run.begin();
    let mut versions = Vec::new();
    for (is_mid_episode, updates) in [(false, 0), (false, 1), (true, 0), (true, 1)] {
        training.open_episode = is_mid_episode.then(|| samples::episode(0, 1, Outcome::Collided));
        training.publish_if_due(updates).unwrap();
        versions.push(training.progress.version().0);
    }
    assert_eq!(versions, [1, 2, 2, 3]);
}

#[test]
fn snapshots_are_kept_while_they_fly_or_are_the_best() {
    let run = BegunRun::new(|config| config.learning.policy_lag = 1);
    let mut training = run.begin();
    let kept = |training: &Training<'_>| -> Vec<u64> {
        training.snapshots.keys().map(|version| version.0).collect()
    };
    training.order_ahead().unwrap();
    training.find_best();
    training.in_flight.pop_front();
    training.skip_epoch();
    training.order_ahead().unwrap();
    assert_eq!(kept(&training), [0, 1]);
    training.in_flight.pop_front();
    training.skip_epoch();
    assert_eq!(kept(&training), [0, 1, 2], "the best, flown, the newest");
    training.in_flight.clear();
    training.skip_epoch();
    assert_eq!(kept(&training), [0, 3]);
    training.find_best();
    training.skip_epoch();
    assert_eq!(kept(&training), [3, 4]);
}

#[test]
fn the_last_snapshot_is_a_candidate_once_whatever_was_flown() {
    let run = BegunRun::new(|_| {});
    let mut training = run.begin();
    training.progress.episodes = 39;
    assert!(!training.is_candidate());
    training.progress.episodes = 40;
    assert!(training.is_candidate());
    training.progress.latest_candidate = Some(40);
    assert!(!training.is_candidate());
}

#[test]
fn a_run_counts_as_trained_from_the_configured_rate_on_and_only_once() {
    let run = BegunRun::new(|config| config.evaluation.trained_rate = 0.5);
    let mut training = run.begin();
    let passed = |passed| [EpisodeWalls { passed, of: 4 }];
    training.note_trained(&passed(1));
    assert!(training.progress.trained.is_none());
    training.note_trained(&passed(2));
    assert_eq!(training.progress.trained.unwrap().rate, 0.5);
    training.progress.episodes = 10;
    training.note_trained(&passed(4));
    assert_eq!(training.progress.trained.unwrap().episodes, 0);
}

/// The VAE is frozen in the first epoch. The policy must learn from the codes computed again then,
/// and the snapshot must hold what both learned.
#[test]
fn an_epoch_trains_the_vae_then_the_policy_and_publishes_both() {
    let run = BegunRun::new(|config| {
        (config.run.episodes, config.learning.episodes_per_epoch) = (4, 2);
        (config.learning.warmup_steps, config.sac.batch_size) = (4, 4);
        config.learning.updates_per_step = 0.25;
        config.vae.train_steps = 15;
        (config.vae.updates_per_step, config.vae.batch_size) = (0.2, 2);
    });
    let mut training = run.begin();
    let mut by_hand = Trainer::new(&run.config).unwrap();
    for epoch in 0..2 {
        let episode = |number| {
            let mut flown = samples::episode(2 * epoch + number, 10, Outcome::Collided);
            flown.rewards.fill(0.5);
            samples::with_images(flown)
        };
        training.learn_from([0, 1].map(episode).to_vec()).unwrap();

        (0..2).for_each(|number| by_hand.take_in(episode(number)).unwrap());
        let (version, mut timer) = (PolicyVersion(epoch), LapTimer::start());
        by_hand
            .train_vae(version, &mut timer, |_| Ok::<_, UpdateError>(()))
            .unwrap();
        let means = &mut MetricMeans::default();
        by_hand
            .train_policy(version, &mut timer, means, |_| Ok::<_, UpdateError>(()))
            .unwrap();
        let expected = by_hand.snapshot(PolicyVersion(epoch + 1));
        let published = training.snapshots.keys().next_back();
        assert_eq!(published, Some(&expected.version));
        assert!(
            training.snapshots[&expected.version] == expected,
            "epoch {epoch}"
        );
    }
    let trainer = &training.trainer;
    assert_eq!((trainer.vae_updates(), trainer.updates()), (3, 9));
    assert_eq!(training.progress.episodes, 4);
}

#[test]
fn an_episode_in_segments_is_counted_once_and_recorded_whole() {
    let run = BegunRun::new(|config| {
        config.learning.segment_steps = 4;
        config.learning.episodes_per_epoch = 1;
        config.learning.warmup_steps = 1000;
        config.replay.success_share = 0.0;
        config.transport.max_records_per_episode = 40;
        config.simulator.insert("max_steps".to_owned(), 30.into());
    });
    let mut training = run.begin();
    let mut counted = Vec::new();
    for (first_step, outcome) in [(0, None), (4, None), (8, Some(Outcome::Collided))] {
        let mut segment = samples::with_images(samples::episode(0, 4, Outcome::Collided));
        (segment.first_step, segment.outcome) = (first_step, outcome);
        training.learn_from(vec![segment]).unwrap();
        let open = training.open_episode.as_ref();
        counted.push((
            training.progress.episodes,
            training.metrics.state().episodes,
            open.map(CommittedEpisode::steps),
        ));
    }
    assert_eq!(counted, [(0, 0, Some(4)), (0, 0, Some(8)), (1, 1, None)]);
    assert_eq!(training.trainer.steps(), 12);
    training.metrics.flush().unwrap();
    let rows = std::fs::read_to_string(run.directory.episodes_csv()).unwrap();
    let row: Vec<_> = rows.lines().nth(1).unwrap().split(',').collect();
    assert_eq!(row[5], "12", "steps in {rows}");
}
