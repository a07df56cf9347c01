//! How long an actor thinks: milliseconds for each depth image and each action, on one thread.
//!
//! `cargo run --release -p skein-actor --example inference_time`

use std::hint::black_box;
use std::time::Instant;

use skein_actor::inference::{Network, Scratch};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

fn main() {
    let layout = SnapshotLayout::new(32, 256);
    let values = (0..layout.values())
        .map(|index| (index as f32 * 0.37).sin() * 0.03)
        .collect();
    let snapshot = Snapshot {
        version: PolicyVersion(0),
        values,
    };
    let network = Network::new(&snapshot, &layout);
    let mut scratch = Scratch::default();
    let image: [u8; IMAGE_PIXELS] = std::array::from_fn(|pixel| (pixel * 7) as u8);

    report("rearranging a snapshot", 20, || {
        drop(black_box(Network::new(&snapshot, &layout)))
    });
    report("encoding an image", 500, || {
        black_box(network.encode(black_box(&image), &mut scratch));
    });
    report("choosing an action", 5000, || {
        black_box(network.distribution(black_box(&[0.1; 32]), &mut scratch));
    });
}

/// Prints the median, which a busy machine disturbs least, and the least time of `runs`.
fn report(what: &str, runs: usize, mut run: impl FnMut()) {
    let mut millis: Vec<f64> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    millis.sort_by(f64::total_cmp);
    println!("{what}: median {:.3} ms, least {:.3} ms", millis[runs / 2], millis[0]);
}
