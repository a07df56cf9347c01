//! Summary at the end of a run: its evaluation, where the time went, and where its files are.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use skein_protocol::config::EvaluationSection;
use skein_protocol::config::ParameterKey;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::files::{self, REPORT_BYTES};
use skein_protocol::stages::StageTimes;
use skein_protocol::summary::{RunEnding, RunSummary, Trained};
use skein_run::RunDirectory;
use skein_run::tables::{evaluation_table, stages_table};

use skein_reports::Clock;

/// Returns the evaluation table, a sentence on the run, the table of times per stage, and the paths
/// of all files the run left, for standard output of `columns`. Parts that the run did not write
/// are left out.
pub fn conclusion(run: &RunDirectory, columns: usize) -> String {
    let mut text = String::new();
    if let Some(report) = read::<EvaluationReport>(&run.evaluation_json()) {
        push(
            &mut text,
            &format!(
                "Best snapshot (version {}), flown without exploration:\n{}\n",
                report.policy_version,
                evaluation_table(&report, columns)
            ),
        );
    }
    if let Some(summary) = run.summary() {
        if let Some(trained) = &summary.trained {
            push(&mut text, &trained_sentence(trained));
        }
        push(&mut text, &sentence(&summary));
        if let Some(reason) = &summary.untrained {
            push(&mut text, &format!("{reason}\n"));
        }
        if summary.stages != StageTimes::default() {
            push(
                &mut text,
                &format!("{}\n", stages_table(&summary.stages, columns)),
            );
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
    serde_json::from_slice(&files::read(path, REPORT_BYTES).ok()?).ok()
}

fn trained_sentence(trained: &Trained) -> String {
    let flown = trained.confirmation_episodes;
    let (flown, remark) = match flown {
        // Written by a version that did not record it.
        0 => ("".to_owned(), ""),
        1 => (
            "1 ".to_owned(),
            " One says little: raise evaluation.confirm_episodes.",
        ),
        few if few < EvaluationSection::FEW_EPISODES => (
            format!("{few} "),
            " So few say little: raise evaluation.confirm_episodes.",
        ),
        enough => (format!("{enough} "), ""),
    };
    format!(
        "Trained after {}: R (share of walls passed) {:.3} in {flown}evaluation episode{}, \
         after {} episodes, {} steps, {} updates.{remark}",
        Clock(trained.wall_secs),
        trained.rate,
        if trained.confirmation_episodes == 1 {
            ""
        } else {
            "s"
        },
        trained.episodes,
        trained.steps,
        trained.updates
    )
}

fn sentence(summary: &RunSummary) -> String {
    let ending = match summary.ending {
        RunEnding::Completed => "Completed",
        RunEnding::Interrupted => "Interrupted",
    };
    format!(
        "{ending} after {}: {} episodes, {} steps, {} updates, {} VAE updates. \
             Final policy (version {}): {}.\n",
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

/// Returns the files that exist, each with its meaning.
fn artefacts(run: &RunDirectory) -> Vec<(PathBuf, &'static str)> {
    let plot = |name: &str| run.plots().join(name);
    [
        (run.config(), "the resolved configuration"),
        (run.courses(), "courses of the run"),
        (
            run.parameters(ParameterKey::Encoder),
            "the encoder that the run started from",
        ),
        (
            run.parameters(ParameterKey::Policy),
            "the policy that the run started from",
        ),
        (run.parameters(ParameterKey::Teacher), "the teacher"),
        (run.episodes_csv(), "one row per training episode"),
        (run.evaluation_json(), "the evaluation above"),
        (
            run.evaluation_trajectories_csv(),
            "trajectories of the evaluation episodes",
        ),
        (run.summary_json(), "counts, times per stage, policy_sha256"),
        (plot("return.png"), "return of the training episodes"),
        (
            plot("walls_passed.png"),
            "walls passed by the training episodes",
        ),
        (
            plot("reconstructions.png"),
            "depth images and their VAE reconstructions",
        ),
        (
            plot("trajectories.png"),
            "trajectories of the evaluation episodes",
        ),
        (
            run.best_snapshot(),
            "the best snapshot; fly it: launch/evaluate.sh --run DIR",
        ),
        (run.latest_snapshot(), "the last snapshot"),
        (
            run.checkpoints(),
            "full state of the learner, to resume from",
        ),
        (
            run.recordings(),
            "recorded episodes: launch/watch.sh plays them",
        ),
        (
            run.tensorboard(),
            "training curves: tensorboard --logdir DIR",
        ),
        (run.logs(), "one log per process"),
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
    fn the_conclusion_of_a_finished_run_has_its_table_and_paths() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let report = EvaluationReport {
            policy_version: PolicyVersion(42),
            policy_sha256: "00".to_owned(),
            courses: vec![CourseEvaluation::of("training", &[])],
        };
        let mut stages = StageTimes::default();
        stages.add(Stage::Encoder, 2000, Duration::from_millis(1500));
        let summary = RunSummary {
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
                confirmation_episodes: 20,
                episodes: 90,
                steps: 1800,
                updates: 270,
                wall_secs: 61.0,
            }),
            untrained: None,
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
        let text = conclusion(&run, usize::MAX);
        for part in [
            "version 42",
            "training",
            "Trained after 1:01: R (share of walls passed) 0.930 in 20 evaluation episodes, \
             after 90 episodes, 1800",
            "Completed after 1:15: 100 episodes, 2000 steps",
            "│ actors, together    ┆ encoder ┆  2000 ┆ 1.50 s ┆ 750.00 µs ┆ 100.0 % │",
            "summary.json",
        ] {
            assert!(text.contains(part), "`{part}` is missing in\n{text}");
        }
        assert!(
            !text.contains("episodes.csv"),
            "a file that does not exist is not listed:\n{text}"
        );
    }

    #[test]
    fn the_sentence_on_success_says_on_how_many_episodes_it_rests() {
        let sentence = |confirmation_episodes| {
            trained_sentence(&Trained {
                rate: 1.0,
                confirmation_episodes,
                episodes: 50,
                steps: 900,
                updates: 50,
                wall_secs: 9.0,
            })
        };
        let three = sentence(3);
        assert!(
            three.contains("1.000 in 3 evaluation episodes,")
                && three.contains("evaluation.confirm_episodes"),
            "{three}"
        );
        assert!(sentence(1).contains("1.000 in 1 evaluation episode,"));
        let enough = sentence(EvaluationSection::FEW_EPISODES);
        assert!(!enough.contains("confirm_episodes"), "{enough}");
        assert!(sentence(0).contains("1.000 in evaluation episodes,"));
    }

    #[test]
    fn a_run_that_left_nothing_still_has_a_conclusion() {
        let directory = tempfile::tempdir().unwrap();
        assert!(
            conclusion(&RunDirectory::new(directory.path()), 80)
                .contains(&directory.path().display().to_string())
        );
    }
}
