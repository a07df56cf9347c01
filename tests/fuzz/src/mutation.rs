//! Mutates an input: bits, bytes, pieces, words and numbers.

use rand::{Rng, RngExt};

/// Replacements for a number or a word.
const NASTY: [&str; 30] = [
    "nan",
    "-nan",
    "inf",
    "-inf",
    "0",
    "-0",
    "0.0",
    "1",
    "-1",
    "255",
    "256",
    "65535",
    "65536",
    "4294967295",
    "4294967296",
    "9223372036854775807",
    "-9223372036854775808",
    "18446744073709551615",
    "1e38",
    "-1e38",
    "1e39",
    "1e308",
    "1e-46",
    "true",
    "[]",
    "{}",
    "\"\"",
    "null",
    "[[]]",
    "1979-05-27",
];

/// Changes `bytes` in one to eight ways. Inserts some of `words`, and pieces of `other`.
pub fn mutate(
    bytes: &mut Vec<u8>,
    other: &[u8],
    words: &[Vec<u8>],
    limit_bytes: usize,
    rng: &mut impl Rng,
) {
    for _ in 0..1 + rng.random_range(0..8_u32) * u32::from(rng.random::<bool>()) {
        change(bytes, other, words, rng);
    }
    bytes.truncate(limit_bytes);
}

fn change(bytes: &mut Vec<u8>, other: &[u8], words: &[Vec<u8>], rng: &mut impl Rng) {
    if bytes.is_empty() {
        bytes.extend_from_slice(piece(other, rng));
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    match rng.random_range(0..10_u32) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8_u32),
        1 => bytes[at] = rng.random(),
        2 => {
            let value: u64 = [
                0,
                1,
                u64::MAX,
                u64::MAX >> 1,
                1 << 63,
                1 << 31,
                1 << 32,
                255,
            ][rng.random_range(0..8_usize)];
            let width = [1, 2, 4, 8][rng.random_range(0..4_usize)].min(bytes.len() - at);
            bytes[at..at + width].copy_from_slice(&value.to_le_bytes()[..width]);
        }
        3 => replace(bytes, at..at, &[rng.random()]),
        4 => {
            let end = rng.random_range(at..=bytes.len());
            replace(bytes, at..end, &[]);
        }
        5 => {
            let copied = piece(bytes, rng).to_vec();
            replace(bytes, at..at, &copied);
        }
        6 => {
            let end = (at + piece(other, rng).len()).min(bytes.len());
            replace(bytes, at..end, piece(other, rng));
        }
        7 if !words.is_empty() => {
            let word = token(bytes, at);
            replace(bytes, word, &words[rng.random_range(0..words.len())]);
        }
        8 => {
            let word = token(bytes, at);
            replace(
                bytes,
                word,
                NASTY[rng.random_range(0..NASTY.len())].as_bytes(),
            );
        }
        _ => bytes.truncate(at),
    }
}

fn replace(bytes: &mut Vec<u8>, range: std::ops::Range<usize>, by: &[u8]) {
    bytes.splice(range, by.iter().copied());
}

/// Returns a piece of `bytes`, mostly a short one.
fn piece<'a>(bytes: &'a [u8], rng: &mut impl Rng) -> &'a [u8] {
    let start = rng.random_range(0..=bytes.len());
    let longest = (bytes.len() - start).min(if rng.random_range(0..4_u32) == 0 {
        usize::MAX
    } else {
        32
    });
    &bytes[start..start + rng.random_range(0..=longest)]
}

/// Returns the word or number around `at`.
fn token(bytes: &[u8], at: usize) -> std::ops::Range<usize> {
    let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"_.+-".contains(byte);
    let before = bytes[..at]
        .iter()
        .rev()
        .take_while(|byte| is_part(byte))
        .count();
    let after = bytes[at..].iter().take_while(|byte| is_part(byte)).count();
    at - before..at + after
}
