//! The paper's rivals as complete runs: a policy that learns from images, without a VAE, and a
//! U-Net in place of the VAE.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;

use rustix::process::Signal;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::summary::RunSummary;
use skein_tests::{EndedRun, RunRecipe};

fn end_to_end(algorithm: &str) -> RunRecipe {
    RunRecipe::small()
        .set("learning.encoder=end-to-end")
        .set(&format!("learning.algorithm={algorithm}"))
        .set("run.learner_threads=1")
        .set("learning.updates_per_step=0.1")
        .set("sac.batch_size=8")
        .set("td3.batch_size=8")
        .set("td3.hidden_width=32")
}

fn learners_log(run: &EndedRun) -> String {
    fs::read_to_string(run.directory.logs().join("learner.log")).unwrap()
}

#[test]
fn without_a_vae_a_run_killed_and_resumed_with_more_actors_learns_the_same_bit_for_bit() {
    let calm = end_to_end("sac").actors(1).finish();
    assert!(
        learners_log(&calm).contains("engine=libtorch"),
        "{}",
        learners_log(&calm)
    );
    let RunSummary {
        updates,
        vae_updates,
        ..
    } = calm.summary();
    assert!(
        updates > 10 && vae_updates == 0,
        "{updates} updates, {vae_updates} of the VAE"
    );

    let mut run = end_to_end("sac").actors(2).start();
    // After the first checkpoint, during updates.
    run.until_episodes(25);
    run.process("skein-learner").signal(Signal::KILL);
    run.finish().assert_same_as(&calm);
}

#[test]
fn without_a_vae_the_critic_trains_the_encoder_of_ordinary_snapshots() {
    let encoder = |run: &EndedRun| {
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
    // Without a VAE nothing is reconstructed or plotted.
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
    let u_net = RunRecipe::small().set("vae.decoder=u-net").finish();
    let log = learners_log(&u_net);
    assert!(
        log.contains("engine=native") && log.contains("vae_engine=libtorch"),
        "{log}"
    );
    assert!(u_net.summary().vae_updates > 5);
    assert!(u_net.directory.plots().join("reconstructions.png").exists());
    let plain = RunRecipe::small().finish();
    assert_ne!(u_net.summary().policy_sha256, plain.summary().policy_sha256);
}
