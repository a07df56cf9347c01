//! Shared helpers of tests: a policy with random parameters, and a configuration with the shipped
//! courses.

use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::config::Config;
use skein_protocol::ids::PolicyVersion;
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};

/// Returns a snapshot with parameters uniform in about PyTorch's default range, so that values
/// neither vanish nor explode.
pub(crate) fn random_snapshot(layout: &SnapshotLayout, seed: u64) -> Snapshot {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut values = vec![0.0; layout.values()];
    for tensor in layout.tensors() {
        let bound = (tensor.shape[0] as f32 / tensor.range.len() as f32)
            .sqrt()
            .min(0.5);
        values[tensor.range.clone()].fill_with(|| rng.random_range(-bound..bound));
    }
    Snapshot {
        version: PolicyVersion(seed),
        values,
    }
}

/// Returns the default configuration with a small policy, the shipped courses, and `simulator` as
/// its simulator section.
pub(crate) fn config(simulator: &str) -> Config {
    let mut config = Config {
        simulator: toml::from_str(simulator).unwrap(),
        ..Config::default()
    };
    config.sac.hidden_width = 16;
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    let courses = &mut config.courses;
    for path in courses.paths_mut() {
        *path = configs.join(&*path);
    }
    config
}
