//! Whole episodes by the actor's own loop: what every other way to fly is compared with.

use std::convert::Infallible;
use std::hint::black_box;

use bytemuck::Zeroable;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::ticket::{Exploration, Ticket};
use skein_protocol::transition::{RecordLengths, TransitionRecord};
use skein_protocol::{IMAGE_PIXELS, MAX_ACTION};
use skein_rollout::agent::Agent;
use skein_rollout::courses::Simulators;
use skein_rollout::environment_loop::{Directive, EnvironmentLoop, RecordLink, reset};

use skein_simulator::reward::RewardTerms;

use crate::parallel::for_each;
use crate::policy::Policy;
use crate::task::{Choice, Flown, Task, refused};

/// Flies the episode of `seed` from its reset to its end, as an actor does. Returns the columns of
/// a recording, `[steps + 1, …]`.
#[pyfunction]
#[pyo3(signature = (task, policy, seed, exploration, course=None, course_seed=None, level=None))]
#[allow(clippy::too_many_arguments, reason = "the fields of a ticket")]
pub(crate) fn fly<'py>(
    py: Python<'py>,
    task: &Task,
    policy: &Policy,
    seed: u64,
    exploration: &str,
    course: Option<Bound<'py, PyAny>>,
    course_seed: Option<u64>,
    level: Option<u8>,
) -> PyResult<Bound<'py, PyDict>> {
    let (flown, trained) = (task.flown.action(), policy.config.action_space());
    if flown != trained {
        return Err(refused(format!(
            "vehicle.action = \"{}\", but the policy was trained with \"{}\": give the environment \
             vehicle={{\"action\": \"{}\"}}",
            flown.name(),
            trained.name(),
            trained.name()
        )));
    }
    let choice = task.flown.choice(course.as_ref(), course_seed, level)?;
    let mut ticket = task.flown.ticket(seed, 0, &choice)?;
    ticket.exploration = exploration_of(exploration)?;
    let simulators = Simulators::new(task.flown.courses.clone());
    let agent = Agent::new(policy.config.observation_layout());
    let mut memory = Memory::default();
    py.detach(|| {
        let mut flown = EnvironmentLoop::new(ActorId(0), ActorIncarnation(0), simulators, agent);
        flown.fly(&ticket, &policy.network, &mut memory)
    })
    .map_err(refused)?;
    columns(py, &memory.sent, policy.config.record_lengths())
}

/// Flies `steps` steps with each of `environments` simulators on `threads` threads, with random
/// actions: reset, step, image and reward, and nothing of Python. The measure of what the
/// environments add.
#[pyfunction]
pub(crate) fn simulate(
    py: Python<'_>,
    task: &Task,
    environments: usize,
    threads: usize,
    steps: u64,
) -> PyResult<()> {
    let flown = &task.flown;
    let alone: PyResult<Vec<_>> = (0..environments)
        .map(|index| Alone::new(flown, index as u64))
        .collect();
    let mut alone = alone?;
    let share = environments.div_ceil(threads.max(1)).max(1);
    let results = py.detach(|| {
        let mut results: Vec<PyResult<()>> = alone.chunks(share).map(|_| Ok(())).collect();
        let jobs: Vec<_> = alone.chunks_mut(share).zip(&mut results).collect();
        for_each(threads, jobs.into_iter(), |(alone, result)| {
            let mut image = Box::new([0; IMAGE_PIXELS]);
            *result = (0..steps).try_for_each(|_| {
                let mut each = alone.iter_mut();
                each.try_for_each(|alone| alone.step(flown, &mut image))
            });
        });
        results
    });
    results.into_iter().collect()
}

/// A simulator without anything around it.
struct Alone {
    simulators: Simulators,
    rng: Pcg64Mcg,
    ticket: Ticket,
    ended: bool,
}

impl Alone {
    fn new(flown: &Flown, seed: u64) -> PyResult<Self> {
        Ok(Self {
            simulators: Simulators::new(flown.courses.clone()),
            rng: Pcg64Mcg::seed_from_u64(seed),
            ticket: flown.ticket(seed, 0, &Choice::default())?,
            ended: true,
        })
    }

    fn step(&mut self, flown: &Flown, image: &mut [u8; IMAGE_PIXELS]) -> PyResult<()> {
        if self.ended {
            self.ticket = flown.ticket(self.rng.random(), 0, &Choice::default())?;
            let simulator = reset(&mut self.simulators, &self.ticket).map_err(refused)?;
            simulator.render(image);
        }
        let simulator = self.simulators.of(&self.ticket).map_err(refused)?;
        let mut action = [0.0; MAX_ACTION];
        action[..flown.action().numbers()].fill_with(|| self.rng.random_range(-1.0..=1.0));
        let report = simulator.step(action).map_err(refused)?;
        simulator.render(image);
        let settings = &flown.courses.settings().reward;
        black_box(RewardTerms::of(settings, &report, image));
        self.ended = report.outcome.is_some();
        Ok(())
    }
}

/// Reads the name of a choice of actions.
///
/// # Errors
/// `ValueError` names the choices.
pub(crate) fn exploration_of(name: &str) -> PyResult<Exploration> {
    match name {
        "mode" => Ok(Exploration::Mode),
        "sample" => Ok(Exploration::Sample),
        "uniform" => Ok(Exploration::Uniform),
        other => Err(refused(format!(
            "exploration = {other:?} is none of \"mode\", \"sample\", \"uniform\""
        ))),
    }
}

/// Records of one episode.
#[derive(Default)]
struct Memory {
    sent: Vec<Box<TransitionRecord>>,
}

impl RecordLink for Memory {
    type Loan = Box<TransitionRecord>;
    type Error = Infallible;

    fn loan(&mut self) -> Result<Self::Loan, Infallible> {
        Ok(Box::new(TransitionRecord::zeroed()))
    }

    fn send(&mut self, record: Self::Loan) -> Result<(), Infallible> {
        self.sent.push(record);
        Ok(())
    }

    fn directive(&mut self) -> Result<Directive, Infallible> {
        Ok(Directive::Continue)
    }
}

/// Returns the columns by name, each as bytes: u8 `[steps + 1, …]`, others f32.
fn columns<'py>(
    py: Python<'py>,
    sent: &[Box<TransitionRecord>],
    lengths: RecordLengths,
) -> PyResult<Bound<'py, PyDict>> {
    let images: Vec<u8> = sent.iter().flat_map(|record| record.depth).collect();
    let bytes = |of: fn(&TransitionRecord) -> u8| -> Bound<'py, PyBytes> {
        let bytes: Vec<u8> = sent.iter().map(|record| of(record)).collect();
        PyBytes::new(py, &bytes)
    };
    let numbers = |of: &dyn Fn(&TransitionRecord) -> &[f32]| -> Bound<'py, PyBytes> {
        let numbers: Vec<f32> = sent.iter().flat_map(|record| of(record)).copied().collect();
        PyBytes::new(py, bytemuck::cast_slice(&numbers))
    };
    let dict = PyDict::new(py);
    dict.set_item("depth", PyBytes::new(py, &images))?;
    dict.set_item(
        "latent",
        numbers(&|record| &record.latent[..lengths.latent]),
    )?;
    dict.set_item("position_m", numbers(&|record| &record.position_m))?;
    dict.set_item("orientation", numbers(&|record| &record.orientation))?;
    dict.set_item("velocity_mps", numbers(&|record| &record.velocity_mps))?;
    let action = lengths.action.numbers();
    dict.set_item("goal_m", numbers(&|record| &record.goal_m))?;
    dict.set_item("action", numbers(&|record| &record.action[..action]))?;
    dict.set_item("reward_terms", numbers(&|record| &record.reward_terms))?;
    dict.set_item(
        "reward",
        numbers(&|record| std::slice::from_ref(&record.reward)),
    )?;
    dict.set_item("walls_passed", bytes(|record| record.walls_passed))?;
    dict.set_item("terminated", bytes(|record| record.terminated))?;
    dict.set_item("truncated", bytes(|record| record.truncated))?;
    Ok(dict)
}
