//! `skein-actor`: an actor process of a run.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use anyhow::Context;
use clap::Parser;
use skein_actor::recorder::Recorder;
use skein_actor::service::{ExitReason, Service};
use skein_inference::Network;
use skein_kernels::Isa;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::policy_file::teacher_policy;
use skein_protocol::snapshot::SnapshotLayout;
use skein_rollout::agent::Agent;
use skein_rollout::courses::{Courses, Simulators};
use skein_rollout::environment_loop::EnvironmentLoop;
use skein_run::allocation::{EndWithoutMemory, return_large_blocks};
use skein_run::failure::{EXIT_LEARNER_GONE, EXIT_OUT_OF_MEMORY, with_causes};
use skein_run::logging::{LogFormat, log_to_file};
use skein_run::note;
use skein_run::signals::{end_on_signal, survive_file_size_limit};
use skein_run::{Presence, RunDirectory};
use skein_simulator::camera::InstructionSet;
use tracing::{error, info};

/// Flies episodes for a run, until the run is over.
///
/// Actors may join and leave at any time: the result does not depend on them. If the learner dies,
/// an actor waits for its next incarnation. The log is logs/actor-ID.log in the run's directory
/// (RUST_LOG filters it, SKEIN_LOG_FORMAT=json sets its format). Exit status: 0 when the run is
/// over or on SIGTERM or SIGINT, 1 on an error, 3 when no learner sent a heartbeat for
/// transport.learner_silence_secs.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Directory of the run.
    #[arg(long, value_name = "DIR")]
    run: PathBuf,
    /// Number of this actor, unique within the run; by default the lowest free one.
    #[arg(long, value_name = "ID")]
    id: Option<u32>,
}

#[global_allocator]
static ALLOCATOR: EndWithoutMemory = EndWithoutMemory {
    program: "skein-actor",
    status: EXIT_OUT_OF_MEMORY,
};

fn main() -> ExitCode {
    survive_file_size_limit();
    return_large_blocks();
    match run(&Arguments::parse()) {
        Ok(ExitReason::Stopped | ExitReason::Signalled) => ExitCode::SUCCESS,
        Ok(ExitReason::LearnerSilent) => {
            note!(
                "skein-actor: no learner of this run sent a heartbeat for \
                transport.learner_silence_secs; exiting"
            );
            ExitCode::from(EXIT_LEARNER_GONE)
        }
        Err(error) => {
            let error = with_causes(error.as_ref());
            error!(error, "actor failed");
            note!("skein-actor: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> anyhow::Result<ExitReason> {
    let exit_requested = end_on_signal().context("cannot listen for SIGTERM and SIGINT")?;
    let directory = RunDirectory::new(&arguments.run);
    let (identity, config) = directory.open()?;
    // The process that chose the number holds the claim to it.
    let (actor, _claim) = match arguments.id {
        Some(id) => (ActorId(id), None),
        None => {
            let claim = directory.claim_actor()?;
            (claim.id(), Some(claim))
        }
    };
    let log = directory.actor_log(actor);
    log_to_file(&log, LogFormat::from_environment())
        .with_context(|| format!("cannot write {}", log.display()))?;

    let (isa, camera) = (Isa::best(), InstructionSet::best());
    info!(%actor, pid = std::process::id(), run = %identity.run, %isa, %camera, "actor started");
    let _presence = Presence::enter(&identity)?;
    let courses = Arc::new(Courses::of_run(&config)?);
    let recorder = Recorder::start(&config, directory.recordings(), Arc::clone(&courses))
        .context("cannot start the thread that records")?;
    let simulators = Simulators::new(courses);
    // Each join assigns a new incarnation.
    let mut environment_loop = EnvironmentLoop::new(
        actor,
        ActorIncarnation(0),
        simulators,
        Agent::new(config.observation_layout()),
    );
    if let Some((snapshot, trained)) = teacher_policy(&config)? {
        environment_loop = environment_loop.with_teacher(
            Network::new(&snapshot, &SnapshotLayout::of(&trained)),
            Agent::new(trained.observation_layout()),
        );
    }
    let exit_requested = || exit_requested.load(Ordering::Relaxed);
    let service = Service::new(&identity, &config, actor, &exit_requested).with_recorder(recorder);
    Ok(service.serve(&mut environment_loop)?)
}
