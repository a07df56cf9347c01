//! What an action costs an actor as the policy grows wider.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion};
use skein_inference::{Network, Scratch};
use skein_protocol::config::{Observation, VaeSection, View};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let mut group = criterion.benchmark_group("policy_width");
    let view = View::present(Observation::LatentVelocity, VaeSection::default().latent);
    let observation = vec![0.1; view.len()];
    for width in [64, 128, 256, 512, 1024] {
        let layout = SnapshotLayout::new(&view, width);
        let snapshot = Snapshot {
            version: PolicyVersion(0),
            // Small, so that numbers neither vanish nor explode on their way through the layers.
            values: (0..layout.values())
                .map(|index| (index as f32 * 0.37).sin() * 0.03)
                .collect(),
        };
        let network = Network::new(&snapshot, &layout);
        let mut scratch = Scratch::default();
        group.bench_function(BenchmarkId::new("action", width), |bencher| {
            bencher.iter(|| black_box(network.distribution(black_box(&observation), &mut scratch)));
        });
    }
    group.finish();
    criterion.final_summary();
}
