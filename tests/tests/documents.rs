//! Documents that stay true: links, named files and symbols, commands and settings in them exist.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use skein_protocol::config::Config;
use skein_tests::repository;

/// Every Markdown file of the project, by path within the repository.
fn documents() -> Vec<PathBuf> {
    let mut found = vec![];
    for folder in ["", "docs", "docs/results"] {
        for entry in fs::read_dir(repository().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "md") {
                found.push(path.strip_prefix(repository()).unwrap().to_owned());
            }
        }
    }
    found.sort();
    assert!(found.len() > 20, "{found:?}");
    found
}

fn text(document: &Path) -> String {
    fs::read_to_string(repository().join(document)).unwrap()
}

/// Sources of the project: Rust files and scripts.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            if name != "target" && name != "runs" && !name.starts_with('.') {
                sources(&path, found);
            }
        } else if name.ends_with(".rs") || name.ends_with(".sh") {
            found.push(path);
        }
    }
}

fn all_sources() -> Vec<PathBuf> {
    let mut found = vec![];
    sources(repository(), &mut found);
    found
}

/// Parts of `text` between single backticks, outside of code blocks.
fn code_spans(text: &str) -> Vec<String> {
    let mut prose = String::new();
    for (index, part) in text.split("```").enumerate() {
        if index % 2 == 0 {
            prose.push_str(part);
        }
    }
    prose
        .split('`')
        .skip(1)
        .step_by(2)
        .map(str::to_owned)
        .collect()
}

/// Lines of the shell blocks of `text`; a line that ends with a backslash is joined to the next.
fn shell_lines(text: &str) -> Vec<String> {
    text.split("```sh\n")
        .skip(1)
        .flat_map(|block| {
            let block = block.split("```").next().unwrap().replace("\\\n", " ");
            block.lines().map(str::to_owned).collect::<Vec<_>>()
        })
        .collect()
}

/// The anchor that a heading gets on the usual hosts.
fn anchor(heading: &str) -> String {
    let plain = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = plain.chars().filter_map(|character| match character {
        ' ' => Some('-'),
        '-' | '_' => Some(character),
        _ => character.is_alphanumeric().then_some(character),
    });
    kept.collect()
}

fn anchors(document: &str) -> BTreeSet<String> {
    document
        .lines()
        .filter(|line| line.starts_with('#'))
        .map(anchor)
        .collect()
}

#[test]
fn the_top_has_only_the_documents_that_belong_there() {
    let top: Vec<_> = documents()
        .into_iter()
        .filter(|path| path.components().count() == 1)
        .collect();
    assert_eq!(
        top,
        ["CHANGELOG.md", "CONTRIBUTING.md", "README.md"].map(PathBuf::from)
    );
}

#[test]
fn documents_keep_to_their_length() {
    for (document, most) in [("README.md", 900), ("docs/architecture.md", 3000)] {
        let words = text(Path::new(document)).split_whitespace().count();
        assert!(
            words <= most,
            "{document} has {words} words, at most {most} are allowed"
        );
    }
}

#[test]
fn every_link_leads_somewhere() {
    for document in documents() {
        let content = text(&document);
        for link in content.split("](").skip(1) {
            let target = link.split(')').next().unwrap();
            if target.contains("://") {
                continue;
            }
            let (path, heading) = target.split_once('#').unwrap_or((target, ""));
            let file = match path {
                "" => repository().join(&document),
                path => repository().join(document.parent().unwrap()).join(path),
            };
            assert!(
                file.exists(),
                "{}: {target} does not exist",
                document.display()
            );
            if !heading.is_empty() {
                let there = anchors(&fs::read_to_string(&file).unwrap());
                let named = document.display();
                assert!(
                    there.contains(heading),
                    "{named}: {target} has no such heading: {there:?}"
                );
            }
        }
    }
}

#[test]
fn files_and_tests_that_are_named_exist() {
    let files = all_sources();
    let code: String = files
        .iter()
        .map(|path| fs::read_to_string(path).unwrap())
        .collect();
    for document in documents() {
        for span in code_spans(&text(&document)) {
            // `file.rs: test`
            for word in span.split([' ', ':', ',']).filter(|word| !word.is_empty()) {
                if word.ends_with(".rs") && !word.contains(['*', '<']) {
                    let known = files
                        .iter()
                        .any(|path| path.ends_with(word.trim_start_matches("./")));
                    assert!(known, "{}: there is no file {word}", document.display());
                }
                let is_claim = word.matches('_').count() >= 4
                    && word
                        .chars()
                        .all(|character| character.is_ascii_lowercase() || character == '_');
                if is_claim {
                    let known = code.contains(&format!("fn {word}("));
                    assert!(known, "{}: there is no test {word}", document.display());
                }
            }
        }
    }
}

#[test]
fn scripts_configurations_and_settings_in_commands_exist() {
    let mut seen = 0;
    for document in documents() {
        for line in shell_lines(&text(&document)) {
            let command = line.split(" #").next().unwrap();
            let words: Vec<_> = command
                .split_whitespace()
                .map(|word| word.trim_matches('\''))
                .collect();
            for (index, word) in words.iter().enumerate() {
                let shown = format!("{}: {command}", document.display());
                if (word.starts_with("launch/")
                    || word.starts_with("tests/")
                    || word.starts_with("configs/"))
                    && !word.contains(['*', '='])
                {
                    assert!(
                        repository().join(word).exists(),
                        "{shown}: {word} does not exist"
                    );
                    seen += 1;
                }
                if *word == "--set" {
                    let setting = words[index + 1];
                    check_setting(setting, &shown);
                    seen += 1;
                }
                if word.ends_with("experiment.sh") && !words[index + 1].starts_with('-') {
                    let file = format!("configs/experiments/{}.toml", words[index + 1]);
                    assert!(
                        repository().join(&file).exists() || words[index + 1] == "NAME",
                        "{shown}: {file}"
                    );
                }
            }
        }
    }
    assert!(seen > 30, "only {seen} commands were found");
}

/// Asserts that a run of the default configuration takes `setting`, as far as the key is concerned.
fn check_setting(setting: &str, shown: &str) {
    let config = repository().join("configs/local.toml");
    if let Err(error) = Config::load(&config, &[setting.to_owned()]) {
        let text = error.to_string();
        assert!(!text.contains("unknown"), "{shown}: {text}");
    }
}
