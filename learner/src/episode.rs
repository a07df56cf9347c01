//! An episode as the learner keeps it: committed, complete, in order.
//!
//! The assembly builds it from streamed records; metrics and replay read it. It holds one
//! observation more than steps: the closing observation follows the last step, and a truncated
//! episode bootstraps from it. An episode flown in segments is committed segment by segment: each
//! segment is a [`CommittedEpisode`], and so are the segments so far, joined.

use skein_protocol::config::{ObservationLayout, SeenStep};
use skein_protocol::heading::heading;
use skein_protocol::ids::{ActorId, EpisodeId, Epoch, PolicyVersion};
use skein_protocol::transition::Outcome;
use skein_protocol::{Action, ActionSpace, GROUND_TRUTH, IMAGE_PIXELS, LatentCode, REWARD_TERMS};

/// Observation and pose of the vehicle at the beginning of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepObservation {
    /// The VAE's latent mean of the depth image.
    pub latent: LatentCode,
    /// Velocity in the world in metres per second: forward, left, up.
    pub velocity_mps: [f32; 3],
    /// The goal from the drone, in the heading frame, in metres: forward, left, up.
    pub goal_m: [f32; 3],
    /// Position in the world in metres: along the corridor, lateral, up.
    pub position_m: [f32; 3],
    /// Orientation, world from body, as a unit quaternion (i, j, k, w).
    pub orientation: [f32; 4],
    /// Further state known to the simulator, in its order and units.
    pub ground_truth: [f32; GROUND_TRUTH],
}

/// Factors that bring the ground truth's numbers, in their order, to a common size. They reflect 10
/// m between walls, some metres to an opening, and tenths of a newton.
#[rustfmt::skip]
const TRUTH_SCALE: [f32; GROUND_TRUTH] = [
    0.2, 0.5, 0.5, 1.0, // the next wall: distance, left, up, clearance
    0.1, 0.5, 0.5, 1.0, // the one after it
    0.25, 0.25,         // from the corridor's middle
    0.03,               // to the end
    1.0,                // mass
    1.0,                // latency
    3.0, 3.0, 3.0,      // gust
    0.25, 0.25,         // half the corridor's width and height
];

/// A whole episode of T steps, or T consecutive steps of one.
#[derive(Debug, Clone, PartialEq)]
pub struct CommittedEpisode {
    /// Number of the episode.
    pub episode: EpisodeId,
    /// Epoch that the episode belongs to.
    pub epoch: Epoch,
    /// Snapshot that the episode was flown with; of several segments, the first one's.
    pub policy_version: PolicyVersion,
    /// Actor that flew the episode, or its first segment; without influence on learning.
    pub actor: ActorId,
    /// Level whose start the episode was reset to, from 1.
    pub level: u8,
    /// Steps of the episode before these; 0 if the episode is whole.
    pub first_step: usize,
    /// Action before the first step; zero at the reset.
    pub action_before: Action,
    /// Observations, `[T + 1]`, the closing one last.
    pub observations: Vec<StepObservation>,
    /// Actions, each number in [-1, 1]; `[T]`.
    pub actions: Vec<Action>,
    /// The teacher's actions for the same observations; zero where none was asked. `[T]`.
    pub teacher_actions: Vec<Action>,
    /// Rewards, `[T]`.
    pub rewards: Vec<f32>,
    /// Terms of each reward: [`REWARD_TERM_NAMES`](skein_protocol::REWARD_TERM_NAMES); `[T]`.
    pub reward_terms: Vec<[f32; REWARD_TERMS]>,
    /// `true` where the step crossed a wall or reached the destination; `[T]`.
    pub level_up: Vec<bool>,
    /// Outcome of the episode; `None` for a segment whose episode continues.
    pub outcome: Option<Outcome>,
    /// Walls passed since the reset, the end wall not counted.
    pub walls_passed: u8,
    /// Walls of the course; 0 while the episode continues.
    pub course_walls: u8,
    /// Wall that was hit, from 1 in order along the course; `None` if none was, or if the corridor
    /// was hit.
    pub hit_wall: Option<u8>,
    /// Depth images of all observations, `[T + 1, 72, 128]`, while the VAE is trained.
    pub depth: Option<Vec<u8>>,
}

/// Reason why an episode's parts do not fit together.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("episode {episode} of {steps} steps has {found} {what} where {expected} are expected")]
pub struct MalformedEpisode {
    /// Number of the episode.
    pub episode: EpisodeId,
    /// Number of its steps, counted by its actions.
    pub steps: usize,
    /// Name of the part that is too short or too long.
    pub what: &'static str,
    /// Length of that part.
    pub found: usize,
    /// Length that it should have.
    pub expected: usize,
}

impl CommittedEpisode {
    /// Number of steps, T.
    pub fn steps(&self) -> usize {
        self.actions.len()
    }

    /// Undiscounted sum of all rewards, in double precision, so that the order of summation does
    /// not matter.
    pub fn total_reward(&self) -> f32 {
        self.rewards
            .iter()
            .map(|&reward| f64::from(reward))
            .sum::<f64>() as f32
    }

    /// Outcome of the episode.
    ///
    /// # Panics
    /// When this is a segment whose episode continues.
    pub fn ending(&self) -> Outcome {
        self.outcome.expect("only an ended episode has an outcome")
    }

    /// `true` if the episode ended in a state without a future. An episode at its step limit did
    /// not: its last step still bootstraps.
    pub fn terminated(&self) -> bool {
        match self.outcome {
            Some(Outcome::Collided | Outcome::ReachedEnd) => true,
            Some(Outcome::TimedOut) | None => false,
        }
    }

    /// Returns a copy without images.
    #[must_use]
    pub fn without_images(&self) -> Self {
        Self {
            depth: None,
            observations: self.observations.clone(),
            actions: self.actions.clone(),
            teacher_actions: self.teacher_actions.clone(),
            rewards: self.rewards.clone(),
            reward_terms: self.reward_terms.clone(),
            level_up: self.level_up.clone(),
            ..*self
        }
    }

    /// Appends the segment that was flown next, except its images.
    pub fn extend(&mut self, segment: &Self) {
        // The segment's first observation replaces this one's last: perhaps another encoder saw it.
        self.observations.pop();
        self.observations.extend_from_slice(&segment.observations);
        self.actions.extend_from_slice(&segment.actions);
        self.teacher_actions
            .extend_from_slice(&segment.teacher_actions);
        self.rewards.extend_from_slice(&segment.rewards);
        self.reward_terms.extend_from_slice(&segment.reward_terms);
        self.level_up.extend_from_slice(&segment.level_up);
        self.outcome = segment.outcome;
        self.walls_passed = segment.walls_passed;
        self.course_walls = segment.course_walls;
        self.hit_wall = segment.hit_wall;
    }

    /// Writes the observation vector at the beginning of `step`, at most T, as the actor saw it.
    pub fn write_observation(&self, step: usize, view: &ObservationLayout, into: &mut [f32]) {
        view.write(step, into, |step, into| self.write_moment(step, view, into));
    }

    /// Writes the critic's input at the beginning of `step`, `[critic_state(action)]`, where the
    /// critic sees the [ground truth](skein_protocol::config::CriticInput::GroundTruth).
    ///
    /// It holds the ground truth, the velocity, the tilt, the heading of a drone that turns, and
    /// the action before, which under latency has yet to take effect. Each number is roughly within
    /// [-2, 2].
    pub fn write_critic_state(&self, step: usize, action: ActionSpace, into: &mut [f32]) {
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
        let turned = match action {
            ActionSpace::Lateral | ActionSpace::Velocity => None,
            ActionSpace::VelocityYaw => Some(heading(seen.orientation)),
        };
        let all = truth
            .chain(motion)
            .chain(turned.into_iter().flatten())
            .chain(self.action_before(step));
        into.iter_mut()
            .zip(all)
            .for_each(|(into, value)| *into = value);
    }

    fn action_before(&self, step: usize) -> Action {
        step.checked_sub(1)
            .map_or(self.action_before, |previous| self.actions[previous])
    }

    fn write_moment(&self, step: usize, view: &ObservationLayout, into: &mut [f32]) {
        let previous_action = self.action_before(step);
        let seen = &self.observations[step];
        let step = SeenStep {
            latent: &seen.latent,
            velocity_mps: &seen.velocity_mps,
            orientation: &seen.orientation,
            goal_m: &seen.goal_m,
            previous_action: &previous_action,
        };
        view.write_step(&step, into);
    }

    /// Checks that there is a step, and that every part is as long as the number of actions
    /// requires.
    ///
    /// # Errors
    /// [`MalformedEpisode`] names the first part that is not.
    pub fn check(&self) -> Result<(), MalformedEpisode> {
        let steps = self.steps();
        let images = self
            .depth
            .as_ref()
            .map_or((steps + 1) * IMAGE_PIXELS, Vec::len);
        for (what, found, expected) in [
            ("actions", steps, steps.max(1)),
            ("teacher's actions", self.teacher_actions.len(), steps),
            ("observations", self.observations.len(), steps + 1),
            ("rewards", self.rewards.len(), steps),
            ("reward terms", self.reward_terms.len(), steps),
            ("level-up flags", self.level_up.len(), steps),
            ("bytes of depth images", images, (steps + 1) * IMAGE_PIXELS),
        ] {
            if found != expected {
                return Err(MalformedEpisode {
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

    use skein_protocol::MAX_ACTION;

    use super::*;

    /// An episode of `steps` steps, in which every number is a function of (`episode`, step). Image
    /// t is filled with [`shade`]; its latent is [`code`] of that.
    pub(crate) fn episode(episode: u64, steps: usize, outcome: Outcome) -> CommittedEpisode {
        let at = |step: usize| episode as f32 * 1000.0 + step as f32;
        CommittedEpisode {
            episode: EpisodeId(episode),
            epoch: Epoch(episode / 10),
            policy_version: PolicyVersion(episode / 10),
            actor: ActorId(0),
            level: 1,
            first_step: 0,
            action_before: [0.0; MAX_ACTION],
            observations: (0..=steps)
                .map(|step| StepObservation {
                    latent: code(shade(episode, step)),
                    velocity_mps: [1.0, at(step) + 0.25, at(step) + 0.5],
                    goal_m: [60.0 - step as f32, at(step), 1.0],
                    position_m: [step as f32, 0.0, 3.5],
                    orientation: [0.0, 0.0, 0.0, 1.0],
                    ground_truth: std::array::from_fn(|index| at(step) + index as f32),
                })
                .collect(),
            actions: (0..steps)
                .map(|step| [1e6, -1e6, 4e6, -5e6].map(|size| at(step) / size))
                .collect(),
            teacher_actions: (0..steps)
                .map(|step| [2e6, -3e6, 6e6, -7e6].map(|size| at(step) / size))
                .collect(),
            rewards: (0..steps).map(|step| at(step) / 100.0).collect(),
            reward_terms: vec![[0.0; REWARD_TERMS]; steps],
            level_up: vec![false; steps],
            outcome: Some(outcome),
            walls_passed: 0,
            course_walls: 5,
            hit_wall: None,
            depth: None,
        }
    }

    /// Adds the images.
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
    use skein_protocol::config::Observation;
    use skein_protocol::critic_state;

    use super::*;

    #[test]
    fn a_part_of_the_wrong_length_is_named() {
        let sound = samples::with_images(samples::episode(3, 5, Outcome::Collided));
        assert_eq!(sound.check(), Ok(()));
        type Damage = fn(&mut CommittedEpisode);
        let damage: [(&str, Damage); 7] = [
            ("actions", |episode| episode.actions.clear()),
            ("teacher's actions", |episode| {
                episode.teacher_actions.clear();
            }),
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
        let view = ObservationLayout::present(Observation::LatentVelocityAction, 16);
        let mut vector = [f32::NAN; 16 + 2 + 2];
        episode.write_observation(0, &view, &mut vector);
        assert_eq!(vector[18..], [0.0, 0.0]);
        episode.write_observation(5, &view, &mut vector);
        assert_eq!(vector[18..], episode.actions[4][..2]);
        assert_eq!(vector[..16], episode.observations[5].latent[..16]);
        assert_eq!(vector[16..18], episode.observations[5].velocity_mps[1..]);
    }

    #[test]
    fn earlier_moments_follow_the_present_and_before_reset_all_was_as_at_reset() {
        let episode = samples::episode(3, 5, Outcome::Collided);
        let view = ObservationLayout {
            history_steps: vec![1, 4],
            ..ObservationLayout::present(Observation::LatentVelocity, 8)
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
        let mut state = vec![f32::NAN; critic_state(ActionSpace::Lateral)];
        episode.write_critic_state(4, ActionSpace::Lateral, &mut state);
        let seen = &episode.observations[4];
        assert_eq!(state[0], seen.ground_truth[0] * TRUTH_SCALE[0]);
        assert_eq!(state[15], seen.ground_truth[15] * TRUTH_SCALE[15]);
        assert_eq!(state[GROUND_TRUTH..GROUND_TRUTH + 3], seen.velocity_mps);
        let before = state.len() - 2;
        assert_eq!(state[before..], episode.actions[3][..2]);
        episode.write_critic_state(0, ActionSpace::Lateral, &mut state);
        assert_eq!(state[before..], [0.0, 0.0]);
    }

    #[test]
    fn only_collision_and_destination_terminate() {
        assert!(samples::episode(0, 1, Outcome::Collided).terminated());
        assert!(samples::episode(0, 1, Outcome::ReachedEnd).terminated());
        assert!(!samples::episode(0, 1, Outcome::TimedOut).terminated());
    }
}
