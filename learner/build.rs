//! Sets the run-time path of libtorch, so that binaries and tests start without `LD_LIBRARY_PATH`,
//! and the commit that the learner reports as its version.

use std::path::Path;
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=DEP_TCH_LIBTORCH_LIB");
    // Set by torch-sys for the packages that depend on it directly.
    if let Ok(libtorch) = std::env::var("DEP_TCH_LIBTORCH_LIB") {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{libtorch}");
    }
    let version = env!("CARGO_PKG_VERSION");
    match commit() {
        Some(commit) => println!("cargo:rustc-env=SKEIN_VERSION={version}+{commit}"),
        None => println!("cargo:rustc-env=SKEIN_VERSION={version}"),
    }
}

/// Paths that learning depends on: the packages that fly and learn, and their build files.
const SOURCES: [&str; 5] = ["Cargo.toml", "Cargo.lock", "learner", "protocol", "actor"];

/// Returns the last commit that changed one of the [`SOURCES`], with `-dirty` appended if they
/// differ from it or new files are among them. Returns `None` outside a clone, and if none of them
/// was ever committed.
fn commit() -> Option<String> {
    let package = std::env::var_os("CARGO_MANIFEST_DIR")?;
    let root = Path::new(&package).parent()?;
    // Sources copied into another repository do not belong to its commits.
    if Path::new(&git(root, &["rev-parse", "--show-toplevel"])?) != root.canonicalize().ok()? {
        return None;
    }
    // The last path changes with every commit. A path that does not exist would make cargo run this
    // script at every build.
    let moves = git(root, &["rev-parse", "--git-path", "logs/HEAD"])?;
    for path in SOURCES.into_iter().chain([moves.as_str()]) {
        let path = root.join(path);
        if path.exists() {
            println!("cargo:rerun-if-changed={}", path.display());
        }
    }
    let of_sources = |command: &[&str]| git(root, &[command, &["--"], &SOURCES].concat());
    let commit = of_sources(&["log", "-1", "--format=%h", "--abbrev=12"])
        .filter(|commit| !commit.is_empty())?;
    let is_clean = of_sources(&["status", "--porcelain"])?.is_empty();
    Some(if is_clean {
        commit
    } else {
        format!("{commit}-dirty")
    })
}

fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let output = Command::new("git")
        .arg("-C")
        .arg(root)
        .args(arguments)
        .output()
        .ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
