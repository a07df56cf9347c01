//! The reward: a sum of terms in every step, each with a setting of its own; 0 turns a term off.
//! The first four are the paper's.
//!
//! `reward_terms!` lists them: settings, records, curves and recordings follow from the list.
//!
//! | term | given when | value | default |
//! |---|---|---|---|
//! | `collision` | the step ends in a collision | the setting, a penalty | −1 |
//! | `level_up` | the drone passes a wall in the step | the setting, a bonus | 1 |
//! | `destination` | the step reaches the end wall | the setting, a bonus | 1 |
//! | `open_view` | in every step | the setting `k` times a view contrast in [-1, 1] | `k` = 1 |
//! | `progress` | in every step | `k` per metre nearer to the goal | `k` = 0 |
//! | `clearance` | within 1 m of a surface after the step | `-k` per missing metre | `k` = 0 |
//! | `effort` | in every step | `-k` times the mean square of the action's numbers | `k` = 0 |
//! | `effort_change` | in every step | `-k` times the mean square of their change | `k` = 0 |
//!
//! `open_view` rewards looking into open space: its contrast is the mean depth of the image's
//! central 16 × 16 pixels minus the mean depth of the whole image. The paper calls it the "action
//! reward". It is positive when the view ahead is deeper than the rest of the image.
//!
//! Rewards have no unit. The paper's Table 1, which holds its values, is lost; the defaults are our
//! choice and suffice to learn the task.
//!
//! Source: Xue & Gonsalves 2021, section on the reward function.

use serde::{Deserialize, Serialize};

use crate::camera::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use crate::step_report::{EpisodeOutcome, LevelUp, StepReport};

/// Side of the central square that [`RewardTerms::open_view`] looks at, pixels.
const CENTRE_SIDE: usize = 16;

/// Largest magnitude accepted for a setting.
const MAX_REWARD: f32 = 1e6;

/// Declares the terms: for each, its documentation, its name and the default of its setting. The
/// order is that of their sum.
macro_rules! reward_terms {
    ($($(#[$doc:meta])* $name:ident = $default:literal),+ $(,)?) => {
        /// Size of each reward term: section `[simulator.reward]`.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct RewardSettings {
            $($(#[$doc])* pub $name: f32),+
        }

        impl Default for RewardSettings {
            fn default() -> Self {
                Self { $($name: $default),+ }
            }
        }

        impl RewardSettings {
            fn by_key(&self) -> [(&'static str, f32); RewardTerms::NAMES.len()] {
                [$((stringify!($name), self.$name)),+]
            }
        }

        /// The reward of one step, term by term: 0 for what did not happen in it.
        #[derive(Debug, Clone, Copy, Default, PartialEq)]
        pub struct RewardTerms {
            $($(#[$doc])* pub $name: f32),+
        }

        impl RewardTerms {
            /// Names of all terms, in the order of their sum.
            pub const NAMES: &[&str] = &[$(stringify!($name)),+];

            /// Returns the values, in the order of [`RewardTerms::NAMES`].
            pub fn values(&self) -> [f32; Self::NAMES.len()] {
                [$(self.$name),+]
            }

            fn values_mut(&mut self) -> [&mut f32; Self::NAMES.len()] {
                [$(&mut self.$name),+]
            }
        }
    };
}

reward_terms! {
    /// Given when the step ends in a collision. Default −1.
    collision = -1.0,
    /// Given when the drone passes a wall in the step. Default 1.
    level_up = 1.0,
    /// Given when the step reaches the end wall. Default 1.
    destination = 1.0,
    /// `k · (mean of the central 16 × 16 pixels − mean of the whole depth image)`, pixels scaled to
    /// [0, 1], given in every step: between −k and k. The setting is the factor `k`. Default 1; 0
    /// rewards events only.
    open_view = 1.0,
    /// `k ·` metres nearer to the middle of the end wall, given in every step. The setting is the
    /// factor `k`. Default 0.
    progress = 0.0,
    /// `-k · max(0, 1 − d)`, with the distance `d` in metres from the body's middle to the nearest
    /// surface after the step: between −k and 0. The setting is the factor `k`. Default 0.
    clearance = 0.0,
    /// `-k ·` mean square of the action's numbers, given in every step: between −k and 0. The
    /// setting is the factor `k`. Default 0.
    effort = 0.0,
    /// `-k ·` mean square of the change of the action's numbers since the step before, given in
    /// every step: between −4k and 0. The setting is the factor `k`. Default 0.
    effort_change = 0.0,
}

impl RewardSettings {
    /// Checks that every setting is a number whose sums stay finite.
    ///
    /// # Errors
    /// [`RewardSettingsError`] names the first key at fault.
    pub fn validate(&self) -> Result<(), RewardSettingsError> {
        for (key, value) in self.by_key() {
            if !(-MAX_REWARD..=MAX_REWARD).contains(&value) {
                return Err(RewardSettingsError { key, value });
            }
        }
        Ok(())
    }
}

/// A reward setting that is out of bounds.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "[simulator.reward] {key} = {value} is outside -{MAX_REWARD} to {MAX_REWARD}: no critic can \
     learn returns of that size"
)]
pub struct RewardSettingsError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: f32,
}

impl RewardTerms {
    /// Returns the terms of a step with the result `report`, after which the camera saw
    /// `image_after`.
    pub fn of(
        settings: &RewardSettings,
        report: &StepReport,
        image_after: &[u8; IMAGE_PIXELS],
    ) -> Self {
        let mut terms = Self {
            open_view: settings.open_view * centre_minus_whole(image_after),
            progress: settings.progress * report.progress_m,
            clearance: -settings.clearance * (1.0 - report.clearance_m).max(0.0),
            effort: -settings.effort * report.effort,
            effort_change: -settings.effort_change * report.effort_change,
            ..Self::default()
        };
        if report.outcome == Some(EpisodeOutcome::Collided) {
            terms.collision = settings.collision;
        }
        if report.level_up == LevelUp::Yes {
            terms.level_up = settings.level_up;
        }
        if report.outcome == Some(EpisodeOutcome::ReachedEnd) {
            terms.destination = settings.destination;
        }
        terms
    }

    /// Returns the terms with these values, in the order of [`RewardTerms::NAMES`].
    #[must_use]
    pub fn from_values(values: [f32; Self::NAMES.len()]) -> Self {
        let mut terms = Self::default();
        for (term, value) in terms.values_mut().into_iter().zip(values) {
            *term = value;
        }
        terms
    }

    /// Returns the sum of the terms: the reward the agent learns from.
    pub fn total(&self) -> f32 {
        let [first, rest @ ..] = self.values();
        rest.into_iter().fold(first, |sum, term| sum + term)
    }
}

/// Returns how much deeper the image's centre is than the whole image, in [-1, 1].
fn centre_minus_whole(image: &[u8; IMAGE_PIXELS]) -> f32 {
    const TOP: usize = (IMAGE_HEIGHT - CENTRE_SIDE) / 2;
    const LEFT: usize = (IMAGE_WIDTH - CENTRE_SIDE) / 2;
    let sum = |pixels: &[u8]| pixels.iter().map(|&p| u32::from(p)).sum::<u32>();
    let centre: u32 = image
        .chunks_exact(IMAGE_WIDTH)
        .skip(TOP)
        .take(CENTRE_SIDE)
        .map(|row| sum(&row[LEFT..LEFT + CENTRE_SIDE]))
        .sum();
    let mean = |sum: u32, count: usize| sum as f32 / (count as f32 * 255.0);
    mean(centre, CENTRE_SIDE * CENTRE_SIDE) - mean(sum(image), IMAGE_PIXELS)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(level_up: LevelUp, outcome: Option<EpisodeOutcome>) -> StepReport {
        StepReport {
            walls_passed: 1,
            level_up,
            outcome,
            clearance_m: 2.0,
            ..StepReport::default()
        }
    }

    #[test]
    fn a_reward_out_of_bounds_is_refused_by_key() {
        for value in [f32::NAN, f32::INFINITY, -2e6] {
            let settings = RewardSettings {
                collision: value,
                ..RewardSettings::default()
            };
            let refusal = settings.validate().unwrap_err().to_string();
            assert!(
                refusal.contains("[simulator.reward] collision ="),
                "{refusal}"
            );
        }
        assert_eq!(RewardSettings::default().validate(), Ok(()));
    }

    #[test]
    fn every_term_is_a_setting_a_value_and_a_summand_under_one_name() {
        let keys = RewardSettings::default().by_key().map(|(key, _)| key);
        assert_eq!(keys, RewardTerms::NAMES);
        let terms = RewardTerms {
            collision: 1e8,
            level_up: 1.0,
            open_view: -1e8,
            ..RewardTerms::default()
        };
        assert_eq!(terms.values()[..4], [1e8, 1.0, 0.0, -1e8]);
        // In this order the 1 is lost, in others it is not.
        assert_eq!(terms.total(), 0.0);
    }

    #[test]
    fn open_view_is_centre_minus_whole() {
        let mut image = [51; IMAGE_PIXELS];
        for row in 28..44 {
            image[row * IMAGE_WIDTH + 56..row * IMAGE_WIDTH + 72].fill(255);
        }
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, None),
            &image,
        );
        // 256 of 9216 pixels are 1, the others 0.2: the mean is 0.2 + 0.8 / 36.
        assert!((terms.open_view - (1.0 - (0.2 + 0.8 / 36.0))).abs() < 1e-6);
        assert_eq!(terms.total(), terms.open_view);
    }

    #[test]
    fn even_image_gives_no_open_view_reward() {
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, None),
            &[200; IMAGE_PIXELS],
        );
        assert!(terms.open_view.abs() < 1e-6);
    }

    #[test]
    fn passing_a_wall_and_hitting_something_in_one_step_give_both_terms() {
        let settings = RewardSettings {
            collision: -3.0,
            level_up: 2.0,
            ..Default::default()
        };
        let terms = RewardTerms::of(
            &settings,
            &report(LevelUp::Yes, Some(EpisodeOutcome::Collided)),
            &[0; IMAGE_PIXELS],
        );
        assert_eq!(
            (terms.collision, terms.level_up, terms.destination),
            (-3.0, 2.0, 0.0)
        );
        assert_eq!(terms.total(), -1.0);
    }

    #[test]
    fn a_step_is_paid_for_progress_and_charged_for_nearness_and_effort() {
        let report = StepReport {
            progress_m: 0.5,
            clearance_m: 0.75,
            effort: 0.2,
            effort_change: 0.1,
            ..report(LevelUp::No, None)
        };
        let of = |settings: &RewardSettings| {
            RewardTerms::of(settings, &report, &[0; IMAGE_PIXELS]).values()
        };
        assert_eq!(of(&RewardSettings::default()), [0.0; 8]);
        let settings = RewardSettings {
            progress: 2.0,
            clearance: 4.0,
            effort: 5.0,
            effort_change: 10.0,
            ..Default::default()
        };
        assert_eq!(of(&settings)[4..], [1.0, -1.0, -1.0, -1.0]);
        let terms = RewardTerms::from_values(of(&settings));
        assert_eq!(terms.values(), of(&settings));
    }

    #[test]
    fn running_out_of_time_is_neither_collision_nor_arrival() {
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, Some(EpisodeOutcome::TimedOut)),
            &[0; IMAGE_PIXELS],
        );
        assert_eq!(terms.total(), 0.0);
    }
}
