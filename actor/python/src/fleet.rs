//! Many environments, flown by several threads without the interpreter's lock.

use std::sync::Arc;

use pyo3::exceptions::{PyIndexError, PyRuntimeError};
use pyo3::prelude::*;
use pyo3::types::PyByteArray;
use skein_protocol::ticket::CourseChoice;
use skein_protocol::{Action, ActionSpace, IMAGE_PIXELS, MAX_ACTION};

use crate::batch::batch;
use crate::environment::{Environment, EnvironmentError, EpisodeSeeds, Flight, Moment};
use crate::parallel::for_each;
use crate::task::{Choice, Flown, Task, refused};

/// Most environments of a fleet: more do not fit the memory of any machine.
const MOST: usize = 1 << 16;
/// Most threads.
const MOST_THREADS: usize = 512;

/// Environments that fly one [`Task`]. Batches are fresh in every call.
#[pyclass(module = "skein_rl._core")]
pub(crate) struct Fleet {
    task: Arc<Flown>,
    environments: Vec<Environment>,
    threads: usize,
    autoreset: Autoreset,
}

/// Sequel to the end of an episode, as Gymnasium names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Autoreset {
    /// The next step resets, and its action is ignored.
    NextStep,
    /// The same step resets; the last observation is returned beside.
    SameStep,
    /// The caller resets.
    Disabled,
}

/// Result of a step of one environment.
struct Done {
    moment: Moment,
    /// Last image and moment of an episode that ended in a step that also reset.
    last: Option<Last>,
}

/// The end of an episode.
type Last = (Box<[u8; IMAGE_PIXELS]>, Moment);

/// Reason why an environment did not do its part.
enum Failure {
    Environment(EnvironmentError),
    Python(PyErr),
}

/// State of an environment in plain numbers, for pickling: first seed, next episode, and the
/// present episode.
type State = (u64, u64, Option<FlightState>);

/// Number, seed, course (index or -1, seed), level and actions.
type FlightState = (u64, u64, i64, u64, u8, Vec<Action>);

/// A batch, and the ends of episodes that a step also reset, by environment.
type Drawn<'py> = (Bound<'py, PyByteArray>, Vec<(usize, Last)>);

/// A batch; the environments whose episode ended in a step that also reset; a batch of the ends.
type Stepped<'py> = (Bound<'py, PyByteArray>, Vec<usize>, Bound<'py, PyByteArray>);

#[pymethods]
impl Fleet {
    #[new]
    fn new(task: &Task, environments: usize, threads: usize, autoreset: &str) -> PyResult<Self> {
        let within = |key: &str, value: usize, most: usize| match (1..=most).contains(&value) {
            true => Ok(()),
            false => Err(refused(format!("{key} = {value} is outside 1 to {most}"))),
        };
        within("num_envs", environments, MOST)?;
        within("threads", threads, MOST_THREADS)?;
        let task = task.flown.clone();
        Ok(Self {
            environments: (0..environments).map(|_| Environment::new(&task)).collect(),
            task,
            threads,
            autoreset: Autoreset::named(autoreset)?,
        })
    }

    /// Starts episodes where `mask` is true. A seed starts a sequence of episodes; without one, the
    /// sequence continues. Returns the batch of all.
    #[pyo3(signature = (seeds, mask, course=None, course_seed=None, level=None))]
    fn reset<'py>(
        &mut self,
        py: Python<'py>,
        seeds: Vec<Option<u64>>,
        mask: Vec<bool>,
        course: Option<Bound<'py, PyAny>>,
        course_seed: Option<u64>,
        level: Option<u8>,
    ) -> PyResult<Bound<'py, PyByteArray>> {
        self.check_len("seeds", seeds.len())?;
        self.check_len("mask", mask.len())?;
        let choice = self.task.choice(course.as_ref(), course_seed, level)?;
        let task = self.task.clone();
        let (reset, _) = self.on_all(py, |index, environment, image| {
            if mask[index] {
                if let Some(seed) = seeds[index] {
                    *environment.seeds() = EpisodeSeeds::starting_with(seed);
                }
                begin_next(&task, environment, &choice)?;
            }
            let moment = environment.observe(&task, image)?;
            Ok(Done { moment, last: None })
        })?;
        Ok(reset)
    }

    /// Flies one control period. `actions`: the bytes of f32 `[n, action]`.
    fn step<'py>(&mut self, py: Python<'py>, actions: &[u8]) -> PyResult<Stepped<'py>> {
        let actions = self.checked(actions)?;
        for (index, environment) in self.environments.iter().enumerate() {
            let resets = self.autoreset == Autoreset::NextStep && environment.has_ended();
            if !resets {
                environment
                    .check_flying()
                    .map_err(|error| self.failure(index, &error))?;
            }
        }
        let (task, autoreset) = (self.task.clone(), self.autoreset);
        let (stepped, lasts) = self.on_all(py, |index, environment, image| {
            advance(&task, environment, autoreset, actions[index], image)
        })?;
        let (ended, lasts): (Vec<_>, Vec<Last>) = lasts.into_iter().unzip();
        let lasts = batch(py, lasts.len(), |images| {
            let drawn = images.iter_mut().zip(lasts);
            Ok(drawn
                .map(|(image, (seen, moment))| {
                    *image = *seen;
                    moment
                })
                .collect())
        })?;
        Ok((stepped, ended, lasts))
    }

    /// The oracle's actions, `[n, action]`.
    fn oracle_actions(&mut self) -> PyResult<Vec<Vec<f32>>> {
        let numbers = self.task.action().numbers();
        let mut actions = Vec::new();
        for index in 0..self.environments.len() {
            let action = self.environments[index].oracle_action();
            let action = action.map_err(|error| self.failure(index, &error))?;
            actions.push(action[..numbers].to_vec());
        }
        Ok(actions)
    }

    /// Depth image, 72 × 128 bytes, of a camera that follows the drone, and that camera's position.
    fn chase<'py>(
        &mut self,
        py: Python<'py>,
        index: usize,
    ) -> PyResult<(Bound<'py, PyByteArray>, [f32; 3])> {
        self.check_index(index)?;
        let seen = self.environments[index].chase(&self.task);
        let (image, eye) = seen.map_err(|error| self.failure(index, &error))?;
        Ok((PyByteArray::new(py, &image[..]), eye))
    }

    /// The present moment of one environment, a batch of one.
    fn view<'py>(&mut self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyByteArray>> {
        self.check_index(index)?;
        let task = self.task.clone();
        batch(py, 1, |images| {
            let seen = self.environments[index].observe(&task, &mut images[0]);
            Ok(vec![seen.map_err(|error| self.failure(index, &error))?])
        })
    }

    /// State of all environments.
    fn state(&mut self) -> Vec<State> {
        self.environments.iter_mut().map(state_of).collect()
    }

    /// Puts the environments into a state that [`Fleet::state`] returned: repeats the actions.
    fn restore(&mut self, py: Python<'_>, states: Vec<State>) -> PyResult<()> {
        self.check_len("state", states.len())?;
        let task = self.task.clone();
        py.detach(|| {
            for (index, state) in states.into_iter().enumerate() {
                let restored = restore(&task, &mut self.environments[index], state)?;
                restored.map_err(|error| self.failure(index, &error))?;
            }
            Ok(())
        })
    }
}

impl Fleet {
    /// Does `work` for all environments, on several threads; `work` draws an environment's image.
    fn on_all<'py>(
        &mut self,
        py: Python<'py>,
        work: impl Fn(usize, &mut Environment, &mut [u8; IMAGE_PIXELS]) -> Result<Done, Failure>
        + Sync
        + Send,
    ) -> PyResult<Drawn<'py>> {
        let (count, threads) = (self.environments.len(), self.threads);
        let mut lasts = Vec::new();
        let drawn = batch(py, count, |images| {
            let environments = &mut self.environments;
            let results = py.detach(|| {
                let mut results: Vec<_> = (0..count).map(|_| None).collect();
                let places = environments.iter_mut().zip(images).zip(&mut results);
                let jobs: Vec<_> = places.enumerate().collect();
                for_each(
                    threads,
                    jobs.into_iter(),
                    |(index, ((environment, image), result))| {
                        *result = Some(work(index, environment, image));
                    },
                );
                results
            });
            let mut moments = Vec::with_capacity(count);
            for (index, result) in results.into_iter().enumerate() {
                let result = result.unwrap_or(Err(EnvironmentError::NotFlying.into()));
                let done = result.map_err(|failure| match failure {
                    Failure::Environment(error) => self.failure(index, &error),
                    Failure::Python(error) => error,
                })?;
                moments.push(done.moment);
                lasts.extend(done.last.map(|last| (index, last)));
            }
            Ok(moments)
        })?;
        Ok((drawn, lasts))
    }

    /// Reads the actions of all environments.
    ///
    /// # Errors
    /// `ValueError` names the environment and the number at fault.
    fn checked(&self, actions: &[u8]) -> PyResult<Vec<Action>> {
        let space = self.task.action();
        let actions = actions_of("actions", actions, self.environments.len(), space)?;
        for (index, action) in actions.iter().enumerate() {
            if !action.iter().all(|number| number.is_finite()) {
                return Err(refused(format!(
                    "the action of environment {index} is {:?}: all numbers must be finite, \
                     within [-1, 1]",
                    &action[..space.numbers()]
                )));
            }
        }
        let clamped = |action: Action| action.map(|number| number.clamp(-1.0, 1.0));
        Ok(actions.into_iter().map(clamped).collect())
    }

    fn check_len(&self, what: &str, len: usize) -> PyResult<()> {
        match len == self.environments.len() {
            true => Ok(()),
            false => Err(refused(format!(
                "{what} has {len} entries for {} environments",
                self.environments.len()
            ))),
        }
    }

    fn check_index(&self, index: usize) -> PyResult<()> {
        match index < self.environments.len() {
            true => Ok(()),
            false => Err(PyIndexError::new_err(format!(
                "there is no environment {index}: they are 0 to {}",
                self.environments.len() - 1
            ))),
        }
    }

    fn failure(&self, index: usize, error: &EnvironmentError) -> PyErr {
        let message = match self.environments.len() {
            1 => error.to_string(),
            _ => format!("environment {index}: {error}"),
        };
        match error {
            EnvironmentError::Fault(_) => refused(message),
            _ => PyRuntimeError::new_err(message),
        }
    }
}

impl From<EnvironmentError> for Failure {
    fn from(error: EnvironmentError) -> Self {
        Self::Environment(error)
    }
}

/// Reads rows of f32 numbers, an action each.
///
/// # Errors
/// `ValueError` names `what`, its length and the number of rows.
pub(crate) fn actions_of(
    what: &str,
    bytes: &[u8],
    rows: usize,
    action: ActionSpace,
) -> PyResult<Vec<Action>> {
    let numbers = action.numbers();
    let flat = rows_of::<1>(what, bytes, rows * numbers)?;
    let padded = |row: &[[f32; 1]]| {
        let mut action = [0.0; MAX_ACTION];
        action[..numbers].copy_from_slice(row.as_flattened());
        action
    };
    Ok(flat.chunks_exact(numbers).map(padded).collect())
}

/// Reads rows of `N` f32 numbers.
///
/// # Errors
/// `ValueError` names `what`, its length and the number of rows.
pub(crate) fn rows_of<const N: usize>(
    what: &str,
    bytes: &[u8],
    rows: usize,
) -> PyResult<Vec<[f32; N]>> {
    if bytes.len() != rows * N * size_of::<f32>() {
        return Err(refused(format!(
            "{what} has {} bytes, not those of float32 [{rows}, {N}]",
            bytes.len()
        )));
    }
    let (numbers, _) = bytes.as_chunks::<4>();
    let numbers: Vec<f32> = numbers
        .iter()
        .map(|four| f32::from_ne_bytes(*four))
        .collect();
    let (rows, _) = numbers.as_chunks::<N>();
    Ok(rows.to_vec())
}

/// Flies one control period, or resets, as `autoreset` says.
fn advance(
    task: &Flown,
    environment: &mut Environment,
    autoreset: Autoreset,
    action: Action,
    image: &mut [u8; IMAGE_PIXELS],
) -> Result<Done, Failure> {
    if autoreset == Autoreset::NextStep && environment.has_ended() {
        begin_next(task, environment, &Choice::default())?;
        let moment = environment.observe(task, image)?;
        return Ok(Done { moment, last: None });
    }
    let ended = environment.step(task, action, image)?;
    if autoreset != Autoreset::SameStep || !environment.has_ended() {
        return Ok(Done {
            moment: ended,
            last: None,
        });
    }
    let last = Some((Box::new(*image), ended));
    begin_next(task, environment, &Choice::default())?;
    let begun = environment.observe(task, image)?;
    let moment = Moment {
        reward: ended.reward,
        terminated: ended.terminated,
        truncated: ended.truncated,
        ..begun
    };
    Ok(Done { moment, last })
}

/// Starts the next episode of an environment's sequence.
fn begin_next(task: &Flown, environment: &mut Environment, choice: &Choice) -> Result<(), Failure> {
    let (seed, episode) = environment.seeds().advance();
    let ticket = task
        .ticket(seed, episode, choice)
        .map_err(Failure::Python)?;
    Ok(environment.begin(ticket)?)
}

fn state_of(environment: &mut Environment) -> State {
    let seeds = *environment.seeds();
    let flight = environment.flight().map(|flight| {
        let ticket = &flight.ticket;
        let (course, course_seed) = match ticket.course {
            CourseChoice::Generated(seed) => (-1, seed),
            CourseChoice::Evaluation(index) => (index.into(), 0),
            CourseChoice::Training => (0, 0),
        };
        let actions = flight.flown.clone();
        let (episode, level) = (ticket.episode.0, ticket.start_level);
        (episode, ticket.seed, course, course_seed, level, actions)
    });
    (seeds.first, seeds.next_episode, flight)
}

fn restore(
    task: &Flown,
    environment: &mut Environment,
    (first, next_episode, flight): State,
) -> PyResult<Result<(), EnvironmentError>> {
    *environment.seeds() = EpisodeSeeds {
        first,
        next_episode,
    };
    let Some((episode, seed, course, course_seed, level, flown)) = flight else {
        return Ok(Ok(()));
    };
    let mut ticket = task.ticket(seed, episode, &Choice::default())?;
    ticket.start_level = level;
    ticket.course = match u32::try_from(course) {
        Ok(index) => CourseChoice::Evaluation(index),
        Err(_) => CourseChoice::Generated(course_seed),
    };
    let ended = false;
    Ok(environment.restore(Flight {
        ticket,
        flown,
        ended,
    }))
}

impl Autoreset {
    fn named(name: &str) -> PyResult<Self> {
        match name {
            "NextStep" => Ok(Self::NextStep),
            "SameStep" => Ok(Self::SameStep),
            "Disabled" => Ok(Self::Disabled),
            other => Err(refused(format!(
                "autoreset_mode = {other:?} is none of NextStep, SameStep, Disabled"
            ))),
        }
    }
}
