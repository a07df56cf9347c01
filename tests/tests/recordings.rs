//! `run.record_every`: what is recorded, that it is what was flown, and that it changes nothing.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;

use skein_recordings::{images, read};
use skein_run::RunDirectory;
use skein_tests::RunRecipe;

/// Returns the recordings of a run by name.
fn recordings(run: &RunDirectory) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(run.recordings()).unwrap();
    entries
        .map(|entry| entry.unwrap())
        .map(|entry| {
            let name = entry.file_name().into_string().unwrap();
            (name, fs::read(entry.path()).unwrap())
        })
        .collect()
}

#[test]
fn a_recorded_run_learns_the_same_and_its_recordings_do_not_depend_on_the_actors() {
    let plain = RunRecipe::small().finish();
    assert!(!plain.directory.recordings().exists());
    let recorded = || RunRecipe::small().set("run.record_every=10");
    let (one, three) = (recorded().actors(1).finish(), recorded().actors(3).finish());
    for run in [&one, &three] {
        run.learned()
            .assert_same(&plain.learned(), "what is recorded");
    }
    let (one, three) = (recordings(&one.directory), recordings(&three.directory));
    let training = |name: &&String| name.starts_with("training-");
    let named: Vec<_> = one.keys().filter(training).collect();
    assert_eq!(named.len(), 4, "{named:?}");
    for name in named {
        assert_eq!(one[name], three[name], "{name}");
    }

    let rows = plain.episodes();
    for (episode, row) in rows.iter().enumerate().step_by(10) {
        let prefix = format!("training-{episode}-");
        let (name, file) = one
            .iter()
            .find(|(name, _)| name.starts_with(&prefix))
            .unwrap();
        assert!(name.contains(row.outcome.as_str()), "{name}");
        let [flight] = &read(file).unwrap()[..] else {
            panic!("{name} has other than one episode")
        };
        assert_eq!(flight.steps.len(), row.steps as usize + 1, "{name}");
        let reward = |step: &skein_recordings::RecordedStep| f64::from(step.numbers["reward"][0]);
        let total: f64 = flight.steps.iter().map(reward).sum();
        assert!(
            (total - row.r#return.parse::<f64>().unwrap()).abs() < 1e-4,
            "{name}"
        );
        let pixels = 72 * 128;
        assert_eq!(images(file, 0).unwrap().len(), flight.steps.len() * pixels);
    }
    // The last evaluation is the final one: none flies its first episode alone, a second time.
    let of_evaluations = one.keys().filter_map(|name| {
        let mut numbers = name.strip_prefix("evaluation-")?.split('-');
        let mut next = || numbers.next().unwrap().parse::<u64>().unwrap();
        Some((next(), next()))
    });
    let of_evaluations: BTreeSet<_> = of_evaluations.collect();
    assert!(
        of_evaluations
            .last()
            .is_some_and(|&(_, episode)| episode > 0),
        "{:?}",
        one.keys()
    );
}
