//! Allowed dependencies between packages. A package exists where a heavy dependency is confined;
//! this test holds the confinement.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand, PackageId};
use skein_tests::repository;

/// The folders at the top level, complete.
const FOLDERS: [&str; 7] = [
    "actor", "configs", "docs", "launch", "learner", "protocol", "tests",
];

/// Dependencies to consider: those of programs, or also those of tests.
#[derive(Clone, Copy, PartialEq)]
enum Of {
    Programs,
    Tests,
}

/// Returns the names of all direct and indirect dependencies of `package`.
fn dependencies(metadata: &Metadata, package: &str, of: Of) -> BTreeSet<String> {
    let resolve = metadata.resolve.as_ref().unwrap();
    let nodes: BTreeMap<&PackageId, _> =
        resolve.nodes.iter().map(|node| (&node.id, node)).collect();
    let packages = metadata.workspace_packages();
    let start = packages
        .iter()
        .find(|found| found.name.as_str() == package)
        .unwrap();
    let mut seen: BTreeSet<&PackageId> = BTreeSet::new();
    let mut to_see = vec![&start.id];
    while let Some(id) = to_see.pop() {
        for dependency in &nodes[id].deps {
            // Tests of a dependency do not matter.
            let for_tests = id == &start.id && of == Of::Tests;
            let counts = dependency
                .dep_kinds
                .iter()
                .any(|kind| for_tests || kind.kind != DependencyKind::Development);
            if counts && seen.insert(&dependency.pkg) {
                to_see.push(&dependency.pkg);
            }
        }
    }
    seen.iter()
        .map(|id| metadata[id].name.to_string())
        .collect()
}

fn metadata() -> Metadata {
    MetadataCommand::new()
        .manifest_path(repository().join("Cargo.toml"))
        // This machine's dependencies are all downloaded; those of other platforms may not be.
        .other_options(
            [
                "--locked",
                "--offline",
                "--filter-platform",
                env!("SKEIN_TARGET"),
            ]
            .map(str::to_owned),
        )
        .exec()
        .unwrap()
}

#[test]
fn every_package_has_only_its_allowed_dependencies() {
    let metadata = metadata();
    let of_ours: BTreeSet<String> = metadata
        .workspace_packages()
        .iter()
        .map(|package| package.name.to_string())
        .collect();
    let torch = &["tch", "torch-sys"][..];
    let physics = &["rapier3d", "parry3d"][..];
    let transport = &["iceoryx2", "iceoryx2-bb-posix"][..];
    let tokio = &["tokio"][..];
    for (package, allowed, forbidden) in [
        ("skein-simulator", &[][..], &[torch, transport, tokio][..]),
        ("skein-protocol", &[], &[torch, physics, transport, tokio]),
        (
            "skein-run",
            &["skein-protocol"],
            &[torch, physics, transport, tokio],
        ),
        (
            "skein-transport",
            &["skein-protocol", "skein-run"],
            &[torch, physics, tokio],
        ),
        ("skein-action", &[], &[torch, physics, transport, tokio]),
        ("skein-kernels", &[], &[torch, physics, transport, tokio]),
        (
            "skein-inference",
            &["skein-kernels", "skein-protocol"],
            &[torch, physics, transport, tokio],
        ),
        (
            "skein-rollout",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-simulator",
            ],
            &[torch, transport, tokio],
        ),
        (
            "skein-recordings",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-rollout",
                "skein-simulator",
            ],
            &[torch, transport, tokio],
        ),
        (
            "skein-evaluate",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-recordings",
                "skein-reports",
                "skein-rollout",
                "skein-run",
                "skein-simulator",
            ],
            &[torch, transport, tokio],
        ),
        (
            "skein-actor",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-recordings",
                "skein-rollout",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[torch, tokio],
        ),
        (
            "skein-learner",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-run",
                "skein-transport",
            ],
            &[physics],
        ),
        (
            "skein-encoder",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-learner",
                "skein-protocol",
                "skein-reports",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[],
        ),
        (
            "skein-prepare",
            &[
                "skein-protocol",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[torch],
        ),
        (
            "skein-reports",
            &["skein-protocol", "skein-run", "skein-simulator"],
            &[torch, transport],
        ),
        (
            "skein-export",
            &["skein-protocol"],
            &[torch, physics, transport, tokio],
        ),
        (
            "skein-python",
            &[
                "skein-export",
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-rollout",
                "skein-simulator",
            ],
            &[torch, transport, tokio],
        ),
        // What joins a run, and so the transport, is a wheel of its own.
        (
            "skein-python-actor",
            &[
                "skein-actor",
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-recordings",
                "skein-rollout",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[torch, tokio],
        ),
        // The page reads files: it can start, change and join nothing.
        (
            "skein-watch",
            &[
                "skein-inference",
                "skein-kernels",
                "skein-protocol",
                "skein-recordings",
                "skein-rollout",
                "skein-run",
                "skein-simulator",
            ],
            &[torch, transport],
        ),
        // An experiment starts `skein run`: it knows no supervisor.
        (
            "skein-experiments",
            &[
                "skein-prepare",
                "skein-protocol",
                "skein-reports",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[torch],
        ),
        (
            "skein-launch",
            &[
                "skein-evaluate",
                "skein-experiments",
                "skein-export",
                "skein-inference",
                "skein-kernels",
                "skein-prepare",
                "skein-protocol",
                "skein-recordings",
                "skein-reports",
                "skein-rollout",
                "skein-run",
                "skein-simulator",
                "skein-transport",
            ],
            &[torch],
        ),
        // The judge of a run trusts none of its programs.
        (
            "skein-chaos",
            &["skein-protocol", "skein-run"],
            &[torch, physics, transport],
        ),
    ] {
        for of in [Of::Programs, Of::Tests] {
            let found = dependencies(&metadata, package, of);
            // An action's numbers are known to all but the kernels.
            let common = |name: &&str| *name == "skein-action" && package != "skein-kernels";
            let ours = found.intersection(&of_ours).map(String::as_str);
            let ours: Vec<_> = ours.filter(|name| !common(name)).collect();
            assert_eq!(
                ours, allowed,
                "workspace packages that {package} depends on"
            );
            for fenced in forbidden.iter().copied().flatten() {
                assert!(!found.contains(*fenced), "{package} depends on {fenced}");
            }
        }
    }
}

#[test]
fn confined_dependencies_are_found_where_they_belong() {
    let metadata = metadata();
    for (package, inside) in [
        ("skein-learner", "tch"),
        ("skein-simulator", "rapier3d"),
        ("skein-transport", "iceoryx2"),
        ("skein-transport", "iceoryx2-bb-posix"),
        ("skein-learner", "tokio"),
        ("skein-rollout", "rapier3d"),
        ("skein-actor", "rapier3d"),
        ("skein-reports", "plotters"),
    ] {
        assert!(
            dependencies(&metadata, package, Of::Programs).contains(inside),
            "{package} does not depend on {inside}: this test would find nothing"
        );
    }
}

#[test]
fn the_top_level_has_exactly_the_fixed_folders() {
    let target = metadata().target_directory;
    let found: BTreeSet<String> = fs::read_dir(repository())
        .unwrap()
        .map(|entry| entry.unwrap())
        .filter(|entry| entry.path().is_dir() && entry.path() != target.as_std_path())
        .map(|entry| entry.file_name().into_string().unwrap())
        // Folders of runs and builds are not in the repository.
        .filter(|name| !name.starts_with('.') && name != "runs" && name != "target")
        .collect();
    assert_eq!(found, FOLDERS.map(str::to_owned).into_iter().collect());
}
