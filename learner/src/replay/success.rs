//! The rule for success experience.
//!
//! The paper keeps "experience of avoiding an obstacle" apart without saying where it begins and
//! ends, so the configuration decides. Episodes are inserted whole, hence the steps before a
//! level-up are known when they are sorted into the two parts.

use skein_protocol::config::{ReplaySection, SuccessRule};

/// Marks the steps of an episode that are success experience, `[steps]`.
///
/// `level_up`, `[steps]`: `true` where the step crossed a wall or reached the destination. No step
/// is marked where success experience has no part of its own.
pub(super) fn success_steps(level_up: &[bool], section: &ReplaySection) -> Vec<bool> {
    if section.success_share == 0.0 {
        return vec![false; level_up.len()];
    }
    let before = match section.success {
        SuccessRule::LevelUp => 0,
        SuccessRule::Approach => section.approach_steps,
    };
    let mut success = vec![false; level_up.len()];
    for step in (0..level_up.len()).filter(|&step| level_up[step]) {
        success[step.saturating_sub(before)..=step].fill(true);
    }
    success
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(level_up: &str, success: SuccessRule) -> String {
        let level_up: Vec<_> = level_up.chars().map(|c| c == 'X').collect();
        let section = ReplaySection {
            success,
            approach_steps: 2,
            ..Default::default()
        };
        success_steps(&level_up, &section)
            .iter()
            .map(|&s| if s { 'X' } else { '.' })
            .collect()
    }

    #[test]
    fn level_up_rule_takes_the_crossing_step_alone() {
        assert_eq!(steps("...X....X.", SuccessRule::LevelUp), "...X....X.");
    }

    #[test]
    fn approach_rule_takes_the_steps_that_led_there_and_none_after() {
        assert_eq!(steps("...X....X.", SuccessRule::Approach), ".XXX..XXX.");
    }

    #[test]
    fn an_approach_does_not_reach_before_reset() {
        assert_eq!(steps("X....", SuccessRule::Approach), "X....");
    }

    #[test]
    fn an_episode_without_a_crossing_is_all_regular() {
        assert_eq!(steps(".....", SuccessRule::Approach), ".....");
    }
}
