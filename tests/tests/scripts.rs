//! Scripts in `launch/` and `tests/`, called in unusual ways.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::os::unix::fs::symlink;
use std::process::Command;

use skein_tests::{repository, run_program};

/// Output of `script`, called as bash does in the repository.
fn bash(script: &str) -> String {
    let output = Command::new("bash")
        .args(["-c", script])
        .current_dir(repository())
        .output()
        .unwrap();
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

#[test]
fn every_script_finds_its_repository_through_a_link_and_with_cdpath_set() {
    let elsewhere = tempfile::tempdir().unwrap();
    for folder in ["launch", "tests"] {
        for entry in fs::read_dir(repository().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            if path.extension().is_none_or(|ending| ending != "sh") || name == "common.sh" {
                continue;
            }
            let link = elsewhere.path().join(&name);
            symlink(&path, &link).unwrap();
            let script = format!("{folder}/{name}");
            for called in [
                format!("CDPATH=. {script} --help"),
                format!("cd /; {} --help", link.display()),
            ] {
                let shown = bash(&called);
                assert!(shown.contains(&script), "{called}:\n{shown}");
                assert!(!shown.contains("No such file"), "{called}:\n{shown}");
            }
        }
    }
}

#[test]
fn a_build_continues_when_its_output_is_lost() {
    let script = "source launch/common.sh
        printf 'Compiling\\nFinished\\n' | say_once building >/dev/full && echo built";
    assert_eq!(bash(script), "built\n");
}

#[test]
fn settings_of_a_resumed_run_are_refused_with_what_to_do_instead() {
    let refused = |more: &[&str]| {
        let arguments = [&["run", "--resume", "/tmp/my run"], more].concat();
        let output = run_program("skein", &arguments);
        assert_eq!(output.code, Some(2), "{output:?}");
        assert!(!output.stderr.contains("Usage"), "{output:?}");
        output.stderr
    };
    let text = refused(&["--set", "run.seed=2"]);
    assert!(text.contains("--resume '/tmp/my run' alone"), "{text}");
    let text = refused(&["--set", "run.episodes=200"]);
    assert!(
        text.contains("--resume '/tmp/my run' --episodes N"),
        "{text}"
    );
}
