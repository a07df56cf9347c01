//! Files in a run's directory besides configuration and snapshots, and standard output of its
//! learner.

use std::sync::LazyLock;

use skein_launch::conclusion::conclusion;
use skein_launch::display::ProgressDisplay;
use skein_launch::supervisor::Restarts;
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::Config;
use skein_protocol::evaluation::{CourseEvaluation, EpisodeScore, EvaluationReport};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::progress::ProgressReport;
use skein_protocol::summary::RunSummary;
use skein_protocol::transition::Outcome;
use skein_run::{Announcement, LearnerIncarnation, RunDirectory, RunIdentity};

use super::{ReaderDecision, Target, USUAL, tagged};
use crate::scratch::with_files;

pub(super) const IDENTITY: Target = Target {
    name: "run_identity",
    reads: "run.json",
    longest_bytes: 1024,
    weight: USUAL,
    samples: || vec![RUN.0.clone()],
    run: identity,
};

pub(super) const ANNOUNCEMENT: Target = Target {
    name: "announcement",
    reads: "the learner's announcement of its present incarnation",
    longest_bytes: 1024,
    weight: USUAL,
    samples: || {
        let incarnation: LearnerIncarnation = serde_json::from_str("7").unwrap();
        let (identity, config) = opened();
        vec![serde_json::to_vec(&Announcement::new(&identity, incarnation, &config)).unwrap()]
    },
    run: |bytes| {
        let read = serde_json::from_slice::<Announcement>(bytes).ok();
        let joined =
            read.filter(|announcement| announcement.check(&IDENTIFIED.0, &IDENTIFIED.1).is_ok());
        if let Some(announcement) = &joined {
            // The learner chooses incarnation and process id; all else must equal what this code
            // would write.
            let mut mine =
                Announcement::new(&IDENTIFIED.0, announcement.incarnation, &IDENTIFIED.1);
            mine.pid = announcement.pid;
            assert_eq!(announcement, &mine);
        }
        ReaderDecision::of(joined)
    },
};

pub(super) const RESULTS: Target = Target {
    name: "results",
    reads: "evaluation.json (after a 0) and summary.json (after a 1), as read by a run's \
            conclusion",
    longest_bytes: 4096,
    weight: USUAL,
    samples: result_samples,
    run: results,
};

pub(super) const PROGRESS: Target = Target {
    name: "progress",
    reads: "standard output of a learner, line by line, as it is shown",
    longest_bytes: 4096,
    weight: USUAL,
    samples: progress_samples,
    run: progress,
};

/// `run.json` and `config.toml` of a run.
static RUN: LazyLock<(Vec<u8>, Vec<u8>)> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDirectory::new(folder.path());
    run.create(&Config::default()).unwrap();
    let read = |path| std::fs::read(path).unwrap();
    (read(run.identity()), read(run.config()))
});

static IDENTIFIED: LazyLock<(RunIdentity, Config)> = LazyLock::new(opened);

fn opened() -> (RunIdentity, Config) {
    with_files(&[("run.json", &RUN.0), ("config.toml", &RUN.1)], |folder| {
        RunDirectory::new(folder).open()
    })
    .unwrap()
}

fn identity(bytes: &[u8]) -> ReaderDecision {
    with_files(
        &[("run.json", bytes), ("config.toml", &RUN.1)],
        |folder| match RunDirectory::new(folder).open() {
            Ok((identity, config)) => {
                assert_eq!(identity.protocol_version, PROTOCOL_VERSION);
                assert_eq!(identity.config_digest, config.digest());
                ReaderDecision::Accepted
            }
            Err(error) => {
                assert!(
                    error.to_string().contains(&folder.display().to_string()),
                    "{error}"
                );
                ReaderDecision::Refused
            }
        },
    )
}

fn result_samples() -> Vec<Vec<u8>> {
    let scores = [EpisodeScore {
        walls_passed: 3,
        walls: 5,
        episode_return: -1.5,
        outcome: Outcome::Collided,
        hit_wall: Some(4),
    }; 4];
    let report = EvaluationReport {
        policy_version: PolicyVersion(80),
        policy_sha256: "1024266715d59141".to_owned(),
        courses: vec![CourseEvaluation::of("training", &scores)],
    };
    // Constant rather than generated: it lists all possible fields, and a reader that knows fewer
    // of them must read it too.
    let summary = r#"{"skein_version":"0.1.0","run":7,"seed":1,"ending":"completed",
        "policy_sha256":"1024266715d59141",
        "final_version":80,
        "best_version":70,"best_confirmed_walls_passed":4.9,
        "episodes":800,"steps":42837,"updates":20418,
        "vae_updates":400,
        "evaluation_episodes":400,"tickets_reissued":0,"records_refused":0,"wall_secs":333.3,
        "stages":[{"thread":"actors","stage":"physics","count":42000,"secs":12.5},
            {"thread":"training","stage":"idle","count":80,"secs":200.0}]}"#;
    let read: RunSummary = serde_json::from_str(summary).unwrap();
    let written = serde_json::to_vec(&read).unwrap();
    vec![
        tagged(0, &serde_json::to_vec(&report).unwrap()),
        tagged(1, &written),
    ]
}

fn results(bytes: &[u8]) -> ReaderDecision {
    let Some((&kind, content)) = bytes.split_first() else {
        return ReaderDecision::Refused;
    };
    let name = if kind % 2 == 0 {
        "evaluation.json"
    } else {
        "summary.json"
    };
    with_files(&[(name, content)], |folder| {
        let text = conclusion(&RunDirectory::new(folder), 80);
        assert!(text.contains(name), "{text}");
        // Invalid files are left out.
        let shown = ["Best snapshot (", "Final policy ("]
            .into_iter()
            .find(|words| text.contains(words));
        ReaderDecision::of(shown)
    })
}

fn progress_samples() -> Vec<Vec<u8>> {
    let line = |phase: &str, episodes: u64, secs: f64| {
        format!(
            concat!(
                r#"{{"phase":"{}","episodes":{},"total_episodes":2000,"#,
                r#""evaluation_episodes":[0,20],"steps":10000,"updates":4000,"vae_updates":100,"#,
                r#""steps_per_sec":151.6,"updates_per_sec":63.2,"walls_passed":1.25,"#,
                r#""mean_return":null,"temperature":0.05,"vae_loss":50.1,"actors":2,"#,
                r#""elapsed_secs":{}}}"#
            ),
            phase, episodes, secs
        )
    };
    let lines = [
        line("flying", 10, 1.0),
        line("learning", 20, 2.0),
        line("evaluating", 20, 62.5),
        line("finishing", 0, 0.0),
    ];
    let sample = lines.join("\n").into_bytes();
    let understood = sample
        .split(|byte| *byte == b'\n')
        .all(|line| serde_json::from_slice::<ProgressReport>(line).is_ok());
    assert!(
        understood,
        "the samples are progress lines of another version"
    );
    vec![sample]
}

fn progress(bytes: &[u8]) -> ReaderDecision {
    let mut display = ProgressDisplay::new();
    let mut verdict = ReaderDecision::Refused;
    for line in bytes.split(|byte| *byte == b'\n') {
        if let Ok(progress) = serde_json::from_slice::<ProgressReport>(line) {
            let (head, figures) = display.text(&progress, Restarts::default());
            assert!(!head.is_empty() && !figures.is_empty());
            verdict = ReaderDecision::Accepted;
        }
    }
    verdict
}
