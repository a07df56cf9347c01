//! Runs every target over its samples, its committed inputs, and a few seconds of mutations with a
//! fixed seed.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_fuzz::mutation::mutate;
use skein_fuzz::{ReaderDecision, TARGETS, Target, committed, word_list};

/// Duration of the mutations of one target…
const TIME: Duration = Duration::from_millis(1200);
/// … or their number, so that a fast machine always reaches the same inputs.
const MOST: usize = 50_000;
/// Longest allowed time per input, even on a busy machine.
const SLOWEST: Duration = Duration::from_secs(10);

/// Reads `bytes`. If that violates a guarantee, prints how to reproduce it.
#[track_caller]
fn exercise(target: &Target, what: &str, bytes: &[u8]) -> ReaderDecision {
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
    // A target that refuses all valid samples would test no guarantee.
    assert!(
        verdicts.contains(&ReaderDecision::Accepted),
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
        verdicts.contains(&ReaderDecision::Refused),
        "everything is accepted by {name}"
    );
    let accepted = verdicts
        .iter()
        .filter(|verdict| **verdict == ReaderDecision::Accepted)
        .count();
    println!(
        "{name}: {accepted} of {} inputs were accepted",
        verdicts.len()
    );
}

/// Reads an input from `regressions/` that once violated a guarantee, and checks the present
/// decision.
#[track_caller]
fn recall(name: &str, file: &str, expected: ReaderDecision) {
    let target = TARGETS.iter().find(|target| target.name == name).unwrap();
    let path = format!("regressions/{name}/{file}");
    let (_, bytes) = committed(target)
        .into_iter()
        .find(|(found, _)| *found == path)
        .unwrap();
    assert_eq!(exercise(target, file, &bytes), expected);
}

#[test]
fn deeply_nested_sections_are_refused() {
    recall(
        "overrides",
        "deeply_nested_sections",
        ReaderDecision::Refused,
    );
}

#[test]
fn a_buffer_whose_counter_is_exhausted_is_refused() {
    recall(
        "replay",
        "inserted_at_the_end_of_numbers",
        ReaderDecision::Refused,
    );
}

#[test]
fn returns_near_the_largest_float_are_refused() {
    recall(
        "report_pictures",
        "returns_at_the_end_of_numbers",
        ReaderDecision::Refused,
    );
}

#[test]
fn positions_far_beyond_any_course_are_refused() {
    recall(
        "report_pictures",
        "flown_to_infinity",
        ReaderDecision::Refused,
    );
}

#[test]
fn an_episodes_file_without_final_newline_is_continued_on_the_next_line() {
    recall(
        "episodes_csv",
        "last_line_without_end",
        ReaderDecision::Accepted,
    );
}

#[test]
fn an_event_file_outside_the_folder_is_left_alone() {
    recall(
        "event_files",
        "name_outside_the_folder",
        ReaderDecision::Refused,
    );
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
    no_configuration_file_panics_and_accepted_ones_read_back => "config",
    no_override_panics_and_refusals_name_the_override => "overrides",
    no_simulator_section_panics_and_accepted_ones_fly => "simulator",
    no_experiment_panics_and_accepted_ones_can_run => "experiment",
    no_course_file_panics_and_accepted_ones_can_be_flown => "course_file",
    no_geometry_panics_and_accepted_ones_can_be_flown => "course_layout",
    no_generator_ranges_panic_and_drawn_courses_can_be_flown => "generator",
    no_suite_panics_and_accepted_ones_have_courses => "suite_file",
    no_records_panic_and_committed_episodes_are_complete_and_finite => "records",
    no_signal_panics_and_accepted_ones_are_written_identically => "signals",
    no_snapshot_file_panics_and_accepted_ones_are_finite => "snapshot_file",
    no_received_snapshot_panics_and_accepted_ones_equal_the_sent_one => "snapshot_received",
    no_encoder_file_panics_and_accepted_ones_are_finite => "encoder_file",
    no_decoder_file_panics => "decoder_file",
    no_checkpoint_file_panics_and_loaded_state_can_be_used => "checkpoint",
    no_replay_content_panics_and_restored_content_can_be_continued => "replay",
    no_episodes_csv_panics_and_a_continued_one_can_be_continued_again => "episodes_csv",
    no_list_of_event_files_reaches_beyond_their_folder => "event_files",
    no_run_identity_panics_and_accepted_ones_match_their_configuration => "run_identity",
    no_announcement_panics_and_accepted_ones_equal_our_own => "announcement",
    no_result_file_panics_the_conclusion => "results",
    no_progress_line_panics_the_display => "progress",
    no_report_file_panics_its_reader => "report_files",
    no_report_file_panics_the_plots => "report_pictures",
    no_event_file_panics_its_reader => "curves",
    no_recording_panics_its_reader => "recording",
}
