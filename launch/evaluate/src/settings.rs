//! Settings of an evaluation that differ from those the snapshot was trained with.

use std::path::Path;

use anyhow::bail;
use skein_protocol::config::{Config, failing_override};
use skein_protocol::snapshot::SnapshotLayout;

/// Sections and keys that an evaluation does not use, each with the remedy.
const UNUSED: [(&str, &str); 4] = [
    ("courses", "name course files with --course"),
    ("evaluation.episodes", "set their number with --episodes"),
    (
        "simulator.generator",
        "a suite's entries have ranges of their own: write a suite",
    ),
    (
        "run.learner_threads",
        "set the number of threads with --threads",
    ),
];

/// Kind of what an evaluation flies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flown {
    /// Courses, with the disturbances of the configuration.
    Courses,
    /// A suite, whose entries have disturbances of their own.
    Suite,
}

/// Returns the configuration of the snapshot at `snapshot` with `overrides`, `section.key=value`:
/// keys in `[simulator]`, and `run.seed`, from which the episodes' seeds derive.
///
/// # Errors
/// Names the key, the value and the remedy: the value is invalid, or the key belongs to the
/// snapshot's networks or has no effect.
pub(crate) fn with_overrides(
    config: &Config,
    snapshot: &Path,
    overrides: &[String],
    flown: Flown,
) -> anyhow::Result<Config> {
    let message = |overrides: &[String]| {
        let changed = config.overridden(snapshot, overrides);
        changed.err().map(|error| error.to_string())
    };
    let changed = match config.overridden(snapshot, overrides) {
        Ok(changed) => changed,
        Err(error) => match failing_override(overrides, message) {
            Some(text) if !error.to_string().starts_with("--set") => {
                bail!("with --set {text}, {error}")
            }
            _ => return Err(error.into()),
        },
    };
    for text in overrides {
        let key = text
            .split_once('=')
            .map_or(text.as_str(), |(key, _)| key)
            .trim();
        let is_in = |section: &str| {
            key.strip_prefix(section)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        if let Some((_, remedy)) = UNUSED.iter().find(|(unused, _)| is_in(unused)) {
            bail!("--set {text}: {key} has no effect on an evaluation; {remedy}");
        }
        if flown == Flown::Suite && is_in("simulator.disturbances") {
            bail!(
                "--set {text}: {key} has no effect on a suite, whose entries have disturbances of \
                their own; change the suite, or name courses with --course"
            );
        }
        let alone = config.overridden(snapshot, std::slice::from_ref(text));
        if alone.is_ok_and(|alone| has_other_networks(config, &alone)) {
            bail!(
                "--set {text}: {key} would change the networks, which the snapshot in {} holds as \
                they were trained; train a policy with this setting",
                snapshot.display()
            );
        }
        if is_in("simulator") || key == "run.seed" {
            continue;
        }
        bail!(
            "--set {text}: {key} has no effect on an evaluation; only keys in [simulator] and \
            run.seed have"
        );
    }
    Ok(changed)
}

fn has_other_networks(here: &Config, there: &Config) -> bool {
    SnapshotLayout::of(here).digest() != SnapshotLayout::of(there).digest()
        || here.observation_layout() != there.observation_layout()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(overrides: &[&str], flown: Flown) -> Result<Config, String> {
        let overrides: Vec<_> = overrides.iter().map(ToString::to_string).collect();
        let snapshot = Path::new("best.safetensors");
        with_overrides(&Config::default(), snapshot, &overrides, flown)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn an_evaluation_takes_another_vehicle_step_limit_and_disturbances() {
        let config = set(
            &[
                "simulator.vehicle.preset=hummingbird",
                "simulator.max_steps=200",
                "simulator.disturbances.mass_spread=0.1",
                "run.seed=7",
            ],
            Flown::Courses,
        )
        .unwrap();
        assert_eq!(config.run.seed, 7);
        let vehicle = &config.simulator["vehicle"];
        assert_eq!(vehicle["preset"].as_str(), Some("hummingbird"));
    }

    #[test]
    fn keys_of_the_networks_and_keys_without_effect_are_refused_by_name() {
        for (key, part) in [
            (
                "learning.observation=latent+velocity",
                "would change the networks",
            ),
            ("learning.history_steps=[2]", "would change the networks"),
            ("vae.latent=16", "would change the networks"),
            (
                "simulator.vehicle.action=velocity",
                "would change the networks",
            ),
            ("sac.hidden_width=64", "would change the networks"),
            ("sac.discount=0.9", "only keys in [simulator]"),
            ("run.episodes=9", "only keys in [simulator]"),
            ("evaluation.episodes=9", "--episodes"),
            ("courses.training=a.toml", "--course"),
            ("simulator.generator.wall_thickness_m=0.2", "write a suite"),
            ("vae.latent=17", "set it to one of them"),
            ("simulator.max_steps", "has no `=`"),
        ] {
            let error = set(&["simulator.max_steps=200", key], Flown::Courses).unwrap_err();
            assert!(
                error.contains(&format!("--set {key}")) && error.contains(part),
                "{key}: {error}"
            );
        }
        let gusts = "simulator.disturbances.gust.force_rms_n=0.1";
        assert!(set(&[gusts], Flown::Courses).is_ok());
        let error = set(&[gusts], Flown::Suite).unwrap_err();
        assert!(error.contains("disturbances of their own"), "{error}");
    }
}
