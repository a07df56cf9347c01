//! What the user is told at the end of a run: the evaluation, where the time went, and where
//! everything lies.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::stages::StageTimes;
use skein_protocol::summary::{RunEnding, Summary, Trained};
use skein_run::RunDirectory;
use skein_run::tables::{evaluation_table, stages_table};

use skein_reports::Clock;

/// The evaluation table, the run in one sentence, the table of where the time went, and the paths
/// of everything it left, for standard output. What a run did not come to write is left out.
pub fn conclusion(run: &RunDirectory) -> String {
    let mut text = String::new();
    if let Some(report) = read::<EvaluationReport>(&run.evaluation_json()) {
        push(
            &mut text,
            &format!(
                "Best snapshot (version {}), flown without exploration:\n{}\n",
                report.policy_version,
                evaluation_table(&report)
            ),
        );
    }
    if let Some(summary) = run.summary() {
        if let Some(trained) = &summary.trained {
            push(&mut text, &trained_sentence(trained));
        }
        push(&mut text, &sentence(&summary));
        if summary.stages != StageTimes::default() {
            push(&mut text, &format!("{}\n", stages_table(&summary.stages)));
        }
    }
    push(&mut text, &format!("{}:", run.root().display()));
    for (path, meaning) in artefacts(run) {
        let shown = path
            .strip_prefix(run.root())
            .unwrap_or(&path)
            .display()
            .to_string();
        push(&mut text, &format!("  {shown:<30} {meaning}"));
    }
    text
}

fn push(text: &mut String, line: &str) {
    writeln!(text, "{line}").expect("writing to a string cannot fail");
}

fn read<T: DeserializeOwned>(path: &Path) -> Option<T> {
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

fn trained_sentence(trained: &Trained) -> String {
    format!(
        "Trained after {}: R {:.3} in evaluation episodes after {} episodes, {} steps, {} updates.",
        Clock(trained.wall_secs),
        trained.rate,
        trained.episodes,
        trained.steps,
        trained.updates
    )
}

fn sentence(summary: &Summary) -> String {
    let ending = match summary.ending {
        RunEnding::Completed => "Completed",
        RunEnding::Interrupted => "Interrupted",
    };
    format!(
        "{ending} after {}: {} episodes, {} steps, {} updates, {} VAE updates. Final policy (version {}): {}.\n",
        Clock(summary.wall_secs),
        summary.episodes,
        summary.steps,
        summary.updates,
        summary.vae_updates,
        summary.final_version,
        summary
            .policy_sha256
            .get(..16)
            .unwrap_or(&summary.policy_sha256)
    )
}

/// What is there, and what it is.
fn artefacts(run: &RunDirectory) -> Vec<(PathBuf, &'static str)> {
    let plot = |name: &str| run.plots().join(name);
    [
        (run.config(), "the resolved configuration"),
        (run.courses(), "the courses flown"),
        (run.episodes_csv(), "one row per training episode"),
        (run.evaluation_json(), "the evaluation above"),
        (run.evaluation_trajectories_csv(), "where its episodes flew"),
        (run.summary_json(), "counts, times above, policy_sha256"),
        (plot("return.png"), "return over the training episodes"),
        (
            plot("walls_passed.png"),
            "walls passed over the training episodes",
        ),
        (
            plot("reconstructions.png"),
            "depth images and what the VAE makes of them",
        ),
        (
            plot("trajectories.png"),
            "evaluation episodes through the walls",
        ),
        (
            run.best_snapshot(),
            "the best snapshot: launch/evaluate.sh --run DIR",
        ),
        (run.latest_snapshot(), "the last snapshot"),
        (run.checkpoints(), "everything the learner knew"),
        (run.tensorboard(), "curves: tensorboard --logdir DIR"),
        (run.logs(), "a log for each process"),
    ]
    .into_iter()
    .filter(|(path, _)| path.exists())
    .collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;
    use std::time::Duration;

    use skein_protocol::evaluation::CourseEvaluation;
    use skein_protocol::ids::{PolicyVersion, RunId};
    use skein_protocol::stages::Stage;

    use super::*;

    #[test]
    fn a_finished_run_is_told_with_its_table_and_paths() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let report = EvaluationReport {
            policy_version: PolicyVersion(42),
            policy_sha256: "00".to_owned(),
            courses: vec![CourseEvaluation::of("training", 5, &[])],
        };
        let mut stages = StageTimes::default();
        stages.add(Stage::Encoder, 2000, Duration::from_millis(1500));
        let summary = Summary {
            skein_version: "0".to_owned(),
            run: RunId(1),
            seed: 1,
            ending: RunEnding::Completed,
            policy_sha256: "0123456789abcdef0000".to_owned(),
            final_version: PolicyVersion(50),
            best_version: None,
            best_confirmed_walls_passed: None,
            trained: Some(Trained {
                rate: 0.93,
                episodes: 90,
                steps: 1800,
                updates: 270,
                wall_secs: 61.0,
            }),
            episodes: 100,
            steps: 2000,
            updates: 300,
            vae_updates: 40,
            evaluation_episodes: 0,
            tickets_reissued: 0,
            records_refused: 0,
            reissued_by_reason: Default::default(),
            refused_by_reason: Default::default(),
            resumes: 0,
            wall_secs: 75.0,
            stages,
            thread_cpu_secs: BTreeMap::new(),
        };
        fs::write(
            run.evaluation_json(),
            serde_json::to_string(&report).unwrap(),
        )
        .unwrap();
        fs::write(run.summary_json(), serde_json::to_string(&summary).unwrap()).unwrap();
        let text = conclusion(&run);
        for part in [
            "version 42",
            "training",
            "Trained after 1:01: R 0.930 in evaluation episodes after 90 episodes, 1800 steps",
            "Completed after 1:15: 100 episodes, 2000 steps",
            "│ actors, together    ┆ encoder ┆  2000 ┆ 1.50 s ┆ 750.00 µs ┆ 100.0 % │",
            "summary.json",
        ] {
            assert!(text.contains(part), "`{part}` is missing in\n{text}");
        }
        assert!(
            !text.contains("episodes.csv"),
            "what is not there is not listed:\n{text}"
        );
    }

    #[test]
    fn a_run_that_left_nothing_has_a_conclusion_still() {
        let directory = tempfile::tempdir().unwrap();
        assert!(
            conclusion(&RunDirectory::new(directory.path()))
                .contains(&directory.path().display().to_string())
        );
    }
}
