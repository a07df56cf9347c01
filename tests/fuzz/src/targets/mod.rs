//! Readers of outside bytes, one module per subject.

mod checkpoints;
mod configuration;
mod courses;
mod recordings;
mod records;
mod replay;
mod reports;
mod runs;
mod signals;
mod snapshots;

use crate::allocations;

/// A reader of outside bytes.
#[derive(Debug)]
pub struct Target {
    /// Its name, also that of its folder in the corpus.
    pub name: &'static str,
    /// Description of what it reads.
    pub reads: &'static str,
    /// Length beyond which inputs add nothing new.
    pub longest_bytes: usize,
    /// Relative share of executions among all targets: slow ones get fewer.
    pub weight: usize,
    /// Valid inputs, made by the code that writes them or from shipped files, so that no format is
    /// maintained by hand.
    pub samples: fn() -> Vec<Vec<u8>>,
    /// Reads the input; panics if a guarantee is violated.
    pub run: fn(&[u8]) -> ReaderDecision,
}

/// Decision of a reader on an input. A target that never accepts anything would test no guarantee.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReaderDecision {
    /// At least a part was accepted.
    Accepted,
    /// Nothing was accepted.
    Refused,
}

impl ReaderDecision {
    /// Returns `Accepted` for a result, and `Refused` for `None`.
    fn of<T>(result: Option<T>) -> Self {
        match result {
            Some(_) => Self::Accepted,
            None => Self::Refused,
        }
    }
}

impl Target {
    /// Reads `bytes`.
    ///
    /// # Panics
    /// Panics if the reader panics, violates a guarantee, or allocates too much.
    pub fn exercise(&self, bytes: &[u8]) -> ReaderDecision {
        allocations::forget();
        let verdict = (self.run)(bytes);
        allocations::check();
        verdict
    }
}

/// Weight of a target that reads thousands of inputs per second.
const USUAL: usize = 200;

/// All targets.
pub static TARGETS: [Target; 26] = [
    configuration::CONFIG,
    configuration::OVERRIDES,
    configuration::SIMULATOR,
    configuration::EXPERIMENT,
    courses::FILE,
    courses::LAYOUT,
    courses::GENERATOR,
    courses::SUITE,
    records::RECORDS,
    signals::SIGNALS,
    snapshots::FILE,
    snapshots::RECEIVED,
    snapshots::ENCODER,
    snapshots::DECODER,
    checkpoints::FILES,
    replay::REPLAY,
    checkpoints::EPISODES_CSV,
    checkpoints::EVENT_FILES,
    runs::IDENTITY,
    runs::ANNOUNCEMENT,
    runs::RESULTS,
    runs::PROGRESS,
    reports::FILES,
    reports::PICTURES,
    reports::CURVES,
    recordings::FILE,
];

/// Returns a file of the repository, by its path from the root.
fn shipped(path: &str) -> Vec<u8> {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    std::fs::read(format!("{root}/{path}")).unwrap()
}

/// Returns `content` after a byte that selects its kind.
fn tagged(kind: u8, content: &[u8]) -> Vec<u8> {
    [&[kind], content].concat()
}

/// Returns the input as text. Other bytes are refused when a file is opened, before any reader of
/// Skein sees them.
fn text(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(bytes).ok()
}
