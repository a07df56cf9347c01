//! The paper's rivals as whole runs: a policy that learns from images, without a VAE, and a U-Net
//! in the VAE's place.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;

use rustix::process::Signal;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::summary::Summary;
use skein_tests::{Ended, Recipe};

fn end_to_end(algorithm: &str) -> Recipe {
    Recipe::small()
        .set("learning.encoder=end-to-end")
        .set(&format!("learning.algorithm={algorithm}"))
        .set("run.learner_threads=1")
        .set("learning.updates_per_step=0.1")
        .set("sac.batch_size=8")
        .set("td3.batch_size=8")
        .set("td3.hidden_width=32")
}

fn learners_log(run: &Ended) -> String {
    fs::read_to_string(run.directory.logs().join("learner.log")).unwrap()
}

#[test]
fn without_a_vae_a_run_killed_and_gone_on_with_by_more_actors_learns_the_same_bit_for_bit() {
    let calm = end_to_end("sac").actors(1).finish();
    assert!(
        learners_log(&calm).contains("engine=libtorch"),
        "{}",
        learners_log(&calm)
    );
    let Summary {
        updates,
        vae_updates,
        ..
    } = calm.summary();
    assert!(
        updates > 10 && vae_updates == 0,
        "{updates} updates, {vae_updates} of the VAE"
    );

    let mut run = end_to_end("sac").actors(2).start();
    // After the first checkpoint, amid updates.
    run.until_episodes(25);
    run.process("skein-learner").signal(Signal::KILL);
    run.finish().assert_same_as(&calm);
}

#[test]
fn snapshots_of_such_a_run_are_laid_out_as_ever_and_the_critic_has_trained_their_encoder() {
    let encoder = |run: &Ended| {
        let (snapshot, config) = Snapshot::load(&run.directory.latest_snapshot()).unwrap();
        snapshot.values[SnapshotLayout::of(&config).encoder()].to_vec()
    };
    let trained = end_to_end("td3").finish();
    let untrained = end_to_end("td3")
        .set("learning.updates_per_step=0")
        .finish();
    let (trained_encoder, untrained_encoder) = (encoder(&trained), encoder(&untrained));
    assert_eq!(trained_encoder.len(), untrained_encoder.len());
    assert_ne!(trained_encoder, untrained_encoder);
    // Nothing is there to be reconstructed, and nothing is told of it.
    assert!(!trained.directory.reconstructions().exists());
    assert!(
        !trained
            .directory
            .plots()
            .join("reconstructions.png")
            .exists()
    );
    assert!(trained.directory.plots().join("trajectories.png").exists());
}

#[test]
fn a_u_net_trains_on_libtorch_while_the_policy_stays_on_the_kernels() {
    let u_net = Recipe::small().set("vae.decoder=u-net").finish();
    let log = learners_log(&u_net);
    assert!(
        log.contains("engine=native") && log.contains("vae_engine=libtorch"),
        "{log}"
    );
    assert!(u_net.summary().vae_updates > 5);
    assert!(u_net.directory.plots().join("reconstructions.png").exists());
    let plain = Recipe::small().finish();
    assert_ne!(u_net.summary().policy_sha256, plain.summary().policy_sha256);
}
