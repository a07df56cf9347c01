//! Benchmark of the policy at growing widths.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion};
use skein_inference::{Network, Scratch};
use skein_protocol::config::{Observation, ObservationLayout, VaeSection};
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let mut group = criterion.benchmark_group("policy_width");
    let observation_layout =
        ObservationLayout::present(Observation::LatentVelocity, VaeSection::default().latent);
    let observation = vec![0.1; observation_layout.len()];
    for width in [64, 128, 256, 512, 1024] {
        let layout = SnapshotLayout::new(&observation_layout, width);
        let snapshot = Snapshot {
            version: PolicyVersion(0),
            // Small values, so that they neither vanish nor explode through the layers.
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
