//! Drives one target for as long as wanted, following coverage. Started by `tests/fuzz.sh`, which
//! builds it with the counters this takes.
//!
//! `SKEIN_FUZZ_TARGET` names the target; without it the targets are listed. Arguments are
//! libFuzzer's; the first is the folder of the growing corpus, into which the target's samples and
//! its committed inputs are written first.

#![no_main]

use std::path::Path;
use std::sync::OnceLock;
use std::{env, fs, process};

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_fuzz::mutation::mutate;
use skein_fuzz::{TARGETS, Target, committed, word_list};

/// What is driven.
struct Driven {
    target: &'static Target,
    inputs: Vec<Vec<u8>>,
    words: Vec<Vec<u8>>,
}

static DRIVEN: OnceLock<Driven> = OnceLock::new();

fn driven() -> &'static Driven {
    DRIVEN.get_or_init(|| {
        let name = env::var("SKEIN_FUZZ_TARGET").unwrap_or_else(|_| list());
        let Some(target) = TARGETS.iter().find(|target| target.name == name) else {
            eprintln!("skein-fuzz: there is no target `{name}`; the targets are those that it lists without one");
            process::exit(1);
        };
        let samples = (target.samples)();
        let words = word_list(&samples);
        let kept = committed(target).into_iter().map(|(_, bytes)| bytes);
        Driven {
            target,
            inputs: samples.into_iter().chain(kept).collect(),
            words,
        }
    })
}

/// Name, longest input, weight, and what is read, a line each.
fn list() -> ! {
    for target in &TARGETS {
        let Target {
            name,
            reads,
            longest_bytes,
            weight,
            ..
        } = target;
        println!("{name}\t{longest_bytes}\t{weight}\t{reads}");
    }
    process::exit(0);
}

/// Writes the inputs there are into the folder that is the first argument, if it is one.
fn begin() {
    let driven = driven();
    let Some(folder) = env::args()
        .nth(1)
        .filter(|folder| Path::new(folder).is_dir())
    else {
        return;
    };
    for (number, input) in driven.inputs.iter().enumerate() {
        if let Err(error) = fs::write(Path::new(&folder).join(format!("sample-{number}")), input) {
            eprintln!("skein-fuzz: {folder}: {error}");
            process::exit(1);
        }
    }
}

fuzz_target!(init: begin(), |bytes: &[u8]| {
    driven().target.exercise(bytes);
});

// Half of the time by libFuzzer's own mutations, which know what was compared with what; half by
// ours, which know words and numbers.
fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mut rng = Pcg64Mcg::seed_from_u64(seed.into());
    if rng.random() {
        return fuzzer_mutate(data, size, max_size);
    }
    let driven = driven();
    let mut input = data[..size].to_vec();
    let other = &driven.inputs[rng.random_range(0..driven.inputs.len())];
    mutate(&mut input, other, &driven.words, max_size, &mut rng);
    data[..input.len()].copy_from_slice(&input);
    input.len()
});
