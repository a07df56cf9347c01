//! The Python package `skein-rl-actor`: a user's own environment flies tickets of a run.
//!
//! `skein_rl.Actor` is its face. It has a wheel of its own because only it needs the transport.
//! What speaks to the learner is the service of `skein-actor`; [`foreign`] stands in the
//! simulator's place.

mod foreign;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use pyo3::exceptions::{PyConnectionError, PyValueError};
use pyo3::prelude::*;
use rustix::fs::Mode;
use skein_actor::service::{ExitReason, Service};
use skein_inference::Network;
use skein_protocol::ids::ActorIncarnation;
use skein_protocol::policy_file::teacher_policy;
use skein_protocol::snapshot::SnapshotLayout;
use skein_rollout::agent::Agent;
use skein_rollout::courses::Courses;
use skein_rollout::environment_loop::EnvironmentLoop;
use skein_run::failure::with_causes;
use skein_run::logging::{LogFormat, log_within};
use skein_run::{Presence, RunDirectory};

use crate::foreign::{Failure, ForeignWorlds};

/// Function behind `skein_rl.Actor`.
#[pymodule(name = "skein_rl_actor")]
fn face(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(join, module)?)?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))
}

/// Flies tickets of the run in `run_dir` in the environment behind `bridge`, until the run is over
/// or an exception ends this actor. Returns `True` if the run is over.
///
/// # Errors
/// What the environment raised; `KeyboardInterrupt`; `ValueError` if the run cannot be joined;
/// `ConnectionError` if its learner is gone.
#[pyfunction]
fn join(py: Python<'_>, run_dir: PathBuf, bridge: Py<PyAny>) -> PyResult<bool> {
    let failure = Failure::default();
    let ending = py.detach(|| fly(&run_dir, bridge, &failure));
    // An exception of Python's is the reason for whatever else went wrong.
    if let Some(error) = failure.take() {
        return Err(error);
    }
    match ending? {
        Ending::Of(ExitReason::Stopped) => Ok(true),
        Ending::Of(ExitReason::Signalled) => Ok(false),
        Ending::Of(ExitReason::LearnerSilent) => Err(PyConnectionError::new_err(format!(
            "no learner of the run in {} sent a heartbeat for transport.learner_silence_secs: the \
             run is over or its learner is gone; join while it runs, or resume it with \
             launch/run_local.sh --resume",
            run_dir.display()
        ))),
        Ending::Full { most } => Err(PyValueError::new_err(format!(
            "the run in {} has all the actors of transport.max_actors = {most}: end one, or start \
             the run with a larger number",
            run_dir.display()
        ))),
    }
}

/// How the actor ended.
enum Ending {
    Of(ExitReason),
    /// The run has as many actors as it allows.
    Full {
        most: usize,
    },
}

fn fly(run_dir: &Path, bridge: Py<PyAny>, failure: &Failure) -> PyResult<Ending> {
    let directory = RunDirectory::new(run_dir);
    let (identity, config) = directory.open().map_err(refused)?;
    let claim = directory.claim_actor().map_err(refused)?;
    let most = config.transport.max_actors;
    if claim.id().0 as usize >= most {
        return Ok(Ending::Full { most });
    }
    let courses = Arc::new(Courses::of_run(&config).map_err(refused)?);
    let teacher = teacher_policy(&config).map_err(refused)?;
    let log = directory.actor_log(claim.id());
    let mask = Umask::remember();
    let ending = log_within(&log, LogFormat::from_environment(), || {
        tracing::info!(actor = %claim.id(), run = %identity.run, "actor in Python started");
        let _presence = Presence::enter(&identity).map_err(refused)?;
        let worlds = ForeignWorlds::new(bridge, &config, courses, failure);
        // Each join assigns a new incarnation.
        let mut environment_loop = EnvironmentLoop::new(
            claim.id(),
            ActorIncarnation(0),
            worlds,
            Agent::new(config.observation_layout()),
        );
        if let Some((snapshot, trained)) = teacher {
            environment_loop = environment_loop.with_teacher(
                Network::new(&snapshot, &SnapshotLayout::of(&trained)),
                Agent::new(trained.observation_layout()),
            );
        }
        let exit_requested = || failure.ends();
        Service::new(&identity, &config, claim.id(), &exit_requested)
            .serve(&mut environment_loop)
            .map_err(|error| PyConnectionError::new_err(with_causes(&error)))
    });
    drop(mask);
    let ending =
        ending.map_err(|error| refused(format!("cannot write {}: {error}", log.display())))??;
    Ok(Ending::Of(ending))
}

/// The process's umask, which entering a run narrows: it is the user's again afterwards.
struct Umask(Mode);

impl Umask {
    fn remember() -> Self {
        let mask = rustix::process::umask(Mode::empty());
        rustix::process::umask(mask);
        Self(mask)
    }
}

impl Drop for Umask {
    fn drop(&mut self) {
        rustix::process::umask(self.0);
    }
}

/// Returns a `ValueError` with this message.
fn refused(message: impl ToString) -> PyErr {
    PyValueError::new_err(message.to_string())
}
