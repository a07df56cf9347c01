//! The paper's reward: a penalty for colliding, bonuses for passing a wall and for arriving, and
//! one for looking into free space.
//!
//! Its Table 1, which holds the numbers, is lost; the defaults are of our choosing and were enough
//! to learn the task.

use serde::{Deserialize, Serialize};

use crate::camera::{IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH};
use crate::simulator::{LevelUp, Outcome, StepReport};

/// Edge of the square in the image's middle that the action reward looks at, pixels.
const CENTRE_SIDE: usize = 16;

/// Largest reward, either way, that can be set.
const MAX_REWARD: f32 = 1e6;

/// Size of each reward term.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RewardSettings {
    /// Given on collision. Default −1.
    pub collision: f32,
    /// Given when a wall has been passed. Default 1.
    pub level_up: f32,
    /// Given on reaching the end wall. Default 1.
    pub destination: f32,
    /// Factor `k` of the action reward. Default 1.
    pub action_scale: f32,
}

impl Default for RewardSettings {
    fn default() -> Self {
        Self {
            collision: -1.0,
            level_up: 1.0,
            destination: 1.0,
            action_scale: 1.0,
        }
    }
}

impl RewardSettings {
    /// Checks that every reward is a number that sums of rewards can hold.
    ///
    /// # Errors
    /// [`RewardSettingsError`] names the key.
    pub fn validate(&self) -> Result<(), RewardSettingsError> {
        for (key, value) in [
            ("collision", self.collision),
            ("level_up", self.level_up),
            ("destination", self.destination),
            ("action_scale", self.action_scale),
        ] {
            if !(-MAX_REWARD..=MAX_REWARD).contains(&value) {
                return Err(RewardSettingsError { key, value });
            }
        }
        Ok(())
    }
}

/// A reward no critic can learn.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "[simulator.reward] {key} = {value} is outside [-{MAX_REWARD}, {MAX_REWARD}]: no critic can learn returns of that size"
)]
pub struct RewardSettingsError {
    /// The key.
    pub key: &'static str,
    /// Its value.
    pub value: f32,
}

/// What each term gave in one step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct RewardTerms {
    /// [`RewardSettings::collision`] if the step ended in a collision, else 0.
    pub collision: f32,
    /// [`RewardSettings::level_up`] if a wall was passed in the step, else 0.
    pub level_up: f32,
    /// [`RewardSettings::destination`] if the step reached the end wall, else 0.
    pub destination: f32,
    /// `k · (mean of the central 16 × 16 pixels − mean of the whole depth image)`, both in [0, 1].
    pub action: f32,
}

impl RewardTerms {
    /// Terms of the step that `report` tells of and after which the camera saw `image_after`.
    ///
    /// Source: Xue & Gonsalves 2021, section on the reward function.
    pub fn of(
        settings: &RewardSettings,
        report: &StepReport,
        image_after: &[u8; IMAGE_PIXELS],
    ) -> Self {
        let mut terms = Self {
            action: settings.action_scale * centre_minus_whole(image_after),
            ..Self::default()
        };
        if report.outcome == Some(Outcome::Collided) {
            terms.collision = settings.collision;
        }
        if report.level_up == LevelUp::Yes {
            terms.level_up = settings.level_up;
        }
        if report.outcome == Some(Outcome::ReachedEnd) {
            terms.destination = settings.destination;
        }
        terms
    }

    /// The reward the agent learns from.
    pub fn total(&self) -> f32 {
        self.collision + self.level_up + self.destination + self.action
    }
}

/// How much deeper the image's middle is than the whole, in [-1, 1].
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

    fn report(level_up: LevelUp, outcome: Option<Outcome>) -> StepReport {
        StepReport {
            walls_passed: 1,
            level_up,
            outcome,
            hit: None,
        }
    }

    #[test]
    fn a_reward_that_is_no_number_is_refused_by_key() {
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
    fn action_term_is_centre_minus_whole() {
        let mut image = [51; IMAGE_PIXELS];
        for row in 28..44 {
            image[row * IMAGE_WIDTH + 56..row * IMAGE_WIDTH + 72].fill(255);
        }
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, None),
            &image,
        );
        // 256 of 9216 pixels are 1, the rest 0.2: mean 0.2 + 0.8 / 36.
        assert!((terms.action - (1.0 - (0.2 + 0.8 / 36.0))).abs() < 1e-6);
        assert_eq!(terms.total(), terms.action);
    }

    #[test]
    fn even_image_rewards_nothing() {
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, None),
            &[200; IMAGE_PIXELS],
        );
        assert!(terms.action.abs() < 1e-6);
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
            &report(LevelUp::Yes, Some(Outcome::Collided)),
            &[0; IMAGE_PIXELS],
        );
        assert_eq!(
            (terms.collision, terms.level_up, terms.destination),
            (-3.0, 2.0, 0.0)
        );
        assert_eq!(terms.total(), -1.0);
    }

    #[test]
    fn running_out_of_time_is_neither_collision_nor_arrival() {
        let terms = RewardTerms::of(
            &RewardSettings::default(),
            &report(LevelUp::No, Some(Outcome::TimedOut)),
            &[0; IMAGE_PIXELS],
        );
        assert_eq!(terms.total(), 0.0);
    }
}
