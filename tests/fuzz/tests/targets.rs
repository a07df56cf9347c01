//! Every target, over its samples, its committed inputs, and what a few seconds of mutation with a
//! fixed seed make of them.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_fuzz::mutation::mutate;
use skein_fuzz::{TARGETS, Target, Verdict, committed, word_list};

/// Mutations of one target are tried this long...
const TIME: Duration = Duration::from_millis(1200);
/// ... or until there were so many: what is reached on a fast machine is reached there every time.
const MOST: usize = 50_000;
/// No input may take longer, on however busy a machine.
const SLOWEST: Duration = Duration::from_secs(10);

/// Reads `bytes`; if that breaks a promise, says how to see it again.
#[track_caller]
fn exercise(target: &Target, what: &str, bytes: &[u8]) -> Verdict {
    let started = Instant::now();
    let Ok(verdict) = catch_unwind(AssertUnwindSafe(|| target.exercise(bytes))) else {
        let kept = std::env::temp_dir().join(format!("skein-fuzz-{}-finding", target.name));
        let written = std::fs::write(&kept, bytes);
        panic!(
            "target {}, {what}: the input lies in {} ({written:?})",
            target.name,
            kept.display()
        );
    };
    let took = started.elapsed();
    assert!(
        took < SLOWEST,
        "target {}, {what}: took {took:?}: {bytes:?}",
        target.name
    );
    verdict
}

fn drive(name: &str) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    let samples = (target.samples)();
    let verdicts = samples.iter().enumerate();
    let mut verdicts: Vec<_> = verdicts
        .map(|(number, sample)| exercise(target, &format!("sample {number}"), sample))
        .collect();
    // What refuses everything tries no promise: the samples are sound.
    assert!(
        verdicts.contains(&Verdict::Accepted),
        "no sample of {name} is accepted"
    );
    let mut inputs = samples.clone();
    for (file, bytes) in committed(target) {
        exercise(target, &file, &bytes);
        inputs.push(bytes);
    }
    let words = word_list(&samples);
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let started = Instant::now();
    for number in 0..MOST {
        let mut input = inputs[rng.random_range(0..inputs.len())].clone();
        let other = &inputs[rng.random_range(0..inputs.len())];
        mutate(&mut input, other, &words, target.longest_bytes, &mut rng);
        verdicts.push(exercise(target, &format!("mutation {number}"), &input));
        if started.elapsed() > TIME {
            break;
        }
    }
    assert!(
        verdicts.contains(&Verdict::Refused),
        "everything is accepted by {name}"
    );
    let accepted = verdicts
        .iter()
        .filter(|verdict| **verdict == Verdict::Accepted)
        .count();
    println!(
        "{name}: {accepted} of {} inputs were accepted",
        verdicts.len()
    );
}

/// What once broke a promise, by its file in `regressions/`, and what is thought of it now.
#[track_caller]
fn recall(name: &str, file: &str, expected: Verdict) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    let path = format!("regressions/{name}/{file}");
    let (_, bytes) = committed(target)
        .into_iter()
        .find(|(found, _)| *found == path)
        .unwrap();
    assert_eq!(exercise(target, file, &bytes), expected);
}

#[test]
fn sections_within_sections_are_refused_before_they_can_only_be_written() {
    recall("overrides", "deeply_nested_sections", Verdict::Refused);
}

#[test]
fn a_buffer_that_has_counted_to_the_end_is_refused_before_it_counts_on() {
    recall("replay", "inserted_at_the_end_of_numbers", Verdict::Refused);
}

#[test]
fn returns_near_the_end_of_numbers_are_refused_before_an_axis_is_divided() {
    recall(
        "report_pictures",
        "returns_at_the_end_of_numbers",
        Verdict::Refused,
    );
}

#[test]
fn places_far_beyond_any_course_are_refused() {
    recall("report_pictures", "flown_to_infinity", Verdict::Refused);
}

#[test]
fn a_file_of_episodes_that_lost_its_last_line_end_is_continued_on_the_next_line() {
    recall("episodes_csv", "last_line_without_end", Verdict::Accepted);
}

#[test]
fn an_event_file_outside_the_folder_is_left_alone() {
    recall("event_files", "name_outside_the_folder", Verdict::Refused);
}

macro_rules! drive {
    ($($claim:ident => $target:literal),* $(,)?) => {
        $(#[test] fn $claim() { drive($target); })*

        #[test]
        fn every_target_is_driven() {
            let driven = [$($target),*];
            assert_eq!(TARGETS.each_ref().map(|target| target.name), driven);
        }
    };
}

drive! {
    no_configuration_file_panics_and_what_is_accepted_reads_back => "config",
    no_override_panics_and_what_is_refused_has_a_culprit => "overrides",
    no_simulator_section_panics_and_what_is_accepted_flies => "simulator",
    no_experiment_panics_and_what_is_accepted_can_be_run => "experiment",
    no_course_file_panics_and_what_is_accepted_flies => "course_file",
    no_geometry_panics_and_what_is_accepted_flies => "course_layout",
    no_generator_ranges_panic_and_what_is_drawn_flies => "generator",
    no_suite_panics_and_what_is_accepted_has_courses => "suite_file",
    no_records_panic_and_what_is_committed_is_whole_and_finite => "records",
    no_signal_panics_and_what_is_believed_says_the_same_again => "signals",
    no_snapshot_file_panics_and_what_is_accepted_is_finite => "snapshot_file",
    no_received_snapshot_panics_and_what_is_accepted_is_what_was_sent => "snapshot_received",
    no_checkpoint_file_panics_and_what_is_loaded_can_be_used => "checkpoint",
    no_replay_content_panics_and_what_is_restored_goes_on => "replay",
    no_episodes_csv_panics_and_what_is_continued_can_be_continued_again => "episodes_csv",
    no_list_of_event_files_reaches_beyond_their_folder => "event_files",
    no_run_identity_panics_and_what_is_accepted_is_of_its_configuration => "run_identity",
    no_announcement_panics_and_what_may_be_joined_is_what_we_would_say => "announcement",
    no_result_file_panics_the_conclusion => "results",
    no_progress_line_panics_the_display => "progress",
    no_report_file_panics_its_reader => "report_files",
    no_report_file_panics_the_plots => "report_pictures",
    no_event_file_panics_its_reader => "curves",
}
