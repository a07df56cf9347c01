//! Worlds that tickets are flown in: the simulator, or an environment from elsewhere.
//!
//! [`EnvironmentLoop`](crate::environment_loop::EnvironmentLoop) knows no more of it than this. A
//! [`Worlds`] has the [`World`] of each ticket: a simulator belongs to one course.

use skein_protocol::ticket::Ticket;
use skein_protocol::transition::TransitionRecord;
use skein_protocol::{Action, IMAGE_PIXELS};
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{Simulator, StepReport};

use crate::courses::Simulators;
use crate::environment_loop::{self, EpisodeFault};

/// Worlds of one actor, selected by tickets.
pub trait Worlds {
    /// World of one episode.
    type World: World;

    /// Starts the episode of `ticket` in its world.
    ///
    /// # Errors
    /// [`EpisodeFault`] if it cannot begin.
    fn reset(&mut self, ticket: &Ticket) -> Result<&mut Self::World, EpisodeFault>;

    /// Returns the world of `ticket` as the last step left it.
    ///
    /// # Errors
    /// [`EpisodeFault`] if there is none.
    fn resume(&mut self, ticket: &Ticket) -> Result<&mut Self::World, EpisodeFault>;

    /// Returns the settings of the reward.
    fn reward_settings(&self) -> RewardSettings;
}

/// World of an episode.
pub trait World {
    /// Draws the current depth image into `image`.
    fn render(&mut self, image: &mut [u8; IMAGE_PIXELS]);

    /// Writes pose, velocity, goal and ground truth of the current moment into `record`.
    fn measure(&mut self, record: &mut TransitionRecord);

    /// Flies one step.
    ///
    /// # Errors
    /// [`EpisodeFault`]; the episode is lost.
    fn step(&mut self, action: Action) -> Result<StepReport, EpisodeFault>;

    /// Returns the action of an oracle that knows the course, each number in [-1, 1].
    ///
    /// # Errors
    /// [`EpisodeFault::Foreign`] if the world has no oracle.
    fn oracle_action(&mut self) -> Result<Action, EpisodeFault>;

    /// Returns the reward of the last step, whose result is `report`, after which the camera saw
    /// `image_after`.
    fn reward(
        &self,
        settings: &RewardSettings,
        report: &StepReport,
        image_after: &[u8; IMAGE_PIXELS],
    ) -> RewardTerms;

    /// Returns the number of walls of the course.
    fn walls(&self) -> u8;
}

impl Worlds for Simulators {
    type World = Simulator;

    fn reset(&mut self, ticket: &Ticket) -> Result<&mut Simulator, EpisodeFault> {
        environment_loop::reset(self, ticket)
    }

    fn resume(&mut self, ticket: &Ticket) -> Result<&mut Simulator, EpisodeFault> {
        Ok(self.of(ticket)?)
    }

    fn reward_settings(&self) -> RewardSettings {
        self.settings().reward.clone()
    }
}

impl World for Simulator {
    fn render(&mut self, image: &mut [u8; IMAGE_PIXELS]) {
        Simulator::render(self, image);
    }

    fn measure(&mut self, record: &mut TransitionRecord) {
        let state = self.state();
        record.position_m = state.position_m.coords.into();
        record.orientation = state.world_from_body.coords.into();
        record.velocity_mps = state.velocity_mps.into();
        record.goal_m = self.goal_m();
        record.ground_truth = self.ground_truth().numbers();
    }

    fn step(&mut self, action: Action) -> Result<StepReport, EpisodeFault> {
        Ok(Simulator::step(self, action)?)
    }

    fn oracle_action(&mut self) -> Result<Action, EpisodeFault> {
        Ok(Simulator::oracle_action(self))
    }

    fn reward(
        &self,
        settings: &RewardSettings,
        report: &StepReport,
        image_after: &[u8; IMAGE_PIXELS],
    ) -> RewardTerms {
        RewardTerms::of(settings, report, image_after)
    }

    fn walls(&self) -> u8 {
        self.course().levels()
    }
}
