//! A SAC update beside the same update in JAX (`sac_peer.py`), on one thread and on two, in turns.
//!
//! `tests/bench.sh --only sac_peer` sets JAX up and names its Python in `SKEIN_PEER_PYTHON`.

mod common;

use std::env;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use skein_kernels::{Isa, Team};
use skein_learner::algorithm::{Algorithm, Inputs};
use skein_learner::noise::Noise;
use skein_learner::sac::NativeSac;
use skein_protocol::config::SacSection;

use common::{OBSERVATION, Transitions};

/// Updates of a sample, so that a clock's tick and JAX's call do not count.
const UPDATES: usize = 20;

/// Fastest samples: those of the machine at its least disturbed.
#[derive(Clone, Copy)]
struct Fastest {
    ours: f64,
    jax: f64,
}

fn main() {
    let quick = env::args().any(|argument| argument == "--quick");
    let (rounds, samples) = if quick { (1, 2) } else { (4, 30) };
    let python = env::var("SKEIN_PEER_PYTHON")
        .expect("SKEIN_PEER_PYTHON names a Python with JAX: run tests/bench.sh --only sac_peer");
    let mut fastest = [Fastest {
        ours: f64::INFINITY,
        jax: f64::INFINITY,
    }; 2];
    for _ in 0..rounds {
        for (threads, fastest) in (1..).zip(&mut fastest) {
            fastest.ours = fastest.ours.min(ours(threads, samples));
            fastest.jax = fastest.jax.min(jax(&python, threads, samples));
        }
    }
    // XLA may be slower on two threads than on one.
    print("jax/1", fastest[0].jax);
    print("jax/best", fastest[0].jax.min(fastest[1].jax));
    for (threads, fastest) in (1..).zip(fastest) {
        print(&threads.to_string(), fastest.ours);
        let [ours, jax] = [fastest.ours, fastest.jax].map(|secs| secs * 1e3);
        eprintln!("{threads} threads: {ours:.3} ms an update, JAX {jax:.3} ms");
    }
}

/// Prints a figure for the table, from the seconds of an update.
fn print(name: &str, secs: f64) {
    println!(
        "{{\"name\": \"sac_peer/{name}\", \"figure\": {:.1}, \"unit\": \"updates/s\"}}",
        1.0 / secs
    );
}

/// Returns the seconds of one of our updates in the fastest of `samples`.
fn ours(threads: usize, samples: usize) -> f64 {
    let section = SacSection::default();
    let transitions = Transitions::random(section.batch_size);
    let columns = transitions.columns();
    let mut sac = NativeSac::new(&section, Inputs::same(OBSERVATION), 1, Isa::best());
    let (mut team, mut noise) = (Team::new(threads), Noise::new(2));
    let mut sample = || {
        let begun = Instant::now();
        for _ in 0..UPDATES {
            sac.update(&mut team, columns, &mut noise)
                .expect("random rewards are finite");
        }
        begun.elapsed().as_secs_f64() / UPDATES as f64
    };
    sample();
    (0..samples).map(|_| sample()).fold(f64::INFINITY, f64::min)
}

/// Returns the seconds of one of JAX's updates in the fastest of `samples`.
fn jax(python: &str, threads: usize, samples: usize) -> f64 {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/sac_peer.py");
    // XLA's pool has a thread a core that the process may use.
    let cores = format!("0-{}", threads - 1);
    let output = Command::new("taskset")
        .args(["--cpu-list", &cores, python])
        .arg(script)
        .args([UPDATES, samples].map(|number| number.to_string()))
        .env("JAX_PLATFORMS", "cpu")
        .output()
        .expect("taskset (util-linux) is installed");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .map(|line| line.parse().expect("the script prints seconds"))
        .fold(f64::INFINITY, f64::min)
}
