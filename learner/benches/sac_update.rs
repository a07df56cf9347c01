//! A SAC update, batch 256, on one thread: native with networks of growing width, and on libtorch
//! with automatic gradients.

mod common;

use criterion::{BenchmarkId, Criterion, Throughput};
use skein_kernels::{Isa, Team};
use skein_learner::algorithm::{Algorithm, Columns, Inputs};
use skein_learner::device::use_threads;
use skein_learner::noise::Noise;
use skein_learner::sac::{NativeSac, TorchSac};
use skein_protocol::config::{Engine, SacSection};
use tch::Device;

use common::{ACTION, OBSERVATION, Transitions};

/// Default width of hidden layers.
const WIDTH: usize = 256;

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    use_threads(1);
    let transitions = Transitions::random(SacSection::default().batch_size);
    let columns = transitions.columns();
    for width in [64, 128, WIDTH, 512, 1024] {
        update(&mut criterion, Engine::Native, width, columns);
    }
    update(&mut criterion, Engine::Libtorch, WIDTH, columns);
    criterion.final_summary();
}

fn update(criterion: &mut Criterion, engine: Engine, width: usize, columns: Columns<'_>) {
    let section = SacSection {
        hidden_width: width,
        ..SacSection::default()
    };
    let inputs = Inputs::same(OBSERVATION);
    let mut sac: Box<dyn Algorithm> = match engine {
        Engine::Native => Box::new(NativeSac::new(&section, inputs, 1, Isa::best())),
        Engine::Libtorch => Box::new(TorchSac::new(&section, inputs, 1, Device::Cpu)),
    };
    let (mut team, mut noise) = (Team::new(1), Noise::new(2));
    let mut group = criterion.benchmark_group("sac_update");
    group.throughput(Throughput::Elements(operations(
        columns.rewards.len(),
        width,
    )));
    group.bench_function(BenchmarkId::new(engine.to_string(), width), |bencher| {
        bencher.iter(|| {
            sac.update(&mut team, columns, &mut noise)
                .expect("random rewards are finite")
        });
    });
    group.finish();
}

/// Floating-point operations of an update's necessary matrix products; a multiplication and an
/// addition count as two. Nothing else is counted.
fn operations(rows: usize, width: usize) -> u64 {
    let (observation, estimates) = (OBSERVATION, 2);
    // Number of weights: the policy's layers, and the critic's.
    let policy_first = observation * width;
    let policy_rest = 2 * width * width + width * 2 * ACTION;
    let critic_first = (observation + ACTION) * width;
    let critic_rest = width * width + width * estimates;
    let forward = 2 * (policy_first + policy_rest) + 3 * (critic_first + critic_rest);
    // Weight gradients of all layers; gradients through all layers but the first ones; and once
    // more through the critic, to the action only.
    let gradients = policy_first + policy_rest + critic_first + critic_rest;
    let back = policy_rest + 2 * critic_rest + width * ACTION;
    (2 * rows * (forward + gradients + back)) as u64
}
