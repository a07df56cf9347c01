//! Costs of transport for the learner: `cargo bench -p skein-learner --bench transport`.
//!
//! This process runs the learner's receiver as in a run. Synthetic actors are separate processes.
//! They use the actors' ends of the services and send whole episodes of valid records as fast as
//! they can. Nothing is simulated or learned, so what remains is transport, assembly and delivery.
//! Only the learner's own processor time is measured. So a machine with fewer cores than actors
//! still shows whether a record costs more with more actors, though not the throughput of a larger
//! machine.
//!
//! Each figure is one line of JSON on standard output, with a baseline measured beside it. A table
//! for people goes to standard error. `--quick` measures only briefly, with the fewest and the most
//! actors, to check that the benchmark works.

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

use skein_learner::episodes::assembly::KeptData;
use skein_run::allocation::keep_freed_memory;

use crate::learner::{Learner, Load, Throughput};
use crate::report::report;

/// First argument of a process that acts as a synthetic actor.
const SYNTHETIC_ACTOR: &str = "--synthetic-actor";
/// Numbers of actors to try.
const ACTORS: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [first, directory, number] = &arguments[..]
        && first == SYNTHETIC_ACTOR
    {
        return synthetic::serve(Path::new(directory), number.parse().unwrap());
    }
    let is_quick = arguments.iter().any(|argument| argument == "--quick");
    // Cargo passes `--bench` to every benchmark. A number selects a number of actors.
    let chosen: Vec<u32> = arguments
        .iter()
        .filter_map(|argument| argument.parse().ok())
        .collect();
    // Ascending, because actors are only added.
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
        for (kept, keep) in [("_with_images", KeptData::Depth), ("", KeptData::Latents)] {
            let measured = learner.throughput(&Load {
                keep,
                warm_up: Duration::from_secs_f64(seconds / 4.0),
                measured: Duration::from_secs_f64(seconds),
            });
            let least = *least.entry(kept).or_insert(measured.process_micros);
            print_figures(count, kept, &measured, least);
        }
    }
    learner.finish();
}

/// Prints the measurement with `count` actors. `kept`: suffix that names the kept data; `least`:
/// microseconds per record that the learner needed with the fewest actors.
fn print_figures(count: u32, kept: &str, measured: &Throughput, least: f64) {
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
