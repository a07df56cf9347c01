//! Machine on which figures were measured.

use std::fmt;
use std::fs;
use std::hint::black_box;
use std::path::Path;
use std::thread;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use skein_kernels::{Isa, peak_flops};

/// Bytes copied at a time, more than any cache holds.
const COPIED: usize = 128 << 20;
/// Number of copies; the fastest counts.
const COPIES: usize = 4;

/// Instruction sets that determine the speed of the kernels, as `/proc/cpuinfo` spells them.
const INSTRUCTIONS: [&str; 6] = ["sse4_2", "avx", "avx2", "fma", "f16c", "avx512f"];

/// Best measured performance of one core, as a line of `machine.jsonl`. A line is written between
/// any two benchmarks, and the best of all lines counts, because a disturbance must not pass for
/// the core's limit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Core {
    /// f32 operations per second.
    pub f32_flops: f64,
    /// Bytes per second copied from memory to memory.
    pub copied_bytes_per_sec: f64,
    /// Threads of other processes that ran or were ready at that moment. Any such thread lengthens
    /// times.
    pub others_running: u32,
    /// `true` if the measurement was pinned to this core.
    pub is_pinned: bool,
}

/// Description of the machine.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Machine {
    /// Processor name with family and model; virtual machines often hide the rest.
    pub processor: String,
    /// Cores available to processes.
    pub cores: usize,
    /// Relevant instruction sets that it has.
    pub instructions: Vec<&'static str>,
    /// Performance of one core.
    pub core: Core,
    /// Memory in bytes.
    pub memory_bytes: u64,
    /// Kernel version.
    pub kernel: String,
}

impl Core {
    /// Measures the core of the calling thread.
    pub fn measure() -> Self {
        Self {
            f32_flops: peak_flops(Isa::best()),
            copied_bytes_per_sec: copied_bytes_per_sec(),
            others_running: others_running(&read("/proc/loadavg")),
            is_pinned: thread::available_parallelism().is_ok_and(|cores| cores.get() == 1),
        }
    }

    /// Combines the best performance and the worst disturbance of the lines of `path`; measures now
    /// if there are none.
    pub fn best_of(path: &Path) -> Self {
        let text = fs::read_to_string(path).unwrap_or_default();
        let lines = text
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok());
        lines
            .reduce(|a: Self, b: Self| Self {
                f32_flops: a.f32_flops.max(b.f32_flops),
                copied_bytes_per_sec: a.copied_bytes_per_sec.max(b.copied_bytes_per_sec),
                others_running: a.others_running.max(b.others_running),
                is_pinned: a.is_pinned && b.is_pinned,
            })
            .unwrap_or_else(Self::measure)
    }
}

impl Machine {
    /// Describes this machine, with `core` as measured.
    pub fn with(core: Core) -> Self {
        let info = read("/proc/cpuinfo");
        let field = |name: &str| {
            info.lines()
                .filter_map(|line| line.split_once(':'))
                .find_map(|(key, value)| (key.trim() == name).then(|| value.trim().to_owned()))
                .unwrap_or_else(|| "unknown".to_owned())
        };
        let flags = field("flags");
        let memory = read("/proc/meminfo");
        let memory_kib = memory.lines().find_map(|line| {
            line.strip_prefix("MemTotal:")?
                .split_whitespace()
                .next()?
                .parse()
                .ok()
        });
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
            core,
            memory_bytes: memory_kib.unwrap_or(0_u64) << 10,
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
        }
    }
}

fn copied_bytes_per_sec() -> f64 {
    let source = vec![1_u8; COPIED];
    let mut target = vec![2_u8; COPIED];
    let copies = (0..COPIES).map(|_| {
        let start = Instant::now();
        target.copy_from_slice(black_box(&source));
        black_box(&target);
        start.elapsed().as_secs_f64()
    });
    COPIED as f64 / copies.fold(f64::INFINITY, f64::min)
}

/// Returns the running and ready threads of `/proc/loadavg`, without the calling one.
fn others_running(load: &str) -> u32 {
    let running = load
        .split_whitespace()
        .nth(3)
        .and_then(|word| word.split('/').next()?.parse().ok());
    running.unwrap_or(1_u32).saturating_sub(1)
}

/// Returns the number of the machine's cores; the calling thread itself may be pinned to one.
fn cores(info: &str) -> usize {
    let listed = info
        .lines()
        .filter(|line| line.starts_with("processor"))
        .count();
    listed.max(thread::available_parallelism().map_or(1, Into::into))
}

/// Returns the contents of a system file; empty if it does not exist.
fn read(path: &str) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

impl fmt::Display for Machine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}, {} cores, {:.0} GB of memory, Linux {}; \
                at most {} other threads ran between benchmarks",
            self.processor,
            self.cores,
            self.memory_bytes as f64 / 1e9,
            self.kernel,
            self.core.others_running
        )?;
        write!(
            f,
            "{}; one core{}: {:.1} GFLOP/s in f32, {:.1} GB/s copied",
            self.instructions.join(" "),
            if self.core.is_pinned {
                ""
            } else {
                ", NOT pinned to it"
            },
            self.core.f32_flops / 1e9,
            self.core.copied_bytes_per_sec / 1e9
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_measurement_counts() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("machine.jsonl");
        let line = |f32_flops, copied_bytes_per_sec, others_running| {
            let core = Core {
                f32_flops,
                copied_bytes_per_sec,
                others_running,
                is_pinned: others_running == 0,
            };
            serde_json::to_string(&core).unwrap()
        };
        fs::write(
            &path,
            format!("{}\n{}\n", line(2e9, 1e9, 0), line(1e9, 3e9, 2)),
        )
        .unwrap();
        let best = Core::best_of(&path);
        assert_eq!((best.f32_flops, best.copied_bytes_per_sec), (2e9, 3e9));
        // Of the disturbances, the worst counts.
        assert_eq!((best.others_running, best.is_pinned), (2, false));
    }

    #[test]
    fn the_calling_thread_does_not_count_as_another() {
        assert_eq!(others_running("9.92 9.09 6.03 3/412 31793"), 2);
        assert_eq!(others_running("0.00 0.00 0.00 1/412 31793"), 0);
        assert_eq!(others_running(""), 0);
    }
}
