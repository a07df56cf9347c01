//! Report on standard output: the disturbances, their consequences, and a verdict on each.

use skein_chaos::OutcomeCheck;
use skein_run::show;

use crate::planned::PlannedScript;
use crate::points::Points;
use crate::soak::Finding;
use crate::storm::Storm;

/// Prints the number of disturbances. Returns `true` if all planned ones happened.
pub(crate) fn disturbances(storm: &Storm<'_>, planning: &PlannedScript) -> bool {
    tally(storm);
    if planning.left() > 0 {
        show!(
            "  {:<32} {}: the run ended too early; increase run.episodes",
            "NOT DONE",
            planning.left()
        );
    }
    planning.left() == 0
}

/// Prints the number of disturbances of each kind.
pub(crate) fn tally(storm: &Storm<'_>) {
    show!("Disturbances:");
    for (what, times) in storm.tally() {
        show!("  {what:<32} {times}");
    }
}

/// Prints the points at which processes died. Returns `true` if these are all points.
pub(crate) fn points(points: &Points) -> bool {
    show!("Processes died at:");
    for point in points.fired() {
        show!("  {}", point.name());
    }
    for point in points.unfired() {
        show!("  {:<32} NOT REACHED", point.name());
    }
    points.unfired().is_empty()
}

/// Prints the durations.
pub(crate) fn durations(disturbed_secs: f64, calm_secs: f64) {
    show!("  {:<32} {disturbed_secs:.0} s", "disturbed run");
    show!("  {:<32} {calm_secs:.0} s", "undisturbed run");
}

/// Prints the comparison. Returns `true` if nothing differs.
pub(crate) fn comparison(checks: &[OutcomeCheck]) -> bool {
    show!("Compared with the undisturbed run:");
    for check in checks {
        match &check.verdict {
            Ok(common) => show!("  {:<32} equal: {common}", check.what),
            Err(difference) => show!("  {:<32} DIFFERS: {difference}", check.what),
        }
    }
    checks.iter().all(|check| check.verdict.is_ok())
}

/// Prints the trends. Returns `true` if nothing grew.
pub(crate) fn findings(findings: &[Finding]) -> bool {
    show!(
        "{:<12} {:<24} {:>13} {:>13} {:>12} {:>10}",
        "",
        "after the warm-up",
        "first quarter",
        "last quarter",
        "per hour",
        "tolerance"
    );
    for finding in findings {
        let trend = match finding.trend {
            Some(trend) => format!(
                "{:>13.1} {:>13.1} {:>+12.2} {:>10.1}",
                trend.first, trend.last, trend.per_hour, finding.tolerance
            ),
            None => format!("{:>51}", "too few samples"),
        };
        let verdict = if finding.flat { "flat" } else { "GROWS" };
        show!(
            "{:<12} {:<24} {trend}  {verdict}",
            finding.whose,
            finding.what
        );
    }
    findings.iter().all(|finding| finding.flat)
}

/// Prints the leftovers on the machine. Returns `true` if there are none.
pub(crate) fn leftovers(left: &[String]) -> bool {
    if left.is_empty() {
        show!("No leftovers: no process, no shared memory, no file in /tmp.");
    }
    for thing in left {
        show!("LEFT BEHIND: {thing}");
    }
    left.is_empty()
}
