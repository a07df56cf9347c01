//! The machine that figures were measured on.

use std::fmt;
use std::fs;
use std::hint::black_box;
use std::path::Path;
use std::thread;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use skein_kernels::{Isa, peak_flops};

/// Bytes copied at a time, beyond any cache.
const COPIED: usize = 128 << 20;
/// Times that they are copied; the fastest counts.
const COPIES: usize = 4;

/// Instruction sets that decide how fast kernels are, as `/proc/cpuinfo` spells them.
const INSTRUCTIONS: [&str; 6] = ["sse4_2", "avx", "avx2", "fma", "f16c", "avx512f"];

/// What one core can do at best, measured. A line of `machine.jsonl`, written between two
/// benchmarks: what holds the core up then must not pass for all it can do, so the best of all
/// lines counts.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Core {
    /// f32 operations a second.
    pub f32_flops: f64,
    /// Bytes a second copied from memory to memory.
    pub copied_bytes_per_sec: f64,
    /// Threads of others that ran, or wanted to, at that moment: with any, times are too long.
    pub others_running: u32,
    /// Whether it was the only core that was allowed to measure.
    pub is_pinned: bool,
}

/// What is known of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Machine {
    /// The processor's name, with family and model: virtual machines often hide the rest.
    pub processor: String,
    /// Cores that processes may use.
    pub cores: usize,
    /// Of the instruction sets that matter, those it has.
    pub instructions: Vec<&'static str>,
    /// One of them.
    pub core: Core,
    /// Memory, bytes.
    pub memory_bytes: u64,
    /// The kernel.
    pub kernel: String,
}

impl Core {
    /// The core that the calling thread runs on.
    pub fn measure() -> Self {
        Self {
            f32_flops: peak_flops(Isa::best()),
            copied_bytes_per_sec: copied_bytes_per_sec(),
            others_running: others_running(&read("/proc/loadavg")),
            is_pinned: thread::available_parallelism().is_ok_and(|cores| cores.get() == 1),
        }
    }

    /// The best of what the lines of `path` say, and the worst of what disturbed it; measured now
    /// where there are none.
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
    /// This machine, whose cores are like `core`.
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

/// Of `/proc/loadavg`, the threads that run or want to, without the calling one.
fn others_running(load: &str) -> u32 {
    let running = load
        .split_whitespace()
        .nth(3)
        .and_then(|word| word.split('/').next()?.parse().ok());
    running.unwrap_or(1_u32).saturating_sub(1)
}

/// The machine's cores; the calling thread itself may be pinned to one.
fn cores(info: &str) -> usize {
    let listed = info
        .lines()
        .filter(|line| line.starts_with("processor"))
        .count();
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
            "{}, {} cores, {:.0} GB of memory, Linux {}; between benchmarks, at most {} threads of others ran",
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
    fn the_best_of_what_was_measured_counts() {
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
        // And the worst of what disturbed.
        assert_eq!((best.others_running, best.is_pinned), (2, false));
    }

    #[test]
    fn whoever_asks_does_not_count_as_another() {
        assert_eq!(others_running("9.92 9.09 6.03 3/412 31793"), 2);
        assert_eq!(others_running("0.00 0.00 0.00 1/412 31793"), 0);
        assert_eq!(others_running(""), 0);
    }
}
