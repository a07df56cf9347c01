//! Inputs worth keeping: found by long fuzzing because they reach what no sample reaches, or
//! because they once violated a guarantee.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::targets::Target;

/// Returns the files in `corpus/<target>/` and `regressions/<target>/` of this package, with their
/// names, in order.
///
/// # Panics
/// Panics if they cannot be read.
pub fn committed(target: &Target) -> Vec<(String, Vec<u8>)> {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    for folder in ["corpus", "regressions"] {
        let Ok(entries) = fs::read_dir(package.join(folder).join(target.name)) else {
            continue; // not every target has both
        };
        for entry in entries {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(package).unwrap().display().to_string();
            found.push((name, fs::read(&path).unwrap()));
        }
    }
    found.sort();
    found
}

/// Returns the words and numbers in the printable samples of a target: the vocabulary of its
/// grammar.
pub fn word_list(samples: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"_.+-".contains(byte);
    let words: BTreeSet<Vec<u8>> = samples
        .iter()
        .filter(|sample| sample.is_ascii())
        .flat_map(|sample| sample.split(|byte| !is_part(byte)))
        .filter(|word| (1..=32).contains(&word.len()))
        .map(<[u8]>::to_vec)
        .collect();
    words.into_iter().collect()
}
