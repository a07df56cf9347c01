//! A run is accessible only to its user, and only on its machine.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use skein_tests::{RunRecipe, RunningRun, processes_of, program};

/// Id of the user `nobody`, by convention; no account is needed.
const OTHER_USER: u32 = 65534;

/// Runs `program` as the other user.
fn as_other_user(program: &Path, arguments: &[&Path]) -> Output {
    Command::new(program)
        .args(arguments)
        .uid(OTHER_USER)
        .gid(OTHER_USER)
        .current_dir("/")
        .output()
        .unwrap()
}

/// Returns `true` if the other user's shell can do `action` to `path`, its first parameter.
fn other_user_can(action: &str, path: &Path) -> bool {
    let shell = [Path::new("-c"), Path::new(action), Path::new("sh"), path];
    as_other_user(Path::new("/bin/sh"), &shell).status.success()
}

const READ: &str = r#"head -c 1 < "$1" > /dev/null"#;
const WRITE: &str = r#": >> "$1""#;
const LIST: &str = r#"ls "$1""#;

fn set_mode(path: &Path, mode: u32) {
    fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
}

/// Starts a run in a folder that all users may enter, and waits until it flies.
fn flying_run() -> RunningRun {
    let mut run = RunRecipe::small().set("run.episodes=100").start();
    set_mode(run.directory().root().parent().unwrap(), 0o755);
    run.until_episodes(10);
    run
}

#[test]
fn another_user_can_neither_read_nor_write_nor_join() {
    if !rustix::process::geteuid().is_root() {
        eprintln!("skipped: only root can become another user");
        return;
    }
    let run = flying_run();
    let (identity, _) = run.directory().open().unwrap();
    let everybodys = tempfile::tempdir().unwrap();
    set_mode(everybodys.path(), 0o777);
    let (open, segment_prefix) = (
        everybodys.path().join("open"),
        format!("skein_{:016x}_", identity.run.0),
    );
    fs::write(&open, "x").unwrap();
    set_mode(&open, 0o666);
    for action in [READ, WRITE] {
        assert!(
            other_user_can(action, &open),
            "without this the test shows nothing"
        );
    }

    let segments: Vec<PathBuf> = fs::read_dir("/dev/shm")
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            path.file_name()
                .unwrap()
                .to_str()
                .unwrap()
                .starts_with(&segment_prefix)
        })
        .collect();
    assert!(segments.len() > 10, "{segments:?}");
    let files = [
        run.directory().identity(),
        run.directory().config(),
        run.directory().episodes_csv(),
        identity.transport_folder().join("incarnation"),
        identity.transport_folder().join("learner.lock"),
    ];
    for path in segments.iter().chain(&files) {
        // Files that an actor has removed cannot be read.
        assert!(
            !other_user_can(READ, path),
            "{} can be read",
            path.display()
        );
        assert!(
            !other_user_can(WRITE, path),
            "{} can be written",
            path.display()
        );
    }
    for folder in [run.directory().root(), &identity.transport_folder()] {
        assert!(
            !other_user_can(LIST, folder),
            "{} can be listed",
            folder.display()
        );
    }

    // The other user has all information about the run.
    let copy = everybodys.path().join("copy");
    let actor = everybodys.path().join("skein-actor");
    let copied = Command::new("cp")
        .arg("-r")
        .arg(run.directory().root())
        .arg(&copy)
        .status();
    assert!(copied.unwrap().success());
    let given = Command::new("chown")
        .arg("-R")
        .arg(OTHER_USER.to_string())
        .arg(&copy)
        .status();
    assert!(given.unwrap().success());
    fs::copy(program("skein-actor"), &actor).unwrap();
    chown(&actor, Some(OTHER_USER), None).unwrap();
    let joined = as_other_user(
        &actor,
        &[Path::new("--run"), &copy, Path::new("--id"), Path::new("7")],
    );
    let message = String::from_utf8_lossy(&joined.stderr);
    assert!(
        !joined.status.success() && message.contains("belongs to user 0"),
        "{joined:?}"
    );

    run.finish();
}

#[test]
fn nothing_listens_on_the_network() {
    let run = flying_run();
    let mut sockets = BTreeSet::new();
    let processes = processes_of(run.directory());
    assert!(
        processes.len() >= 4,
        "supervisor, learner and two actors: {processes:?}"
    );
    for process in processes {
        for descriptor in fs::read_dir(format!("/proc/{}/fd", process.pid())).unwrap() {
            // A descriptor that was closed meanwhile has no target.
            let Ok(target) = fs::read_link(descriptor.unwrap().path()) else {
                continue;
            };
            let target = target.to_string_lossy().into_owned();
            sockets.extend(
                target
                    .strip_prefix("socket:[")
                    .map(|inode| inode.trim_end_matches(']').to_owned()),
            );
        }
    }
    let kind_of = |kind: &str| -> Vec<String> {
        // A kernel without the protocol has no such file.
        let table = fs::read_to_string(format!("/proc/net/{kind}")).unwrap_or_default();
        table
            .lines()
            .filter(|line| line.split_whitespace().any(|field| sockets.contains(field)))
            .map(str::to_owned)
            .collect()
    };
    assert!(
        !kind_of("unix").is_empty(),
        "events use sockets of the file system: {sockets:?}"
    );
    for kind in [
        "tcp", "tcp6", "udp", "udp6", "udplite", "udplite6", "raw", "raw6", "packet",
    ] {
        assert_eq!(kind_of(kind), Vec::<String>::new(), "{kind}");
    }
    run.finish();
}
