//! The run's directory: its paths, creation and opening.

use std::fs;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{RunIdentity, durable, inputs};
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::{Config, ConfigError, ParameterKey};
use skein_protocol::files::{self, REPORT_BYTES, SETTINGS_BYTES};
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
    /// Names the run in `root`.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// Returns the copy of the file that `key` names, if the configuration has the key.
    pub fn parameters(&self, key: ParameterKey) -> PathBuf {
        self.root.join(key.copy())
    }

    /// Returns the directory itself.
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
        /// Log files, one per process.
        logs => "logs",
        /// Lock file that the learner holds while it is alive, see
        /// [`LearnerLock`](crate::LearnerLock).
        learner_lock => "learner.lock",
        /// One row per learner start: incarnation,unix_secs,episodes; `episodes` counts the
        /// committed ones it resumed from.
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
        /// The decoder of a plain VAE, or the one that came with the encoder: for people who look
        /// at latent codes.
        decoder => "decoder.safetensors",
        /// Checkpoints, from which the learner resumes.
        checkpoints => "checkpoints",
        /// [`EvaluationReport`](skein_protocol::evaluation::EvaluationReport) of the best snapshot.
        evaluation_json => "evaluation.json",
        /// Trajectories of the evaluation episodes: course,episode,step,x_m,y_m,z_m,outcome.
        evaluation_trajectories_csv => "evaluation_trajectories.csv",
        /// Depth images and their reconstructions: `depth` and `reconstruction`, u8 `[n, 72, 128]`.
        reconstructions => "reconstructions.safetensors",
        /// [`RunSummary`](skein_protocol::summary::RunSummary).
        summary_json => "summary.json",
        /// Recorded episodes, MCAP files, if the run records any.
        recordings => "recordings",
        /// PNG files.
        plots => "plots",
    }

    /// Returns the learner's log file.
    pub fn learner_log(&self) -> PathBuf {
        self.logs().join("learner.log")
    }

    /// Returns an actor's log file.
    pub fn actor_log(&self, actor: ActorId) -> PathBuf {
        self.logs().join(format!("actor-{actor}.log"))
    }

    /// Returns the file with the results of the best snapshot on the suite called `suite`, as
    /// `skein-evaluate` writes it. Only experiments write it.
    pub fn suite_json(&self, suite: &str) -> PathBuf {
        self.root.join("suites").join(format!("{suite}.json"))
    }

    /// Returns the committed episodes of the run's newest checkpoint, by the checkpoints' names.
    /// The checkpoint may still turn out damaged when it is read.
    pub fn newest_checkpoint(&self) -> Option<u64> {
        self.checkpoint_names().into_iter().max()
    }

    /// Returns the committed episodes of the run's checkpoints, by their names.
    fn checkpoint_names(&self) -> Vec<u64> {
        let episodes = |entry: fs::DirEntry| {
            entry
                .file_name()
                .to_str()?
                .strip_prefix("episode-")?
                .parse()
                .ok()
        };
        let entries = fs::read_dir(self.checkpoints()).into_iter().flatten();
        entries.filter_map(|entry| episodes(entry.ok()?)).collect()
    }

    /// Creates the directory with its folders, accessible to this user only. Writes the resolved
    /// configuration and a new identity, which holds the checksums of course files and encoder
    /// already there.
    ///
    /// # Errors
    /// [`RunError`] names the path.
    pub fn create(&self, config: &Config) -> Result<RunIdentity, RunError> {
        let io = |path: PathBuf| move |source| RunError::Io { path, source };
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&self.root)
            // An existing directory may be open to others.
            .and_then(|()| fs::set_permissions(&self.root, fs::Permissions::from_mode(0o700)))
            .map_err(io(self.root.clone()))?;
        self.make_folders()?;
        fs::create_dir_all(self.checkpoints()).map_err(io(self.checkpoints()))?;
        // Synced to disk: after a power cut there must be no checkpoints of a run without an
        // identity.
        let resolved = self.write_config(config)?;
        let courses = inputs::course_checksums(&self.courses()).map_err(io(self.courses()))?;
        let parameters =
            inputs::parameter_checksums(&self.root, config).map_err(io(self.root.clone()))?;
        let copies = courses.keys().map(|name| self.courses().join(name));
        let parameter_copies = parameters.keys().map(|name| self.root.join(name));
        for file in copies.chain(parameter_copies) {
            durable::sync(&file).map_err(io(file))?;
        }
        if !courses.is_empty() {
            durable::sync(&self.courses()).map_err(io(self.courses()))?;
        }
        let identity = RunIdentity::new(&resolved, courses, parameters);
        self.write_identity(&identity)?;
        Ok(identity)
    }

    /// Writes `config`, whose courses are relative to this directory; returns it as it is read.
    fn write_config(&self, config: &Config) -> Result<Config, RunError> {
        let (path, version) = (self.config(), env!("CARGO_PKG_VERSION"));
        let text = format!("# Resolved by Skein {version}.\n\n{}", config.to_toml());
        match durable::replace(&path, text.as_bytes()) {
            Ok(()) => Config::load(&path, &[]).map_err(RunError::Config),
            Err(source) => Err(RunError::Io { path, source }),
        }
    }

    fn write_identity(&self, identity: &RunIdentity) -> Result<(), RunError> {
        let path = self.identity();
        let json = serde_json::to_string_pretty(identity).expect("an identity is plain data");
        durable::replace(&path, json.as_bytes()).map_err(|source| RunError::Io { path, source })
    }

    /// Creates missing folders: a copy of a run may lack those that were empty. The checkpoint
    /// folder is not created, because a run without it starts from the beginning.
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

    /// Reads identity and configuration of an existing run, and checks that its course files and
    /// its encoder are those it was started with.
    ///
    /// # Errors
    /// [`RunError`] names the file and the problem.
    pub fn open(&self) -> Result<(RunIdentity, Config), RunError> {
        self.open_if(|identity, config| config.digest() == identity.config_digest)
    }

    /// Opens a run that is to be lengthened. Unlike [`RunDirectory::open`], also opens one whose
    /// lengthening was cut off between two files.
    ///
    /// # Errors
    /// [`RunError`] names the file and the problem.
    pub fn open_to_lengthen(&self) -> Result<(RunIdentity, Config), RunError> {
        self.open_if(|identity, config| {
            let before = || config.lengthened_from(&self.started_config(identity)?);
            config.digest() == identity.config_digest || before().is_some()
        })
    }

    /// Sets `run.episodes` of this run, of which no process is alive, to `episodes`. Everything
    /// else of its configuration stays.
    ///
    /// # Errors
    /// [`RunError`] if the run has more episodes, or no checkpoint before its end; then nothing is
    /// changed.
    pub fn lengthen(&self, episodes: u64) -> Result<(RunIdentity, Config), RunError> {
        let (mut identity, mut config) = self.open_to_lengthen()?;
        let present = config.run.episodes;
        if episodes < present {
            return Err(RunError::Shortened {
                path: self.config(),
                present,
                wanted: episodes,
            });
        }
        let checkpoints = self.checkpoint_names();
        let has_begun = !checkpoints.is_empty() || self.summary().is_some();
        if episodes > present && has_begun && checkpoints.iter().all(|&flown| flown >= present) {
            return Err(RunError::NothingBeforeEnd {
                path: self.checkpoints(),
                present,
                wanted: episodes,
            });
        }
        config.run.episodes = episodes;
        config.validate().map_err(|source| {
            let path = self.config();
            RunError::Config(ConfigError::Invalid { path, source })
        })?;
        for course in config.courses.paths_mut() {
            *course = Path::new("courses").join(course.file_name().unwrap_or_default());
        }
        for (_, file) in config.parameter_files_mut() {
            *file = file.file_name().map(PathBuf::from).unwrap_or_default();
        }
        identity.config_digest = self.write_config(&config)?.digest();
        self.write_identity(&identity)?;
        self.open()
    }

    /// Opens a run whose identity and configuration belong together according to `fit`.
    fn open_if(
        &self,
        fit: impl Fn(&RunIdentity, &Config) -> bool,
    ) -> Result<(RunIdentity, Config), RunError> {
        let path = self.identity();
        let text = files::read_text(&path, REPORT_BYTES).map_err(|source| RunError::Io {
            path: path.clone(),
            source,
        })?;
        let not_an_identity = |source| RunError::Identity {
            path: path.clone(),
            source,
        };
        // The version comes first: another version's identity may have other fields.
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
        if !fit(&identity, &config) {
            return Err(RunError::ConfigChanged {
                path: self.config(),
                differences: self.differences(&identity, &config),
            });
        }
        inputs::verify_courses(&self.courses(), &identity.courses, &config)?;
        inputs::verify_parameters(&self.root, &identity.parameters, &config)?;
        Ok((identity, config))
    }
}

/// The field that identities of all versions have.
#[derive(Deserialize)]
struct Versioned {
    protocol_version: u32,
}

impl RunDirectory {
    /// Returns the portable text of the configuration that belongs to `identity`, if a checkpoint
    /// still holds a copy.
    fn started_config(&self, identity: &RunIdentity) -> Option<String> {
        let copies = self.checkpoint_names().into_iter().map(|episodes| {
            let file = format!("episode-{episodes}/config.toml");
            files::read_text(&self.checkpoints().join(file), SETTINGS_BYTES)
        });
        copies
            .flatten()
            .find(|text| Config::digest_of(text) == identity.config_digest)
    }

    /// Returns the keys in which `config` differs from the run's configuration, if a checkpoint
    /// still holds a copy.
    fn differences(&self, identity: &RunIdentity, config: &Config) -> String {
        self.started_config(identity)
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

/// Returns the remedy, if there is one.
fn remedy(error: &std::io::Error) -> &'static str {
    match error.kind() {
        std::io::ErrorKind::NotFound => "; is this the directory of a run?",
        std::io::ErrorKind::PermissionDenied => "; it belongs to another user or is read-only",
        std::io::ErrorKind::ReadOnlyFilesystem => "; copy the run to a writable disk",
        _ => "",
    }
}

/// Reason why a run's directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}{}", path.display(), remedy(source))]
    Io {
        /// The path.
        path: PathBuf,
        /// Cause.
        #[source]
        source: std::io::Error,
    },
    /// The identity file is damaged.
    #[error("{} is not the identity of a run: {source}", path.display())]
    Identity {
        /// The file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: serde_json::Error,
    },
    /// The run was started by a program of another version.
    #[error("{}: the run uses protocol version {found}, this program {PROTOCOL_VERSION}; use the \
        program version that started the run", path.display())]
    OtherVersion {
        /// The identity file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
    /// The configuration is not the one the run was started with.
    #[error("{} has changed since the run was started (\"there\": at the start, \"here\": now): \
        {differences}; restore it, or start a new run", path.display())]
    ConfigChanged {
        /// The configuration file.
        path: PathBuf,
        /// The differing keys with both values; without a checkpoint, both digests.
        differences: String,
    },
    /// A run can only be lengthened.
    #[error("{}: run.episodes = {present} can only grow, and {wanted} is less: give more, or start \
        a new run", path.display())]
    Shortened {
        /// The configuration file.
        path: PathBuf,
        /// Its number of episodes.
        present: u64,
        /// Number asked for.
        wanted: u64,
    },
    /// A longer run resumes from before the end of the shorter one, and nothing is left of that.
    #[error("{} holds no checkpoint from before the end of the run, episode {present}, and a \
        longer run resumes from there: start a new run with run.episodes = {wanted}. \
        With checkpoints.keep of 2 or more and checkpoints.every_episodes below run.episodes, a \
        run can be lengthened", path.display())]
    NothingBeforeEnd {
        /// Folder of the checkpoints.
        path: PathBuf,
        /// Number of episodes of the run.
        present: u64,
        /// Number asked for.
        wanted: u64,
    },
    /// A course file is not the one the run was started with.
    #[error("{} {problem}: the run would mix episodes of different courses; restore the file, or \
        start a new run", path.display())]
    CourseChanged {
        /// The course file.
        path: PathBuf,
        /// The problem.
        problem: String,
    },
    /// A file of parameters is not the one the run was started with.
    #[error("{} {problem}: the run would mix episodes of different encoders or policies; restore \
        the file, or start a new run", path.display())]
    ParametersChanged {
        /// The file.
        path: PathBuf,
        /// The problem.
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
    fn a_run_of_another_version_is_refused_as_such_whatever_its_identity_holds() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        fs::write(
            run.identity(),
            r#"{ "protocol_version": 1, "what": "was then" }"#,
        )
        .unwrap();
        let error = run.open().unwrap_err().to_string();
        assert!(error.contains("uses protocol version 1"), "{error}");
        fs::write(run.identity(), "").unwrap();
        let error = run.open().unwrap_err().to_string();
        assert!(error.contains("is not the identity of a run"), "{error}");
    }

    #[test]
    fn a_changed_configuration_is_refused() {
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
        // With the checkpoint's copy, the message names the key.
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
    fn a_run_is_lengthened_in_run_episodes_alone_and_never_shortened() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let begun = run.create(&Config::default()).unwrap();
        let (_, before) = run.open().unwrap();
        let present = before.run.episodes;
        let shorter = run.lengthen(present - 1).unwrap_err().to_string();
        assert!(shorter.contains("can only grow"), "{shorter}");
        let endless = run.lengthen(1 << 62).unwrap_err().to_string();
        assert!(endless.contains("run.episodes"), "{endless}");
        assert_eq!(run.open().unwrap(), (begun.clone(), before.clone()));

        let (identity, after) = run.lengthen(present + 1).unwrap();
        assert_eq!(identity.run, begun.run);
        assert_eq!(after.lengthened_from(&before.portable()), Some(present));
        assert_eq!(before.lengthened_from(&after.portable()), None);
        assert_eq!(run.open().unwrap(), (identity, after));
    }

    #[test]
    fn a_run_without_a_checkpoint_before_its_end_is_not_lengthened() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        let present = run.open().unwrap().1.run.episodes;
        fs::create_dir(run.checkpoints().join(format!("episode-{present}"))).unwrap();
        let error = run.lengthen(present + 1).unwrap_err().to_string();
        assert!(error.contains("no checkpoint from before"), "{error}");
        fs::create_dir(run.checkpoints().join("episode-1")).unwrap();
        run.lengthen(present + 1).unwrap();
    }

    #[test]
    fn a_lengthening_cut_off_between_two_files_is_repeated() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        run.create(&Config::default()).unwrap();
        let (identity, before) = run.open().unwrap();
        let checkpoint = run.checkpoints().join("episode-20");
        fs::create_dir(&checkpoint).unwrap();
        fs::write(checkpoint.join("config.toml"), before.portable()).unwrap();
        let longer = before.run.episodes + 10;
        run.lengthen(longer).unwrap();
        // As if the power had failed before the second file.
        run.write_identity(&identity).unwrap();
        let error = run.open().unwrap_err().to_string();
        assert!(error.contains("run.episodes = "), "{error}");
        let (_, config) = run.lengthen(longer).unwrap();
        assert_eq!(config.run.episodes, longer);
        run.open().unwrap();
    }

    #[test]
    fn a_changed_damaged_or_missing_course_is_refused_by_name() {
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
        refused(&training, "has changed");
        fs::write(&training, "walls = 5").unwrap();
        run.open().unwrap();
        fs::remove_file(&gates).unwrap();
        refused(&gates, "No such file");
        fs::write(&gates, "walls = 2").unwrap();
        run.open().unwrap();

        // The digest ignores folders, but a course of the same name elsewhere is still another
        // course.
        let elsewhere = directory.path().join("training.toml");
        fs::copy(&training, &elsewhere).unwrap();
        config.courses.training.clone_from(&elsewhere);
        fs::write(run.config(), config.to_toml()).unwrap();
        refused(&elsewhere, "is not one of the courses");
    }

    /// Returns the configuration of a run that starts from the encoder in its directory.
    fn started_from_encoder() -> Config {
        let mut config = Config::default();
        config.vae.train_steps = 0;
        config.vae.start_from = Some("encoder.safetensors".into());
        config
    }

    #[test]
    fn a_changed_or_missing_encoder_is_refused_by_name() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        fs::write(run.parameters(ParameterKey::Encoder), "parameters").unwrap();
        run.create(&started_from_encoder()).unwrap();
        let (_, config) = run.open().unwrap();
        assert_eq!(
            config.vae.start_from,
            Some(run.parameters(ParameterKey::Encoder))
        );
        let refused = |problem: &str| {
            let error = run.open().unwrap_err().to_string();
            for part in [
                run.parameters(ParameterKey::Encoder).to_str().unwrap(),
                problem,
            ] {
                assert!(error.contains(part), "{error}");
            }
        };
        fs::write(run.parameters(ParameterKey::Encoder), "others").unwrap();
        refused("has changed");
        fs::remove_file(run.parameters(ParameterKey::Encoder)).unwrap();
        refused("No such file");
        fs::write(run.parameters(ParameterKey::Encoder), "parameters").unwrap();
        run.open().unwrap();

        // The digest ignores folders, but an encoder elsewhere is still another encoder.
        let mut elsewhere = config;
        elsewhere.vae.start_from = Some(directory.path().join("other/encoder.safetensors"));
        fs::write(run.config(), elsewhere.to_toml()).unwrap();
        refused("vae.start_from");
    }

    #[test]
    fn a_run_can_be_moved_and_then_lengthened() {
        let directory = tempfile::tempdir().unwrap();
        let (before, after) = (
            directory.path().join("before"),
            directory.path().join("after"),
        );
        let run = RunDirectory::new(&before);
        fs::create_dir(&before).unwrap();
        fs::write(run.parameters(ParameterKey::Encoder), "parameters").unwrap();
        let begun = run.create(&started_from_encoder()).unwrap();
        fs::rename(&before, &after).unwrap();
        let run = RunDirectory::new(&after);
        let (_, moved) = run.open().unwrap();
        assert_eq!(moved.courses.training, after.join("courses/training.toml"));
        assert_eq!(
            moved.vae.start_from,
            Some(run.parameters(ParameterKey::Encoder))
        );
        let (identity, _) = run.lengthen(moved.run.episodes + 1).unwrap();
        assert_eq!(identity.parameters, begun.parameters);
    }

    #[test]
    fn only_the_owner_can_access_a_run_directory() {
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
