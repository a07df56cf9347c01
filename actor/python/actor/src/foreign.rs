//! An environment of Python's in the simulator's place.
//!
//! `skein_rl/actor.py` turns what a Gymnasium environment returns into a [`Moment`], and checks
//! shapes and numbers there. An exception ends the actor: it is kept, the episode is abandoned
//! without a word to the learner, and its ticket goes to another actor.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use pyo3::exceptions::{PyTimeoutError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use skein_protocol::config::{Config, CoursesSection, CriticInput};
use skein_protocol::ticket::{CourseChoice, Ticket};
use skein_protocol::transition::TransitionRecord;
use skein_protocol::{Action, ActionSpace, GROUND_TRUTH, IMAGE_PIXELS, MAX_ACTION, REWARD_TERMS};
use skein_rollout::courses::Courses;
use skein_rollout::environment_loop::EpisodeFault;
use skein_rollout::world::{World, Worlds};
use skein_simulator::reward::{RewardSettings, RewardTerms};
use skein_simulator::simulator::{EpisodeOutcome, LevelUp, Obstacle, StepReport};

/// The exception that ends the actor, once there is one.
#[derive(Default)]
pub(crate) struct Failure(Mutex<Option<PyErr>>);

impl Failure {
    /// Returns the exception.
    pub(crate) fn take(&self) -> Option<PyErr> {
        self.lock().take()
    }

    /// Returns `true` if there is an exception, or Python has one for this thread: Ctrl-C.
    pub(crate) fn ends(&self) -> bool {
        if self.lock().is_some() {
            return true;
        }
        match Python::attach(|py| py.check_signals()) {
            Ok(()) => false,
            Err(error) => {
                self.keep(error);
                true
            }
        }
    }

    /// Keeps the first exception; returns it as a fault.
    fn keep(&self, error: PyErr) -> EpisodeFault {
        let fault = EpisodeFault::Foreign(error.to_string());
        self.lock().get_or_insert(error);
        fault
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<PyErr>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The environment, for every ticket: it gets the ticket's seed, course and level at each reset.
pub(crate) struct ForeignWorlds<'a> {
    bridge: Py<PyAny>,
    failure: &'a Failure,
    courses: Arc<Courses>,
    training: String,
    evaluation: Vec<String>,
    action: ActionSpace,
    limits: Limits,
    /// Steps in this episode.
    steps: usize,
    moment: Moment,
    /// Image of the present moment.
    image: Box<[u8; IMAGE_PIXELS]>,
}

/// Limits that the run sets an environment.
struct Limits {
    /// Longest time for a reset or a step: then the learner takes the actor for dead.
    silence: Duration,
    most_records: usize,
    needs_ground_truth: bool,
    needs_goal: bool,
}

/// State of the environment after a reset or a step, beside the image.
struct Moment {
    velocity_mps: [f32; 3],
    goal_m: [f32; 3],
    position_m: [f32; 3],
    orientation: [f32; 4],
    ground_truth: [f32; GROUND_TRUTH],
    reward_terms: [f32; REWARD_TERMS],
    walls_passed: u8,
    hit_wall: u8,
    outcome: Option<EpisodeOutcome>,
    walls: u8,
}

/// A moment as `skein_rl/actor.py` hands it over: image, velocity, goal, position, orientation,
/// ground truth, terms of the reward, walls passed, wall hit, outcome, walls of the course.
type Handed<'py> = (
    Bound<'py, PyBytes>,
    [f32; 3],
    Option<[f32; 3]>,
    [f32; 3],
    [f32; 4],
    Option<[f32; GROUND_TRUTH]>,
    [f32; REWARD_TERMS],
    u8,
    u8,
    u8,
    Option<u8>,
);

impl<'a> ForeignWorlds<'a> {
    pub(crate) fn new(
        bridge: Py<PyAny>,
        config: &Config,
        courses: Arc<Courses>,
        failure: &'a Failure,
    ) -> Self {
        Self {
            bridge,
            failure,
            courses,
            training: CoursesSection::names(&[&config.courses.training]).remove(0),
            evaluation: CoursesSection::names(&config.courses.evaluation),
            action: config.action_space(),
            limits: Limits {
                silence: Duration::from_secs_f64(config.transport.actor_silence_secs),
                most_records: config.transport.max_records_per_episode,
                needs_ground_truth: config.learning.critic_input == CriticInput::GroundTruth,
                needs_goal: config.learning.observation.has_goal(),
            },
            steps: 0,
            moment: Moment {
                velocity_mps: [0.0; 3],
                goal_m: [0.0; 3],
                position_m: [0.0; 3],
                orientation: [0.0, 0.0, 0.0, 1.0],
                ground_truth: [0.0; GROUND_TRUTH],
                reward_terms: [0.0; REWARD_TERMS],
                walls_passed: 0,
                hit_wall: 0,
                outcome: None,
                walls: 0,
            },
            image: Box::new([0; IMAGE_PIXELS]),
        }
    }

    /// Calls the environment and takes its moment.
    fn ask(
        &mut self,
        name: &str,
        call: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<Py<PyAny>>,
    ) -> Result<(), EpisodeFault> {
        let begun = Instant::now();
        let taken = Python::attach(|py| {
            let handed = call(self.bridge.bind(py))?;
            self.take(handed.bind(py).extract()?)?;
            match begun.elapsed() {
                elapsed if elapsed > self.limits.silence => Err(PyTimeoutError::new_err(format!(
                    "env.{name} took {:.1} s, longer than transport.actor_silence_secs = {}: \
                         the learner has given the episode to another actor; start the run with a \
                         larger number",
                    elapsed.as_secs_f64(),
                    self.limits.silence.as_secs_f64()
                ))),
                _ => Ok(()),
            }
        });
        taken.map_err(|error| self.failure.keep(error))
    }

    fn take(&mut self, handed: Handed<'_>) -> PyResult<()> {
        let (
            image,
            velocity,
            goal,
            position,
            orientation,
            truth,
            terms,
            passed,
            hit,
            outcome,
            walls,
        ) = handed;
        let image = image.as_bytes();
        if image.len() != IMAGE_PIXELS {
            return Err(PyValueError::new_err(format!(
                "depth has {} bytes, not {IMAGE_PIXELS}",
                image.len()
            )));
        }
        self.image.copy_from_slice(image);
        if truth.is_none() && self.limits.needs_ground_truth {
            return Err(PyValueError::new_err(
                "info has no \"ground_truth\", which learning.critic_input = \"ground-truth\" of \
                 this run needs: add it, float32 [18], or train with \"observation\"",
            ));
        }
        if goal.is_none() && self.limits.needs_goal {
            return Err(PyValueError::new_err(
                "the observation has no \"goal\", which learning.observation of this run needs: \
                 add it, float32 [3], or train without \"+goal\"",
            ));
        }
        let walls = walls.unwrap_or(self.moment.walls);
        self.check_walls(walls, passed, hit)?;
        self.moment = Moment {
            velocity_mps: velocity,
            goal_m: goal.unwrap_or([0.0; 3]),
            position_m: position,
            orientation,
            ground_truth: truth.unwrap_or([0.0; GROUND_TRUTH]),
            reward_terms: terms,
            walls_passed: passed,
            hit_wall: hit,
            outcome: match outcome {
                1 => Some(EpisodeOutcome::Collided),
                2 => Some(EpisodeOutcome::ReachedEnd),
                3 => Some(EpisodeOutcome::TimedOut),
                _ => None,
            },
            walls,
        };
        Ok(())
    }

    /// Refuses counts of walls that the learner would refuse: it would give the episode to others
    /// and end the run after several such refusals.
    fn check_walls(&self, walls: u8, passed: u8, hit: u8) -> PyResult<()> {
        let before = self.moment.walls_passed;
        let problem = if walls == 0 {
            "info[\"walls\"] = 0: a course has at least one".to_owned()
        } else if passed > walls {
            format!(
                "info[\"walls_passed\"] = {passed} of {walls} walls: info[\"walls\"] says how \
                 many there are"
            )
        } else if passed < before {
            format!("info[\"walls_passed\"] fell from {before} to {passed} within an episode")
        } else if hit > walls {
            format!("info[\"hit_wall\"] = {hit} of {walls} walls: 0 is none of them")
        } else {
            return Ok(());
        };
        Err(PyValueError::new_err(problem))
    }

    /// Refuses an episode that the learner would refuse.
    fn check_length(&self) -> Result<(), EpisodeFault> {
        // The closing record is one more than there are steps.
        if self.moment.outcome.is_some() || self.steps + 1 < self.limits.most_records {
            return Ok(());
        }
        Err(self.failure.keep(PyValueError::new_err(format!(
            "the episode goes on after {} steps, but transport.max_records_per_episode = {}: wrap \
             the environment in gymnasium.wrappers.TimeLimit with fewer steps",
            self.steps, self.limits.most_records
        ))))
    }
}

impl Worlds for ForeignWorlds<'_> {
    type World = Self;

    fn reset(&mut self, ticket: &Ticket) -> Result<&mut Self, EpisodeFault> {
        let (course, _) = self.courses.course(ticket)?;
        self.moment.walls = course.levels();
        self.moment.walls_passed = 0;
        self.steps = 0;
        let (name, course_seed) = match ticket.course {
            CourseChoice::Training => (self.training.clone(), None),
            CourseChoice::Evaluation(place) => {
                let listed = self.evaluation.get(place as usize);
                (listed.cloned().unwrap_or_default(), None)
            }
            CourseChoice::Generated(seed) => ("random".to_owned(), Some(seed)),
        };
        let (seed, level) = (ticket.seed, ticket.start_level);
        self.ask("reset", |bridge| {
            let options = PyDict::new(bridge.py());
            options.set_item("course", name)?;
            options.set_item("level", level)?;
            if let Some(seed) = course_seed {
                options.set_item("course_seed", seed)?;
            }
            Ok(bridge.call_method1("reset", (seed, options))?.unbind())
        })?;
        Ok(self)
    }

    fn resume(&mut self, _: &Ticket) -> Result<&mut Self, EpisodeFault> {
        Ok(self)
    }

    fn reward_settings(&self) -> RewardSettings {
        self.courses.settings().reward.clone()
    }
}

impl World for ForeignWorlds<'_> {
    fn render(&mut self, image: &mut [u8; IMAGE_PIXELS]) {
        image.copy_from_slice(&*self.image);
    }

    fn measure(&mut self, record: &mut TransitionRecord) {
        record.position_m = self.moment.position_m;
        record.orientation = self.moment.orientation;
        record.velocity_mps = self.moment.velocity_mps;
        record.goal_m = self.moment.goal_m;
        record.ground_truth = self.moment.ground_truth;
    }

    fn step(&mut self, action: Action) -> Result<StepReport, EpisodeFault> {
        let passed_before = self.moment.walls_passed;
        let numbers = action[..self.action.numbers()].to_vec();
        self.ask("step", |bridge| {
            Ok(bridge.call_method1("step", (numbers,))?.unbind())
        })?;
        self.steps += 1;
        self.check_length()?;
        let moment = &self.moment;
        let hit = match moment.hit_wall {
            0 => Obstacle::Corridor,
            wall => Obstacle::Wall(wall),
        };
        Ok(StepReport {
            walls_passed: moment.walls_passed,
            level_up: match moment.walls_passed > passed_before {
                true => LevelUp::Yes,
                false => LevelUp::No,
            },
            outcome: moment.outcome,
            hit: (moment.outcome == Some(EpisodeOutcome::Collided)).then_some(hit),
            // Its reward is the environment's own.
            ..StepReport::default()
        })
    }

    fn oracle_action(&mut self) -> Result<Action, EpisodeFault> {
        let numbers = self.action.numbers();
        let asked = Python::attach(|py| -> PyResult<Vec<f32>> {
            let oracle = self.bridge.bind(py).call_method1("oracle", (numbers,))?;
            oracle.extract()
        });
        let asked = asked.map_err(|error| self.failure.keep(error))?;
        let mut action = [0.0; MAX_ACTION];
        action
            .iter_mut()
            .zip(asked)
            .for_each(|(into, number)| *into = number);
        Ok(action)
    }

    fn reward(&self, _: &RewardSettings, _: &StepReport, _: &[u8; IMAGE_PIXELS]) -> RewardTerms {
        RewardTerms::from_values(self.moment.reward_terms)
    }

    fn walls(&self) -> u8 {
        self.moment.walls
    }
}
