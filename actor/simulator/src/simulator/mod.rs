//! Episodes through a course, one at a time: [`Simulator::reset`] starts an episode,
//! [`Simulator::step`] flies one control period, [`Simulator::render`] draws the depth image.
//!
//! An episode is a pure function of course, settings, start, disturbances and actions. A number
//! that is not finite never survives the step in which it appears: the step returns
//! [`SimulationError::NonFinite`] and the episode is over.

mod error;
mod ground_truth;
#[cfg(test)]
mod passing_tests;
mod reach;
mod settings;
mod surroundings;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use nalgebra::Vector3;
use rand::Rng;
use skein_action::{Action, MAX_ACTION};

pub use error::{SimulationError, SimulatorError};
pub use ground_truth::{GroundTruth, OpeningAhead};
pub use reach::OutOfReach;
pub use settings::SimulatorSettings;

pub use crate::step_report::{EpisodeOutcome, LevelUp, Obstacle, StepReport};

use crate::camera::{DepthCamera, IMAGE_PIXELS};
use crate::course::{Course, NoSuchLevel};
use crate::disturbances::{CommandDelay, DisturbanceSettings, DrawnDisturbances, Gust};
use crate::oracle::Oracle;
use crate::vehicle::{Command, Vehicle, VehicleSettings, VehicleState};
use crate::world::{Contact, World};

/// A drone in a course.
pub struct Simulator {
    course: Arc<Course>,
    max_steps: u32,
    physics_steps: u32,
    dt_secs: f32,
    vehicle_settings: VehicleSettings,
    pristine_vehicle: Vehicle,
    vehicle: Vehicle,
    world: World,
    camera: DepthCamera,
    disturbances: DisturbanceSettings,
    commands: CommandDelay,
    gust: Option<Gust>,
    episode: EpisodeState,
}

/// Progress and disturbances of the current episode.
#[derive(Debug, Clone, Copy, PartialEq)]
struct EpisodeState {
    phase: EpisodePhase,
    steps: u32,
    /// Walls that the drone's tail has left, including those before its start.
    walls_behind: usize,
    walls_behind_at_start: usize,
    /// Action of the step before; zero before the first.
    last_action: Action,
    /// The drone's mass relative to its nominal mass.
    mass_factor: f32,
    /// Seed of the camera's errors; `None` in a calm episode.
    depth_seed: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum EpisodePhase {
    Flying,
    Over,
}

impl Simulator {
    /// Builds a simulator of `course`, with no episode in progress yet.
    ///
    /// # Errors
    /// [`SimulatorError`] names the setting or the course at fault.
    pub fn new(course: Arc<Course>, settings: &SimulatorSettings) -> Result<Self, SimulatorError> {
        settings.vehicle.validate()?;
        settings.reward.validate()?;
        if settings.max_steps == 0 {
            return Err(SimulatorError::NoSteps);
        }
        let (physics_steps, dt_secs) = settings.vehicle.physics_steps();
        let vehicle = Vehicle::trimmed(&settings.vehicle);
        let world = World::new(&course, vehicle.body(), dt_secs).map_err(|source| {
            SimulatorError::Mesh {
                course: course.name().to_owned(),
                source,
            }
        })?;
        let camera = DepthCamera::new(&settings.camera, &course)?;
        settings
            .disturbances
            .validate(&settings.vehicle, settings.camera.range_m)?;
        Ok(Self {
            camera: camera.with_noise(&settings.disturbances.depth),
            course,
            max_steps: settings.max_steps,
            physics_steps,
            dt_secs,
            vehicle_settings: settings.vehicle.clone(),
            pristine_vehicle: vehicle.clone(),
            vehicle,
            world,
            commands: CommandDelay::new(settings.disturbances.latency_periods),
            disturbances: settings.disturbances.clone(),
            gust: None,
            episode: EpisodeState {
                phase: EpisodePhase::Over,
                steps: 0,
                walls_behind: 0,
                walls_behind_at_start: 0,
                last_action: [0.0; MAX_ACTION],
                mass_factor: 1.0,
                depth_seed: None,
            },
        })
    }

    /// Starts an episode with the drone hovering at the start of `level` (1 = before the first
    /// wall).
    ///
    /// `start` draws the position within the course's start area. `disturbances` draws everything
    /// that disturbs the episode; with disturbances off it has no influence.
    ///
    /// # Errors
    /// [`NoSuchLevel`] if the course has fewer walls.
    pub fn reset(
        &mut self,
        level: u8,
        start: &mut impl Rng,
        disturbances: &mut impl Rng,
    ) -> Result<(), NoSuchLevel> {
        let position_m = self.course.start_position(level, start)?;
        // A corridor's episodes draw nothing more.
        let motion_seed = match self.course.obstacles() {
            [] => 0,
            _ => start.next_u64(),
        };
        let drawn = DrawnDisturbances::draw(&self.disturbances, disturbances);
        self.vehicle = self.pristine_vehicle.clone();
        self.world
            .reset(&position_m, drawn.mass_factor, motion_seed);
        let DrawnDisturbances {
            disturbed,
            mass_factor,
            gust_seed,
            depth_seed,
        } = drawn;
        let gust = Gust::new(&self.disturbances.gust, self.dt_secs, gust_seed);
        self.gust = gust.filter(|_| disturbed);
        self.commands.begin(if disturbed {
            self.disturbances.latency_periods
        } else {
            0
        });
        // In front of the wall, or in the stage, of its level.
        let walls_behind = usize::from(level) - 1;
        self.episode = EpisodeState {
            phase: EpisodePhase::Flying,
            steps: 0,
            walls_behind,
            walls_behind_at_start: walls_behind,
            last_action: [0.0; MAX_ACTION],
            mass_factor,
            depth_seed: disturbed.then_some(depth_seed),
        };
        Ok(())
    }

    /// Flies one control period with `action`: the numbers of
    /// [`VehicleSettings::action`](crate::vehicle::VehicleSettings::action) in order, each clamped
    /// to [-1, 1]. Missing ones are 0, further ones are ignored. With latency, `action` takes
    /// effect some steps later.
    ///
    /// If the body touches something, the episode ends at that physics step, within the control
    /// period, and the state is that of the contact.
    ///
    /// # Errors
    /// [`SimulationError::NonFinite`] names what is NaN or infinite, in the action or the physics;
    /// it ends the episode. [`SimulationError::NotFlying`] if no episode is in progress.
    pub fn step<const N: usize>(
        &mut self,
        action: [f32; N],
    ) -> Result<StepReport, SimulationError> {
        if self.episode.phase == EpisodePhase::Over {
            return Err(SimulationError::NotFlying);
        }
        self.episode.steps += 1;
        let walls_behind_before = self.episode.walls_behind;
        let away_before_m = self.to_goal_m().norm();

        let action = self.checked(action)?;
        let before = std::mem::replace(&mut self.episode.last_action, action);
        let command = self.vehicle_settings.command(&self.commands.pass(action));
        let contact = self.fly_until_contact(&command)?;
        let outcome = self.outcome(contact);

        if outcome.is_some() {
            self.episode.phase = EpisodePhase::Over;
        }
        Ok(StepReport {
            walls_passed: self.walls_passed(),
            level_up: if self.episode.walls_behind > walls_behind_before {
                LevelUp::Yes
            } else {
                LevelUp::No
            },
            outcome,
            hit: (contact == Contact::Obstacle).then(|| self.obstacle()),
            progress_m: away_before_m - self.to_goal_m().norm(),
            clearance_m: surroundings::clearance_m(&self.course, &self.state().position_m)
                .min(self.world.to_obstacle_m()),
            effort: self.mean_square(&action, &[0.0; MAX_ACTION]),
            effort_change: self.mean_square(&action, &before),
        })
    }

    /// Draws the current depth image into `image`, row by row from the top. The camera's errors
    /// belong to the step: rendering twice gives the same image.
    pub fn render(&mut self, image: &mut [u8; IMAGE_PIXELS]) {
        let pose = self.world.state().pose();
        self.camera.move_obstacles(self.world.moment());
        match self.episode.depth_seed {
            Some(seed) => {
                let key = seed ^ u64::from(self.episode.steps);
                self.camera.render_with_noise(&pose, key, image);
            }
            None => self.camera.render(&pose, image),
        }
    }

    /// Returns the drone's pose and motion.
    #[must_use]
    pub fn state(&self) -> VehicleState {
        self.world.state()
    }

    /// Returns the oracle's action for the current moment, each number in [-1, 1].
    #[must_use]
    pub fn oracle_action(&self) -> Action {
        let oracle = Oracle {
            course: &self.course,
            vehicle: &self.vehicle_settings,
            half_length_m: self.vehicle.body().half_extents_m.x,
        };
        let command = oracle.command(self.world.tail_x_m(), &self.state());
        self.vehicle_settings.action_for(&command)
    }

    /// Returns the goal, the middle of the end wall or of a world's goal, as a vector from the
    /// drone in the heading frame, m. A real drone has it from its own estimate.
    #[must_use]
    pub fn goal_m(&self) -> [f32; 3] {
        self.state().in_heading_frame(&self.to_goal_m()).into()
    }

    /// Returns the ground truth of the current moment, which the camera does not show.
    #[must_use]
    pub fn ground_truth(&self) -> GroundTruth {
        let state = self.state();
        let corridor = self.course.corridor();
        let [_, y_m, z_m] = state.position_m.coords.into();
        GroundTruth {
            ahead: OpeningAhead::next_two(&self.course, self.walls_left(), &state),
            from_middle_m: [y_m, z_m - corridor.height_m / 2.0],
            to_end_m: self.course.to_end_m(&state.position_m),
            mass_factor: self.episode.mass_factor,
            latency_periods: self.commands.periods() as f32,
            gust_n: self
                .gust
                .as_ref()
                .map_or([0.0; 3], |gust| gust.force_n().into()),
            half_section_m: [corridor.width_m / 2.0, corridor.height_m / 2.0],
        }
    }

    /// Returns the drone's level: 1 before the first wall, one more behind each wall.
    #[must_use]
    pub fn level(&self) -> u8 {
        // A course has at most `MAX_WALLS` walls.
        self.episode.walls_behind as u8 + 1
    }

    /// Returns the number of walls passed in this episode so far.
    #[must_use]
    pub fn walls_passed(&self) -> u8 {
        let episode = &self.episode;
        episode
            .walls_behind
            .saturating_sub(episode.walls_behind_at_start) as u8
    }

    /// Returns the course.
    #[must_use]
    pub fn course(&self) -> &Course {
        &self.course
    }

    /// Returns the vector from the drone to the goal, world frame, m.
    fn to_goal_m(&self) -> Vector3<f32> {
        surroundings::goal(&self.course) - self.state().position_m
    }

    /// Returns the mean square of the differences between the numbers of two actions.
    fn mean_square(&self, one: &Action, other: &Action) -> f32 {
        let numbers = self.vehicle_settings.action.numbers();
        let squares = one.iter().zip(other).take(numbers);
        squares
            .map(|(one, other)| (one - other).powi(2))
            .sum::<f32>()
            / numbers as f32
    }

    /// Returns `action` with all its numbers within their bounds.
    fn checked<const N: usize>(&mut self, action: [f32; N]) -> Result<Action, SimulationError> {
        const { assert!(N <= MAX_ACTION, "an action has at most MAX_ACTION numbers") };
        if !action.iter().all(|v| v.is_finite()) {
            return Err(self.abort("action"));
        }
        let mut numbers = [0.0; MAX_ACTION];
        numbers[..N].copy_from_slice(&action.map(|v| v.clamp(-1.0, 1.0)));
        Ok(numbers)
    }

    fn fly_until_contact(&mut self, command: &Command) -> Result<Contact, SimulationError> {
        let counted = self.episode.walls_behind;
        for _ in 0..self.physics_steps {
            let actuation = self
                .vehicle
                .actuate(&self.world.state(), command, self.dt_secs);
            let gust_n = self.gust.as_mut().map(Gust::advance);
            self.world.advance(&actuation, gust_n);

            if self.world.is_quarantined() {
                return Err(self.abort("the body's pose or velocity"));
            }
            let contact = self.world.contact();
            self.count_walls(contact, counted);
            if contact != Contact::Nothing {
                return Ok(contact);
            }
        }
        Ok(Contact::Nothing)
    }

    /// Counts the walls passed after a physics step that ended with `contact`. `counted`: walls
    /// that earlier control periods counted.
    fn count_walls(&mut self, contact: Contact, counted: usize) {
        let passed = self.episode.walls_behind;
        self.episode.walls_behind = match contact {
            // A passed wall stays passed if the drone comes back without a collision.
            Contact::Nothing | Contact::EndWall => passed.max(self.walls_left()),
            // No step passes a wall and hits it. What an earlier step reported stands, even if the
            // drone flies or is blown back into that wall.
            Contact::Obstacle => self
                .world
                .touched_wall()
                .map_or(passed, |hit| hit.min(passed).max(counted)),
        };
    }

    fn outcome(&self, contact: Contact) -> Option<EpisodeOutcome> {
        match contact {
            Contact::Obstacle => Some(EpisodeOutcome::Collided),
            Contact::EndWall => Some(EpisodeOutcome::ReachedEnd),
            Contact::Nothing if self.episode.steps >= self.max_steps => {
                Some(EpisodeOutcome::TimedOut)
            }
            Contact::Nothing => None,
        }
    }

    /// Returns the obstacle that the body touches. It must touch one.
    fn obstacle(&self) -> Obstacle {
        match self.world.touched_wall() {
            // A course has at most `MAX_WALLS` walls.
            Some(place) => Obstacle::Wall(place as u8 + 1),
            // An obstacle of a world is named by its stage.
            None if self.world.touches_obstacle() => {
                Obstacle::Wall(self.level().min(self.course.levels()))
            }
            None => Obstacle::Corridor,
        }
    }

    /// Returns the number of walls that the whole body is clear of, or of stages behind it.
    fn walls_left(&self) -> usize {
        let position_m = self.world.state().position_m;
        self.course.walls_behind(&position_m, self.world.tail_x_m())
    }

    fn abort(&mut self, what: &'static str) -> SimulationError {
        self.episode.phase = EpisodePhase::Over;
        SimulationError::NonFinite {
            what,
            step: self.episode.steps,
        }
    }
}
