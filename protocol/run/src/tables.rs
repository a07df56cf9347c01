//! Tables for the terminal.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, ContentArrangement, Row, Table};
use skein_protocol::evaluation::{CourseEvaluation, EvaluationReport, WallFailures};
use skein_protocol::stages::{StageTime, StageTimes, ThreadRole};

/// Returns the evaluation of a snapshot as a table with one row per course, or, where `columns` are
/// too few for it, as two tables: results, then failures.
pub fn evaluation_table(report: &EvaluationReport, columns: usize) -> String {
    let whole = grid(&[&RESULTS[..], &FAILURES[..]].concat(), report);
    let text = whole.to_string();
    if width(&text) <= columns {
        return text;
    }
    let parts = [&RESULTS[..], &[RESULTS[0]], &FAILURES[..]];
    let (results, failures) = (parts[0].to_vec(), parts[1..].concat());
    let fitted = |part: Vec<TableColumn>| fit(grid(&part, report), columns);
    format!("{}\n{}", fitted(results), fitted(failures))
}

/// A column of the evaluation table: its title, and its cell for a course.
type TableColumn = (&'static str, fn(&CourseEvaluation) -> String);

/// Columns on how far the drone came.
const RESULTS: [TableColumn; 6] = [
    ("course", |course| course.course.clone()),
    ("episodes", |course| course.episodes.to_string()),
    ("R", |course| format!("{:.3}", course.r)),
    ("completed", |course| {
        format!("{:.1} %", 100.0 * course.completed)
    }),
    ("passed wall\n1, 2, …", |course| {
        let walls: Vec<String> = course.walls_passed.iter().map(u64::to_string).collect();
        walls.join(" ")
    }),
    ("return", |course| format!("{:.2}", course.mean_return)),
];

/// Columns on how the other episodes failed.
const FAILURES: [TableColumn; 3] = [
    ("hit wall\n1, 2, …", |course| {
        let mut hit_wall = failed(course, |failures| failures.hit_wall);
        // No wall follows the last one.
        hit_wall.truncate(course.walls_passed.len());
        counts(&hit_wall)
    }),
    ("hit corridor\nbefore 1, …, end", |course| {
        counts(&failed(course, |failures| failures.hit_corridor))
    }),
    ("timed out\nbefore 1, …, end", |course| {
        counts(&failed(course, |failures| failures.timed_out))
    }),
];

fn failed(course: &CourseEvaluation, by: fn(&WallFailures) -> u64) -> Vec<u64> {
    course.failures.iter().map(by).collect()
}

fn grid(shown: &[TableColumn], report: &EvaluationReport) -> Table {
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED);
    table.set_header(shown.iter().map(|(title, _)| *title));
    for course in &report.courses {
        table.add_row(shown.iter().map(|(_, cell)| cell(course)));
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// Returns rows of cells below `titles` as a table of at most `columns`. The first column is text,
/// the others are numbers.
pub fn rates_table(titles: &[&str], rows: &[Vec<String>], columns: usize) -> String {
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED);
    table.set_header(titles);
    for row in rows {
        table.add_row(row);
    }
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    fit(table, columns)
}

/// Returns the text of `table` in at most `columns`: cells are broken into lines where it is wider.
/// Where even its rules do not fit, each cell is a line `title: cell`.
pub fn fit(mut table: Table, columns: usize) -> String {
    let text = table.to_string();
    if width(&text) <= columns {
        return text;
    }
    table.set_content_arrangement(ContentArrangement::Dynamic);
    table.set_width(u16::try_from(columns).unwrap_or(u16::MAX));
    let text = table.to_string();
    match width(&text) <= columns {
        true => text,
        false => stacked(&table, columns),
    }
}

/// Returns the cells of `table` one below the other, with an empty line between its rows.
fn stacked(table: &Table, columns: usize) -> String {
    let titles: Vec<String> = table
        .header()
        .into_iter()
        .flat_map(|header| header.cell_iter().map(|cell| cell.content()))
        .collect();
    let of_row = |row: &Row| {
        let cells = row.cell_iter().map(|cell| cell.content()).zip(&titles);
        let lines: Vec<_> = cells
            .filter(|(content, _)| !content.is_empty())
            .map(|(content, title)| format!("{title}: {content}").replace('\n', " "))
            .map(|line| broken(&line, columns))
            .collect();
        lines.join("\n")
    };
    table
        .row_iter()
        .map(of_row)
        .collect::<Vec<_>>()
        .join("\n\n")
}

/// Returns `line` in lines of `columns`, broken anywhere.
fn broken(line: &str, columns: usize) -> String {
    let characters: Vec<char> = line.chars().collect();
    let pieces = characters.chunks(columns.max(1)).map(String::from_iter);
    pieces.collect::<Vec<String>>().join("\n")
}

/// Returns `text` with those of its Markdown tables that are wider than `columns` broken to fit.
pub fn fit_markdown(text: &str, columns: usize) -> String {
    let mut shown = String::new();
    let lines: Vec<&str> = text.lines().collect();
    for block in lines.chunk_by(|one, next| one.starts_with('|') == next.starts_with('|')) {
        let block = block.join("\n");
        let fits = !block.starts_with('|') || width(&block) <= columns;
        shown.push_str(&match fits {
            true => block,
            false => fit(from_markdown(&block), columns),
        });
        shown.push('\n');
    }
    shown.trim_end_matches('\n').to_owned()
}

/// Reads a Markdown table: a header, a rule that ends in a colon above columns aligned right, rows.
fn from_markdown(text: &str) -> Table {
    let mut rows = text.lines().map(|line| {
        let cells = line.trim().trim_matches('|').split('|');
        cells.map(str::trim).collect::<Vec<_>>()
    });
    let mut table = Table::new();
    table.load_preset(UTF8_FULL_CONDENSED);
    table.set_header(rows.next().unwrap_or_default());
    let rule = rows.next().unwrap_or_default();
    rows.for_each(|cells| {
        table.add_row(cells);
    });
    for (column, dashes) in table.column_iter_mut().zip(rule) {
        if dashes.ends_with(':') {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}

/// Returns the columns that `text` takes.
fn width(text: &str) -> usize {
    let lines = text.lines().map(|line| line.chars().count());
    lines.max().unwrap_or(0)
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

/// Returns the times of a run as a table of at most `columns` with one row per stage, in the order
/// of the data flow.
pub fn stages_table(times: &StageTimes, columns: usize) -> String {
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
    fit(table, columns)
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

    fn report(episodes: &[EpisodeScore]) -> EvaluationReport {
        EvaluationReport {
            policy_version: PolicyVersion(1),
            policy_sha256: String::new(),
            courses: ["training", "non_rectangular"]
                .map(|name| CourseEvaluation::of(name, episodes))
                .to_vec(),
        }
    }

    #[test]
    fn no_table_exceeds_the_terminal_and_only_a_wide_one_has_all_in_a_row() {
        let score = EpisodeScore {
            walls_passed: 2,
            walls: 3,
            episode_return: -12.345,
            outcome: Outcome::Collided,
            hit_wall: None,
        };
        let report = report(&[score; 100]);
        let wide = evaluation_table(&report, usize::MAX);
        for columns in 1..160 {
            let table = evaluation_table(&report, columns);
            assert!(width(&table) <= columns, "{columns}:\n{table}");
            assert_eq!(table == wide, width(&wide) <= columns);
            let stages = stages_table(&sample(), columns);
            assert!(width(&stages) <= columns, "{columns}:\n{stages}");
        }
        // Where no table fits, each cell keeps its title.
        let stacked = evaluation_table(&report, 12);
        assert!(stacked.contains("episodes: 10\n0\n"), "{stacked}");
        // At the usual width, no cell is broken.
        let narrow = evaluation_table(&report, 80);
        assert_eq!(narrow.matches("non_rectangular").count(), 2, "{narrow}");
        assert!(
            narrow.contains("100.0 %") || narrow.contains("0.0 %"),
            "{narrow}"
        );
    }

    #[test]
    fn a_markdown_table_is_broken_only_where_it_is_too_wide() {
        let text = "# Question\n\n| arm | R |\n|-----|--:|\n| one | 0.5 [0.4, 0.6] |\n\nEnd.";
        assert_eq!(fit_markdown(text, 80), text);
        let narrow = fit_markdown(text, 16);
        assert!(width(&narrow) <= 16, "{narrow}");
        for part in ["# Question\n\n", "one", "0.4,", "\n\nEnd."] {
            assert!(narrow.contains(part), "{part:?} is missing in\n{narrow}");
        }
        let stacked = fit_markdown(text, 8);
        let rows = "arm: one\nR: 0.5 [\n0.4, 0.6\n]\n\nEnd.";
        assert!(stacked.contains(rows), "{stacked}");
    }

    #[test]
    fn failures_stand_in_course_order_and_a_dot_is_none() {
        let score = |walls_passed, outcome, hit_wall| EpisodeScore {
            walls_passed,
            walls: 3,
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
        let table = evaluation_table(&report(&episodes), usize::MAX);
        assert!(
            table.contains("┆    · 2 · ┆") && table.contains("· · 1 1"),
            "{table}"
        );
    }

    #[test]
    fn the_table_has_a_row_a_stage_and_the_shares_of_a_thread_sum_to_one() {
        let table = stages_table(&sample(), usize::MAX);
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
