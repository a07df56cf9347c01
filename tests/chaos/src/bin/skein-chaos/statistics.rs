//! Growth of a series of samples: quarters, medians, and a slope that is robust against single
//! outliers.

use std::cmp::Reverse;
use std::collections::BTreeMap;

/// Trend of a series.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Trend {
    /// Median of the first quarter of the samples.
    pub(crate) first: f64,
    /// Median of the last quarter.
    pub(crate) last: f64,
    /// Median of the slopes between all pairs of samples (Theil-Sen), per hour.
    pub(crate) per_hour: f64,
}

/// Largest number of samples used: the number of pairs grows with its square.
const SAMPLES: usize = 400;

impl Trend {
    /// Returns the trend of `samples` (seconds and values, in order); `None` for fewer than eight.
    pub(crate) fn of(samples: &[(f64, f64)]) -> Option<Self> {
        if samples.len() < 8 {
            return None;
        }
        let quarter = samples.len() / 4;
        let values = |part: &[(f64, f64)]| part.iter().map(|&(_, value)| value).collect();
        Some(Self {
            first: median(values(&samples[..quarter])),
            last: median(values(&samples[samples.len() - quarter..])),
            per_hour: slope_per_sec(samples) * 3600.0,
        })
    }

    /// Returns `true` if neither the quarters nor the slope, over `hours`, grow by more than
    /// `tolerance`.
    pub(crate) fn is_flat(&self, tolerance: f64, hours: f64) -> bool {
        self.last - self.first <= tolerance && self.per_hour * hours <= tolerance
    }
}

fn slope_per_sec(samples: &[(f64, f64)]) -> f64 {
    let thinned: Vec<_> = samples
        .iter()
        .step_by(samples.len().div_ceil(SAMPLES))
        .collect();
    let mut slopes = Vec::with_capacity(thinned.len() * thinned.len() / 2);
    for (index, one) in thinned.iter().enumerate() {
        for other in &thinned[index + 1..] {
            slopes.push((other.1 - one.1) / (other.0 - one.0));
        }
    }
    median(slopes)
}

/// Returns the most frequent number, or the smallest of several.
pub(crate) fn most_frequent(numbers: impl Iterator<Item = usize>) -> Option<usize> {
    let mut counts = BTreeMap::<usize, usize>::new();
    numbers.for_each(|number| *counts.entry(number).or_default() += 1);
    let most = counts
        .iter()
        .max_by_key(|&(&number, &count)| (count, Reverse(number)));
    most.map(|(&number, _)| number)
}

/// Returns the median, for an even number of values the upper one; zero for no values.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(value: impl Fn(f64) -> f64) -> Vec<(f64, f64)> {
        (0..720)
            .map(|sample| f64::from(sample) * 5.0)
            .map(|secs| (secs, value(secs)))
            .collect()
    }

    #[test]
    fn a_leak_is_found_despite_noise_and_outliers() {
        let noise =
            |secs: f64| (secs * 1.7).sin() * 30.0 + if secs % 300.0 == 0.0 { 5000.0 } else { 0.0 };
        let leak = Trend::of(&series(|secs| 1000.0 + secs / 36.0 + noise(secs))).unwrap();
        assert!((leak.per_hour - 100.0).abs() < 5.0, "{leak:?}");
        assert!(!leak.is_flat(50.0, 1.0));
        let flat = Trend::of(&series(|secs| 1000.0 + noise(secs))).unwrap();
        assert!(flat.is_flat(20.0, 1.0), "{flat:?}");
    }

    #[test]
    fn a_step_that_the_slope_misses_is_found_by_the_quarters() {
        let step = Trend::of(&series(|secs| if secs < 3000.0 { 100.0 } else { 200.0 })).unwrap();
        assert!(
            step.per_hour * 1.0 < 150.0 && !step.is_flat(50.0, 1.0),
            "{step:?}"
        );
    }

    #[test]
    fn the_most_frequent_number_is_found() {
        assert_eq!(most_frequent([7, 9, 9, 8, 7, 3].into_iter()), Some(7));
        assert_eq!(most_frequent([].into_iter()), None);
    }

    #[test]
    fn a_shrinking_series_is_not_a_leak() {
        assert!(
            Trend::of(&series(|secs| 1000.0 - secs))
                .unwrap()
                .is_flat(1.0, 1.0)
        );
    }
}
