//! The style that CONTRIBUTING asks for, as far as a program can see it.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::fs;
use std::path::{Path, PathBuf};

use skein_tests::repository;

/// Widest line of a source file, in characters.
const COLUMNS: usize = 100;

/// Words and phrases that a stranger stumbles over, and what to write instead.
const UNCLEAR: [(&str, &str); 9] = [
    ("anew", "again"),
    ("nought", "zero"),
    ("to be had", "available"),
    ("comes to the same", "has the same result"),
    ("is told", "is reported"),
    ("gone on with", "resumed"),
    ("goes on with", "resumes"),
    ("in earnest", "say what is meant"),
    ("in vain", "without success"),
];

/// First words of a doc comment that hide what it is about.
const HIDDEN_NOUN: [&str; 6] = ["Of ", "That ", "What ", "Who ", "Those ", "Whether "];

fn files(folder: &Path, extensions: &[&str], found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let is_ours = !name.starts_with('.') && name != "target" && name != "runs";
        if path.is_dir() && is_ours {
            files(&path, extensions, found);
        } else if path
            .extension()
            .is_some_and(|ending| extensions.iter().any(|one| ending == *one))
        {
            found.push(path);
        }
    }
}

/// Lines of all files with one of these extensions, each with where it stands.
fn lines(extensions: &[&str]) -> Vec<(String, String)> {
    let mut found = vec![];
    files(repository(), extensions, &mut found);
    // This file names what it forbids.
    found.retain(|path| !path.ends_with("tests/tests/style.rs"));
    let of = |path: PathBuf| {
        let shown = path
            .strip_prefix(repository())
            .unwrap()
            .display()
            .to_string();
        let text = fs::read_to_string(path).unwrap();
        let numbered = text.lines().enumerate();
        numbered
            .map(|(index, line)| (format!("{shown}:{}", index + 1), line.to_owned()))
            .collect::<Vec<_>>()
    };
    found.into_iter().flat_map(of).collect()
}

#[test]
fn no_line_of_code_is_wider_than_a_screen() {
    let wide: Vec<_> = lines(&["rs"])
        .into_iter()
        .filter(|(_, line)| line.chars().count() > COLUMNS)
        .map(|(place, _)| place)
        .collect();
    assert!(wide.is_empty(), "wider than {COLUMNS} columns: {wide:#?}");
}

#[test]
fn no_text_uses_words_that_a_stranger_stumbles_over() {
    let mut found = vec![];
    for (place, line) in lines(&["rs", "md", "toml", "sh"]) {
        let text = line.to_lowercase().replace('_', " ");
        let words = format!(
            " {} ",
            text.replace(|sign: char| !sign.is_alphanumeric(), " ")
        );
        for (unclear, better) in UNCLEAR {
            if words.contains(&format!(" {unclear} ")) {
                found.push(format!("{place}: \"{unclear}\": {better}"));
            }
        }
    }
    assert!(found.is_empty(), "{found:#?}");
}

/// First folders of absolute paths that code may name: they are on every machine.
const EVERYWHERE: [&str; 6] = ["bin", "dev", "etc", "proc", "sys", "tmp"];
/// First names of absolute paths that are only compared, topics of recordings and addresses of the
/// page among them. No file of them is ever looked for.
const ONLY_COMPARED: [&str; 18] = [
    "api",
    "camera",
    "courses",
    "d.toml",
    "drone",
    "elsewhere",
    "events",
    "frames",
    "m",
    "mine",
    "no-run-has-this-name",
    "page.css",
    "page.js",
    "plotly.js",
    "runs",
    "scene",
    "somewhere",
    "tests",
];

/// Returns the absolute paths at the beginning of the string literals in a line of code.
fn absolute_paths(line: &str) -> impl Iterator<Item = &str> {
    let quoted = line.split('"').skip(1);
    let is_path = |text: &&str| {
        text.strip_prefix('/').is_some_and(|rest| {
            rest.starts_with(|first: char| first.is_alphanumeric() || first == '_')
        })
    };
    quoted.filter(is_path)
}

fn is_foreign(path: &str) -> bool {
    let is_part = |sign: char| sign.is_alphanumeric() || "-_.".contains(sign);
    let first = path[1..].split(|sign| !is_part(sign)).next().unwrap_or("");
    !EVERYWHERE.contains(&first) && !ONLY_COMPARED.contains(&first)
}

#[test]
fn a_foreign_place_is_found_wherever_it_stands_in_a_line() {
    let found = |line: &str| absolute_paths(line).any(is_foreign);
    assert!(found(r#"open(&format!("{x}"), Path::new("/void/file"))"#));
    assert!(found(r#""/missing""#));
    for sound in [
        r#"("/dev/null", "/tmp")"#,
        r#"join("a/b")"#,
        r#""/m/run: x""#,
    ] {
        assert!(!found(sound), "{sound}");
    }
}

#[test]
fn no_test_counts_on_a_place_that_it_did_not_make() {
    let mut found = vec![];
    for (place, line) in lines(&["rs"]) {
        for path in absolute_paths(&line).filter(|path| is_foreign(path)) {
            found.push(format!("{place}: {path}"));
        }
    }
    assert!(
        found.is_empty(),
        "some machine has or lacks these: make a folder, or name a file missing in it: {found:#?}"
    );
}

#[test]
fn no_doc_comment_hides_its_noun() {
    let all = lines(&["rs"]);
    let mut found = vec![];
    for (previous, (place, line)) in std::iter::once("")
        .chain(all.iter().map(|(_, line)| line.as_str()))
        .zip(&all)
    {
        let is_doc = |line: &str| {
            line.trim_start().starts_with("///") || line.trim_start().starts_with("//!")
        };
        let Some(text) = line
            .trim_start()
            .strip_prefix("///")
            .or(line.trim_start().strip_prefix("//!"))
        else {
            continue;
        };
        let is_first = !is_doc(previous);
        if is_first
            && HIDDEN_NOUN
                .iter()
                .any(|hidden| text.trim_start().starts_with(hidden))
        {
            found.push(format!("{place}: {text}"));
        }
    }
    assert!(found.is_empty(), "{found:#?}");
}

/// Returns `true` if a line of code uses a printing macro of the standard library.
fn prints(line: &str) -> bool {
    let code = line.split("//").next().unwrap_or("");
    let is_name = |sign: char| sign.is_alphanumeric() || sign == '_';
    ["println", "eprintln", "print", "eprint", "dbg"]
        .iter()
        .any(|name| {
            code.match_indices(&format!("{name}!"))
                .any(|(place, _)| !code[..place].ends_with(is_name))
        })
}

#[test]
fn a_printing_macro_is_found_wherever_it_stands_in_a_line() {
    for line in [
        "println!(\"x\");",
        "None => eprint!(\"x\"),",
        "if x { std::print! { \"x\" } }",
        "(dbg!(x))",
    ] {
        assert!(prints(line), "{line}");
    }
    for line in ["note!(\"x\");", "/// As `println!` does.", "my_println!(x)"] {
        assert!(!prints(line), "{line}");
    }
}

#[test]
fn no_program_prints_with_macros_that_panic_when_the_terminal_is_gone() {
    let mut found = vec![];
    for (place, line) in lines(&["rs"]) {
        let is_program = place.contains("src/") && !place.contains("tests.rs");
        let is_test = place.contains("/tests/mod.rs") || place.contains("tests/src/");
        if is_program && !is_test && prints(&line) {
            found.push(place);
        }
    }
    assert!(
        found.is_empty(),
        "use show! and note! of skein-run: {found:#?}"
    );
}

/// Programs that end users start or that are started for them: files with a function `main`.
#[test]
fn every_program_survives_the_limit_of_file_sizes() {
    let mut found = vec![];
    files(repository(), &["rs"], &mut found);
    let mut programs = 0;
    for path in found {
        let is_program =
            path.ends_with("main.rs") || path.components().any(|part| part.as_os_str() == "bin");
        let text = fs::read_to_string(&path).unwrap();
        let Some((_, main)) = text.split_once("\nfn main() -> ExitCode {\n") else {
            continue;
        };
        if is_program {
            programs += 1;
            let first = main.lines().next().unwrap_or("");
            assert_eq!(
                first.trim(),
                "survive_file_size_limit();",
                "{}",
                path.display()
            );
        }
    }
    assert!(programs >= 6, "only {programs} programs were found");
}
