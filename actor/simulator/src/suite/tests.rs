//! Suites: which courses they fly, and which files are refused.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use super::*;
use crate::course::{GeneratedShape, Shape};

fn configs() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs")
}

fn generalist() -> Suite {
    Suite::load(configs().join("evaluations/generalist.toml")).unwrap()
}

fn entry<'a>(suite: &'a Suite, name: &str) -> &'a SuiteEntry {
    suite
        .entries
        .iter()
        .find(|entry| entry.name == name)
        .unwrap()
}

fn labels(course: &Course) -> Vec<u32> {
    course.walls().iter().map(|wall| wall.label().0).collect()
}

#[test]
fn a_suite_is_used_whole_or_refused() {
    let refused = |entry: &str, parts: &[&str]| {
        let text = format!("name = \"x\"\nepisodes = 1\n[[entry]]\nname = \"one\"\n{entry}");
        let message = Suite::parse(&text, "x.toml").unwrap_err().to_string();
        assert!(!message.contains('\n'), "{message:?}");
        for part in parts {
            assert!(message.contains(part), "`{part}` is missing in {message}");
        }
    };
    for key in ["course", "orders_of"] {
        let named = format!("{key} = \"\" names no file");
        refused(
            &format!("{key} = \"\""),
            &["x.toml", "entry \"one\"", &named],
        );
    }
    let corridor = "[entry.generated]\ncorridor = [60.0, 6.0, 7.0, 9.0]";
    refused(corridor, &["x.toml", "corridor"]);
    for (key, count) in [("clearance_m", 3), ("rotation_deg", 1)] {
        let numbers = &"0.9, 1.0, 1.1"[..5 * count - 2];
        let entry = format!("[entry.generated]\n{key} = [{numbers}]");
        let problem = format!("has {count} numbers: give 2");
        refused(&entry, &["x.toml", "line 6", &problem]);
    }
}

#[test]
fn the_generalist_suite_has_seven_thousand_episodes() {
    let suite = generalist();
    assert_eq!(suite.entries.len(), 7);
    assert!(suite.entries.iter().all(|entry| entry.episodes == 1000));
    let disturbed: Vec<_> = suite
        .entries
        .iter()
        .filter(|entry| entry.disturbances != DisturbanceSettings::default())
        .collect();
    assert_eq!(disturbed.len(), 1);
    let DisturbanceSettings {
        share,
        mass_spread,
        latency_periods,
        ref gust,
        ref depth,
    } = disturbed[0].disturbances;
    assert_eq!((share, mass_spread, latency_periods), (1.0, 0.2, 1));
    assert!(
        gust.force_rms_n > 0.0 && depth.dropout_share > 0.0 && depth.sigma_quadratic_per_m > 0.0
    );
}

#[test]
fn all_orders_are_flown_equally_often_and_the_first_is_the_files_own() {
    let suite = generalist();
    let orders = entry(&suite, "all 120 orders");
    let flown: Vec<_> = (0..240)
        .map(|episode| labels(&orders.courses.of_episode(episode).unwrap()))
        .collect();
    assert_eq!(flown[0], [1, 2, 3, 4, 5]);
    assert_eq!(flown[..120].iter().collect::<HashSet<_>>().len(), 120);
    assert_eq!(flown[..120], flown[120..]);
    // A few episodes are spread over all orders as well.
    for first in 1..=5 {
        let starts = flown[..20].iter().filter(|order| order[0] == first).count();
        assert!(
            (3..=5).contains(&starts),
            "{starts} of 20 start with wall {first}"
        );
    }
    // A wall keeps its opening wherever it stands.
    let training = Course::load(configs().join("courses/training.toml")).unwrap();
    for episode in [1, 77, 119] {
        let course = orders.courses.of_episode(episode).unwrap();
        for (wall, place) in course.walls().iter().zip(training.walls()) {
            let same = training
                .walls()
                .iter()
                .find(|other| other.label() == wall.label());
            assert_eq!(wall.opening(), same.unwrap().opening());
            assert_eq!(wall.x_m(), place.x_m());
        }
    }
}

#[test]
fn held_out_courses_hold_only_held_out_shapes_with_the_disc_they_name() {
    let suite = generalist();
    for (name, radius_m) in [
        ("held-out shapes, disc of 1.0 m", 1.0),
        ("held-out shapes, disc of 0.75 m", 0.75),
    ] {
        let held_out = entry(&suite, name);
        let EntryCourses::Generated { ranges, .. } = &held_out.courses else {
            panic!("{name} generates its courses");
        };
        let kinds: HashSet<_> = ranges.shapes.iter().collect();
        assert_eq!(kinds, GeneratedShape::HELD_OUT.iter().collect());
        let mut outlines = HashSet::new();
        for episode in 0..100 {
            let course = held_out.courses.of_episode(episode).unwrap();
            for wall in course.walls() {
                assert!(
                    (wall.clearance_m() - radius_m).abs() < 0.003,
                    "{}",
                    wall.clearance_m()
                );
                assert!(!matches!(
                    wall.opening().shape,
                    Shape::Rectangle { .. } | Shape::Polygon { .. }
                ));
            }
            outlines.insert(format!("{:?}", course.walls()[0].outline()));
        }
        assert_eq!(outlines.len(), 100, "every episode has its own course");
    }
}

#[test]
fn the_non_rectangular_gates_are_the_held_out_families() {
    let gates = Course::load(configs().join("courses/non_rectangular.toml")).unwrap();
    let names: HashSet<_> = gates
        .walls()
        .iter()
        .map(|wall| wall.opening().shape.name())
        .collect();
    assert_eq!(
        names,
        GeneratedShape::HELD_OUT
            .iter()
            .map(|shape| shape.name())
            .collect()
    );
}

#[test]
fn a_suite_that_cannot_be_flown_is_refused_by_file_entry_and_key() {
    let path = configs().join("evaluations/x.toml");
    let refusal = |text: &str| Suite::parse(text, &path).unwrap_err().to_string();
    let of_entry = |keys: &str| {
        refusal(&format!(
            "name = \"x\"\nepisodes = 2\n[[entry]]\nname = \"one\"\n{keys}"
        ))
    };
    for (message, expected) in [
        (refusal("name = \"x\""), "has 0 [[entry]] tables"),
        (refusal("name = 3"), "line 1: invalid type"),
        (
            refusal("name = \"x\"\nepisods = 2\n"),
            "line 2: unknown field `episods`",
        ),
        (
            of_entry(""),
            "entry \"one\": names its courses by 0 of the keys",
        ),
        (
            of_entry(
                "course = \"../courses/training.toml\"\norders_of = \"../courses/training.toml\"",
            ),
            "names its courses by 2 of the keys",
        ),
        (of_entry("course = \"none.toml\""), "none.toml"),
        (
            of_entry("course = \"../courses/training.toml\"\nfirst_seed = 3"),
            "has first_seed",
        ),
        (
            of_entry("course = \"../courses/training.toml\"\nepisodes = 0"),
            "episodes = 0 is outside",
        ),
        (
            of_entry("generated.shapes = [\"circle\", \"cross\", \"circle\"]"),
            "generated.shapes lists \"circle\" twice",
        ),
        (
            of_entry("[entry.generated]\n[[entry]]\nname = \"\\u001b[2J\""),
            "entry \"\\u{1b}[2J\": its name cannot be shown",
        ),
        (
            of_entry("[entry.generated]\n[[entry]]\nname = \"\\u202e\""),
            "its name cannot be shown",
        ),
        (
            of_entry("[entry.generated]\n[[entry]]\nname = \" \""),
            "entry \" \": its name cannot be shown",
        ),
        (
            refusal("name = \"a\\tb\"\nepisodes = 2\n[[entry]]\nname = \"one\"\ngenerated = {}"),
            "name = \"a\\tb\" cannot be shown",
        ),
        (
            of_entry("generated = {}\nfirst_seed = 9223372036854775808"),
            "line 6: `first_seed` = 9223372036854775808 is outside",
        ),
        (
            of_entry("generated = {}\nfirst_seed = 0xffff_ffff_ffff_ffff"),
            "line 6: `first_seed` = 0xffff_ffff_ffff_ffff is outside",
        ),
        (
            of_entry("generated.clearance_m = [0.3, 0.3]"),
            "clearance_m = [0.3, 0.3]",
        ),
        (
            of_entry("generated.shapes = [\"heart\"]"),
            "unknown variant `heart`",
        ),
        (
            of_entry("course = \"../courses/training.toml\"\ndisturbances.mass = 1.0"),
            "unknown field `mass`",
        ),
        (
            of_entry(
                "course = \"../courses/training.toml\"\n[[entry]]\nname = \"one\"\n\
                 course = \"../courses/training.toml\"",
            ),
            "another entry has this name",
        ),
        (
            refusal(
                "name = \"x\"\n[[entry]]\nname = \"one\"\ncourse = \"../courses/training.toml\"",
            ),
            "has no episodes",
        ),
    ] {
        assert!(message.contains(expected), "{message}");
        assert!(message.contains("evaluations/x.toml: "), "{message}");
    }
}
