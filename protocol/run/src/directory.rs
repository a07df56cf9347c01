//! The run's directory: where everything in it lies, and how it is created and opened.

use std::fs;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{RunIdentity, courses, durable};
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::{Config, ConfigError};
use skein_protocol::ids::ActorId;

/// Paths within a run's directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunDirectory {
    root: PathBuf,
}

macro_rules! paths {
    ($($(#[$doc:meta])* $name:ident => $path:literal),* $(,)?) => {
        $($(#[$doc])* pub fn $name(&self) -> PathBuf { self.root.join($path) })*
    };
}

impl RunDirectory {
    /// The run in `root`.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// The directory itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    paths! {
        /// The resolved configuration.
        config => "config.toml",
        /// [`RunIdentity`].
        identity => "run.json",
        /// Copies of the course files, so that the directory is complete.
        courses => "courses",
        /// One log file a process.
        logs => "logs",
        /// Locked by the learner while it lives, see [`LearnerLock`](crate::LearnerLock).
        learner_lock => "learner.lock",
        /// One row per start of the learner: incarnation,unix_secs,episodes it went on from.
        incarnations_csv => "incarnations.csv",
        /// One row per committed training episode.
        episodes_csv => "episodes.csv",
        /// TensorBoard event files.
        tensorboard => "tensorboard",
        /// `best.safetensors`, `latest.safetensors`.
        snapshots => "snapshots",
        /// The best snapshot.
        best_snapshot => "snapshots/best.safetensors",
        /// The newest snapshot.
        latest_snapshot => "snapshots/latest.safetensors",
        /// Everything needed to go on.
        checkpoints => "checkpoints",
        /// [`EvaluationReport`](skein_protocol::evaluation::EvaluationReport) of the best snapshot.
        evaluation_json => "evaluation.json",
        /// Where the evaluation episodes flew: course,episode,step,x_m,y_m,z_m,outcome.
        evaluation_trajectories_csv => "evaluation_trajectories.csv",
        /// Depth images and their reconstructions: `depth` and `reconstruction`, u8 `[n, 72, 128]`.
        reconstructions => "reconstructions.safetensors",
        /// [`Summary`](skein_protocol::summary::Summary).
        summary_json => "summary.json",
        /// PNG files.
        plots => "plots",
    }

    /// The learner's log file.
    pub fn learner_log(&self) -> PathBuf {
        self.logs().join("learner.log")
    }

    /// An actor's log file.
    pub fn actor_log(&self, actor: ActorId) -> PathBuf {
        self.logs().join(format!("actor-{actor}.log"))
    }

    /// How the best snapshot flies the suite called `suite`, as `skein-evaluate` tells it; an
    /// experiment has it written.
    pub fn suite_json(&self, suite: &str) -> PathBuf {
        self.root.join("suites").join(format!("{suite}.json"))
    }

    /// Episodes committed in the newest of the run's checkpoints, by their names; whether one is
    /// sound, only reading it can tell.
    pub fn newest_checkpoint(&self) -> Option<u64> {
        let episodes = |entry: fs::DirEntry| {
            entry
                .file_name()
                .to_str()?
                .strip_prefix("episode-")?
                .parse()
                .ok()
        };
        fs::read_dir(self.checkpoints())
            .ok()?
            .filter_map(|entry| episodes(entry.ok()?))
            .max()
    }

    /// Creates the directory with its folders, for this user alone, and writes the resolved
    /// configuration and a new identity, which vouches for the course files that are in it already.
    ///
    /// # Errors
    /// [`RunError`] names the path.
    pub fn create(&self, config: &Config) -> Result<RunIdentity, RunError> {
        let io = |path: PathBuf| move |source| RunError::Io { path, source };
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&self.root)
            // One that was there before may be open to others.
            .and_then(|()| fs::set_permissions(&self.root, fs::Permissions::from_mode(0o700)))
            .map_err(io(self.root.clone()))?;
        self.make_folders()?;
        fs::create_dir_all(self.checkpoints()).map_err(io(self.checkpoints()))?;
        let text = format!(
            "# Resolved by Skein {}.\n\n{}",
            env!("CARGO_PKG_VERSION"),
            config.to_toml()
        );
        // A power cut shortly after must not leave checkpoints of a run that nobody knows any more:
        // all of it is brought to disk.
        durable::replace(&self.config(), text.as_bytes()).map_err(io(self.config()))?;
        let resolved = Config::load(&self.config(), &[]).map_err(RunError::Config)?;
        let courses = courses::checksums(&self.courses()).map_err(io(self.courses()))?;
        for file in courses.keys().map(|name| self.courses().join(name)) {
            durable::sync(&file).map_err(io(file))?;
        }
        if !courses.is_empty() {
            durable::sync(&self.courses()).map_err(io(self.courses()))?;
        }
        let identity = RunIdentity::new(&resolved, courses);
        let json = serde_json::to_string_pretty(&identity).expect("an identity is plain data");
        durable::replace(&self.identity(), json.as_bytes()).map_err(io(self.identity()))?;
        Ok(identity)
    }

    /// Makes the folders that are not there: copies of a run may lack those that were empty. That
    /// of the checkpoints is none of them, because a run without any is begun anew.
    ///
    /// # Errors
    /// [`RunError`] names the path.
    pub fn make_folders(&self) -> Result<(), RunError> {
        for folder in [
            self.logs(),
            self.tensorboard(),
            self.snapshots(),
            self.plots(),
        ] {
            fs::create_dir_all(&folder).map_err(|source| RunError::Io {
                path: folder,
                source,
            })?;
        }
        Ok(())
    }

    /// Reads identity and configuration of an existing run; its course files are those it was
    /// started with.
    ///
    /// # Errors
    /// [`RunError`] names the file and what is wrong with it.
    pub fn open(&self) -> Result<(RunIdentity, Config), RunError> {
        let path = self.identity();
        let text = fs::read_to_string(&path).map_err(|source| RunError::Io {
            path: path.clone(),
            source,
        })?;
        let not_an_identity = |source| RunError::Identity {
            path: path.clone(),
            source,
        };
        // First of all: another version's identity may have other parts.
        let Versioned { protocol_version } =
            serde_json::from_str(&text).map_err(not_an_identity)?;
        if protocol_version != PROTOCOL_VERSION {
            return Err(RunError::OtherVersion {
                path,
                found: protocol_version,
            });
        }
        let identity: RunIdentity = serde_json::from_str(&text).map_err(not_an_identity)?;
        let config = Config::load(&self.config(), &[]).map_err(RunError::Config)?;
        if config.digest() != identity.config_digest {
            return Err(RunError::ConfigChanged {
                path: self.config(),
                differences: self.differences(&identity, &config),
            });
        }
        courses::verify(&self.courses(), &identity.courses, &config)?;
        Ok((identity, config))
    }
}

/// What identities of all versions have.
#[derive(Deserialize)]
struct Versioned {
    protocol_version: u32,
}

impl RunDirectory {
    /// In which keys `config` differs from the configuration of the run, if a checkpoint still
    /// tells it.
    fn differences(&self, identity: &RunIdentity, config: &Config) -> String {
        let known = self.newest_checkpoint().and_then(|episodes| {
            let copy = self
                .checkpoints()
                .join(format!("episode-{episodes}/config.toml"));
            fs::read_to_string(copy).ok()
        });
        known
            .filter(|text| Config::digest_of(text) == identity.config_digest)
            .and_then(|text| config.differences(&text).ok())
            .map_or_else(
                || {
                    format!(
                        "its digest is {:016x} where {:016x} is expected",
                        config.digest(),
                        identity.config_digest
                    )
                },
                |differences| differences.join(", "),
            )
    }
}

/// What to do about it, if that can be told.
fn remedy(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::NotFound => "; is this the directory of a run?",
        std::io::ErrorKind::PermissionDenied => {
            "; it belongs to another user, or may not be written"
        }
        std::io::ErrorKind::ReadOnlyFilesystem => "; copy the run to a disk that can be written",
        _ => "",
    }
}

/// Why a run's directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}{}", path.display(), remedy(source))]
    Io {
        /// The path.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The identity file is damaged.
    #[error("{} is not the identity of a run: {source}", path.display())]
    Identity {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// The run was started by a program of another version.
    #[error("{}: the run speaks protocol version {found}, this program {PROTOCOL_VERSION}; use the program that started it", path.display())]
    OtherVersion {
        /// The identity file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
    /// The configuration is not the one the run was started with.
    #[error("{} was changed since the run was started (\"there\" is as it was started, \"here\" as it is now): {differences}; change it back, or start a new run for another configuration", path.display())]
    ConfigChanged {
        /// The configuration file.
        path: PathBuf,
        /// Each key with both values; if no checkpoint tells them, both digests.
        differences: String,
    },
    /// A course file is not the one the run was started with.
    #[error("{} {problem}, and episodes through another course would be learned from as if it were the same; put the file back as it was, or start a new run", path.display())]
    CourseChanged {
        /// The course file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(ConfigError),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_created_run_opens_with_the_same_identity() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let identity = run.create(&Config::default()).unwrap();
        let (opened, config) = run.open().unwrap();
        assert_eq!(opened, identity);
        assert_eq!(config.run, Config::default().run);
    }

    #[test]
    fn another_versions_run_is_told_as_such_whatever_its_identity_holds() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        fs::write(
            run.identity(),
            r#"{ "protocol_version": 1, "what": "was then" }"#,
        )
        .unwrap();
        let error = run.open().unwrap_err().to_string();
        assert!(error.contains("speaks protocol version 1"), "{error}");
        fs::write(run.identity(), "").unwrap();
        let error = run.open().unwrap_err().to_string();
        assert!(error.contains("is not the identity of a run"), "{error}");
    }

    #[test]
    fn a_changed_configuration_is_noticed() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        let (_, before) = run.open().unwrap();
        let text = fs::read_to_string(run.config())
            .unwrap()
            .replace("seed = 1", "seed = 2");
        fs::write(run.config(), text).unwrap();
        let refusal = || match run.open() {
            Err(error @ RunError::ConfigChanged { .. }) => error.to_string(),
            other => panic!("{other:?}"),
        };
        assert!(refusal().contains("its digest is"), "{}", refusal());
        // What a checkpoint says of the run's configuration tells the key.
        let checkpoint = run.checkpoints().join("episode-20");
        fs::create_dir(&checkpoint).unwrap();
        fs::write(checkpoint.join("config.toml"), before.portable()).unwrap();
        assert!(
            refusal().contains("run.seed = 1 there, 2 here"),
            "{}",
            refusal()
        );
    }

    #[test]
    fn a_changed_damaged_or_missing_course_is_noticed_and_named() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        fs::create_dir(run.courses()).unwrap();
        let (training, gates) = (
            run.courses().join("training.toml"),
            run.courses().join("gates.toml"),
        );
        fs::write(&training, "walls = 5").unwrap();
        fs::write(&gates, "walls = 2").unwrap();
        let mut config = Config::default();
        config.courses.training.clone_from(&training);
        config.courses.evaluation = vec![training.clone(), gates.clone()];
        run.create(&config).unwrap();
        run.open().unwrap();
        let refused = |path: &Path, problem: &str| {
            let error = run.open().unwrap_err().to_string();
            assert!(
                error.contains(path.to_str().unwrap()) && error.contains(problem),
                "{error}"
            );
        };
        fs::write(&training, "walls = 4").unwrap();
        refused(&training, "was changed");
        fs::write(&training, "walls = 5").unwrap();
        run.open().unwrap();
        fs::remove_file(&gates).unwrap();
        refused(&gates, "No such file");
        fs::write(&gates, "walls = 2").unwrap();
        run.open().unwrap();

        // The configuration's digest is the same wherever the run's directory lies: a course of the
        // same name elsewhere is another one all the same.
        let elsewhere = directory.path().join("training.toml");
        fs::copy(&training, &elsewhere).unwrap();
        config.courses.training.clone_from(&elsewhere);
        fs::write(run.config(), config.to_toml()).unwrap();
        refused(&elsewhere, "is none of the courses");
    }

    #[test]
    fn a_run_can_be_moved() {
        let directory = tempfile::tempdir().unwrap();
        let (before, after) = (
            directory.path().join("before"),
            directory.path().join("after"),
        );
        let run = RunDirectory::new(&before);
        run.create(&Config::default()).unwrap();
        fs::rename(&before, &after).unwrap();
        let (_, moved) = RunDirectory::new(&after).open().unwrap();
        assert_eq!(moved.courses.training, after.join("courses/training.toml"));
    }

    #[test]
    fn a_run_directory_is_for_its_owner_alone() {
        let parent = tempfile::tempdir().unwrap();
        let (new, open) = (parent.path().join("new"), parent.path().join("open"));
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o755)).unwrap();
        for root in [new, open] {
            RunDirectory::new(&root).create(&Config::default()).unwrap();
            assert_eq!(
                fs::metadata(&root).unwrap().permissions().mode() & 0o777,
                0o700
            );
        }
    }
}
