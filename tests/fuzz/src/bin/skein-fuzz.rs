//! Fuzzes one target for any length of time, guided by coverage. `tests/fuzz.sh` builds it with
//! coverage counters and starts it.
//!
//! `SKEIN_FUZZ_TARGET` names the target; without it the targets are listed. Arguments are
//! libFuzzer's; the first is the folder of the growing corpus. The target's samples and committed
//! inputs are written into it first.

#![no_main]

use std::path::Path;
use std::sync::OnceLock;
use std::{env, fs, process};

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_fuzz::mutation::mutate;
use skein_fuzz::{TARGETS, Target, committed, word_list};
use skein_run::{note, show};

/// Target with its inputs and word list.
struct FuzzedTarget {
    target: &'static Target,
    inputs: Vec<Vec<u8>>,
    words: Vec<Vec<u8>>,
}

static FUZZED: OnceLock<FuzzedTarget> = OnceLock::new();

fn fuzzed_target() -> &'static FuzzedTarget {
    FUZZED.get_or_init(|| {
        let name = env::var("SKEIN_FUZZ_TARGET").unwrap_or_else(|_| list());
        let Some(target) = TARGETS.iter().find(|target| target.name == name) else {
            note!(
                "skein-fuzz: there is no target `{name}`; run it without SKEIN_FUZZ_TARGET for a \
                 list"
            );
            process::exit(1);
        };
        let samples = (target.samples)();
        let words = word_list(&samples);
        let kept = committed(target).into_iter().map(|(_, bytes)| bytes);
        FuzzedTarget {
            target,
            inputs: samples.into_iter().chain(kept).collect(),
            words,
        }
    })
}

/// Prints name, longest input, weight and description of each target, one per line.
fn list() -> ! {
    for target in &TARGETS {
        let Target {
            name,
            reads,
            longest_bytes,
            weight,
            ..
        } = target;
        show!("{name}\t{longest_bytes}\t{weight}\t{reads}");
    }
    process::exit(0);
}

/// Writes the existing inputs into the folder named by the first argument, if it is one.
fn begin() {
    let fuzzed_target = fuzzed_target();
    let Some(folder) = env::args()
        .nth(1)
        .filter(|folder| Path::new(folder).is_dir())
    else {
        return;
    };
    for (number, input) in fuzzed_target.inputs.iter().enumerate() {
        if let Err(error) = fs::write(Path::new(&folder).join(format!("sample-{number}")), input) {
            note!("skein-fuzz: {folder}: {error}");
            process::exit(1);
        }
    }
}

fuzz_target!(init: begin(), |bytes: &[u8]| {
    fuzzed_target().target.exercise(bytes);
});

// Half of the mutations are libFuzzer's, which know compared values; the other half are Skein's,
// which know words and numbers.
fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mut rng = Pcg64Mcg::seed_from_u64(seed.into());
    if rng.random() {
        return fuzzer_mutate(data, size, max_size);
    }
    let fuzzed_target = fuzzed_target();
    let mut input = data[..size].to_vec();
    let other = &fuzzed_target.inputs[rng.random_range(0..fuzzed_target.inputs.len())];
    mutate(&mut input, other, &fuzzed_target.words, max_size, &mut rng);
    data[..input.len()].copy_from_slice(&input);
    input.len()
});
