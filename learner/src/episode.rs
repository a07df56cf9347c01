//! An episode as the learner keeps it: committed, complete, in order.
//!
//! The assembler builds it from streamed records; metrics and replay take it from there. It holds
//! one observation more than it has steps: the closing observation is what the last step led to,
//! and an episode that was cut off bootstraps from it. Of an episode in segments each segment is
//! one of these, and what has been flown of it so far is one as well.

use skein_protocol::config::View;
use skein_protocol::ids::{ActorId, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::transition::Outcome;
use skein_protocol::{ACTION, GROUND_TRUTH, IMAGE_PIXELS, LatentCode};

/// What the vehicle saw and where it was at the beginning of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepObservation {
    /// The VAE's latent mean of the depth image.
    pub latent: LatentCode,
    /// Velocity in the world in metres per second: forward, left, up.
    pub velocity_mps: [f32; 3],
    /// Position in the world in metres: along the corridor, lateral, up.
    pub position_m: [f32; 3],
    /// Orientation, world from body, as a unit quaternion (i, j, k, w).
    pub orientation: [f32; 4],
    /// What the simulator knows beyond that, in its order and units.
    pub ground_truth: [f32; GROUND_TRUTH],
}

/// What brings the numbers of the ground truth, in their order, to a common size: 10 m between
/// walls, some metres to an opening, tenths of a newton.
#[rustfmt::skip]
const TRUTH_SCALE: [f32; GROUND_TRUTH] = [
    0.2, 0.5, 0.5, 1.0, // the next wall: distance, left, up, clearance
    0.1, 0.5, 0.5, 1.0, // the one after it
    0.25, 0.25,         // from the corridor's middle
    0.03,               // to the end
    1.0,                // mass
    1.0,                // latency
    3.0, 3.0, 3.0,      // gust
];

/// One whole episode of T steps, or T steps of one.
#[derive(Debug, Clone, PartialEq)]
pub struct CommittedEpisode {
    /// Its number.
    pub episode: EpisodeId,
    /// The epoch it belongs to.
    pub epoch: Epoch,
    /// The one snapshot all of it was flown with; of several segments, the first one's.
    pub policy_version: PolicyVersion,
    /// Who flew it, or the first segment of it; without influence on learning.
    pub actor: ActorId,
    /// The level (1 is the first) whose start it took off from.
    pub level: u8,
    /// Steps of the episode that were flown before these; 0 if it is whole.
    pub first_step: usize,
    /// The action before the first; zero at reset.
    pub action_before: [f32; ACTION],
    /// `[T + 1]`, the closing observation last.
    pub observations: Vec<StepObservation>,
    /// Lateral and vertical velocity command, each in [-1, 1]; `[T]`.
    pub actions: Vec<[f32; ACTION]>,
    /// `[T]`.
    pub rewards: Vec<f32>,
    /// Terms of each reward: collision, level-up, destination, open view; `[T]`.
    pub reward_terms: Vec<[f32; 4]>,
    /// Whether a wall was crossed or the destination reached in the step; `[T]`.
    pub level_up: Vec<bool>,
    /// How it ended; `None` of a segment whose episode goes on.
    pub outcome: Option<Outcome>,
    /// Walls passed since reset; the end wall is none.
    pub walls_passed: u8,
    /// Walls of the course; 0 while the episode goes on.
    pub course_walls: u8,
    /// The wall that was hit, from 1 in episode order, if it collided with one and not with the
    /// corridor.
    pub hit_wall: Option<u8>,
    /// Depth images of all observations, `[T + 1, 72, 128]`, while the VAE is trained.
    pub depth: Option<Vec<u8>>,
}

/// Why an episode's parts do not belong together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("episode {episode} of {steps} steps has {found} {what} where {expected} are expected")]
pub struct EpisodeFault {
    /// The episode.
    pub episode: EpisodeId,
    /// Its steps, by the number of its actions.
    pub steps: usize,
    /// The part that is too short or too long.
    pub what: &'static str,
    /// Its length.
    pub found: usize,
    /// The length it should have.
    pub expected: usize,
}

impl CommittedEpisode {
    /// Steps flown, T.
    pub fn steps(&self) -> usize {
        self.actions.len()
    }

    /// Sum of all rewards, undiscounted; summed in double precision, so that it does not depend on
    /// how the sum is arranged.
    pub fn total_reward(&self) -> f32 {
        self.rewards
            .iter()
            .map(|&reward| f64::from(reward))
            .sum::<f64>() as f32
    }

    /// How it ended.
    ///
    /// # Panics
    /// When it is a segment whose episode goes on.
    pub fn ending(&self) -> Outcome {
        self.outcome
            .expect("only of episodes that have ended is asked how they did")
    }

    /// Whether it ended in a state without a future. An episode that reached its step limit did
    /// not, and its last step still bootstraps.
    pub fn terminated(&self) -> bool {
        match self.outcome {
            Some(Outcome::Collided | Outcome::ReachedEnd) => true,
            Some(Outcome::TimedOut) | None => false,
        }
    }

    /// The same without images.
    #[must_use]
    pub fn without_images(&self) -> Self {
        Self {
            depth: None,
            observations: self.observations.clone(),
            actions: self.actions.clone(),
            rewards: self.rewards.clone(),
            reward_terms: self.reward_terms.clone(),
            level_up: self.level_up.clone(),
            ..*self
        }
    }

    /// Appends the segment that was flown next, but for its images.
    pub fn extend(&mut self, segment: &Self) {
        // Its first observation is this one's last, seen by another encoder perhaps.
        self.observations.pop();
        self.observations.extend_from_slice(&segment.observations);
        self.actions.extend_from_slice(&segment.actions);
        self.rewards.extend_from_slice(&segment.rewards);
        self.reward_terms.extend_from_slice(&segment.reward_terms);
        self.level_up.extend_from_slice(&segment.level_up);
        self.outcome = segment.outcome;
        self.walls_passed = segment.walls_passed;
        self.course_walls = segment.course_walls;
        self.hit_wall = segment.hit_wall;
    }

    /// Writes the observation vector at the beginning of `step`, at most T, as the actor saw it.
    pub fn write_observation(&self, step: usize, view: &View, into: &mut [f32]) {
        view.write(step, into, |step, into| self.write_moment(step, view, into));
    }

    /// Writes what a critic that is told the [ground
    /// truth](skein_protocol::config::CriticInput::GroundTruth) gets at the beginning of `step`,
    /// `[TRUE_STATE]`: that, the velocity, the tilt and the action before, which with latency has
    /// yet to take effect; each number roughly within [-2, 2].
    pub fn write_true_state(&self, step: usize, into: &mut [f32]) {
        let seen = &self.observations[step];
        let [roll, pitch, ..] = seen.orientation;
        let truth = seen
            .ground_truth
            .iter()
            .zip(TRUTH_SCALE)
            .map(|(value, scale)| value * scale);
        let motion = seen
            .velocity_mps
            .into_iter()
            .chain([10.0 * roll, 10.0 * pitch]);
        let all = truth.chain(motion).chain(self.action_before(step));
        into.iter_mut()
            .zip(all)
            .for_each(|(into, value)| *into = value);
    }

    fn action_before(&self, step: usize) -> [f32; ACTION] {
        step.checked_sub(1)
            .map_or(self.action_before, |previous| self.actions[previous])
    }

    fn write_moment(&self, step: usize, view: &View, into: &mut [f32]) {
        let previous_action = self.action_before(step);
        let seen = &self.observations[step];
        view.write_moment(&seen.latent, &seen.velocity_mps, &previous_action, into);
    }

    /// Checks that every part has the length that the number of actions asks for, and that there is
    /// a step.
    ///
    /// # Errors
    /// [`EpisodeFault`] names the first part that has not.
    pub fn check(&self) -> Result<(), EpisodeFault> {
        let steps = self.steps();
        let images = self
            .depth
            .as_ref()
            .map_or((steps + 1) * IMAGE_PIXELS, Vec::len);
        for (what, found, expected) in [
            ("actions", steps, steps.max(1)),
            ("observations", self.observations.len(), steps + 1),
            ("rewards", self.rewards.len(), steps),
            ("reward terms", self.reward_terms.len(), steps),
            ("level-up flags", self.level_up.len(), steps),
            ("bytes of depth images", images, (steps + 1) * IMAGE_PIXELS),
        ] {
            if found != expected {
                return Err(EpisodeFault {
                    episode: self.episode,
                    steps,
                    what,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod samples {
    //! Episodes for tests, every number in them recognisable.

    use super::*;

    /// An episode of `steps` steps whose every quantity is a function of (`episode`, step). Image t
    /// is filled with [`shade`]; its latent is [`code`] of that.
    pub(crate) fn episode(episode: u64, steps: usize, outcome: Outcome) -> CommittedEpisode {
        let at = |step: usize| episode as f32 * 1000.0 + step as f32;
        CommittedEpisode {
            episode: EpisodeId(episode),
            epoch: Epoch(episode / 10),
            policy_version: PolicyVersion(episode / 10),
            actor: ActorId(0),
            level: 1,
            first_step: 0,
            action_before: [0.0; ACTION],
            observations: (0..=steps)
                .map(|step| StepObservation {
                    latent: code(shade(episode, step)),
                    velocity_mps: [1.0, at(step) + 0.25, at(step) + 0.5],
                    position_m: [step as f32, 0.0, 3.5],
                    orientation: [0.0, 0.0, 0.0, 1.0],
                    ground_truth: std::array::from_fn(|index| at(step) + index as f32),
                })
                .collect(),
            actions: (0..steps)
                .map(|step| [at(step) / 1e6, -at(step) / 1e6])
                .collect(),
            rewards: (0..steps).map(|step| at(step) / 100.0).collect(),
            reward_terms: vec![[0.0; 4]; steps],
            level_up: vec![false; steps],
            outcome: Some(outcome),
            walls_passed: 0,
            course_walls: 5,
            hit_wall: None,
            depth: None,
        }
    }

    /// The same with its images.
    pub(crate) fn with_images(mut committed: CommittedEpisode) -> CommittedEpisode {
        let episode = committed.episode.0;
        committed.depth = Some(
            (0..=committed.steps())
                .flat_map(|step| [shade(episode, step); IMAGE_PIXELS])
                .collect(),
        );
        committed
    }

    /// Gray value of image `step` of `episode`.
    pub(crate) fn shade(episode: u64, step: usize) -> u8 {
        ((episode * 37 + step as u64 * 11) % 251) as u8
    }

    /// Latent code of an image of gray value `shade`.
    pub(crate) fn code(shade: u8) -> LatentCode {
        std::array::from_fn(|index| f32::from(shade) + index as f32 / 64.0)
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::TRUE_STATE;
    use skein_protocol::config::Observation;

    use super::*;

    #[test]
    fn a_part_of_the_wrong_length_is_named() {
        let sound = samples::with_images(samples::episode(3, 5, Outcome::Collided));
        assert_eq!(sound.check(), Ok(()));
        type Damage = fn(&mut CommittedEpisode);
        let damage: [(&str, Damage); 6] = [
            ("actions", |episode| episode.actions.clear()),
            ("observations", |episode| episode.observations.truncate(5)),
            ("rewards", |episode| episode.rewards.push(0.0)),
            ("reward terms", |episode| episode.reward_terms.truncate(4)),
            ("level-up flags", |episode| episode.level_up.push(true)),
            ("bytes of depth images", |episode| {
                episode.depth.as_mut().unwrap().push(0)
            }),
        ];
        for (what, damage) in damage {
            let mut episode = sound.clone();
            damage(&mut episode);
            assert_eq!(episode.check().unwrap_err().what, what);
        }
    }

    #[test]
    fn the_previous_action_is_zero_at_reset_and_then_the_one_before() {
        let episode = samples::episode(3, 5, Outcome::Collided);
        let view = View::present(Observation::LatentVelocityAction, 16);
        let mut vector = [f32::NAN; 16 + 2 + ACTION];
        episode.write_observation(0, &view, &mut vector);
        assert_eq!(vector[18..], [0.0, 0.0]);
        episode.write_observation(5, &view, &mut vector);
        assert_eq!(vector[18..], episode.actions[4]);
        assert_eq!(vector[..16], episode.observations[5].latent[..16]);
        assert_eq!(vector[16..18], episode.observations[5].velocity_mps[1..]);
    }

    #[test]
    fn earlier_moments_follow_the_present_and_before_reset_all_was_as_at_reset() {
        let episode = samples::episode(3, 5, Outcome::Collided);
        let view = View {
            moment: Observation::LatentVelocity,
            latent: 8,
            history_steps: vec![1, 4],
        };
        let mut vector = vec![f32::NAN; view.len()];
        for (step, moments) in [(5, [5, 4, 1]), (2, [2, 1, 0]), (0, [0, 0, 0])] {
            episode.write_observation(step, &view, &mut vector);
            for (seen, moment) in vector.chunks_exact(8 + 2).zip(moments) {
                let observation = &episode.observations[moment];
                assert_eq!(seen[..8], observation.latent[..8]);
                assert_eq!(seen[8..], observation.velocity_mps[1..]);
            }
        }
    }

    #[test]
    fn the_true_state_is_the_ground_truth_the_motion_and_the_action_before() {
        let episode = samples::episode(3, 5, Outcome::Collided);
        let mut state = [f32::NAN; TRUE_STATE];
        episode.write_true_state(4, &mut state);
        let seen = &episode.observations[4];
        assert_eq!(state[0], seen.ground_truth[0] * TRUTH_SCALE[0]);
        assert_eq!(state[15], seen.ground_truth[15] * TRUTH_SCALE[15]);
        assert_eq!(state[16..19], seen.velocity_mps);
        assert_eq!(state[21..], episode.actions[3]);
        episode.write_true_state(0, &mut state);
        assert_eq!(state[21..], [0.0, 0.0]);
    }

    #[test]
    fn only_collision_and_destination_terminate() {
        assert!(samples::episode(0, 1, Outcome::Collided).terminated());
        assert!(samples::episode(0, 1, Outcome::ReachedEnd).terminated());
        assert!(!samples::episode(0, 1, Outcome::TimedOut).terminated());
    }
}
