//! A snapshot's encoder and policy, with the actor's own arithmetic.

use std::path::PathBuf;
use std::sync::Arc;

use bytemuck::Zeroable;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_inference::{Network, Scratch};
use skein_protocol::config::Config;
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::Exploration;
use skein_protocol::transition::TransitionRecord;
use skein_protocol::{Action, IMAGE_PIXELS, LatentCode, MAX_ACTION, MAX_LATENT};
use skein_rollout::agent::Agent;

use crate::fleet::{actions_of, rows_of};
use crate::flight::exploration_of;
use crate::parallel::for_each;
use crate::task::refused;
use crate::values::dict_of;

/// A snapshot in memory, and an agent for each row of a batch.
#[pyclass(module = "skein_rl._core")]
pub(crate) struct Policy {
    pub(crate) network: Arc<Network>,
    pub(crate) snapshot: Snapshot,
    pub(crate) config: Config,
    rows: Vec<Row>,
    threads: usize,
}

/// One row of a batch: an episode, as the policy remembers it.
struct Row {
    agent: Agent,
    /// Step, latent code and velocity, as an actor's agent reads them.
    record: Box<TransitionRecord>,
    next_step: u32,
    last_action: Action,
    noise: Pcg64Mcg,
    scratch: Scratch,
}

#[pymethods]
impl Policy {
    /// Reads a snapshot.
    #[new]
    fn new(path: PathBuf, threads: usize) -> PyResult<Self> {
        let (snapshot, config) = Snapshot::load(&path).map_err(refused)?;
        Ok(Self {
            network: Arc::new(Network::new(&snapshot, &SnapshotLayout::of(&config))),
            snapshot,
            config,
            rows: Vec::new(),
            threads: threads.max(1),
        })
    }

    /// Forgets all episodes. Row i of later batches draws as an actor with a ticket of `seeds[i]`.
    fn reset(&mut self, seeds: Vec<u64>) {
        let layout = self.config.observation_layout();
        let row = |seed| Row {
            agent: Agent::new(layout.clone()),
            record: Box::new(TransitionRecord::zeroed()),
            next_step: 0,
            last_action: [0.0; MAX_ACTION],
            noise: Pcg64Mcg::seed_from_u64(derive(seed, Purpose::ActionNoise, 0)),
            scratch: Scratch::default(),
        };
        self.rows = seeds.into_iter().map(row).collect();
    }

    /// Number of rows since the last reset.
    #[getter]
    fn count(&self) -> usize {
        self.rows.len()
    }

    /// Actions, f32 `[n, action]`. Bytes of `images`: u8 `[n, 9216]`, or of `latents`: f32 `[n,
    /// latent]`; of `velocities`: f32 `[n, 3]`; of `previous`: f32 `[n, action]`, by default the
    /// actions returned before; of `goals`: f32 `[n, 3]`, by default zeros; `starts`: rows whose
    /// episode begins.
    #[allow(clippy::too_many_arguments, reason = "the columns of a batch")]
    fn act<'py>(
        &mut self,
        py: Python<'py>,
        images: Option<&[u8]>,
        latents: Option<&[u8]>,
        velocities: &[u8],
        previous: Option<&[u8]>,
        goals: Option<&[u8]>,
        starts: Vec<bool>,
        exploration: &str,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let (count, latent) = (self.rows.len(), self.config.vae.latent);
        let action = self.config.action_space();
        let seen = Seen {
            images: images.map(|bytes| images_of(bytes, count)).transpose()?,
            latents: latents
                .map(|bytes| rows_of::<1>("latent", bytes, count * latent))
                .transpose()?,
            latent,
            velocities: rows_of("velocity", velocities, count)?,
            previous: previous
                .map(|bytes| actions_of("previous_action", bytes, count, action))
                .transpose()?,
            goals: match goals {
                Some(goals) => rows_of("goal", goals, count)?,
                None => vec![[0.0; 3]; count],
            },
        };
        seen.check()?;
        if starts.len() != count {
            return Err(refused(format!(
                "episode_start has {} entries for {count} rows",
                starts.len()
            )));
        }
        let exploration = exploration_of(exploration)?;
        let Self {
            rows,
            network,
            threads,
            ..
        } = self;
        py.detach(|| {
            let jobs: Vec<_> = rows.iter_mut().zip(starts).enumerate().collect();
            for_each(*threads, jobs.into_iter(), |(index, (row, starts))| {
                if starts {
                    row.restart();
                }
                row.act(network, &seen, index, exploration);
            });
        });
        let taken = self.rows.iter();
        let actions = taken.flat_map(|row| &row.last_action[..action.numbers()]);
        let actions: Vec<f32> = actions.copied().collect();
        Ok(PyBytes::new(py, bytemuck::cast_slice(&actions)))
    }

    /// Latent codes, f32 `[n, latent]`, of the bytes of `images`, u8 `[n, 9216]`.
    fn encode<'py>(&self, py: Python<'py>, images: &[u8]) -> PyResult<Bound<'py, PyBytes>> {
        let images = images_of(images, images.len() / IMAGE_PIXELS)?;
        let mut codes = vec![[0.0; MAX_LATENT]; images.len()];
        py.detach(|| {
            let jobs: Vec<_> = codes.iter_mut().zip(images).collect();
            for_each(self.threads, jobs.into_iter(), |(code, image)| {
                *code = self.network.encode(image, &mut Scratch::default());
            });
        });
        let latent = self.config.vae.latent;
        let numbers = codes.iter().flat_map(|code| &code[..latent]).copied();
        let numbers: Vec<f32> = numbers.collect();
        Ok(PyBytes::new(py, bytemuck::cast_slice(&numbers)))
    }

    /// Parameters by name, each as a shape and the bytes of its f32 numbers.
    fn parameters<'py>(&self, py: Python<'py>) -> Vec<(String, Vec<usize>, Bound<'py, PyBytes>)> {
        let layout = SnapshotLayout::of(&self.config);
        let tensors = layout.tensors().iter().map(|tensor| {
            let bytes = bytemuck::cast_slice(&self.snapshot.values[tensor.range.clone()]);
            let bytes = PyBytes::new(py, bytes);
            (tensor.name.clone(), tensor.shape.clone(), bytes)
        });
        tensors.collect()
    }

    /// Configuration that the policy was trained with.
    #[getter]
    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let text = self.config.portable();
        let table: toml::Table = toml::from_str(&text).map_err(refused)?;
        dict_of(py, &table)
    }

    /// Policy version of the snapshot.
    #[getter]
    fn version(&self) -> u64 {
        self.snapshot.version.0
    }

    /// SHA-256 of the parameters.
    #[getter]
    fn sha256(&self) -> String {
        self.snapshot.sha256()
    }

    /// Length of the latent code.
    #[getter]
    fn latent(&self) -> usize {
        self.config.vae.latent
    }

    /// Policy input per step, as the configuration names it.
    #[getter]
    fn observation(&self) -> &'static str {
        self.config.learning.observation.name()
    }

    /// Names of the numbers of an action, in order.
    #[getter]
    fn action_names(&self) -> Vec<&'static str> {
        let axes = self.config.action_space().axes().iter();
        axes.map(|axis| axis.name()).collect()
    }

    /// Numbers of steps back of the earlier steps that the policy sees.
    #[getter]
    fn history_steps(&self) -> Vec<usize> {
        self.config.learning.history_steps.clone()
    }

    /// The snapshot as an ONNX graph.
    fn to_onnx<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &skein_export::onnx(&self.snapshot, &self.config))
    }
}

/// Inputs of the rows of a batch.
struct Seen<'a> {
    images: Option<&'a [[u8; IMAGE_PIXELS]]>,
    /// Codes back to back, `latent` numbers each.
    latents: Option<Vec<[f32; 1]>>,
    latent: usize,
    velocities: Vec<[f32; 3]>,
    previous: Option<Vec<Action>>,
    goals: Vec<[f32; 3]>,
}

impl Seen<'_> {
    /// Checks that all numbers are finite: the policy would remember what is not.
    fn check(&self) -> PyResult<()> {
        let latents = self.latents.as_deref().unwrap_or_default();
        let previous = self.previous.as_deref().unwrap_or_default();
        for (name, numbers) in [
            ("latent", latents.as_flattened()),
            ("velocity", self.velocities.as_flattened()),
            ("previous_action", previous.as_flattened()),
            ("goal", self.goals.as_flattened()),
        ] {
            if let Some(number) = numbers.iter().find(|number| !number.is_finite()) {
                return Err(refused(format!("{name} holds {number}: it must be finite")));
            }
        }
        Ok(())
    }

    fn code(&self, index: usize) -> LatentCode {
        let mut code = [0.0; MAX_LATENT];
        if let Some(latents) = &self.latents {
            let own = &latents[index * self.latent..][..self.latent];
            code[..self.latent].copy_from_slice(own.as_flattened());
        }
        code
    }
}

impl Row {
    /// Begins another episode.
    fn restart(&mut self) {
        (self.next_step, self.last_action) = (0, [0.0; MAX_ACTION]);
    }

    fn act(&mut self, network: &Network, seen: &Seen<'_>, index: usize, exploration: Exploration) {
        let record = &mut self.record;
        record.step = self.next_step;
        record.velocity_mps = seen.velocities[index];
        record.goal_m = seen.goals[index];
        record.latent = match seen.images {
            Some(images) => network.encode(&images[index], &mut self.scratch),
            None => seen.code(index),
        };
        let previous = match &seen.previous {
            Some(previous) => previous[index],
            None => self.last_action,
        };
        self.last_action = self
            .agent
            .act(exploration, network, record, &previous, &mut self.noise);
        self.next_step = self.next_step.saturating_add(1);
    }
}

fn images_of(bytes: &[u8], count: usize) -> PyResult<&[[u8; IMAGE_PIXELS]]> {
    match bytes.as_chunks() {
        (images, []) if images.len() == count => Ok(images),
        _ => Err(refused(format!(
            "depth has {} bytes, not those of uint8 [{count}, 72, 128]",
            bytes.len()
        ))),
    }
}
