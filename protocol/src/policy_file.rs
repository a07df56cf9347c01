//! Policies on disk that a run uses: the one that it starts from, and its teacher.

use std::path::PathBuf;

use crate::ActionSpace;
use crate::config::{AlgorithmName, Config, ParameterKey};
use crate::encoder_file::TrainedEncoder;
use crate::snapshot::{Snapshot, SnapshotError, SnapshotLayout};

/// Reason why a run cannot use a policy's file.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The file cannot be read, or is no snapshot.
    #[error("{key}: {source}")]
    File {
        /// Key that names the file.
        key: &'static str,
        /// Path and problem.
        #[source]
        source: SnapshotError,
    },
    /// The policy sees something else than this run's policy, or has another size.
    #[error(
        "learning.start_from: the policy in {} was trained with {}: set this here too, or name \
        another file", path.display(), settings.join(", ")
    )]
    Misfit {
        /// The file.
        path: PathBuf,
        /// Settings of the policy that differ from this run's.
        settings: Vec<String>,
    },
    /// The teacher's actions are not those of this run.
    #[error(
        "teacher.snapshot: the policy in {} was trained with simulator.vehicle.action = \"{}\": \
        set this here too, or name another file", path.display(), action.name()
    )]
    OtherAction {
        /// The file.
        path: PathBuf,
        /// Numbers of the teacher's actions.
        action: ActionSpace,
    },
    /// The policy was trained with another encoder.
    #[error(
        "learning.start_from: the policy in {} knows the codes of its own encoder, not of that \
        in vae.start_from: name the same file in both", path.display()
    )]
    OtherEncoder {
        /// The file.
        path: PathBuf,
    },
}

/// Returns the parameters that the policy of `config` starts from, in the order of
/// [`SnapshotLayout::policy`]; `None` if it starts from random ones. `encoder`: that of `config`.
///
/// # Errors
/// [`PolicyError`] names key, file and remedy.
pub fn start_policy(
    config: &Config,
    encoder: Option<&TrainedEncoder>,
) -> Result<Option<Vec<f32>>, PolicyError> {
    let Some(path) = &config.learning.start_from else {
        return Ok(None);
    };
    let (snapshot, trained) = Snapshot::load(path).map_err(|source| PolicyError::File {
        key: ParameterKey::Policy.name(),
        source,
    })?;
    let settings = differences(&trained, config);
    if !settings.is_empty() {
        let path = path.clone();
        return Err(PolicyError::Misfit { path, settings });
    }
    let layout = SnapshotLayout::of(config);
    if encoder.is_none_or(|encoder| encoder.values != snapshot.values[layout.encoder()]) {
        return Err(PolicyError::OtherEncoder { path: path.clone() });
    }
    Ok(Some(snapshot.values[layout.policy()].to_vec()))
}

/// Returns the teacher's policy and the configuration that it was trained with; `None` if the
/// teacher of `config` is no snapshot.
///
/// # Errors
/// [`PolicyError`] names key, file and remedy.
pub fn teacher_policy(config: &Config) -> Result<Option<(Snapshot, Config)>, PolicyError> {
    let Some(path) = &config.teacher.snapshot else {
        return Ok(None);
    };
    let (snapshot, trained) = Snapshot::load(path).map_err(|source| PolicyError::File {
        key: ParameterKey::Teacher.name(),
        source,
    })?;
    let action = trained.action_space();
    if action != config.action_space() {
        let path = path.clone();
        return Err(PolicyError::OtherAction { path, action });
    }
    Ok(Some((snapshot, trained)))
}

/// Returns the settings of `trained` that a policy depends on and that differ in `config`.
fn differences(trained: &Config, config: &Config) -> Vec<String> {
    let settings = |of: &Config| {
        let observed = |of| toml::Value::try_from(of).expect("a name is representable in TOML");
        let (learning, view) = (&of.learning, of.observation_layout());
        let is_td3 = learning.algorithm == AlgorithmName::Td3;
        let width = match learning.algorithm {
            AlgorithmName::Sac => of.sac.hidden_width,
            AlgorithmName::Distill => of.distill.hidden_width,
            AlgorithmName::Td3 => of.td3.hidden_width,
        };
        [
            if is_td3 { "the algorithm td3" } else { "" }.to_owned(),
            format!("learning.observation = {}", observed(view.per_step)),
            format!("learning.history_steps = {:?}", view.history_steps),
            format!("vae.latent = {}", view.latent),
            format!("simulator.vehicle.action = \"{}\"", view.action.name()),
            format!("hidden_width = {width}"),
        ]
    };
    let pairs = settings(trained).into_iter().zip(settings(config));
    pairs
        .filter_map(|(there, here)| (there != here).then_some(there))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> Config {
        let mut config = Config::default();
        (config.vae.latent, config.sac.hidden_width) = (8, 16);
        config
    }

    /// Sets `simulator.vehicle.action`.
    fn act(config: &mut Config, action: &str) {
        let vehicle = toml::Table::from_iter([("action".to_owned(), action.into())]);
        config
            .simulator
            .insert("vehicle".to_owned(), vehicle.into());
    }

    /// Returns a configuration that starts from a snapshot of `trained` in `folder`.
    fn starting(folder: &std::path::Path, trained: &Config) -> (Config, Snapshot) {
        let layout = SnapshotLayout::of(trained);
        let snapshot = Snapshot {
            version: crate::ids::PolicyVersion(3),
            values: (0..layout.values())
                .map(|place| place as f32 * 1e-6)
                .collect(),
        };
        let path = folder.join("policy.safetensors");
        std::fs::write(&path, snapshot.to_file(&layout, trained)).unwrap();
        let mut config = small();
        config.vae.train_steps = 0;
        config.vae.start_from = Some(path.clone());
        config.learning.start_from = Some(path);
        (config, snapshot)
    }

    #[test]
    fn a_run_starts_from_the_policy_of_a_snapshot() {
        let folder = tempfile::tempdir().unwrap();
        let (config, snapshot) = starting(folder.path(), &small());
        config.validate().unwrap();
        let encoder = TrainedEncoder::of(&config).unwrap();
        let policy = start_policy(&config, encoder.as_ref()).unwrap().unwrap();
        assert_eq!(
            policy,
            snapshot.values[SnapshotLayout::of(&config).policy()]
        );
        assert_eq!(start_policy(&small(), None).unwrap(), None);
    }

    #[test]
    fn a_policy_that_does_not_fit_is_refused_with_what_to_set() {
        let folder = tempfile::tempdir().unwrap();
        let mut trained = small();
        trained.learning.history_steps = vec![1, 2];
        trained.sac.hidden_width = 32;
        act(&mut trained, "velocity");
        let (config, _) = starting(folder.path(), &trained);
        let encoder = TrainedEncoder::of(&config).unwrap();
        let error = start_policy(&config, encoder.as_ref()).unwrap_err();
        let error = error.to_string();
        for part in [
            "learning.start_from",
            "policy.safetensors",
            "learning.history_steps = [1, 2]",
            "hidden_width = 32",
            "simulator.vehicle.action = \"velocity\"",
        ] {
            assert!(error.contains(part), "{error}");
        }
        assert!(!error.contains("vae.latent"), "{error}");
    }

    #[test]
    fn a_policy_with_another_encoder_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (config, _) = starting(folder.path(), &small());
        let mut encoder = TrainedEncoder::of(&config).unwrap().unwrap();
        encoder.values[5] += 1.0;
        let error = start_policy(&config, Some(&encoder)).unwrap_err();
        assert!(matches!(error, PolicyError::OtherEncoder { .. }), "{error}");
    }

    #[test]
    fn a_teacher_with_other_actions_is_refused_with_what_to_set() {
        let folder = tempfile::tempdir().unwrap();
        let mut trained = small();
        act(&mut trained, "velocity+yaw");
        let (starting, _) = starting(folder.path(), &trained);
        let mut config = small();
        config.teacher.snapshot = starting.learning.start_from;
        let error = teacher_policy(&config).unwrap_err().to_string();
        for part in [
            "teacher.snapshot",
            "policy.safetensors",
            "simulator.vehicle.action = \"velocity+yaw\"",
        ] {
            assert!(error.contains(part), "{error}");
        }
        act(&mut config, "velocity+yaw");
        assert!(teacher_policy(&config).unwrap().is_some());
    }

    #[test]
    fn a_teacher_that_cannot_be_read_is_named_with_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = small();
        config.teacher.snapshot = Some(folder.path().join("none.safetensors"));
        let error = teacher_policy(&config).unwrap_err().to_string();
        for part in ["teacher.snapshot", "none.safetensors", "No such file"] {
            assert!(error.contains(part), "{error}");
        }
        config.teacher.snapshot = None;
        assert_eq!(teacher_policy(&config).unwrap(), None);
    }
}
