//! Finds and runs the built programs.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

/// Returns the repository's root.
pub fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("this package lies in the repository")
}

/// Returns the path of the program `name` from the build of the running test.
///
/// # Panics
/// Panics if it does not exist: cargo builds the programs of other packages only on request.
pub fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    // target/release/deps/determinism-0123456789abcdef
    let built = test.ancestors().nth(2).expect("tests lie two folders deep");
    let path = built.join(name);
    assert!(
        path.is_file(),
        "{} is not built: run `cargo build --release --workspace --bins` first, as launch/test.sh \
         does",
        path.display()
    );
    path
}

/// ProgramOutput and exit status of a program.
#[derive(Debug)]
pub struct ProgramOutput {
    /// Exit status; `None` if a signal killed it.
    pub code: Option<i32>,
    /// Its standard output.
    pub stdout: String,
    /// Its standard error.
    pub stderr: String,
}

impl ProgramOutput {
    pub(crate) fn of(status: ExitStatus, stdout: &[u8], stderr: &[u8]) -> Self {
        Self {
            code: status.code(),
            stdout: String::from_utf8_lossy(stdout).into_owned(),
            stderr: String::from_utf8_lossy(stderr).into_owned(),
        }
    }

    /// Asserts that the program failed, with all of `parts` in one line on standard error.
    ///
    /// # Panics
    /// Panics if it did not.
    pub fn assert_refused(&self, parts: &[&str]) {
        assert_eq!(self.code, Some(1), "{self:?}");
        let says_it = |line: &str| parts.iter().all(|part| line.contains(part));
        assert!(
            self.stderr.lines().any(says_it),
            "no line contains all of {parts:?}:\n{}",
            self.stderr
        );
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
    }
}

/// Runs the built program `name` to its end. For programs that end by themselves within seconds,
/// because no time limit applies.
///
/// # Panics
/// Panics if it cannot be started.
pub fn run_program<A: AsRef<OsStr>>(name: &str, arguments: &[A]) -> ProgramOutput {
    let output = Command::new(program(name))
        .args(arguments)
        .output()
        .unwrap();
    ProgramOutput::of(output.status, &output.stdout, &output.stderr)
}
