//! What the way of the records costs the learner: `cargo bench -p skein-learner --bench transport`.
//!
//! The learner's receiver, as in a run, in this process; synthetic actors, processes of their own,
//! which use the actors' ends of the services as actors do, and send whole episodes of valid
//! records as fast as they can. Nobody simulates and nobody learns, so what is left is transport,
//! assembly and delivery. The processor's time is the learner's own, so a machine with fewer cores
//! than actors shows whether a record costs more the more actors there are, though not how many
//! records a larger machine would move.
//!
//! Each figure is a line of JSON on standard output, with the baseline it is to be seen against,
//! measured beside it; a table for people goes to standard error. `--quick` measures for a moment
//! only, with the fewest and the most actors, to see that it works.

#![allow(
    clippy::unwrap_used,
    reason = "a benchmark fails by panicking, as tests do"
)]

mod learner;
mod report;
mod synthetic;

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use skein_learner::episodes::assembly::Keep;
use skein_run::allocation::keep_freed_memory;

use crate::learner::{Learner, Load, Throughput};
use crate::report::report;

/// First argument of a process that is to be a synthetic actor.
const SYNTHETIC_ACTOR: &str = "--synthetic-actor";
/// Numbers of actors that are tried.
const ACTORS: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [first, directory, number] = &arguments[..]
        && first == SYNTHETIC_ACTOR
    {
        return synthetic::serve(Path::new(directory), number.parse().unwrap());
    }
    let is_quick = arguments.iter().any(|argument| argument == "--quick");
    // Cargo says `--bench` to every benchmark; a number is one of actors to try instead of all.
    let chosen: Vec<u32> = arguments
        .iter()
        .filter_map(|argument| argument.parse().ok())
        .collect();
    // Ascending, for actors only come.
    let actors = match (is_quick, chosen.is_empty()) {
        (_, false) => chosen,
        (true, true) => vec![ACTORS[0], ACTORS[ACTORS.len() - 1]],
        (false, true) => ACTORS.to_vec(),
    };
    let seconds = if is_quick { 0.3 } else { 2.0 };
    keep_freed_memory();
    let mut learner = Learner::start();
    let mut least = BTreeMap::new();
    for count in actors {
        learner.start_actors(count);
        for (kept, keep) in [("_with_images", Keep::Depth), ("", Keep::Latents)] {
            let measured = learner.throughput(&Load {
                keep,
                warm_up: Duration::from_secs_f64(seconds / 4.0),
                measured: Duration::from_secs_f64(seconds),
            });
            let least = *least.entry(kept).or_insert(measured.process_micros);
            tell(count, kept, &measured, least);
        }
    }
    learner.finish();
}

/// Prints what was measured with `count` actors, of records of which `kept` is kept; with the least
/// number of actors, the learner needed `least` microseconds a record.
fn tell(count: u32, kept: &str, measured: &Throughput, least: f64) {
    let name = |figure: &str| format!("transport/{figure}{kept}/{count}");
    let copied = ("memcpy of the same bytes", measured.copy_micros);
    report(
        &name("records"),
        measured.records_per_second,
        "records/s",
        ("memcpy of the same bytes", 1e6 / measured.copy_micros),
    );
    report(
        &name("receiving_thread"),
        measured.thread_micros,
        "µs",
        copied,
    );
    report(
        &name("learner"),
        measured.process_micros,
        "µs",
        ("with the fewest actors", least),
    );
}
