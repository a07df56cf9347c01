//! What is told at the end, on standard output: what was done, what came of it, and the verdict on
//! each.

use skein_chaos::Check;

use crate::planned::Planning;
use crate::points::Points;
use crate::soak::Finding;
use crate::storm::Storm;

/// What was done how often, and whether it was all that was planned.
pub(crate) fn disturbances(storm: &Storm<'_>, planning: &Planning) -> bool {
    tally(storm);
    if planning.left() > 0 {
        println!(
            "  {:<32} {}: the run ended too soon; train longer, with a greater run.episodes",
            "NOT DONE",
            planning.left()
        );
    }
    planning.left() == 0
}

/// What was done how often.
pub(crate) fn tally(storm: &Storm<'_>) {
    println!("Done to the run:");
    for (what, times) in storm.tally() {
        println!("  {what:<32} {times}");
    }
}

/// Where a process died, and whether that was everywhere.
pub(crate) fn points(points: &Points) -> bool {
    println!("Died at:");
    for point in points.fired() {
        println!("  {}", point.name());
    }
    for point in points.unfired() {
        println!("  {:<32} NOT REACHED", point.name());
    }
    points.unfired().is_empty()
}

/// How long it took.
pub(crate) fn durations(disturbed_secs: f64, calm_secs: f64) {
    println!("  {:<32} {disturbed_secs:.0} s", "took");
    println!("  {:<32} {calm_secs:.0} s", "undisturbed");
}

/// The comparison, and whether nothing differs.
pub(crate) fn comparison(checks: &[Check]) -> bool {
    println!("Compared with the undisturbed run:");
    for check in checks {
        match &check.verdict {
            Ok(common) => println!("  {:<32} equal: {common}", check.what),
            Err(difference) => println!("  {:<32} DIFFERS: {difference}", check.what),
        }
    }
    checks.iter().all(|check| check.verdict.is_ok())
}

/// What grew, and whether nothing did.
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

/// What is left on the machine, and whether it is nothing.
pub(crate) fn leftovers(left: &[String]) -> bool {
    if left.is_empty() {
        println!("Nothing is left: no process, no shared memory, no file in /tmp.");
    }
    for thing in left {
        println!("LEFT BEHIND: {thing}");
    }
    left.is_empty()
}
