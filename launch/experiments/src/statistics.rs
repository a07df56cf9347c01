//! Summary statistics over seeds: interquartile mean or mean with a bootstrap interval, and
//! fluctuation of a curve.
//!
//! Source: Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
//! arXiv:2108.13264, which recommends the interquartile mean and the bootstrap for few runs.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::seeds::{Purpose, derive};

/// Number of resamples for a figure in a table.
pub const RESAMPLES: usize = 10_000;
/// Share of the resamples outside the interval, at either end: 95 % remain inside.
const TAIL: f64 = 0.025;
/// A curve has risen when it first reaches this share of its final level.
const RISEN: f64 = 0.9;

/// Estimate for all seeds from a few of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Interquartile mean or mean.
    pub value: f64,
    /// 95 % bootstrap interval; `None` for a single value, which is no evidence about other seeds.
    pub interval: Option<(f64, f64)>,
}

/// Returns the mean of the middle half of `values`; `None` for no values.
///
/// A quarter of the total weight is left out at either end. A value on the border counts with the
/// part inside it: of three values, the middle one weighs four times as much as each of the others.
pub fn interquartile_mean(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    mean_of_middle_half(&sorted)
}

fn mean_of_middle_half(sorted: &[f64]) -> Option<f64> {
    let count = sorted.len() as f64;
    let (from, to) = (count / 4.0, count * 3.0 / 4.0);
    // The value of rank i covers [i, i + 1).
    let inside = |rank: usize| (to.min(rank as f64 + 1.0) - from.max(rank as f64)).max(0.0);
    let sum: f64 = sorted
        .iter()
        .enumerate()
        .map(|(rank, value)| inside(rank) * value)
        .sum();
    (!sorted.is_empty()).then(|| sum / (to - from))
}

/// Returns the mean; `None` for no values.
fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Resamples of a number of seeds, drawn once. All measures of an experiment use the same
/// resamples, and a repeated report is identical.
#[derive(Debug)]
pub struct Bootstrap {
    seeds: usize,
    /// Indices of the seeds in each resample.
    resamples: Vec<Vec<usize>>,
}

impl Bootstrap {
    /// Draws `resamples` samples of `seeds` indices each, with replacement.
    pub fn new(seeds: usize, resamples: usize) -> Self {
        let mut rng =
            Pcg64Mcg::seed_from_u64(derive(seeds as u64, Purpose::Bootstrap, resamples as u64));
        let mut resample = || (0..seeds).map(|_| rng.random_range(0..seeds)).collect();
        Self {
            seeds,
            resamples: if seeds < 2 {
                Vec::new()
            } else {
                (0..resamples).map(|_| resample()).collect()
            },
        }
    }

    /// Returns the interquartile mean of `values`, one per seed. The interval reaches from the
    /// 2.5th to the 97.5th percentile of the resamples' interquartile means. `None` for no values.
    ///
    /// # Panics
    /// Panics unless there is one value per seed.
    pub fn interquartile_mean(&self, values: &[f64]) -> Option<Estimate> {
        self.estimate(values, |drawn| {
            drawn.sort_by(f64::total_cmp);
            mean_of_middle_half(drawn)
        })
    }

    /// Returns the same for the mean, in which the worst seed counts fully.
    ///
    /// # Panics
    /// Panics unless there is one value per seed.
    pub fn mean(&self, values: &[f64]) -> Option<Estimate> {
        self.estimate(values, |drawn| mean(drawn))
    }

    fn estimate(
        &self,
        values: &[f64],
        statistic: impl Fn(&mut [f64]) -> Option<f64>,
    ) -> Option<Estimate> {
        assert_eq!(values.len(), self.seeds, "one value a seed");
        let mut drawn = values.to_vec();
        let value = statistic(&mut drawn)?;
        let mut resampled: Vec<f64> = self
            .resamples
            .iter()
            .filter_map(|resample| {
                for (place, &seed) in drawn.iter_mut().zip(resample) {
                    *place = values[seed];
                }
                statistic(&mut drawn)
            })
            .collect();
        resampled.sort_by(f64::total_cmp);
        Some(Estimate::of(value, &resampled))
    }

    /// Returns the interquartile mean of `values` minus that of `reference`, both one per seed and
    /// in the same order of seeds. Each resample draws the same seeds for both: what a seed does to
    /// both does not widen the interval. `None` for no values.
    ///
    /// # Panics
    /// Panics unless there is one value per seed in each.
    pub fn difference(&self, values: &[f64], reference: &[f64]) -> Option<Estimate> {
        self.paired(values, reference, interquartile_mean)
    }

    /// Returns the same for the mean.
    ///
    /// # Panics
    /// Panics unless there is one value per seed in each.
    pub fn difference_of_means(&self, values: &[f64], reference: &[f64]) -> Option<Estimate> {
        self.paired(values, reference, mean)
    }

    fn paired(
        &self,
        values: &[f64],
        reference: &[f64],
        statistic: fn(&[f64]) -> Option<f64>,
    ) -> Option<Estimate> {
        let lengths = [values.len(), reference.len()];
        assert_eq!(lengths, [self.seeds; 2], "one value a seed");
        let value = statistic(values)? - statistic(reference)?;
        let drawn = |from: &[f64], seeds: &[usize]| {
            let drawn: Vec<f64> = seeds.iter().map(|&seed| from[seed]).collect();
            statistic(&drawn)
        };
        let mut resampled: Vec<f64> = self
            .resamples
            .iter()
            .filter_map(|seeds| Some(drawn(values, seeds)? - drawn(reference, seeds)?))
            .collect();
        resampled.sort_by(f64::total_cmp);
        Some(Estimate::of(value, &resampled))
    }
}

impl Estimate {
    /// Returns `value` with the interval of resampled values in ascending order.
    fn of(value: f64, resampled: &[f64]) -> Self {
        let interval = (!resampled.is_empty())
            .then(|| (quantile(resampled, TAIL), quantile(resampled, 1.0 - TAIL)));
        Self { value, interval }
    }
}

/// Returns the `share` quantile of values in ascending order, interpolated linearly.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, part) = (place.floor() as usize, place.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + part * (sorted[above] - sorted[below])
}

/// Returns the volatility of a curve after its rise: the root mean square of the differences
/// between averages over successive windows of `window` values that do not overlap. A slow trend
/// contributes little, because neighbouring windows hardly differ by it.
///
/// The curve has risen when a window first averages 0.9 of its [`level`]. `None` if fewer than
/// three windows follow.
///
/// If start levels are flown in turn, a window should contain whole turns (50 episodes of 5 levels,
/// 10 each); otherwise the turns themselves appear as fluctuation.
pub fn volatility(values: &[f64], window: usize) -> Option<f64> {
    let differences = differences_once_risen(values, window)?;
    let squares: f64 = differences
        .iter()
        .map(|difference| difference.powi(2))
        .sum();
    Some((squares / differences.len() as f64).sqrt())
}

/// Returns the dispersion across time: the interquartile range of the differences used by
/// [`volatility`]. A few large swings dominate a volatility but do not affect this measure, which
/// shows the usual fluctuation of a curve.
///
/// Source: Chan et al., "Measuring the Reliability of Reinforcement Learning Algorithms",
/// arXiv:1912.05663, with one window for all that follows the rise.
pub fn dispersion_across_time(values: &[f64], window: usize) -> Option<f64> {
    let mut differences = differences_once_risen(values, window)?;
    differences.sort_by(f64::total_cmp);
    Some(quantile(&differences, 0.75) - quantile(&differences, 0.25))
}

/// Returns the final level of a curve: the median of the averages over successive windows in its
/// second half. `None` without a whole window.
pub fn level(values: &[f64], window: usize) -> Option<f64> {
    level_of(&window_averages(values, window))
}

/// Returns the differences between averages over successive windows, from the first that has risen;
/// at least two.
fn differences_once_risen(values: &[f64], window: usize) -> Option<Vec<f64>> {
    let averages = window_averages(values, window);
    let level = level_of(&averages)?;
    let risen = averages
        .iter()
        .position(|average| *average >= RISEN * level)?;
    let after = &averages[risen..];
    (after.len() >= 3).then(|| after.windows(2).map(|pair| pair[1] - pair[0]).collect())
}

fn window_averages(values: &[f64], window: usize) -> Vec<f64> {
    values
        .chunks_exact(window.max(1))
        .filter_map(mean)
        .collect()
}

fn level_of(averages: &[f64]) -> Option<f64> {
    let mut second_half = averages[averages.len() / 2..].to_vec();
    second_half.sort_by(f64::total_cmp);
    (!second_half.is_empty()).then(|| quantile(&second_half, 0.5))
}

/// Returns the depth of each point of a curve below the previous maximum: learned performance that
/// was lost again.
///
/// Source: as [`dispersion_across_time`]; the maximum is its long-term risk across time.
pub fn drawdowns(curve: &[f64]) -> Vec<f64> {
    let mut highest = f64::NEG_INFINITY;
    let below = |value: &f64| {
        highest = highest.max(*value);
        highest - value
    };
    curve.iter().map(below).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_level_is_the_median_of_the_second_half() {
        assert_eq!(level(&[0.0, 9.0, 1.0, 3.0, 2.0], 1), Some(2.0));
        assert_eq!(level(&[1.0], 2), None);
    }

    #[test]
    fn the_level_of_an_even_number_of_windows_lies_between_the_middle_two() {
        // Risen at 0.9 of 10, with the second value. At 0.9 of 11 it would be the last but one, and
        // too few would follow.
        assert!(volatility(&[0.0, 9.2, 9.2, 9.2, 9.0, 9.0, 11.0, 11.0], 1).is_some());
    }

    #[test]
    fn the_interquartile_mean_matches_the_textbook() {
        let of = |values: &[f64]| interquartile_mean(values).unwrap();
        // Twelve values: the middle six are 5 to 8.
        assert_eq!(
            of(&[5.0, 8.0, 4.0, 38.0, 8.0, 6.0, 9.0, 7.0, 7.0, 3.0, 1.0, 6.0]),
            6.5
        );
        // Nine values: the middle three, and three quarters of their neighbours.
        assert_eq!(of(&[1.0, 3.0, 5.0, 7.0, 9.0, 11.0, 13.0, 15.0, 17.0]), 9.0);
        assert_eq!(of(&[0.0, 1.0, 5.0]), (0.25 * 0.0 + 1.0 + 0.25 * 5.0) / 1.5);
        assert_eq!(
            of(&[0.0, 1.0, 2.0, 3.0, 100.0]),
            (0.75 * 1.0 + 2.0 + 0.75 * 3.0) / 2.5
        );
        assert_eq!((of(&[4.0]), of(&[1.0, 2.0])), (4.0, 1.5));
        assert_eq!(interquartile_mean(&[]), None);
    }

    #[test]
    fn an_interval_contains_its_mean_and_is_reproducible() {
        let values = [0.91, 0.97, 0.88, 0.99, 0.95];
        let estimate = Bootstrap::new(5, RESAMPLES)
            .interquartile_mean(&values)
            .unwrap();
        assert_eq!(
            Bootstrap::new(5, RESAMPLES)
                .interquartile_mean(&values)
                .unwrap(),
            estimate
        );
        let (low, high) = estimate.interval.unwrap();
        assert!(
            0.88 <= low && low < estimate.value && estimate.value < high && high <= 0.99,
            "{estimate:?}"
        );
    }

    /// For two values a and b, a resample is (a, a), (a, b), (b, a) or (b, b). A quarter of the
    /// resamples lies at each end, so the interval is [a, b].
    #[test]
    fn the_interval_of_two_values_reaches_from_one_to_the_other() {
        let estimate = Bootstrap::new(2, 1000)
            .interquartile_mean(&[3.0, 1.0])
            .unwrap();
        assert_eq!(
            estimate,
            Estimate {
                value: 2.0,
                interval: Some((1.0, 3.0))
            }
        );
    }

    /// For values spread evenly over [0, 1], the influence of x on their interquartile mean is 2 (x
    /// - 1/2) with x bounded to [1/4, 3/4]; its variance is 1/6.
    #[test]
    fn the_interval_of_many_values_is_the_asymptotic_one() {
        let n = 400;
        let values: Vec<f64> = (0..n)
            .map(|i| (f64::from(i) + 0.5) / f64::from(n))
            .collect();
        let estimate = Bootstrap::new(values.len(), 2000)
            .interquartile_mean(&values)
            .unwrap();
        let (low, high) = estimate.interval.unwrap();
        let expected = 2.0 * 1.96 * (1.0 / 6.0 / f64::from(n)).sqrt();
        assert!((estimate.value - 0.5).abs() < 1e-9);
        assert!(
            ((high - low) / expected - 1.0).abs() < 0.1,
            "{} instead of {expected}",
            high - low
        );
    }

    /// The mean's standard error matches the textbook, and the worst value, which an interquartile
    /// mean of five leaves out, is included.
    #[test]
    fn the_mean_counts_every_value() {
        let five = Bootstrap::new(5, RESAMPLES);
        let values = [1.0, 1.0, 1.0, 1.0, 0.0];
        let (low, high) = five.mean(&values).unwrap().interval.unwrap();
        assert_eq!((five.mean(&values).unwrap().value, high), (0.8, 1.0));
        // At least 3 of 5 draws are the worst with probability 0.058, at least 4 with 0.0067.
        assert!((low - 0.4).abs() < 1e-9, "{low}");
        assert_eq!(five.interquartile_mean(&values).unwrap().value, 1.0);

        let n = 400;
        let values: Vec<f64> = (0..n)
            .map(|i| (f64::from(i) + 0.5) / f64::from(n))
            .collect();
        let (low, high) = Bootstrap::new(values.len(), 2000)
            .mean(&values)
            .unwrap()
            .interval
            .unwrap();
        let expected = 2.0 * 1.96 * (1.0 / 12.0 / f64::from(n)).sqrt();
        assert!(
            ((high - low) / expected - 1.0).abs() < 0.1,
            "{} instead of {expected}",
            high - low
        );
    }

    /// Seeds differ much more than the arms: only pairs show that the second is always better.
    #[test]
    fn a_difference_is_paired_by_seed() {
        let five = Bootstrap::new(5, RESAMPLES);
        let reference = [0.1, 0.9, 0.3, 0.7, 0.5];
        let better = reference.map(|value| value + 0.25);
        for difference in [
            five.difference(&better, &reference),
            five.difference_of_means(&better, &reference),
        ] {
            let difference = difference.unwrap();
            let (low, high) = difference.interval.unwrap();
            for value in [difference.value, low, high] {
                assert!((value - 0.25).abs() < 1e-12, "{difference:?}");
            }
        }
        let apart = five.interquartile_mean(&better).unwrap().interval.unwrap();
        let alone = five
            .interquartile_mean(&reference)
            .unwrap()
            .interval
            .unwrap();
        assert!(apart.0 < alone.1, "the arms' own intervals overlap");
        // The value is the difference of the figures that a table shows.
        let mixed = [0.8, 0.2, 0.9, 0.4, 0.6];
        let shown = |values: &[f64]| interquartile_mean(values).unwrap();
        assert_eq!(
            five.difference(&mixed, &reference).unwrap().value,
            shown(&mixed) - shown(&reference)
        );
        assert_eq!(Bootstrap::new(0, 10).difference(&[], &[]), None);
        let one = Bootstrap::new(1, 10).difference(&[2.0], &[0.5]).unwrap();
        assert_eq!((one.value, one.interval), (1.5, None));
    }

    /// Expected: the same percentiles over all 5^5 equally likely resamples, each drawn for both
    /// arms, reckoned by other means (Python; middle half of each value counted four times). Where
    /// each arm is drawn for itself, the intervals are [-0.124, 0.605] and [-0.064, 0.518].
    #[test]
    fn the_interval_of_a_difference_is_the_exact_one_over_all_resamples() {
        let five = Bootstrap::new(5, RESAMPLES);
        let values = [0.91, 0.42, 0.88, 0.99, 0.63];
        let reference = [0.50, 0.61, 0.35, 0.97, 0.20];
        for (difference, [value, low, high]) in [
            (five.difference(&values, &reference), [0.326, -0.052, 0.5]),
            (
                five.difference_of_means(&values, &reference),
                [0.24, -0.024, 0.466],
            ),
        ] {
            let difference = difference.unwrap();
            assert!((difference.value - value).abs() < 1e-9, "{difference:?}");
            let interval = difference.interval.unwrap();
            // A tenth of a percentile of 10,000 resamples.
            for (found, exact) in [(interval.0, low), (interval.1, high)] {
                assert!((found - exact).abs() < 0.02, "{difference:?}");
            }
        }
    }

    #[test]
    fn one_value_has_no_interval_and_no_values_have_no_mean() {
        let one = Bootstrap::new(1, RESAMPLES).interquartile_mean(&[2.5]);
        assert_eq!(
            one,
            Some(Estimate {
                value: 2.5,
                interval: None
            })
        );
        assert_eq!(Bootstrap::new(0, RESAMPLES).interquartile_mean(&[]), None);
    }

    #[test]
    fn a_quantile_lies_between_its_neighbours() {
        let sorted = [0.0, 10.0, 20.0, 30.0, 40.0];
        assert_eq!(
            [0.0, 0.25, 0.375, 1.0].map(|share| quantile(&sorted, share)),
            [0.0, 10.0, 15.0, 40.0]
        );
    }

    #[test]
    fn volatility_only_counts_what_follows_the_rise() {
        let of = |averages: &[f64]| {
            let values: Vec<f64> = averages
                .iter()
                .flat_map(|&average| [average - 1.0, average + 1.0])
                .collect();
            volatility(&values, 2)
        };
        // A steady curve has none, however it rose, and noise within a window does not count.
        assert_eq!(of(&[0.0, 0.5, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0]), Some(0.0));
        // Up and down by 0.2 after the rise. The drop counts; the rise does not.
        let swinging = of(&[0.0, 0.1, 2.0, 1.8, 2.0, 1.8, 2.0, 1.8]).unwrap();
        assert!((swinging - 0.2).abs() < 1e-9, "{swinging}");
        let fallen = of(&[0.0, 2.0, 2.0, 2.0, 0.0, 2.0, 2.0, 2.0]).unwrap();
        assert!((fallen - (8.0_f64 / 6.0).sqrt()).abs() < 1e-9, "{fallen}");
        // Too few windows for a result.
        assert_eq!(of(&[1.0, 1.0]), None);
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn dispersion_shows_the_usual_swing_and_volatility_the_rare_one() {
        // Risen immediately; differences alternate between -0.1 and 0.1.
        let steady = [2.0, 1.9, 2.0, 1.9, 2.0, 1.9, 2.0, 1.9, 2.0];
        let of = |values: &[f64]| {
            (
                dispersion_across_time(values, 1).unwrap(),
                volatility(values, 1).unwrap(),
            )
        };
        let (dispersion, volatility) = of(&steady);
        assert!((dispersion - 0.2).abs() < 1e-9 && (volatility - 0.1).abs() < 1e-9);
        let mut fallen_once = steady;
        fallen_once[7] = 0.0;
        let (same, larger) = of(&fallen_once);
        assert!((same - 0.2).abs() < 1e-9 && larger > 0.9, "{same} {larger}");
        // A steady rise has no dispersion: only variation of the differences counts.
        let rising: Vec<f64> = (0..20).map(|step| 10.0 + 0.1 * f64::from(step)).collect();
        assert!(of(&rising).0 < 1e-9);
        assert_eq!(dispersion_across_time(&[1.0, 1.0], 1), None);
    }

    #[test]
    fn a_drawdown_is_measured_from_the_previous_maximum() {
        assert_eq!(
            drawdowns(&[1.0, 3.0, 2.0, 2.5, 0.5, 4.0, 3.5]),
            [0.0, 0.0, 1.0, 0.5, 2.5, 0.0, 0.5]
        );
        assert!(drawdowns(&[]).is_empty());
    }
}
