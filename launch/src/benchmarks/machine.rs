//! The machine that figures were measured on.

use std::fmt;
use std::fs;
use std::thread;

use serde::Serialize;

use super::peak;

/// Instruction sets that decide how fast kernels are, as `/proc/cpuinfo` spells them.
const INSTRUCTIONS: [&str; 10] = [
    "sse4_2",
    "avx",
    "avx2",
    "fma",
    "f16c",
    "avx512f",
    "avx512_vnni",
    "avx512_bf16",
    "amx_bf16",
    "amx_int8",
];

/// What is known of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Machine {
    /// The processor's name, with family and model: virtual machines often hide the rest.
    pub processor: String,
    /// Cores that processes may use.
    pub cores: usize,
    /// Of the instruction sets that matter, those it has.
    pub instructions: Vec<&'static str>,
    /// f32 operations a second of one core, measured.
    pub f32_flops: f64,
    /// Bytes a second that one core copies, measured.
    pub copied_bytes_per_sec: f64,
    /// Memory, bytes.
    pub memory_bytes: u64,
    /// The kernel.
    pub kernel: String,
    /// Processes that wanted to run, on average over the last five minutes: more than the benchmarks' one, and times are too long.
    pub load: f64,
}

impl Machine {
    /// This machine, measured on the core that the calling thread runs on.
    pub fn measure() -> Self {
        let load = read("/proc/loadavg");
        let info = read("/proc/cpuinfo");
        let field = |name: &str| {
            info.lines()
                .filter_map(|line| line.split_once(':'))
                .find_map(|(key, value)| (key.trim() == name).then(|| value.trim().to_owned()))
                .unwrap_or_else(|| "unknown".to_owned())
        };
        let flags = field("flags");
        let memory = read("/proc/meminfo");
        let memory_kib = memory
            .lines()
            .find_map(|line| line.strip_prefix("MemTotal:")?.split_whitespace().next()?.parse().ok());
        Self {
            processor: format!(
                "{} (family {}, model {})",
                field("model name"),
                field("cpu family"),
                field("model")
            ),
            cores: cores(&info),
            instructions: INSTRUCTIONS
                .into_iter()
                .filter(|set| flags.split_whitespace().any(|flag| flag == *set))
                .collect(),
            f32_flops: peak::f32_flops(),
            copied_bytes_per_sec: peak::copied_bytes_per_sec(),
            memory_bytes: memory_kib.unwrap_or(0_u64) << 10,
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
            load: load.split_whitespace().nth(1).and_then(|word| word.parse().ok()).unwrap_or(0.0),
        }
    }
}

/// The machine's cores; the calling thread itself may be pinned to one.
fn cores(info: &str) -> usize {
    let listed = info.lines().filter(|line| line.starts_with("processor")).count();
    listed.max(thread::available_parallelism().map_or(1, Into::into))
}

/// What a file of the system says; nothing where there is none.
fn read(path: &str) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

impl fmt::Display for Machine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}, {} cores, {:.0} GB of memory, Linux {}, load {:.1}",
            self.processor,
            self.cores,
            self.memory_bytes as f64 / 1e9,
            self.kernel,
            self.load
        )?;
        write!(
            f,
            "{}; one core: {:.1} GFLOP/s in f32, {:.1} GB/s copied",
            self.instructions.join(" "),
            self.f32_flops / 1e9,
            self.copied_bytes_per_sec / 1e9
        )
    }
}
