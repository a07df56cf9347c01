//! Output of figures for people and for programs.

use serde_json::json;

/// Prints the figure `name`, in `unit`, beside its `baseline`, a name and a value in the same unit.
pub(crate) fn report(name: &str, figure: f64, unit: &str, baseline: (&str, f64)) {
    let (baseline_name, baseline) = baseline;
    eprintln!("{name:<58} {figure:>12.2} {unit:<10} {baseline:>12.2} {baseline_name}");
    let line = json!({
        "name": name,
        "figure": figure,
        "unit": unit,
        "baseline": baseline_name,
        "baseline_figure": baseline,
    });
    println!("{line}");
}
