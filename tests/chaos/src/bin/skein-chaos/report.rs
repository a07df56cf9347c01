//! Report on standard output: the disturbances, their consequences, and a verdict on each.

use skein_chaos::OutcomeCheck;

use crate::planned::PlannedScript;
use crate::points::Points;
use crate::soak::Finding;
use crate::storm::Storm;

/// Prints the number of disturbances. Returns `true` if all planned ones happened.
pub(crate) fn disturbances(storm: &Storm<'_>, planning: &PlannedScript) -> bool {
    tally(storm);
    if planning.left() > 0 {
        println!(
            "  {:<32} {}: the run ended too early; increase run.episodes",
            "NOT DONE",
            planning.left()
        );
    }
    planning.left() == 0
}

/// Prints the number of disturbances of each kind.
pub(crate) fn tally(storm: &Storm<'_>) {
    println!("Disturbances:");
    for (what, times) in storm.tally() {
        println!("  {what:<32} {times}");
    }
}

/// Prints the points at which processes died. Returns `true` if these are all points.
pub(crate) fn points(points: &Points) -> bool {
    println!("Processes died at:");
    for point in points.fired() {
        println!("  {}", point.name());
    }
    for point in points.unfired() {
        println!("  {:<32} NOT REACHED", point.name());
    }
    points.unfired().is_empty()
}

/// Prints the durations.
pub(crate) fn durations(disturbed_secs: f64, calm_secs: f64) {
    println!("  {:<32} {disturbed_secs:.0} s", "disturbed run");
    println!("  {:<32} {calm_secs:.0} s", "undisturbed run");
}

/// Prints the comparison. Returns `true` if nothing differs.
pub(crate) fn comparison(checks: &[OutcomeCheck]) -> bool {
    println!("Compared with the undisturbed run:");
    for check in checks {
        match &check.verdict {
            Ok(common) => println!("  {:<32} equal: {common}", check.what),
            Err(difference) => println!("  {:<32} DIFFERS: {difference}", check.what),
        }
    }
    checks.iter().all(|check| check.verdict.is_ok())
}

/// Prints the trends. Returns `true` if nothing grew.
pub(crate) fn findings(findings: &[Finding]) -> bool {
    println!(
        "{:<12} {:<24} {:>13} {:>13} {:>12} {:>10}",
        "", "after the warm-up", "first quarter", "last quarter", "per hour", "tolerance"
    );
    for finding in findings {
        print!("{:<12} {:<24}", finding.whose, finding.what);
        match finding.trend {
            Some(trend) => print!(
                " {:>13.1} {:>13.1} {:>+12.2} {:>10.1}",
                trend.first, trend.last, trend.per_hour, finding.tolerance
            ),
            None => print!(" {:>51}", "too few samples"),
        }
        println!("  {}", if finding.flat { "flat" } else { "GROWS" });
    }
    findings.iter().all(|finding| finding.flat)
}

/// Prints the leftovers on the machine. Returns `true` if there are none.
pub(crate) fn leftovers(left: &[String]) -> bool {
    if left.is_empty() {
        println!("No leftovers: no process, no shared memory, no file in /tmp.");
    }
    for thing in left {
        println!("LEFT BEHIND: {thing}");
    }
    left.is_empty()
}
