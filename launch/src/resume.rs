//! Checks that a run can be resumed, and claims it.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use skein_run::terminal::quoted;
use skein_run::{LockError, PathError, RunDirectory, RunError, SupervisorLock};

use skein_prepare::room::{
    check_address_space, check_file_size, check_folders, check_shared_memory,
};
use skein_prepare::{PrepareError, Prepared, check};

/// Time between two checks whether an earlier learner has ended.
const LOOK: Duration = Duration::from_millis(100);

/// Reason why a run cannot be resumed.
#[derive(Debug, thiserror::Error)]
pub enum ResumeError {
    /// The directory holds no run.
    #[error(
        "{} is not a run directory: it holds no {}. \
             Give the directory that the run printed when it started",
        directory.display(),
        missing.display()
    )]
    NotARun {
        /// The directory.
        directory: PathBuf,
        /// The file it should hold.
        missing: PathBuf,
    },
    /// All its training episodes are done.
    #[error(
        "the run in {} is complete (all {episodes} episodes), so it cannot be resumed; \
             launch/run_local.sh --resume {} --episodes N lengthens it to N episodes in all, \
             target/release/skein report --run {} draws its plots again, \
             launch/evaluate.sh --run {} flies its best snapshot again",
        directory.display(),
        quoted(directory),
        quoted(directory),
        quoted(directory)
    )]
    Complete {
        /// The run directory.
        directory: PathBuf,
        /// Number of its training episodes.
        episodes: u64,
    },
    /// Another supervisor or learner runs it.
    #[error(
        "the run in {} is under way: add actors with launch/attach_actor.sh --run {}, \
             or stop it first",
        .0.display(),
        quoted(.0)
    )]
    UnderWay(PathBuf),
    /// Another version made the run, it was changed, or this machine cannot start it.
    #[error(transparent)]
    Prepare(#[from] PrepareError),
    /// Its files cannot be read or written.
    #[error(transparent)]
    Run(#[from] RunError),
    /// Its transport belongs to another user.
    #[error(transparent)]
    Path(#[from] PathError),
    /// The run is under way in another directory, of which this one is a copy.
    #[error("the run in {} is under way in another directory, of which this one is a copy: \
             {source}", directory.display())]
    Copy {
        /// The directory.
        directory: PathBuf,
        /// Process that holds the run's lock.
        #[source]
        source: LockError,
    },
}

/// Checks that `actors` actors can resume the run in `directory`, and claims it. An unsupervised
/// learner that is still running gets `patience` to end. `episodes` lengthens the run to so many
/// training episodes.
///
/// # Errors
/// Returns [`ResumeError`]; in this case nothing was changed.
pub fn resume(
    directory: &Path,
    episodes: Option<u64>,
    actors: usize,
    patience: Duration,
) -> Result<(Prepared, SupervisorLock), ResumeError> {
    let not_a_run = |missing: &Path| ResumeError::NotARun {
        directory: directory.to_owned(),
        missing: missing.to_owned(),
    };
    let unreadable = |path: &Path, source: io::Error| match source.kind() {
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => not_a_run(Path::new("run.json")),
        _ => ResumeError::Run(RunError::Io {
            path: path.to_owned(),
            source,
        }),
    };
    let root = directory.canonicalize();
    let run = RunDirectory::new(root.map_err(|source| unreadable(directory, source))?);
    let identity = run.identity();
    fs::metadata(&identity).map_err(|source| unreadable(&identity, source))?;
    let (identity, config) = match episodes {
        // A lengthening that was cut off is repeated below.
        Some(_) => run.open_to_lengthen()?,
        None => run.open()?,
    };
    let under_way = || ResumeError::UnderWay(run.root().to_owned());
    // A process that only checks whether the lock is taken holds it for a moment.
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
    let (identity, config) = match episodes {
        Some(episodes) => run.lengthen(episodes)?,
        None => (identity, config),
    };
    if let Some(summary) = run.summary()
        && summary.is_of_whole(&config)
    {
        return Err(ResumeError::Complete {
            directory: run.root().to_owned(),
            episodes: summary.episodes,
        });
    }
    run.make_folders()?;
    check(&run.config(), &config, actors)?;
    check_shared_memory(&config, actors).map_err(PrepareError::from)?;
    check_file_size(&config, actors).map_err(PrepareError::from)?;
    check_address_space(&config, actors).map_err(PrepareError::from)?;
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

/// Calls `look` repeatedly until it finds something or `patience` is over.
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
        resume(directory, None, 1, Duration::ZERO)
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn an_unfinished_run_can_be_resumed_by_one_supervisor() {
        let directory = tempfile::tempdir().unwrap();
        let prepared = prepared_run(directory.path());
        let (resumed, lock) = resume(prepared.run.root(), None, 3, Duration::ZERO).unwrap();
        assert_eq!(
            (&resumed.identity, &resumed.config),
            (&prepared.identity, &prepared.config)
        );
        assert!(refusal(prepared.run.root()).contains("is under way"));
        drop(lock);
        assert!(resume(prepared.run.root(), None, 1, Duration::ZERO).is_ok());
    }

    #[test]
    fn a_directory_without_a_run_is_refused_with_a_remedy() {
        let directory = tempfile::tempdir().unwrap();
        for path in [directory.path(), directory.path().join("missing").as_path()] {
            let error = refusal(path);
            assert!(error.contains("is not a run directory"), "{error}");
        }
        // There is something, but it cannot be read.
        let file = directory.path().join("run.json");
        std::os::unix::fs::symlink(&file, &file).unwrap();
        let error = refusal(directory.path());
        assert!(
            error.contains("run.json") && !error.contains("not a run"),
            "{error}"
        );
    }

    #[test]
    fn a_changed_run_and_too_many_actors_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let run = prepared_run(directory.path()).run;
        let actors = Config::default().transport.max_actors + 1;
        let error = resume(run.root(), None, actors, Duration::ZERO)
            .unwrap_err()
            .to_string();
        assert!(error.contains("max_actors"), "{error}");
        let text = fs::read_to_string(run.config())
            .unwrap()
            .replace("seed = 1", "seed = 2");
        fs::write(run.config(), text).unwrap();
        assert!(refusal(run.root()).contains("has changed since the run was started"));
    }
}
