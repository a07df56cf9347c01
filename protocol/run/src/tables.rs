//! Tables for the terminal.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use skein_protocol::evaluation::{EvaluationReport, WallFailures};
use skein_protocol::stages::{StageTime, StageTimes, ThreadRole};

/// Returns the evaluation of a snapshot as a table with one row per course.
pub fn evaluation_table(report: &EvaluationReport) -> String {
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED);
    table.set_header([
        "course",
        "episodes",
        "R",
        "completed",
        "passed wall\n1, 2, …",
        "return",
        "hit wall\n1, 2, …",
        "hit corridor\nbefore 1, …, end",
        "timed out\nbefore 1, …, end",
    ]);
    for course in &report.courses {
        let walls: Vec<String> = course.walls_passed.iter().map(u64::to_string).collect();
        let failed =
            |by: fn(&WallFailures) -> u64| course.failures.iter().map(by).collect::<Vec<_>>();
        // No wall follows the last one.
        let mut hit_wall = failed(|failures| failures.hit_wall);
        hit_wall.truncate(walls.len());
        table.add_row([
            course.course.clone(),
            course.episodes.to_string(),
            format!("{:.3}", course.r),
            format!("{:.1} %", 100.0 * course.completed),
            walls.join(" "),
            format!("{:.2}", course.mean_return),
            counts(&hit_wall),
            counts(&failed(|failures| failures.hit_corridor)),
            counts(&failed(|failures| failures.timed_out)),
        ]);
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.to_string()
}

/// Formats counts in a row, with a dot for zero; a single dot if all are zero.
fn counts(values: &[u64]) -> String {
    if values.iter().all(|&value| value == 0) {
        return "·".to_owned();
    }
    let shown = |&value: &u64| {
        if value == 0 {
            "·".to_owned()
        } else {
            value.to_string()
        }
    };
    values.iter().map(shown).collect::<Vec<_>>().join(" ")
}

/// Returns the times of a run as a table with one row per stage, in the order of the data flow.
pub fn stages_table(times: &StageTimes) -> String {
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED);
    table.set_header([
        "where the time went",
        "stage",
        "count",
        "total",
        "each",
        "share",
    ]);
    let mut thread = None;
    for (stage, tally) in times.occurred() {
        let of_thread = times.total_nanos(stage.thread());
        let title = if thread.replace(stage.thread()) == Some(stage.thread()) {
            ""
        } else {
            title(stage.thread())
        };
        table.add_row([
            title.to_owned(),
            stage.name().to_owned(),
            blank_if_zero(tally.count, tally.count.to_string()),
            format!("{:.2} s", tally.secs()),
            blank_if_zero(tally.count, each(tally)),
            format!(
                "{:.1} %",
                100.0 * tally.nanos as f64 / of_thread.max(1) as f64
            ),
        ]);
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.to_string()
}

/// Returns `text`, or nothing if `count` is zero.
fn blank_if_zero(count: u64, text: String) -> String {
    if count == 0 { String::new() } else { text }
}

fn each(tally: StageTime) -> String {
    let secs = tally.secs() / tally.count.max(1) as f64;
    match secs {
        0.0..1e-3 => format!("{:.2} µs", secs * 1e6),
        1e-3..1.0 => format!("{:.2} ms", secs * 1e3),
        _ => format!("{secs:.2} s"),
    }
}

const fn title(thread: ThreadRole) -> &'static str {
    match thread {
        ThreadRole::Actors => "actors, together",
        ThreadRole::Receiving => "learner: receiving",
        ThreadRole::Training => "learner: training",
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use skein_protocol::evaluation::{CourseEvaluation, EpisodeScore};
    use skein_protocol::ids::PolicyVersion;
    use skein_protocol::stages::Stage;
    use skein_protocol::transition::Outcome;

    use super::*;

    fn sample() -> StageTimes {
        let mut times = StageTimes::default();
        for (nanos, stage) in (1_234_567_891..).step_by(1_111_111_111).zip(Stage::ALL) {
            times.add(*stage, 7, Duration::from_nanos(nanos));
        }
        times
    }

    #[test]
    fn failures_stand_in_course_order_and_a_dot_is_none() {
        let score = |walls_passed, outcome, hit_wall| EpisodeScore {
            walls_passed,
            episode_return: 0.0,
            outcome,
            hit_wall,
        };
        let episodes = [
            score(1, Outcome::Collided, Some(2)),
            score(2, Outcome::Collided, Some(2)),
            score(2, Outcome::Collided, None),
            score(3, Outcome::Collided, None),
        ];
        let table = evaluation_table(&EvaluationReport {
            policy_version: PolicyVersion(1),
            policy_sha256: String::new(),
            courses: vec![CourseEvaluation::of("training", 3, &episodes)],
        });
        assert!(
            table.contains("┆    · 2 · ┆") && table.contains("· · 1 1"),
            "{table}"
        );
    }

    #[test]
    fn the_table_has_a_row_a_stage_and_the_shares_of_a_thread_sum_to_one() {
        let table = stages_table(&sample());
        let mut shares = Vec::new();
        let rows = table.lines().filter(|line| line.contains('%'));
        for (row, stage) in rows.zip(Stage::ALL) {
            let cells: Vec<_> = row.trim_matches('│').split('┆').map(str::trim).collect();
            assert_eq!((cells[1], cells[2]), (stage.name(), "7"));
            let share: f64 = cells[5].trim_end_matches(" %").parse().unwrap();
            shares.push((stage.thread(), share));
        }
        assert_eq!(shares.len(), Stage::ALL.len());
        for thread in [
            ThreadRole::Actors,
            ThreadRole::Receiving,
            ThreadRole::Training,
        ] {
            assert_eq!(table.matches(title(thread)).count(), 1, "{table}");
            let own = shares.iter().filter(|(of, _)| *of == thread);
            let sum: f64 = own.map(|(_, share)| share).sum();
            assert!(
                (sum - 100.0).abs() < 0.05 * Stage::ALL.len() as f64,
                "{sum} in\n{table}"
            );
        }
    }

    #[test]
    fn times_are_printed_in_readable_units() {
        let printed = |nanos| each(StageTime { count: 10, nanos });
        assert_eq!(printed(1_300), "0.13 µs");
        assert_eq!(printed(2_500_000), "250.00 µs");
        assert_eq!(printed(12_300_000), "1.23 ms");
        assert_eq!(printed(120_000_000_000), "12.00 s");
    }
}
