//! One environment: episodes one after another, each a function of its seed.

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use skein_inference::EncoderScratch;
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::ticket::{CourseChoice, Ticket};
use skein_protocol::{
    Action, ActionSpace, IMAGE_PIXELS, LatentCode, MAX_ACTION, MAX_LATENT, REWARD_TERMS,
};
use skein_rollout::courses::Simulators;
use skein_rollout::environment_loop::{EpisodeFault, reset};
use skein_simulator::camera::DepthCamera;
use skein_simulator::reward::RewardTerms;
use skein_simulator::simulator::{
    EpisodeOutcome, GroundTruth, Obstacle, SimulationError, Simulator, StepReport,
};

use crate::task::Flown;

/// Bounds of what is observed, so that observation spaces are bounded. No drone of ours comes near.
pub(crate) const MOST_MPS: f32 = 50.0;
/// See [`MOST_MPS`]; codes have numbers of a few units.
pub(crate) const MOST_LATENT: f32 = 1000.0;

/// Position of the camera that follows the drone, relative to it: behind and above, metres.
const CHASE_M: [f32; 3] = [-3.0, 0.0, 0.7];
/// Least distance of that camera from the corridor's sides, metres.
const CHASE_MARGIN_M: f32 = 0.3;

/// Episodes one after another.
pub(crate) struct Environment {
    simulators: Simulators,
    seeds: EpisodeSeeds,
    flight: Option<Flight>,
    scratch: EncoderScratch,
}

/// Seeds of an environment's episodes: the given one, then what derives from it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct EpisodeSeeds {
    pub(crate) first: u64,
    pub(crate) next_episode: u64,
}

/// The present episode.
#[derive(Debug, Clone)]
pub(crate) struct Flight {
    pub(crate) ticket: Ticket,
    /// Actions since the reset.
    pub(crate) flown: Vec<Action>,
    pub(crate) ended: bool,
}

/// Reason why an environment cannot do what it is asked.
#[derive(Debug, thiserror::Error)]
pub(crate) enum EnvironmentError {
    #[error("no episode is in progress: call reset() first")]
    NotFlying,
    #[error("the episode is over: call reset() to start another")]
    Over,
    #[error("{0}; call reset() to start another episode")]
    Fault(#[from] EpisodeFault),
}

impl From<SimulationError> for EnvironmentError {
    fn from(error: SimulationError) -> Self {
        Self::Fault(error.into())
    }
}

/// A moment of an episode, but for its depth image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    /// Latent code; zero without an encoder.
    pub(crate) latent: LatentCode,
    /// Forward, left, up, m/s; in the heading frame.
    pub(crate) velocity_mps: [f32; 3],
    /// Forward, left, up in the heading frame, m.
    pub(crate) goal_m: [f32; 3],
    /// Zero after a reset.
    pub(crate) previous_action: Action,
    pub(crate) reward: f32,
    pub(crate) reward_terms: [f32; REWARD_TERMS],
    pub(crate) terminated: bool,
    pub(crate) truncated: bool,
    /// 0 while it flies; else as in a record.
    pub(crate) outcome: u8,
    /// From 1 in course order; 0 for none.
    pub(crate) hit_wall: u8,
    pub(crate) walls_passed: u8,
    pub(crate) level: u8,
    pub(crate) step: u32,
    pub(crate) seed: u64,
    /// Index of the listed course; -1 for a generated one.
    pub(crate) course: i32,
    /// Seed of a generated course; 0 for a listed one.
    pub(crate) course_seed: u64,
    pub(crate) position_m: [f32; 3],
    pub(crate) orientation: [f32; 4],
    pub(crate) ground_truth: [f32; GroundTruth::NUMBERS],
}

impl EpisodeSeeds {
    pub(crate) fn starting_with(first: u64) -> Self {
        Self {
            first,
            next_episode: 0,
        }
    }

    /// Returns the next episode's seed, and its number.
    pub(crate) fn advance(&mut self) -> (u64, u64) {
        let episode = self.next_episode;
        self.next_episode += 1;
        match episode {
            0 => (self.first, 0),
            // Not above what the signed integers of frameworks hold.
            later => (derive(self.first, Purpose::Episode, later) >> 1, later),
        }
    }
}

impl Environment {
    pub(crate) fn new(task: &Flown) -> Self {
        Self {
            simulators: Simulators::new(task.courses.clone()),
            seeds: EpisodeSeeds::default(),
            flight: None,
            scratch: EncoderScratch::default(),
        }
    }

    pub(crate) fn seeds(&mut self) -> &mut EpisodeSeeds {
        &mut self.seeds
    }

    pub(crate) fn flight(&self) -> Option<&Flight> {
        self.flight.as_ref()
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.flight.as_ref().is_some_and(|flight| flight.ended)
    }

    /// Returns whether a step is possible.
    pub(crate) fn check_flying(&self) -> Result<(), EnvironmentError> {
        match &self.flight {
            None => Err(EnvironmentError::NotFlying),
            Some(flight) if flight.ended => Err(EnvironmentError::Over),
            Some(_) => Ok(()),
        }
    }

    /// Starts the episode of `ticket`.
    pub(crate) fn begin(&mut self, ticket: Ticket) -> Result<(), EnvironmentError> {
        self.flight = None;
        reset(&mut self.simulators, &ticket)?;
        self.flight = Some(Flight {
            ticket,
            flown: Vec::new(),
            ended: false,
        });
        Ok(())
    }

    /// Starts an episode and repeats its actions: it is then where it was.
    pub(crate) fn restore(&mut self, flight: Flight) -> Result<(), EnvironmentError> {
        self.begin(flight.ticket)?;
        for action in flight.flown {
            self.advance(action)?;
        }
        Ok(())
    }

    /// Draws the present depth image; returns the rest of the moment, with nothing rewarded.
    pub(crate) fn observe(
        &mut self,
        task: &Flown,
        image: &mut [u8; IMAGE_PIXELS],
    ) -> Result<Moment, EnvironmentError> {
        let Self {
            simulators,
            flight,
            scratch,
            ..
        } = self;
        let flight = flight.as_ref().ok_or(EnvironmentError::NotFlying)?;
        let simulator = simulators.of(&flight.ticket).map_err(EpisodeFault::from)?;
        simulator.render(image);
        let mut moment = Moment::of(simulator, flight, task.action());
        if let Some((encoder, _)) = &task.encoder {
            let code = encoder.encode(image, scratch);
            moment.latent = code.map(|number| number.clamp(-MOST_LATENT, MOST_LATENT));
        }
        Ok(moment)
    }

    /// Flies one control period, then as [`Environment::observe`], with the reward.
    pub(crate) fn step(
        &mut self,
        task: &Flown,
        action: Action,
        image: &mut [u8; IMAGE_PIXELS],
    ) -> Result<Moment, EnvironmentError> {
        let report = self.advance(action)?;
        let mut moment = self.observe(task, image)?;
        let reward = RewardTerms::of(&task.courses.settings().reward, &report, image);
        moment.reward = reward.total();
        moment.reward_terms = reward.values();
        moment.take(&report);
        Ok(moment)
    }

    fn advance(&mut self, action: Action) -> Result<StepReport, EnvironmentError> {
        self.check_flying()?;
        let flight = self.flight.as_mut().ok_or(EnvironmentError::NotFlying)?;
        let simulator = self
            .simulators
            .of(&flight.ticket)
            .map_err(EpisodeFault::from)?;
        let report = match simulator.step(action) {
            Ok(report) => report,
            Err(error) => {
                self.flight = None;
                return Err(error.into());
            }
        };
        flight.flown.push(action);
        flight.ended = report.outcome.is_some();
        Ok(report)
    }

    /// Returns the oracle's action for the present moment.
    pub(crate) fn oracle_action(&mut self) -> Result<Action, EnvironmentError> {
        Ok(self.simulator()?.oracle_action())
    }

    /// Returns the depth image of a camera that follows the drone, and that camera's position.
    pub(crate) fn chase(
        &mut self,
        task: &Flown,
    ) -> Result<(Box<[u8; IMAGE_PIXELS]>, [f32; 3]), EnvironmentError> {
        let simulator = self.simulator()?;
        let corridor = simulator.course().corridor();
        let [x, y, z]: [f32; 3] = simulator.state().position_m.coords.into();
        let half = (corridor.width_m / 2.0 - CHASE_MARGIN_M).max(0.0);
        let top = (corridor.height_m - CHASE_MARGIN_M).max(CHASE_MARGIN_M);
        let eye = [
            (x + CHASE_M[0]).max(CHASE_MARGIN_M),
            (y + CHASE_M[1]).clamp(-half, half),
            (z + CHASE_M[2]).clamp(CHASE_MARGIN_M, top),
        ];
        let mut settings = task.courses.settings().camera.clone();
        settings.mount_m = [0.0; 3];
        settings.mount_pitch_deg = 0.0;
        let mut image = Box::new([0; IMAGE_PIXELS]);
        // The settings were checked with the simulator's own camera.
        if let Ok(mut camera) = DepthCamera::new(&settings, simulator.course()) {
            let pose = Isometry3::from_parts(Translation3::from(eye), UnitQuaternion::identity());
            camera.render(&pose, &mut image);
        }
        Ok((image, eye))
    }

    fn simulator(&mut self) -> Result<&mut Simulator, EnvironmentError> {
        let flight = self.flight.as_ref().ok_or(EnvironmentError::NotFlying)?;
        let simulator = self.simulators.of(&flight.ticket);
        Ok(simulator.map_err(EpisodeFault::from)?)
    }
}

impl Moment {
    /// A moment of nothing.
    pub(crate) const EMPTY: Self = Self {
        latent: [0.0; MAX_LATENT],
        velocity_mps: [0.0; 3],
        goal_m: [0.0; 3],
        previous_action: [0.0; MAX_ACTION],
        reward: 0.0,
        reward_terms: [0.0; REWARD_TERMS],
        terminated: false,
        truncated: false,
        outcome: 0,
        hit_wall: 0,
        walls_passed: 0,
        level: 0,
        step: 0,
        seed: 0,
        course: 0,
        course_seed: 0,
        position_m: [0.0; 3],
        orientation: [0.0; 4],
        ground_truth: [0.0; GroundTruth::NUMBERS],
    };

    fn of(simulator: &Simulator, flight: &Flight, action: ActionSpace) -> Self {
        let state = simulator.state();
        let velocity: [f32; 3] = match action {
            // The nose keeps pointing along the corridor.
            ActionSpace::Lateral | ActionSpace::Velocity => state.velocity_mps,
            ActionSpace::VelocityYaw => state.heading_velocity_mps(),
        }
        .into();
        let (course, course_seed) = match flight.ticket.course {
            CourseChoice::Generated(seed) => (-1, seed),
            CourseChoice::Evaluation(index) => (index as i32, 0),
            CourseChoice::Training => (0, 0),
        };
        Self {
            velocity_mps: velocity.map(|mps| mps.clamp(-MOST_MPS, MOST_MPS)),
            goal_m: simulator.goal_m(),
            previous_action: flight.flown.last().copied().unwrap_or_default(),
            walls_passed: simulator.walls_passed(),
            level: simulator.level(),
            step: flight.flown.len() as u32,
            seed: flight.ticket.seed,
            course,
            course_seed,
            position_m: state.position_m.coords.into(),
            orientation: state.world_from_body.coords.into(),
            ground_truth: simulator.ground_truth().numbers(),
            ..Self::EMPTY
        }
    }

    /// Takes the end of the episode over, if it ended.
    fn take(&mut self, report: &StepReport) {
        self.outcome = match report.outcome {
            None => 0,
            Some(EpisodeOutcome::Collided) => 1,
            Some(EpisodeOutcome::ReachedEnd) => 2,
            Some(EpisodeOutcome::TimedOut) => 3,
        };
        self.terminated = matches!(self.outcome, 1 | 2);
        self.truncated = self.outcome == 3;
        if let Some(Obstacle::Wall(place)) = report.hit {
            self.hit_wall = place;
        }
    }
}
