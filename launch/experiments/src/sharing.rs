//! Reuses runs of other experiments. A run is a function of its configuration and seed, so there is
//! no need to train it twice.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use skein_run::RunDirectory;

use super::plan::{ExperimentPlan, PlanError, PlannedRun, RunState, io_at};
use super::results::RunResult;

impl ExperimentPlan {
    /// Replaces every run that does not exist by a link to the same run of another experiment in
    /// the same folder, if it is fully trained there. Returns the names of these runs, and the
    /// linked directories.
    ///
    /// # Errors
    /// [`PlanError::Io`] if a link cannot be created, [`PlanError::Runs`] if the linked run has
    /// changed meanwhile.
    pub fn link_trained_runs(&mut self) -> Result<Vec<(String, PathBuf)>, PlanError> {
        let others: Vec<PathBuf> = arms_beside(&self.root);
        let mut found = Vec::new();
        for run in self
            .runs
            .iter_mut()
            .filter(|run| run.state == RunState::New)
        {
            let Some(other) = others.iter().find_map(|arm| run.trained_in(arm)) else {
                continue;
            };
            run.link_to(&other)?;
            run.state = run.look().map_err(|problem| PlanError::Runs {
                root: self.root.clone(),
                problems: vec![problem],
            })?;
            found.push((run.name.clone(), other));
        }
        Ok(found)
    }
}

/// Returns the arms of all other experiments beside the one in `root`, in a fixed order.
fn arms_beside(root: &Path) -> Vec<PathBuf> {
    let folders = |path: &Path| -> Vec<PathBuf> {
        let entries = fs::read_dir(path).into_iter().flatten().flatten();
        entries
            .map(|entry| entry.path())
            .filter(|path| path.is_dir())
            .collect()
    };
    let beside = root.parent().map(folders).unwrap_or_default();
    let mut arms: Vec<PathBuf> = beside
        .iter()
        .filter(|other| *other != root)
        .flat_map(|other| folders(other))
        .collect();
    arms.sort();
    arms
}

impl PlannedRun {
    /// Returns the directory of the same run in `arm` of another experiment, if it is fully
    /// trained. Links are resolved to their target.
    fn trained_in(&self, arm: &Path) -> Option<PathBuf> {
        let directory = arm.join(format!("seed-{}", self.seed));
        if directory.is_symlink() || !directory.is_dir() {
            return None;
        }
        let other = Self {
            directory: RunDirectory::new(directory.clone()),
            suite_json: None,
            ..self.clone()
        };
        // A run that cannot be reported is useless here and is trained again.
        (other.look() == Ok(RunState::Complete) && RunResult::trained(&other).is_ok())
            .then_some(directory)
    }

    /// The link is relative, so that all experiments can be moved together.
    fn link_to(&self, other: &Path) -> Result<(), PlanError> {
        let root = self.directory.root();
        let within: Vec<_> = other.iter().collect();
        let target: PathBuf =
            Path::new("../..").join(within.iter().rev().take(3).rev().collect::<PathBuf>());
        if let Some(folder) = root.parent() {
            fs::create_dir_all(folder).map_err(io_at(folder))?;
        }
        // A run that never began may have left an empty folder.
        if root.is_dir() {
            fs::remove_dir(root).map_err(io_at(root))?;
        }
        symlink(target, root).map_err(io_at(root))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::definition::Experiment;
    use crate::plan::ACTORS;
    use skein_prepare::prepare;

    fn experiment(folder: &Path, name: &str, shares: [&str; 2]) -> Experiment {
        let base = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/smoke.toml");
        let arm = |name, share| {
            format!(
                "[[arm]]\nname = \"{name}\"\nlabel = \"{name}\"\nsettings.replay.success_share = \
                 {share}\n"
            )
        };
        let text = format!(
            "question = \"?\"\nbase = {base:?}\nseeds = 2\ntables = []\ncurves = []\n{}{}",
            arm("a", shares[0]),
            arm("b", shares[1])
        );
        fs::write(folder.join(format!("{name}.toml")), text).unwrap();
        Experiment::load(folder, name, None).unwrap()
    }

    /// Creates the files of a fully trained run.
    fn train(run: &PlannedRun, experiment: &Experiment) {
        prepare(
            &experiment.base,
            &run.overrides,
            run.directory.root(),
            ACTORS,
        )
        .unwrap();
        let summary = r#"{"skein_version":"0","run":7,"seed":2,"ending":"completed",
        "policy_sha256":"",
        "final_version":8,"best_version":7,
            "best_confirmed_walls_passed":4.9,"episodes":8,"steps":4,"updates":2,
        "vae_updates":4,"evaluation_episodes":4,
            "tickets_reissued":0,"records_refused":0,"wall_secs":3.3}"#;
        fs::write(run.directory.summary_json(), summary).unwrap();
        let evaluation = r#"{"policy_version":7,"policy_sha256":"","courses":[]}"#;
        fs::write(run.directory.evaluation_json(), evaluation).unwrap();
        fs::write(
            run.directory.episodes_csv(),
            "steps,walls_passed,return\n4,2,1.0\n",
        )
        .unwrap();
    }

    fn taken_over(plan: &mut ExperimentPlan) -> Vec<String> {
        plan.link_trained_runs()
            .unwrap()
            .into_iter()
            .map(|(name, _)| name)
            .collect()
    }

    #[test]
    fn a_run_that_another_experiment_has_trained_is_not_trained_again() {
        let folder = tempfile::tempdir().unwrap();
        let root = |name: &str| folder.path().join("runs").join(name);
        let first = experiment(folder.path(), "first", ["0.25", "0.5"]);
        let plan = ExperimentPlan::new(&first, &root("first"), 2).unwrap();
        train(&plan.runs[0], &first);
        prepare(
            &first.base,
            &plan.runs[2].overrides,
            plan.runs[2].directory.root(),
            ACTORS,
        )
        .unwrap();

        let second = experiment(folder.path(), "second", ["0.125", "0.25"]);
        let mut plan = ExperimentPlan::new(&second, &root("second"), 2).unwrap();
        assert_eq!(
            taken_over(&mut plan),
            ["b/seed-1"],
            "seed 2 was begun but not completed"
        );
        assert_eq!(plan.count(RunState::Complete), 1);
        assert_eq!(
            fs::read_link(root("second/b/seed-1")).unwrap(),
            Path::new("../../first/a/seed-1")
        );
        assert_eq!(
            ExperimentPlan::new(&second, &root("second"), 2).unwrap(),
            plan,
            "the link stays"
        );
        assert!(taken_over(&mut plan).is_empty());

        // A run that cannot be reported is not linked.
        let damaged = plan.runs[1].directory.evaluation_json();
        let whole = fs::read(&damaged).unwrap();
        fs::write(&damaged, "{").unwrap();
        let other = experiment(folder.path(), "other", ["0.25", "0.75"]);
        assert!(
            taken_over(&mut ExperimentPlan::new(&other, &root("other"), 1).unwrap()).is_empty()
        );
        fs::write(&damaged, whole).unwrap();

        // A link to a link points to the run itself.
        let third = experiment(folder.path(), "third", ["0.25", "0.75"]);
        let mut plan = ExperimentPlan::new(&third, &root("third"), 1).unwrap();
        assert_eq!(
            plan.link_trained_runs().unwrap(),
            [("a/seed-1".to_owned(), root("first/a/seed-1"))]
        );

        fs::rename(root("first"), folder.path().join("gone")).unwrap();
        let refusal = ExperimentPlan::new(&third, &root("third"), 1)
            .unwrap_err()
            .to_string();
        assert!(
            refusal.contains("a/seed-1 is a link to a run that no longer exists"),
            "{refusal}"
        );
    }
}
