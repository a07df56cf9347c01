//! Missing or mismatched figures. A figure that was renamed in only one place must not pass
//! unnoticed.

use std::collections::BTreeSet;

use super::catalogue::{BenchmarkRow, Growth, Show};
use super::figures::BenchmarkFigures;

/// Returns a line per figure that `rows` and `growths` need but `figures` lack or hold in another
/// form.
pub fn faults(
    rows: &[BenchmarkRow],
    growths: &[Growth],
    figures: &BenchmarkFigures,
) -> Vec<String> {
    let of_rows = rows.iter().flat_map(|row| {
        let (show, unit) = row.part_shown();
        let parts = row.baseline.iter().flat_map(|baseline| &baseline.of);
        let parts = parts.filter_map(move |part| of_figure(part, show, unit, figures));
        of_figure(&row.figure, row.show, &row.unit, figures)
            .into_iter()
            .chain(parts)
    });
    let series = growths.iter().flat_map(|growth| &growth.series);
    let of_series = series.flat_map(|series| {
        let found = figures.series(&series.of);
        let missing = found
            .is_empty()
            .then(|| format!("{}/NUMBER was not measured", series.of));
        let unfit = found.into_iter().filter_map(|(number, figure)| {
            let unfit = figure.shown(series.show, &series.unit, 1.0).err()?;
            Some(format!("{}/{number} {unfit}", series.of))
        });
        missing.into_iter().chain(unfit)
    });
    // Rows may share a figure.
    let once: BTreeSet<String> = of_rows.chain(of_series).collect();
    once.into_iter().collect()
}

fn of_figure(name: &str, show: Show, unit: &str, figures: &BenchmarkFigures) -> Option<String> {
    match figures.get(name) {
        None => Some(format!("{name} was not measured")),
        Some(figure) => figure
            .shown(show, unit, 1.0)
            .err()
            .map(|unfit| format!("{name} {unfit}")),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn rows(toml: &str) -> Vec<BenchmarkRow> {
        #[derive(serde::Deserialize)]
        struct Rows {
            row: Vec<BenchmarkRow>,
        }
        toml::from_str::<Rows>(toml).unwrap().row
    }

    fn printed(lines: &str) -> BenchmarkFigures {
        let directory = tempfile::tempdir().unwrap();
        fs::write(directory.path().join("any.figures"), lines).unwrap();
        BenchmarkFigures::read(directory.path()).unwrap()
    }

    const ROW: &str = r#"
        [[row]]
        stage = "start"
        figure = "actor/start/64"
        show = "value"
        unit = "ms"
        baseline = { what = "one", of = ["actor/start/1"] }
    "#;
    const BOTH: &str = r#"
        {"name":"actor/start/64","figure":2.0,"unit":"ms"}
        {"name":"actor/start/1","figure":1.0,"unit":"ms"}
    "#;

    fn trimmed(lines: &str) -> String {
        lines.lines().map(str::trim).collect::<Vec<_>>().join("\n")
    }

    #[test]
    fn a_measured_figure_is_not_a_fault() {
        assert_eq!(faults(&rows(ROW), &[], &printed(&trimmed(BOTH))), [""; 0]);
    }

    #[test]
    fn a_renamed_figure_or_baseline_is_found() {
        let renamed = trimmed(BOTH).replace("start/64", "begin/64");
        assert_eq!(
            faults(&rows(ROW), &[], &printed(&renamed)),
            ["actor/start/64 was not measured"]
        );
        let renamed = trimmed(BOTH).replace("start/1", "begin/1");
        assert_eq!(
            faults(&rows(ROW), &[], &printed(&renamed)),
            ["actor/start/1 was not measured"]
        );
    }

    #[test]
    fn another_unit_is_refused() {
        let seconds = trimmed(BOTH).replacen("ms", "s", 1);
        assert_eq!(
            faults(&rows(ROW), &[], &printed(&seconds)),
            ["actor/start/64 is in s, not in ms"]
        );
    }

    #[test]
    fn a_line_of_a_picture_needs_a_point() {
        let growth: Growth = toml::from_str(
            r#"
            picture = "any"
            title = "any"
            x = "actors"
            y = "ms"
            series = [
                { label = "start", of = "actor/start", show = "value", unit = "ms" },
                { label = "end", of = "actor/end", show = "value", unit = "ms" },
            ]
            "#,
        )
        .unwrap();
        assert_eq!(
            faults(&[], &[growth], &printed(&trimmed(BOTH))),
            ["actor/end/NUMBER was not measured"]
        );
    }
}
