//! Processor time of the learner's threads.

use std::collections::BTreeMap;
use std::fs;

use rustix::param::clock_ticks_per_second;

/// Seconds of processor time that each thread of this process has taken so far, by thread name.
/// Threads of equal name are added up; ended threads are not included. Empty where the system does
/// not report it.
pub fn cpu_secs() -> BTreeMap<String, f64> {
    let mut secs = BTreeMap::new();
    for thread in fs::read_dir("/proc/self/task")
        .into_iter()
        .flatten()
        .flatten()
    {
        let line = fs::read_to_string(thread.path().join("stat")).unwrap_or_default();
        if let Some((name, ticks)) = parse(&line) {
            *secs.entry(name.to_owned()).or_default() +=
                ticks as f64 / clock_ticks_per_second() as f64;
        }
    }
    secs
}

/// Name and clock ticks, in user and system mode, from a line of `/proc/PID/task/TID/stat`
/// (proc(5): fields 2, 14 and 15).
fn parse(line: &str) -> Option<(&str, u64)> {
    // The name is in parentheses and may contain some.
    let (head, tail) = line.rsplit_once(')')?;
    let (_, name) = head.split_once('(')?;
    let ticks: Vec<u64> = tail
        .split_whitespace()
        .skip(11)
        .take(2)
        .filter_map(|field| field.parse().ok())
        .collect();
    (ticks.len() == 2).then(|| (name, ticks.iter().sum()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_is_parsed_by_its_name_and_both_kinds_of_time() {
        let line = "77 (a) b) S 1 77 77 0 -1 4194304 100 0 0 0 250 50 0 0 20 0 1 0 5 1000 10";
        assert_eq!(parse(line), Some(("a) b", 300)));
        assert_eq!(parse("77 (cut short) S 1 77"), None);
    }

    #[test]
    fn the_time_of_a_busy_thread_is_measured() {
        let busy = std::thread::Builder::new()
            .name("busy".to_owned())
            .spawn(|| {
                let begun = std::time::Instant::now();
                loop {
                    let so_far = cpu_secs().get("busy").copied().unwrap_or_default();
                    if so_far > 0.05 || begun.elapsed().as_secs() > 20 {
                        return so_far;
                    }
                }
            });
        assert!(busy.unwrap().join().unwrap() > 0.05);
    }
}
