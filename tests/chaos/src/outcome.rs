//! Compares the outcomes of two runs, file by file and value by value.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use csv::StringRecord;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::summary::RunSummary;
use skein_run::RunDirectory;
use skein_run::failure::with_causes;

use super::curves::{Curves, read_curves};

/// Curves that depend on the machine, not on what was learned. Their values differ between any two
/// runs.
const MACHINE_CURVES: &str = "rate/";
/// Curves that depend on the fate of processes: they have points only where something was refused.
const FAULT_CURVES: [&str; 2] = ["reissued/", "refused/"];
/// Column of `episodes.csv` with the actor that flew the episode.
const ACTOR_COLUMN: &str = "actor";

/// Comparison of one item that two runs with the same configuration and seed must share.
#[derive(Debug)]
pub struct OutcomeCheck {
    /// Item compared.
    pub what: &'static str,
    /// Common value, or the first difference.
    pub verdict: Result<String, String>,
}

/// Compares the outcome of `other` with that of `calm`. Both have ended.
pub fn compare(calm: &RunDirectory, other: &RunDirectory) -> Vec<OutcomeCheck> {
    type Compare = fn(&RunDirectory, &RunDirectory) -> Result<String, String>;
    let checks: [(&'static str, Compare); 8] = [
        ("policy_sha256", policies),
        ("summary.json: counts and versions", summaries),
        ("episodes.csv without the actor", episodes),
        ("best.safetensors", |calm, other| {
            snapshots(&calm.best_snapshot(), &other.best_snapshot())
        }),
        ("latest.safetensors", |calm, other| {
            snapshots(&calm.latest_snapshot(), &other.latest_snapshot())
        }),
        ("evaluation.json", |calm, other| {
            bytes(&calm.evaluation_json(), &other.evaluation_json())
        }),
        ("evaluation_trajectories.csv", |calm, other| {
            bytes(
                &calm.evaluation_trajectories_csv(),
                &other.evaluation_trajectories_csv(),
            )
        }),
        ("TensorBoard: every point once", curves),
    ];
    checks
        .into_iter()
        .map(|(what, compare)| OutcomeCheck {
            what,
            verdict: compare(calm, other),
        })
        .collect()
}

fn summary(run: &RunDirectory) -> Result<RunSummary, String> {
    let path = run.summary_json();
    let text = fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    serde_json::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))
}

fn same<T: PartialEq + std::fmt::Display>(calm: &T, other: &T) -> Result<(), String> {
    if calm == other {
        Ok(())
    } else {
        Err(format!("{other} instead of {calm}"))
    }
}

fn policies(calm: &RunDirectory, other: &RunDirectory) -> Result<String, String> {
    let (calm, other) = (summary(calm)?, summary(other)?);
    same(&calm.policy_sha256, &other.policy_sha256)?;
    Ok(calm.policy_sha256.chars().take(16).collect())
}

fn summaries(calm: &RunDirectory, other: &RunDirectory) -> Result<String, String> {
    let learned = |of: &RunSummary| {
        format!(
            "{:?}: {} episodes, {} steps, {} updates, {} VAE updates, version {}, \
                 best {:?} with {:?} walls passed",
            of.ending,
            of.episodes,
            of.steps,
            of.updates,
            of.vae_updates,
            of.final_version,
            of.best_version.map(|version| version.0),
            of.best_confirmed_walls_passed
        )
    };
    let (calm, other) = (learned(&summary(calm)?), learned(&summary(other)?));
    same(&calm, &other)?;
    Ok(calm)
}

fn rows(path: &Path) -> Result<(StringRecord, Vec<StringRecord>), String> {
    let text = |error: csv::Error| format!("{}: {error}", path.display());
    let mut reader = csv::Reader::from_path(path).map_err(text)?;
    let header = reader.headers().map_err(text)?.clone();
    let rows = reader.records().collect::<Result<_, _>>().map_err(text)?;
    Ok((header, rows))
}

fn episodes(calm: &RunDirectory, other: &RunDirectory) -> Result<String, String> {
    let (calm_header, calm_rows) = rows(&calm.episodes_csv())?;
    let (other_header, other_rows) = rows(&other.episodes_csv())?;
    if calm_header != other_header {
        return Err(format!(
            "columns {other_header:?} instead of {calm_header:?}"
        ));
    }
    let who = calm_header.iter().position(|column| column == ACTOR_COLUMN);
    let without_who = |row: &StringRecord| -> Vec<String> {
        let kept = row
            .iter()
            .enumerate()
            .filter(|&(column, _)| Some(column) != who);
        kept.map(|(_, value)| value.to_owned()).collect()
    };
    for (number, (calm, other)) in calm_rows.iter().zip(&other_rows).enumerate() {
        if without_who(calm) != without_who(other) {
            return Err(format!("row {number} is {other:?} instead of {calm:?}"));
        }
    }
    same(&calm_rows.len(), &other_rows.len()).map_err(|problem| format!("{problem} rows"))?;
    Ok(format!("{} rows", calm_rows.len()))
}

fn snapshots(calm: &Path, other: &Path) -> Result<String, String> {
    // The configuration in the file holds absolute paths of course files, which differ between
    // directories.
    let load = |path: &Path| match Snapshot::load(path) {
        Ok((snapshot, _)) => Ok(format!(
            "version {}, {}",
            snapshot.version,
            snapshot.sha256()
        )),
        Err(_) if !path.exists() => Ok("none".to_owned()),
        Err(error) => Err(with_causes(&error)),
    };
    let (calm, other) = (load(calm)?, load(other)?);
    same(&calm, &other)?;
    Ok(calm.chars().take(32).collect())
}

fn bytes(calm: &Path, other: &Path) -> Result<String, String> {
    let read = |path: &Path| fs::read(path).map_err(|error| format!("{}: {error}", path.display()));
    let (calm, other) = (read(calm)?, read(other)?);
    match calm
        .iter()
        .zip(&other)
        .position(|(calm, other)| calm != other)
    {
        Some(at) => Err(format!("byte {at} differs")),
        None => {
            same(&calm.len(), &other.len()).map_err(|problem| format!("{problem} bytes"))?;
            Ok(format!("{} bytes", calm.len()))
        }
    }
}

fn curves(calm: &RunDirectory, other: &RunDirectory) -> Result<String, String> {
    let read =
        |run: &RunDirectory| read_curves(&run.tensorboard()).map_err(|error| with_causes(&error));
    let (calm, other) = (read(calm)?, read(other)?);
    compare_curves(&calm, &other)?;
    let points: usize = calm.values().map(std::collections::BTreeMap::len).sum();
    Ok(format!("{points} points of {} curves", calm.len()))
}

fn compare_curves(calm: &Curves, other: &Curves) -> Result<(), String> {
    let is_learned = |tag: &&String| !FAULT_CURVES.iter().any(|group| tag.starts_with(group));
    let tags: BTreeSet<_> = calm.keys().chain(other.keys()).collect();
    for tag in tags.into_iter().filter(is_learned) {
        let (Some(calm), Some(other)) = (calm.get(tag), other.get(tag)) else {
            return Err(format!("only one of the two runs has {tag}"));
        };
        let steps: BTreeSet<_> = calm.keys().chain(other.keys()).collect();
        for step in steps {
            let [calm] = calm.get(step).map_or(&[][..], Vec::as_slice) else {
                return Err(format!(
                    "the calm run does not have exactly one point of {tag} at {step}"
                ));
            };
            let value = match other.get(step).map(Vec::as_slice) {
                None => return Err(format!("{tag} has no point at {step}")),
                Some([value]) => value,
                Some(values) => return Err(format!("{tag} has {} points at {step}", values.len())),
            };
            if !tag.starts_with(MACHINE_CURVES) && calm.to_bits() != value.to_bits() {
                return Err(format!("{tag} at {step} is {value} instead of {calm}"));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str =
        "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n";

    fn run_with(rows: &str) -> (tempfile::TempDir, RunDirectory) {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path());
        fs::write(run.episodes_csv(), format!("{HEADER}{rows}")).unwrap();
        (folder, run)
    }

    #[test]
    fn only_the_actor_of_an_episode_may_differ() {
        let (_calm, calm) = run_with("0,0,0,0,1,20,1,0.5,collided\n1,0,0,1,1,20,1,0.5,collided\n");
        let (_other, other) =
            run_with("0,0,0,7,1,20,1,0.5,collided\n1,0,0,7,1,20,1,0.5,collided\n");
        assert_eq!(episodes(&calm, &other), Ok("2 rows".to_owned()));
        let (_short, short) = run_with("0,0,0,7,1,20,1,0.5,collided\n");
        assert!(episodes(&calm, &short).is_err());
        let (_changed, changed) =
            run_with("0,0,0,7,1,20,1,0.5,collided\n1,0,0,7,1,20,1,0.50000006,collided\n");
        assert!(episodes(&calm, &changed).unwrap_err().contains("row 1"));
    }

    fn curves_of(points: &[(&str, i64, f32)]) -> Curves {
        let folder = tempfile::tempdir().unwrap();
        fs::write(
            folder.path().join("events"),
            super::super::curves::samples::file(points),
        )
        .unwrap();
        read_curves(folder.path()).unwrap()
    }

    #[test]
    fn missing_duplicate_and_changed_points_are_differences() {
        let calm = curves_of(&[
            ("sac/loss", 1, 0.5),
            ("sac/loss", 2, 0.25),
            ("rate/steps", 1, 100.0),
        ]);
        let problem = |points: &[_]| compare_curves(&calm, &curves_of(points)).unwrap_err();
        let sound = [
            ("sac/loss", 1, 0.5),
            ("sac/loss", 2, 0.25),
            ("rate/steps", 1, 99.0),
        ];
        assert_eq!(compare_curves(&calm, &curves_of(&sound)), Ok(()));
        assert!(problem(&[sound[0], sound[2]]).contains("no point at 2"));
        assert!(problem(&[sound[0], sound[1], sound[1], sound[2]]).contains("2 points at 2"));
        assert!(
            problem(&[sound[0], ("sac/loss", 2, 0.26), sound[2]]).contains("0.26 instead of 0.25")
        );
        assert!(problem(&[sound[0], sound[1]]).contains("only one"));
        assert!(
            problem(&[sound[0], sound[1], sound[2], ("rate/steps", 3, 1.0)]).contains("calm run")
        );
    }
}
