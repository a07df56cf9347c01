//! Memory that a recording needs, against what the machine has.

use std::fs;

use skein_protocol::transition::TransitionRecord;
use skein_run::control_groups::{MemoryGroup, memory_groups};

const GIB: f64 = (1u64 << 30) as f64;

/// A recording of an evaluation does not fit into memory.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "--record keeps every step in memory until the end: up to {:.1} GiB for {episodes} episodes \
     ({records} records of 9.3 KiB), but {:.1} GiB are free; record at most {} episodes at a time \
     (--episodes, --course)",
    *needed as f64 / GIB,
    *free as f64 / GIB,
    *episodes as u128 * u128::from(*free) / u128::from(*needed)
)]
pub(crate) struct RecordingTooLarge {
    episodes: u64,
    records: u64,
    /// Bytes.
    needed: u64,
    /// Bytes.
    free: u64,
}

/// Checks that up to `records` records of `episodes` episodes fit into the `free` bytes of memory.
/// Passes if these are unknown.
///
/// # Errors
/// [`RecordingTooLarge`] has the sizes and the remedy.
pub(crate) fn check_recording(
    episodes: u64,
    records: u64,
    free: Option<u64>,
) -> Result<(), RecordingTooLarge> {
    let needed = records.saturating_mul(size_of::<TransitionRecord>() as u64);
    match free {
        Some(free) if free < needed => Err(RecordingTooLarge {
            episodes,
            records,
            needed,
            free,
        }),
        _ => Ok(()),
    }
}

/// Returns the bytes of memory that this process may still take: those of the machine, or of the
/// control group that leaves it least. `None` if neither is known.
pub(crate) fn free_memory() -> Option<u64> {
    let machine = fs::read_to_string("/proc/meminfo").ok();
    let machine = machine.and_then(|text| available(&text));
    let groups = memory_groups();
    let groups = groups.iter().filter_map(MemoryGroup::free);
    machine.into_iter().chain(groups).min()
}

/// Returns the bytes in the line `MemAvailable` of `/proc/meminfo`.
fn available(meminfo: &str) -> Option<u64> {
    let line = meminfo
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_larger_than_memory_is_refused_with_its_size_and_a_remedy() {
        let free = 1 << 30;
        assert_eq!(check_recording(400, 400 * 161, Some(free)), Ok(()));
        assert_eq!(check_recording(1, u64::MAX, None), Ok(()));
        let error = check_recording(1_000_000, 161_000_000, Some(free)).unwrap_err();
        let message = error.to_string();
        for part in [
            "1000000 episodes",
            "1.0 GiB are free",
            "--episodes",
            "--course",
        ] {
            assert!(message.contains(part), "`{part}` is missing in {message}");
        }
        assert!(error.needed > 1 << 40, "more than a terabyte: {message}");
    }

    #[test]
    fn available_memory_is_read_in_bytes() {
        let text = "MemTotal:       8123456 kB\nMemAvailable:    2048 kB\n";
        assert_eq!(available(text), Some(2 << 20));
        assert_eq!(available("MemTotal: 1 kB"), None);
    }
}
