//! `skein-storm`: simulates learner and actors in storms of mishaps, one for each seed.

use std::num::NonZeroUsize;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use skein_run::show;
use skein_run::signals::survive_file_size_limit;
use skein_storm::{Passed, Sky, hunt};

/// Time between two updates of the progress line.
const UPDATE_INTERVAL: Duration = Duration::from_millis(250);

/// Simulates the protocol between learner and actors, with a virtual clock, network and disk.
///
/// In each storm messages are lost, doubled, reordered and late, links are cut, processes die and
/// stand still, the disk fills and the power fails. The run must take in the calm run's episodes in
/// their order, end with its results, and never stand still after the storm. A seed gives the same
/// storm on every machine. The first seed whose run fails is printed.
#[derive(Debug, Parser)]
#[command(version, after_long_help = EXIT_STATUS)]
struct Arguments {
    /// Number of storms.
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    seeds: u64,
    /// Seed of the first storm; the others follow.
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    first: u64,
    /// Number of threads; by default one for each core.
    #[arg(long, value_name = "N")]
    jobs: Option<NonZeroUsize>,
    /// Print every event of the first storm, and simulate no other.
    #[arg(long)]
    log: bool,
}

const EXIT_STATUS: &str = "Exit status: 0 every run survived, 1 one did not, 2 wrong arguments.";

fn main() -> ExitCode {
    survive_file_size_limit();
    let arguments = Arguments::parse();
    if arguments.log {
        let outcome = Sky::new().storm_logged(arguments.first, None);
        show!("trace {:016x}", outcome.trace);
        return match outcome.failure {
            None => ExitCode::SUCCESS,
            Some(_) => ExitCode::FAILURE,
        };
    }
    let default_jobs = || thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
    let jobs = arguments.jobs.unwrap_or_else(default_jobs);
    let end = arguments.first.saturating_add(arguments.seeds);
    let (passed, started) = (Passed::default(), Instant::now());
    let finding = thread::scope(|scope| {
        let hunting = scope.spawn(|| hunt(arguments.first..end, jobs, None, &passed));
        let bar = ProgressBar::new(arguments.seeds).with_style(
            ProgressStyle::with_template("{pos}/{len} storms  {per_sec}  {eta} left")
                .unwrap_or_else(|_| ProgressStyle::default_bar()),
        );
        while !hunting.is_finished() {
            bar.set_position(passed.storms.load(Ordering::Relaxed));
            thread::park_timeout(UPDATE_INTERVAL);
        }
        bar.finish_and_clear();
        hunting.join()
    });
    let storms = passed.storms.load(Ordering::Relaxed);
    let events = passed.events.load(Ordering::Relaxed);
    let secs = started.elapsed().as_secs_f64();
    show!(
        "{storms} storms, {events} events in {secs:.1} s: {:.0} storms/s",
        storms as f64 / secs
    );
    match finding {
        Ok(None) => ExitCode::SUCCESS,
        Ok(Some(finding)) => {
            show!("seed {}: {}", finding.seed, finding.what);
            show!("see it with: skein-storm --log --first {}", finding.seed);
            ExitCode::FAILURE
        }
        Err(_) => {
            show!("the simulation itself has panicked");
            ExitCode::FAILURE
        }
    }
}
