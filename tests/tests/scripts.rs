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

/// Scripts that users call.
fn scripts() -> Vec<String> {
    let of_folder = |folder: &'static str| {
        let entries = fs::read_dir(repository().join(folder)).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names
            .filter(|name| name.ends_with(".sh") && name != "common.sh")
            .map(move |name| format!("{folder}/{name}"))
    };
    ["launch", "tests"]
        .into_iter()
        .flat_map(of_folder)
        .collect()
}

#[test]
fn every_help_says_in_the_same_words_that_wrong_arguments_end_with_status_2() {
    let commands = [
        "run",
        "attach",
        "evaluate",
        "experiment",
        "report",
        "export",
        "encoder",
        "watch",
    ];
    let helps = scripts()
        .into_iter()
        .map(|script| {
            let shown = bash(&format!("{script} --help"));
            (script, shown)
        })
        .chain(commands.map(|command| {
            let shown = run_program("skein", &[command, "--help"]).stdout;
            (format!("skein {command}"), shown)
        }));
    let mut seen = 0;
    for (whose, shown) in helps {
        // Terminals of any width: the text may be wrapped.
        let shown = shown.split_whitespace().collect::<Vec<_>>().join(" ");
        let (_, status) = shown
            .rsplit_once("Exit status: 0 ")
            .unwrap_or_else(|| panic!("{whose} does not say what its exit status means"));
        assert!(status.contains(", 2 wrong arguments"), "{whose}: {status}");
        seen += 1;
    }
    assert!(seen >= 15, "{seen} commands and scripts");
}

#[test]
fn wrong_arguments_end_with_status_2_and_a_line_on_the_remedy() {
    for script in [
        "launch/setup.sh",
        "launch/test.sh",
        "launch/python.sh",
        "launch/peers.sh",
        "tests/bench.sh",
        "tests/fuzz.sh",
        "tests/viewers.sh",
        "tests/watched.sh",
    ] {
        let shown = bash(&format!("{script} --nonsense; echo status $?"));
        let help = format!("see {script} --help");
        for part in ["--nonsense", &help, "status 2"] {
            assert!(shown.contains(part), "`{part}` is missing in {shown}");
        }
    }
    for command in [
        "run",
        "attach",
        "evaluate",
        "experiment",
        "report",
        "export",
        "encoder",
    ] {
        let output = run_program("skein", &[command, "--nonsense"]);
        assert_eq!(output.code, Some(2), "{command}: {output:?}");
        assert!(
            output.stderr.contains("--nonsense"),
            "{command}: {output:?}"
        );
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
