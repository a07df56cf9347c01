//! What reads bytes from outside, one module a subject.

mod checkpoints;
mod configuration;
mod courses;
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
    /// Its name, and that of its folder in the corpus.
    pub name: &'static str,
    /// What it reads, for who chooses one.
    pub reads: &'static str,
    /// Inputs longer than this show nothing that shorter ones do not.
    pub longest_bytes: usize,
    /// Its part in a number of executions over all targets: slow ones get fewer.
    pub weight: usize,
    /// Valid inputs, made by the code that writes them or from what is shipped: no format has to be
    /// kept in step by hand.
    pub samples: fn() -> Vec<Vec<u8>>,
    /// Reads the input; panics when a promise is broken.
    pub run: fn(&[u8]) -> Verdict,
}

/// What the reader thought of an input. A target of which nothing is ever accepted would try no
/// promise.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Something of it was believed.
    Accepted,
    /// Nothing was.
    Refused,
}

impl Verdict {
    /// Accepted if there is a result, and refused if there is none.
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
    /// When the reader does, breaks a promise, or allocates without bounds.
    pub fn exercise(&self, bytes: &[u8]) -> Verdict {
        allocations::forget();
        let verdict = (self.run)(bytes);
        allocations::check();
        verdict
    }
}

/// Weight of a target that reads thousands of inputs a second.
const USUAL: usize = 200;

/// All of them.
pub static TARGETS: [Target; 23] = [
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
];

/// A file of the repository, by its path from the root.
fn shipped(path: &str) -> Vec<u8> {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    std::fs::read(format!("{root}/{path}")).unwrap()
}

/// `content` after a byte that says what it is.
fn tagged(kind: u8, content: &[u8]) -> Vec<u8> {
    [&[kind], content].concat()
}

/// The input as text; what is not UTF-8 is refused by whoever opens a file, before any reader of
/// ours sees it.
fn text(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(bytes).ok()
}
