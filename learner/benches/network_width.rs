//! What a SAC update costs as its networks grow wider: batch 256, one thread.

use criterion::{BenchmarkId, Criterion};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::sac::{Batch, Columns, Sac};
use skein_protocol::ACTION;
use skein_protocol::config::{Observation, SacSection};
use tch::Device;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    use_threads(1);
    let observation = Observation::LatentVelocity;
    let rows = SacSection::default().batch_size;
    let mut noise = Noise::new(1);
    let mut draw = |width: usize| -> Vec<f32> { (0..rows * width).map(|_| noise.uniform(1.0)).collect() };
    let columns = [observation.len(), ACTION, 1, observation.len()].map(&mut draw);
    let terminated = vec![0.0; rows];

    let mut group = criterion.benchmark_group("network_width");
    for width in [64, 128, 256, 512, 1024] {
        let section = SacSection {
            hidden_width: width,
            ..SacSection::default()
        };
        let mut sac = Sac::new(&section, observation, 1, Device::Cpu);
        let mut noise = Noise::new(2);
        group.bench_function(BenchmarkId::new("sac_update", width), |bencher| {
            bencher.iter(|| {
                let [observations, actions, rewards, next_observations] = &columns;
                let columns = Columns {
                    observations,
                    actions,
                    rewards,
                    next_observations,
                    terminated: &terminated,
                };
                sac.update(&Batch::new(columns, Device::Cpu), &mut noise)
                    .expect("random rewards are finite")
            });
        });
    }
    group.finish();
    criterion.final_summary();
}
