//! The curves of repaired faults.

use super::Scalar;
use crate::faults::{Faults, Refusal, Reissue};

/// Returns a point for the curve of each reason that has occurred.
pub fn fault_points(faults: &Faults) -> Vec<(Scalar, f64)> {
    let reissued = faults
        .reissue_counts()
        .map(|(why, count)| (reissue_curve(why), count));
    let refused = faults
        .refusal_counts()
        .map(|(why, count)| (refusal_curve(why), count));
    reissued
        .chain(refused)
        .filter(|(_, count)| *count > 0)
        .map(|(scalar, count)| (scalar, count as f64))
        .collect()
}

fn reissue_curve(why: Reissue) -> Scalar {
    match why {
        Reissue::Skipped => Scalar::ReissuedSkipped,
        Reissue::Hole => Scalar::ReissuedHole,
        Reissue::Failed => Scalar::ReissuedFailed,
        Reissue::Late => Scalar::ReissuedLate,
        Reissue::Silent => Scalar::ReissuedSilent,
        Reissue::Restarted => Scalar::ReissuedRestarted,
        Reissue::Left => Scalar::ReissuedLeft,
    }
}

fn refusal_curve(why: Refusal) -> Scalar {
    match why {
        Refusal::Stranger => Scalar::RefusedStranger,
        Refusal::NoTicket => Scalar::RefusedNoTicket,
        Refusal::OutOfOrder => Scalar::RefusedOutOfOrder,
        Refusal::Impossible => Scalar::RefusedImpossible,
        Refusal::NotFinite => Scalar::RefusedNotFinite,
        Refusal::TooLarge => Scalar::RefusedTooLarge,
        Refusal::Contradiction => Scalar::RefusedContradiction,
        Refusal::Status => Scalar::RefusedStatus,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_its_own_curve() {
        let mut faults = Faults::default();
        Reissue::ALL.iter().for_each(|&why| faults.reissue(why));
        Refusal::ALL.iter().for_each(|&why| faults.refuse(why));
        let points = fault_points(&faults);
        let mut tags: Vec<_> = points.iter().map(|(scalar, _)| scalar.tag()).collect();
        assert_eq!(tags.len(), Reissue::ALL.len() + Refusal::ALL.len());
        tags.sort_unstable();
        tags.dedup();
        assert_eq!(tags.len(), points.len());
    }

    #[test]
    fn a_calm_run_has_no_curve_of_faults() {
        assert!(fault_points(&Faults::default()).is_empty());
        let mut faults = Faults::default();
        faults.refuse(Refusal::Stranger);
        faults.refuse(Refusal::Stranger);
        assert_eq!(fault_points(&faults), [(Scalar::RefusedStranger, 2.0)]);
    }
}
