//! The `[run]` and `[checkpoints]` sections.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::{InvalidValue, require};

/// The `[run]` section: seed, length, device, engine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunSection {
    /// Seed of everything random in the run. Default 1.
    pub seed: u64,
    /// Training episodes of the run, 1 to 2^62 - 1. Default 2000.
    pub episodes: u64,
    /// Device of the learner: `cpu` or `cuda:N`. Default `cpu`.
    pub device: Device,
    /// Engine of the learner's networks: `native` or `libtorch`. The two sum in different orders,
    /// so results differ. Default: `native` on the processor, `libtorch` on a CUDA device, which
    /// `native` does not support. Three settings need `libtorch` and refuse an explicit `native`:
    /// `learning.algorithm = "td3"` and `learning.encoder = "end-to-end"` for policy and critic,
    /// `vae.decoder = "u-net"` for the VAE. All other networks use the default engine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub engine: Option<Engine>,
    /// Threads of the learner's networks, 1 to 256. With `libtorch` the count changes the order of
    /// sums and thus the result; with `native` it does not. Default 2.
    pub learner_threads: usize,
    /// Records training episodes whose number is a multiple of this, at least 1, as MCAP files in
    /// `recordings/`; also, of confirmations and the final evaluation, each course's first episode
    /// and those that failed. The newest 200, of at most 256 MiB, are kept. Results do not depend
    /// on it. Default: nothing is recorded. Needs episodes flown whole:
    /// `learning.segment_steps = 0`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record_every: Option<u64>,
}

impl Default for RunSection {
    fn default() -> Self {
        Self {
            seed: 1,
            episodes: 2000,
            device: Device::Cpu,
            engine: None,
            learner_threads: 2,
            record_every: None,
        }
    }
}

impl RunSection {
    /// Returns the engine in use: the configured one, or the device's default.
    pub fn engine(&self) -> Engine {
        self.engine.unwrap_or(match self.device {
            Device::Cpu => Engine::Native,
            Device::Cuda(_) => Engine::Libtorch,
        })
    }

    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            self.episodes >= 1,
            "run.episodes",
            self.episodes,
            "is below 1: nothing would be flown",
        )?;
        require(
            self.episodes < 1 << 62,
            "run.episodes",
            self.episodes,
            "is not below 2^62: episode numbers would run out",
        )?;
        require(
            self.engine != Some(Engine::Native) || self.device == Device::Cpu,
            "run.engine",
            Engine::Native,
            format!(
                "cannot compute on run.device = {}: leave run.engine out, or set it to \
                \"libtorch\", or run.device to \"cpu\"",
                self.device
            ),
        )?;
        require(
            self.record_every != Some(0),
            "run.record_every",
            0,
            "is below 1: leave it out to record nothing",
        )?;
        require(
            (1..=256).contains(&self.learner_threads),
            "run.learner_threads",
            self.learner_threads,
            "is outside 1..=256: the tensor library takes no such thread count",
        )
    }
}

/// Device of the learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Device {
    /// The processor.
    Cpu,
    /// The CUDA device of this number.
    Cuda(usize),
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("device `{text}` is neither `cpu` nor `cuda:N`");
        match text {
            "cpu" => Ok(Self::Cpu),
            _ => {
                let number = text.strip_prefix("cuda:").ok_or_else(unknown)?;
                number.parse().map(Self::Cuda).map_err(|_| unknown())
            }
        }
    }
}

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
    }
}

/// Engine of the learner's networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Engine {
    /// Skein's own kernels, on the processor: bit-identical results with every instruction set and
    /// for any number of threads.
    Native,
    /// libtorch with automatic gradients: the reference, and the engine for CUDA devices.
    Libtorch,
}

impl fmt::Display for Engine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Native => "native",
            Self::Libtorch => "libtorch",
        })
    }
}

/// The `[checkpoints]` section.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointSection {
    /// Training episodes between two checkpoints, at least 1; one more is written at the end.
    /// Default 100.
    pub every_episodes: u64,
    /// Checkpoints kept, at least 1; older ones are removed. Default 2.
    pub keep: usize,
}

impl Default for CheckpointSection {
    fn default() -> Self {
        Self {
            every_episodes: 100,
            keep: 2,
        }
    }
}

impl CheckpointSection {
    pub(super) fn validate(&self) -> Result<(), InvalidValue> {
        require(
            self.every_episodes >= 1,
            "checkpoints.every_episodes",
            self.every_episodes,
            "is below 1: no episode would ever complete the interval",
        )?;
        require(
            self.keep >= 1,
            "checkpoints.keep",
            self.keep,
            "is below 1: every checkpoint would be removed at once",
        )
    }
}
