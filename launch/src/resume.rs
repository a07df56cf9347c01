//! What must hold for a run to be gone on with, and who may do it.

use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use skein_protocol::summary::RunEnding;
use skein_run::{LockError, PathError, RunDirectory, RunError, SupervisorLock};

use skein_prepare::room::{check_folders, check_shared_memory};
use skein_prepare::{PrepareError, Prepared, check};

/// Between two looks whether an earlier learner is gone.
const LOOK: Duration = Duration::from_millis(100);

/// Why a run cannot be gone on with.
#[derive(Debug, thiserror::Error)]
pub enum ResumeError {
    /// There is no run in the directory.
    #[error(
        "{} is not the directory of a run, it holds no {}: give the one that the run's first lines named",
        directory.display(),
        missing.display()
    )]
    NotARun {
        /// The directory.
        directory: PathBuf,
        /// What it should hold.
        missing: PathBuf,
    },
    /// All of it is done.
    #[error(
        "the run in {} is complete, all {episodes} episodes of it: there is nothing to go on with; start a new one for more. target/release/skein report --run {} draws its plots again, launch/evaluate.sh --run {} flies its best snapshot again",
        directory.display(),
        directory.display(),
        directory.display()
    )]
    Complete {
        /// Its directory.
        directory: PathBuf,
        /// Its training episodes.
        episodes: u64,
    },
    /// Somebody is at it.
    #[error(
        "the run in {} is under way: give it more actors with launch/attach_actor.sh --run {}, or stop it first",
        .0.display(),
        .0.display()
    )]
    UnderWay(PathBuf),
    /// It is of another version, was changed, or cannot be started on this machine.
    #[error(transparent)]
    Prepare(#[from] PrepareError),
    /// Its files cannot be used.
    #[error(transparent)]
    Run(#[from] RunError),
    /// Its transport cannot be looked at: it is another user's.
    #[error(transparent)]
    Place(#[from] PathError),
    /// It is under way in another directory, of which this one is a copy.
    #[error("the run in {} is under way in another directory, of which this one is a copy: {source}", directory.display())]
    Copy {
        /// The directory.
        directory: PathBuf,
        /// Who is at it.
        #[source]
        source: LockError,
    },
}

/// Checks that the run in `directory` can be gone on with by `actors` actors, and claims it. A
/// learner that nobody supervises is given `patience` to end.
///
/// # Errors
/// [`ResumeError`]; nothing was changed then.
pub fn resume(
    directory: &Path,
    actors: usize,
    patience: Duration,
) -> Result<(Prepared, SupervisorLock), ResumeError> {
    let not_a_run = |missing: &Path| ResumeError::NotARun {
        directory: directory.to_owned(),
        missing: missing.to_owned(),
    };
    let run = RunDirectory::new(
        directory
            .canonicalize()
            .map_err(|_| not_a_run(Path::new("run.json")))?,
    );
    if !run.identity().is_file() {
        return Err(not_a_run(Path::new("run.json")));
    }
    let (identity, config) = run.open()?;
    let under_way = || ResumeError::UnderWay(run.root().to_owned());
    // Whoever only looks whether it is taken holds it for a moment.
    let lock = in_time(LOOK * 5, || match SupervisorLock::take(&run, &identity) {
        Err(LockError::Taken { lock, .. }) if lock == run.root() => Ok(None),
        Err(LockError::Path(error)) => Err(error.into()),
        taken => taken.map(Some).map_err(|source| ResumeError::Copy {
            directory: run.root().to_owned(),
            source,
        }),
    })?
    .ok_or_else(under_way)?;
    in_time(patience, || {
        Ok::<_, PathError>((!identity.is_learner_alive()?).then_some(()))
    })?
    .ok_or_else(under_way)?;
    if let Some(summary) = run.summary()
        && summary.ending == RunEnding::Completed
    {
        return Err(ResumeError::Complete {
            directory: run.root().to_owned(),
            episodes: summary.episodes,
        });
    }
    run.make_folders()?;
    check(&run.config(), &config, actors)?;
    check_shared_memory(&config, actors).map_err(PrepareError::from)?;
    check_folders().map_err(PrepareError::from)?;
    Ok((
        Prepared {
            run,
            identity,
            config,
            new: None,
        },
        lock,
    ))
}

/// Looks again and again for what `look` may find, for so long.
fn in_time<T, E>(
    patience: Duration,
    look: impl Fn() -> Result<Option<T>, E>,
) -> Result<Option<T>, E> {
    let deadline = Instant::now() + patience;
    loop {
        match look()? {
            None if Instant::now() < deadline => sleep(LOOK),
            found => return Ok(found),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use skein_protocol::config::Config;

    use super::*;
    use skein_prepare::prepare;

    /// A run of the shipped small configuration in a folder of `directory`, ready to be started.
    fn prepared_run(directory: &Path) -> Prepared {
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/smoke.toml");
        prepare(&config, &[], &directory.join("run"), 1).unwrap()
    }

    fn refusal(directory: &Path) -> String {
        resume(directory, 1, Duration::ZERO)
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn an_unfinished_run_can_be_gone_on_with_by_one_supervisor() {
        let directory = tempfile::tempdir().unwrap();
        let prepared = prepared_run(directory.path());
        let (resumed, lock) = resume(prepared.run.root(), 3, Duration::ZERO).unwrap();
        assert_eq!(
            (&resumed.identity, &resumed.config),
            (&prepared.identity, &prepared.config)
        );
        assert!(refusal(prepared.run.root()).contains("is under way"));
        drop(lock);
        assert!(resume(prepared.run.root(), 1, Duration::ZERO).is_ok());
    }

    #[test]
    fn what_is_no_run_is_refused_with_what_to_give_instead() {
        let directory = tempfile::tempdir().unwrap();
        for path in [directory.path(), Path::new("/nowhere")] {
            let error = refusal(path);
            assert!(error.contains("not the directory of a run"), "{error}");
        }
    }

    #[test]
    fn a_changed_run_and_too_many_actors_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let run = prepared_run(directory.path()).run;
        let actors = Config::default().transport.max_actors + 1;
        let error = resume(run.root(), actors, Duration::ZERO)
            .unwrap_err()
            .to_string();
        assert!(error.contains("max_actors"), "{error}");
        let text = fs::read_to_string(run.config())
            .unwrap()
            .replace("seed = 1", "seed = 2");
        fs::write(run.config(), text).unwrap();
        assert!(refusal(run.root()).contains("was changed"));
    }
}
