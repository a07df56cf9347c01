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

/// Places that a test might take for missing: some machines have them.
const FOREIGN_PLACES: [&str; 3] = ["/nonexistent", "/nowhere", "/no/such"];

#[test]
fn no_test_counts_on_a_place_that_it_did_not_make() {
    let found: Vec<_> = lines(&["rs"])
        .into_iter()
        .filter(|(_, line)| FOREIGN_PLACES.iter().any(|place| line.contains(place)))
        .map(|(place, line)| format!("{place}: {line}: make a folder, name a file missing in it"))
        .collect();
    assert!(found.is_empty(), "{found:#?}");
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

#[test]
fn no_program_prints_with_macros_that_panic_when_the_terminal_is_gone() {
    let mut found = vec![];
    for (place, line) in lines(&["rs"]) {
        let is_program = place.contains("src/") && !place.contains("tests.rs");
        let is_test = place.contains("/tests/mod.rs") || place.contains("tests/src/");
        let prints = ["println!(", "eprintln!(", "print!(", "eprint!("]
            .iter()
            .any(|printing| line.trim_start().starts_with(printing));
        if is_program && !is_test && prints {
            found.push(place);
        }
    }
    assert!(
        found.is_empty(),
        "use show! and note! of skein-run: {found:#?}"
    );
}
