//! A trainer restored from a checkpoint continues bit for bit.

use rand::RngExt;
use skein_inference::{Network, Scratch};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{
    AlgorithmName, DecoderName, EncoderTraining, Engine, Observation, TeacherName,
};
use skein_protocol::transition::Outcome;

use super::*;
use crate::checkpoint::{CheckpointState, CheckpointStore};
use crate::episode::samples::{episode, shade, with_images};

/// Episodes per epoch, of 10 steps each.
const EPISODES: u64 = 2;
/// Steps per epoch.
const STEPS: usize = 20;

/// The VAE is trained in the first three epochs, the policy from the second one on.
fn config() -> Config {
    let mut config = Config::default();
    config.run.learner_threads = 1;
    config.learning.warmup_steps = STEPS + 1;
    config.learning.updates_per_step = 0.25;
    config.learning.episodes_per_epoch = EPISODES;
    config.sac.hidden_width = 16;
    config.sac.batch_size = 8;
    config.vae.train_steps = 3 * STEPS;
    config.vae.recode_steps = 2 * STEPS;
    config.vae.updates_per_step = 0.1;
    config.vae.batch_size = 2;
    config.replay.capacity = 70;
    config
}

/// One epoch, as the training loop does it. With a lag, `keep` was chosen when its episodes were
/// ordered.
fn learn(trainer: &mut Trainer, epoch: u64, keep: KeptData) {
    take_in(trainer, epoch, keep);
    update(trainer, PolicyVersion(epoch));
}

fn take_in(trainer: &mut Trainer, epoch: u64, keep: KeptData) {
    for number in epoch * EPISODES..(epoch + 1) * EPISODES {
        let mut flown = episode(number, STEPS / EPISODES as usize, Outcome::Collided);
        flown.level_up[4] = true;
        // Small rewards, so that a critic of so few updates does not diverge.
        flown
            .rewards
            .iter_mut()
            .for_each(|reward| *reward = reward.sin());
        if keep == KeptData::Depth {
            flown = with_images(flown);
        }
        trainer.take_in(flown).unwrap();
    }
}

fn update(trainer: &mut Trainer, version: PolicyVersion) {
    let (mut timer, before) = (
        LapTimer::start(),
        (trainer.vae_updates(), trainer.updates()),
    );
    trainer
        .train_vae(version, &mut timer, |_| Ok::<_, UpdateError>(()))
        .unwrap();
    trainer
        .train_policy(version, &mut timer, &mut MetricMeans::default(), |_| {
            Ok::<_, UpdateError>(())
        })
        .unwrap();
    let done = (
        trainer.vae_updates() - before.0,
        trainer.updates() - before.1,
    );
    let booked = |stage| timer.times().of(stage).count;
    assert_eq!((booked(Stage::SampleImages), booked(Stage::Sample)), done);
    assert_eq!((booked(Stage::VaeStep), booked(Stage::PolicyUpdate)), done);
}

/// No VAE, and so little room for images that those of overwritten transitions are released.
fn end_to_end(algorithm: AlgorithmName) -> Config {
    let mut config = config();
    config.learning.encoder = EncoderTraining::EndToEnd;
    config.learning.algorithm = algorithm;
    config.td3.hidden_width = 16;
    config.td3.batch_size = 8;
    config.transport.max_records_per_episode = 12;
    config
}

fn state(trainer: &mut Trainer, epochs: u64) -> CheckpointState {
    CheckpointState {
        progress: TrainingProgress {
            episodes: epochs * EPISODES,
            epochs,
            version: epochs,
            environment_steps: trainer.steps(),
            vae_steps: trainer.vae_updates(),
            policy_updates: trainer.updates(),
            ..TrainingProgress::start(config().evaluation.window_episodes as usize)
        },
        tensors: trainer.tensors(),
        replay: trainer.replay().state(),
        snapshots: vec![trainer.snapshot(PolicyVersion(epochs))],
    }
}

/// Saves to disk, and restores into a new trainer.
fn resumed(trainer: &mut Trainer, epochs: u64) -> Trainer {
    let directory = tempfile::tempdir().unwrap();
    let config = trainer.config.clone();
    let store = CheckpointStore::new(directory.path(), &config);
    store.save(&state(trainer, epochs), &[]).unwrap();
    let stored = store.load_newest(|_| Ok(()), |_| {}).unwrap().unwrap();
    let mut resumed = Trainer::new(&config).unwrap();
    resumed
        .restore(&stored.progress, &stored.tensors, stored.replay)
        .unwrap();
    assert_eq!(resumed.snapshot(PolicyVersion(epochs)), stored.snapshots[0]);
    resumed
}

/// Trains six epochs, resumed after each of `resumed_after`.
fn train(config: &Config, lag: u64, resumed_after: &[u64]) -> CheckpointState {
    let mut trainer = Trainer::new(config).unwrap();
    // Data to keep of the first epochs' episodes, chosen when they were ordered.
    let mut keep = vec![trainer.keep(); lag as usize];
    for epoch in 0..6 {
        keep.push(trainer.keep());
        learn(&mut trainer, epoch, keep[epoch as usize]);
        if resumed_after.contains(&(epoch + 1)) {
            trainer = resumed(&mut trainer, epoch + 1);
        }
    }
    state(&mut trainer, 6)
}

#[test]
fn a_resumed_trainer_continues_bit_for_bit_whenever_it_is_resumed() {
    for lag in [0, 1] {
        let undisturbed = train(&config(), lag, &[]);
        assert!(undisturbed.progress.vae_steps > 3 && undisturbed.progress.policy_updates > 10);
        assert!(
            undisturbed.replay.images.is_none(),
            "the VAE was never frozen"
        );
        // Resumed while the VAE is trained, when it is frozen after the third epoch, and later.
        for after in [&[2][..], &[1, 2, 3, 4, 5]] {
            let resumed = train(&config(), lag, after);
            assert!(resumed == undisturbed, "lag {lag}, resumed after {after:?}");
        }
    }
}

#[test]
fn end_to_end_training_continues_bit_for_bit_too_and_keeps_its_images_to_the_end() {
    for algorithm in [AlgorithmName::Sac, AlgorithmName::Td3] {
        let config = end_to_end(algorithm);
        let undisturbed = train(&config, 1, &[]);
        let TrainingProgress {
            vae_steps,
            policy_updates,
            environment_steps,
            ..
        } = undisturbed.progress;
        assert_eq!(vae_steps, 0);
        assert!(policy_updates > 10);
        let images: usize = undisturbed
            .replay
            .images
            .iter()
            .flatten()
            .map(|block| block.len())
            .sum();
        let flown = (environment_steps + 6 * EPISODES) as usize * IMAGE_PIXELS;
        assert!(
            0 < images && images < flown,
            "{images} bytes of {flown} flown are held"
        );
        for after in [&[2][..], &[1, 2, 3, 4, 5]] {
            let resumed = train(&config, 1, after);
            assert!(
                resumed == undisturbed,
                "{algorithm}, resumed after {after:?}"
            );
        }
    }
}

#[test]
fn without_a_vae_snapshots_carry_the_encoder_that_the_critic_trains() {
    let mut trainer = Trainer::new(&end_to_end(AlgorithmName::Sac)).unwrap();
    let encoder = |trainer: &Trainer| {
        trainer.snapshot(PolicyVersion(0)).values[trainer.layout.encoder()].to_vec()
    };
    let before = encoder(&trainer);
    assert!(
        before.iter().filter(|value| **value == 0.0).count() < 10,
        "it is initialised"
    );
    (0..3).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
    let moved = encoder(&trainer)
        .iter()
        .zip(&before)
        .filter(|(after, before)| after != before)
        .count();
    assert!(
        moved > before.len() / 2,
        "{moved} of {} numbers moved",
        before.len()
    );
    assert_eq!(
        (trainer.keep(), trainer.reconstruct(&[0; IMAGE_PIXELS])),
        (KeptData::Depth, None)
    );
    assert!(
        trainer
            .tensors()
            .iter()
            .all(|tensor| !tensor.name.starts_with("vae"))
    );
}

#[test]
fn the_policy_average_flies_where_configured_and_does_not_change_learning() {
    let mut averaged = config();
    averaged.learning.average_updates = 8;
    let undisturbed = train(&averaged, 0, &[]);
    assert!(train(&averaged, 0, &[2, 4]) == undisturbed, "resumed");

    // The same episodes teach the same, whichever policy flies.
    let after = |averaged: usize| {
        let mut config = config();
        config.learning.average_updates = averaged;
        let mut trainer = Trainer::new(&config).unwrap();
        (0..6).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
        let policy = trainer.snapshot(PolicyVersion(6)).values[trainer.layout.policy()].to_vec();
        (policy, trainer.algorithm.named_tensors())
    };
    let ((latest, learned), (of_one, _), (of_many, same)) = (after(0), after(1), after(1000));
    assert!(learned == same);
    let distance = |policy: &[f32]| -> f32 {
        let apart = policy
            .iter()
            .zip(&latest)
            .map(|(one, other)| (one - other).abs());
        apart.fold(0.0, f32::max)
    };
    assert!(
        distance(&of_one) < 1e-6,
        "the average over one update is the latest policy: {}",
        distance(&of_one)
    );
    // Its first updates weigh more: the policy that nothing has taught is forgotten.
    let untaught = {
        let trainer = Trainer::new(&config()).unwrap();
        trainer.snapshot(PolicyVersion(0)).values[trainer.layout.policy()].to_vec()
    };
    let from_untaught = |policy: &[f32]| -> f32 {
        let pairs = policy.iter().zip(&untaught);
        pairs.map(|(one, other)| (one - other).abs()).sum()
    };
    assert!(
        from_untaught(&of_many) > 0.5 * from_untaught(&latest),
        "{} of {}",
        from_untaught(&of_many),
        from_untaught(&latest)
    );
    assert!(
        distance(&of_many) > 1e-4,
        "the average over many updates lags behind: {}",
        distance(&of_many)
    );
}

#[test]
fn a_u_net_runs_on_libtorch_and_leaves_the_policys_start_unchanged() {
    let mut config = config();
    config.vae.decoder = DecoderName::UNet;
    let mut trainer = Trainer::new(&config).unwrap();
    assert!(matches!(trainer.source.vae(), Some(Vae::Libtorch(_))));
    let policy = |trainer: &mut Trainer| {
        let mut parts = trainer.algorithm.named_tensors();
        parts.sort_by(|left, right| left.name.cmp(&right.name));
        parts
    };
    let mut plain = Trainer::new(&self::config()).unwrap();
    assert!(
        policy(&mut trainer) == policy(&mut plain),
        "both begin alike"
    );
    (0..4).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
    assert_eq!(
        trainer.keep(),
        KeptData::Latents,
        "the VAE was never frozen"
    );
}

#[test]
fn a_state_that_lacks_a_tensor_or_miscounts_is_refused_by_name() {
    let mut trainer = Trainer::new(&config()).unwrap();
    learn(&mut trainer, 0, KeptData::Depth);
    let mut refusal = |damage: fn(&mut CheckpointState)| {
        let mut state = state(&mut trainer, 1);
        damage(&mut state);
        let mut other = Trainer::new(&config()).unwrap();
        let restored = other.restore(&state.progress, &state.tensors, state.replay);
        restored.unwrap_err().to_string()
    };
    let missing = refusal(|state| {
        state
            .tensors
            .retain(|tensor| tensor.name != "sac.target.parameters")
    });
    assert!(missing.contains("sac.target.parameters"), "{missing}");
    let miscounted = refusal(|state| state.progress.vae_steps += 1);
    assert!(
        miscounted.contains("VAE steps are 2, but its counters say 3"),
        "{miscounted}"
    );
    let images = refusal(|state| _ = state.replay.images.as_mut().unwrap().pop());
    assert!(images.contains("depth images"), "{images}");
}

#[test]
fn once_the_vae_is_frozen_all_stored_codes_are_those_that_actors_make() {
    for (engine, latent) in [
        (Engine::Native, 32),
        (Engine::Libtorch, 32),
        (Engine::Native, 8),
        (Engine::Libtorch, 64),
    ] {
        let mut config = config();
        config.run.engine = Some(engine);
        config.vae.latent = latent;
        let mut trainer = Trainer::new(&config).unwrap();
        // The last epoch arrives late: its images were ordered before the freeze.
        (0..4).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
        assert_eq!(
            trainer.keep(),
            KeptData::Latents,
            "the VAE was never frozen"
        );
        assert!(
            all_codes_are_the_encoders(&trainer, 4),
            "{engine}, {latent} numbers"
        );
    }
}

#[test]
fn episodes_are_stored_a_second_time_mirrored() {
    let mut config = config();
    config.learning.mirror = true;
    config.learning.observation = Observation::LatentVelocityAction;
    config.replay.capacity = 1000;
    let mut trainer = Trainer::new(&config).unwrap();
    (0..3).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
    assert_eq!(
        (trainer.steps(), trainer.replay().len()),
        (3 * STEPS as u64, 6 * STEPS)
    );
    assert_eq!(
        trainer.keep(),
        KeptData::Depth,
        "mirror images are encoded after the VAE is frozen, too"
    );
    assert!(
        trainer.replay().image_count().is_none(),
        "the VAE was never frozen"
    );
    assert!(
        all_codes_are_the_encoders(&trainer, 3),
        "images are of one shade, and look the same in a mirror"
    );
    let mut drawn = Minibatch::default();
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    trainer.replay().sample(&mut rng, 400, &mut drawn);
    let observations = drawn.observations.chunks(drawn.observations.len() / 400);
    let to_the_left = observations
        .zip(drawn.actions.chunks(2))
        .filter(|(seen, action)| {
            assert!(
                seen[32] * action[0] >= 0.0,
                "velocity and action are mirrored together"
            );
            seen[32] > 0.0
        });
    let count = to_the_left.count();
    assert!(
        (150..=250).contains(&count),
        "{count} of 400 go to the left, the side of all flown episodes"
    );
}

#[test]
fn stored_codes_are_recomputed_as_often_as_configured_while_the_vae_is_trained() {
    let mut trainer = Trainer::new(&config()).unwrap();
    let mut renewed = Vec::new();
    for epoch in 0..3 {
        learn(&mut trainer, epoch, KeptData::Depth);
        renewed.push(all_codes_are_the_encoders(&trainer, epoch + 1));
    }
    assert_eq!(renewed, [false, true, true]);
}

/// Steps, policy updates and VAE steps so far, exploration and data of the next orders.
type Due = (u64, u64, u64, Exploration, KeptData);

/// Counts and choices before the first and after each of four epochs.
fn due(config: &Config) -> Vec<Due> {
    let mut trainer = Trainer::new(config).unwrap();
    let now = |trainer: &Trainer| {
        (
            trainer.steps(),
            trainer.updates(),
            trainer.vae_updates(),
            trainer.exploration(),
            trainer.keep(),
        )
    };
    let mut seen = vec![now(&trainer)];
    for epoch in 0..4 {
        let keep = trainer.keep();
        learn(&mut trainer, epoch, keep);
        seen.push(now(&trainer));
    }
    seen
}

#[test]
fn updates_count_from_the_warm_up_and_vae_steps_to_the_freeze_to_the_step() {
    use Exploration::{Sample, Uniform};
    use KeptData::{Depth, Latents};
    let mut config = config();
    // Both limits lie within an epoch: a quarter of an update, a tenth of a VAE step each step.
    (config.learning.warmup_steps, config.vae.train_steps) = (30, 50);
    let within = [
        (0, 0, 0, Uniform, Depth),
        (20, 0, 2, Uniform, Depth),
        (40, 2, 4, Sample, Depth),
        (60, 7, 5, Sample, Latents),
        (80, 12, 5, Sample, Latents),
    ];
    assert_eq!(due(&config), within);
    // Both lie at an epoch's end, which is past them.
    (config.learning.warmup_steps, config.vae.train_steps) = (STEPS, 2 * STEPS);
    let at_the_end = [
        (0, 0, 0, Uniform, Depth),
        (20, 0, 2, Sample, Depth),
        (40, 5, 4, Sample, Latents),
        (60, 10, 4, Sample, Latents),
        (80, 15, 4, Sample, Latents),
    ];
    assert_eq!(due(&config), at_the_end);
}

#[test]
fn the_teachers_share_falls_with_the_steps_flown_and_is_none_without_a_teacher() {
    let mut config = config();
    assert_eq!(Trainer::new(&config).unwrap().teacher_share(), None);
    config.teacher.policy = TeacherName::Oracle;
    (config.teacher.flown_share, config.teacher.flown_steps) = (0.5, 2 * STEPS as u64);
    let mut trainer = Trainer::new(&config).unwrap();
    let mut shares = vec![trainer.teacher_share()];
    for epoch in 0..2 {
        learn(&mut trainer, epoch, KeptData::Depth);
        shares.push(trainer.teacher_share());
    }
    assert_eq!(shares, [Some(0.5), Some(0.25), Some(0.0)]);
}

#[test]
fn mirrored_transitions_make_no_update_due() {
    let mut config = config();
    config.replay.capacity = 1000;
    config.learning.observation = Observation::LatentVelocityAction;
    let plain = due(&config);
    config.learning.mirror = true;
    let counts = |due: &[Due]| {
        let counts = due.iter();
        counts
            .map(|epoch| (epoch.0, epoch.1, epoch.2))
            .collect::<Vec<_>>()
    };
    assert_eq!(counts(&due(&config)), counts(&plain));
}

#[test]
fn mirrored_or_not_an_episode_of_an_older_encoder_is_encoded_again() {
    for lag in [0, 1] {
        let mut config = config();
        config.learning.mirror = true;
        config.learning.observation = Observation::LatentVelocityAction;
        config.learning.policy_lag = lag;
        config.replay.capacity = 1000;
        let mut trainer = Trainer::new(&config).unwrap();
        // Frozen after the third epoch. With a lag, the fourth was flown before that; without one,
        // its codes are the actors' and are believed.
        (0..4).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
        assert_eq!(
            all_codes_are_the_encoders(&trainer, 4),
            lag > 0,
            "lag {lag}"
        );
    }
}

#[test]
fn a_trained_encoder_flies_from_the_first_episode_on_and_nothing_keeps_images() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("encoder.safetensors");
    let mut config = config();
    (config.vae.train_steps, config.vae.start_from) = (0, Some(path.clone()));
    config.replay.capacity = 1000;
    config.learning.mirror = true;
    config.learning.observation = Observation::LatentVelocityAction;
    config.learning.policy_lag = 1;
    let missing = Trainer::new(&config).unwrap_err().to_string();
    assert!(missing.contains("vae.start_from"), "{missing}");

    let len = SnapshotLayout::of(&config).encoder().len();
    let trained = TrainedEncoder {
        values: (0..len).map(|index| 0.01 * (index as f32).sin()).collect(),
        latent: config.vae.latent,
    };
    std::fs::write(&path, trained.to_file(&config, 9)).unwrap();
    let undisturbed = train(&config, 1, &[]);
    assert_eq!(undisturbed.progress.vae_steps, 0);
    assert!(undisturbed.progress.policy_updates > 10);
    assert!(undisturbed.replay.images.is_none());
    assert!(train(&config, 1, &[1, 2, 4]) == undisturbed, "resumed");
    assert_eq!(undisturbed.snapshots[0].values[..len], trained.values);

    // Images come for the mirror alone. The mirrored half is encoded, the other half's codes are
    // the actors' and are believed.
    let mut trainer = Trainer::new(&config).unwrap();
    assert_eq!(trainer.keep(), KeptData::Depth);
    assert_eq!(trainer.reconstruct(&[0; IMAGE_PIXELS]), None);
    learn(&mut trainer, 0, KeptData::Depth);
    let (encoded, all) = encoded_rows(&trainer, 1);
    assert!(0 < encoded && encoded < all, "{encoded} of {all}");

    config.learning.mirror = false;
    assert_eq!(Trainer::new(&config).unwrap().keep(), KeptData::Latents);
}

#[test]
fn every_algorithm_that_can_starts_from_the_policy_of_a_snapshot() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    let mut config = config();
    (config.vae.train_steps, config.vae.start_from) = (0, Some(path.clone()));
    config.learning.average_updates = 10;
    config.replay.capacity = 1000;
    let layout = SnapshotLayout::of(&config);
    let begun = Snapshot {
        version: PolicyVersion(7),
        values: (0..layout.values())
            .map(|place| 0.01 * (place as f32).cos())
            .collect(),
    };
    std::fs::write(&path, begun.to_file(&layout, &config)).unwrap();
    let random = Trainer::new(&config).unwrap().snapshot(PolicyVersion(0));
    assert_ne!(random.values, begun.values);
    config.learning.start_from = Some(path);
    config.learning.warmup_steps = 1000;
    let exploration = Trainer::new(&config).unwrap().exploration();
    assert_eq!(exploration, Exploration::Sample, "the policy warms up");
    let mut distill = config.clone();
    distill.learning.algorithm = AlgorithmName::Distill;
    distill.distill.hidden_width = config.sac.hidden_width;
    let mut libtorch = config.clone();
    libtorch.run.engine = Some(Engine::Libtorch);
    for config in [&config, &distill, &libtorch] {
        let first = Trainer::new(config).unwrap().snapshot(PolicyVersion(0));
        assert!(
            first.values == begun.values,
            "{:?}",
            config.learning.algorithm
        );
    }
    // A policy that does not fit is refused.
    config.learning.history_steps = vec![1];
    let error = Trainer::new(&config).unwrap_err().to_string();
    assert!(error.contains("learning.start_from"), "{error}");
}

#[test]
fn a_restored_trainer_does_not_recode_before_it_is_due() {
    let mut config = config();
    (config.vae.recode_steps, config.vae.train_steps) = (2 * STEPS, 100 * STEPS);
    let mut trainer = Trainer::new(&config).unwrap();
    (0..2).for_each(|epoch| learn(&mut trainer, epoch, KeptData::Depth));
    let mut trainer = resumed(&mut trainer, 2);
    learn(&mut trainer, 2, KeptData::Depth);
    assert!(
        !all_codes_are_the_encoders(&trainer, 3),
        "due after four epochs"
    );
    learn(&mut trainer, 3, KeptData::Depth);
    assert!(all_codes_are_the_encoders(&trainer, 4));
    learn(&mut trainer, 4, KeptData::Depth);
    assert!(
        !all_codes_are_the_encoders(&trainer, 5),
        "due after six epochs"
    );
}

#[test]
fn updates_from_another_snapshot_draw_other_minibatches_and_noise() {
    let after = |versions: [u64; 2]| {
        let mut trainer = Trainer::new(&config()).unwrap();
        for (epoch, version) in (0..).zip(versions) {
            take_in(&mut trainer, epoch, KeptData::Depth);
            update(&mut trainer, PolicyVersion(version));
        }
        let vae = trainer.source.vae_mut().unwrap().named_tensors();
        (vae, trainer.algorithm.named_tensors())
    };
    let (first, again, other) = (after([0, 1]), after([0, 1]), after([0, 2]));
    assert!(first == again);
    assert!(first.0 != other.0, "the VAE's");
    assert!(first.1 != other.1, "the policy's");

    let purposes = (Purpose::PolicyBatches, Purpose::PolicyNoise);
    let drawn = |version| {
        let (mut rng, mut noise) = draws(&config(), purposes, PolicyVersion(version));
        let mut numbers = [0.0];
        noise.fill_normal(&mut numbers);
        (rng.random::<u64>(), numbers)
    };
    assert!(drawn(1).0 != drawn(2).0 && drawn(1).1 != drawn(2).1);
}

/// `true` if the stored codes of the first `epochs` are those that actors would compute with the
/// present encoder.
fn all_codes_are_the_encoders(trainer: &Trainer, epochs: u64) -> bool {
    let (encoded, all) = encoded_rows(trainer, epochs);
    encoded == all
}

/// Number of rows drawn of the first `epochs` whose code is the present encoder's, and of all
/// drawn.
fn encoded_rows(trainer: &Trainer, epochs: u64) -> (usize, usize) {
    let network = Network::new(&trainer.snapshot(PolicyVersion(epochs)), &trainer.layout);
    let code = |(episode, step)| {
        network.encode(
            &[shade(episode, step); IMAGE_PIXELS],
            &mut Scratch::default(),
        )
    };
    let codes: Vec<_> = (0..epochs * EPISODES)
        .flat_map(|episode| (0..=STEPS / EPISODES as usize).map(move |step| (episode, step)))
        .map(code)
        .collect();
    let mut drawn = Minibatch::default();
    let mut rng = Pcg64Mcg::seed_from_u64(9);
    trainer.replay().sample(&mut rng, 200, &mut drawn);
    let rows = drawn.observations.chunks(drawn.observations.len() / 200);
    let latent = trainer.config.vae.latent;
    let encoded = rows.filter(|observation| {
        codes
            .iter()
            .any(|code| code[..latent] == observation[..latent])
    });
    (encoded.count(), 200)
}
