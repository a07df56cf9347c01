//! Random courses: their free space, their corridors, and the ranges that are refused.

use super::*;

#[test]
fn every_family_is_drawn_with_exactly_the_configured_free_space() {
    let held_out = [&GeneratedShape::HELD_OUT[..], &GeneratedShape::UNTRIED].concat();
    for shape in GeneratedShape::TRAINED.into_iter().chain(held_out) {
        for clearance_m in [BODY_CLEARANCE_M + 0.01, 0.75, 1.0] {
            let ranges = GeneratorRanges {
                shapes: vec![shape],
                clearance_m: [clearance_m; 2],
                ..Default::default()
            };
            for seed in 0..10 {
                let course = Course::generate(seed, &ranges).unwrap();
                for wall in course.walls() {
                    // The widest circle is computed to a millimetre.
                    let off_m = (wall.clearance_m() - clearance_m).abs();
                    assert!(off_m < 0.003, "{shape:?}: {} m", wall.clearance_m());
                }
            }
        }
    }
}

#[test]
fn no_trained_family_is_held_out_and_defaults_draw_no_held_out_family() {
    let held_out = [&GeneratedShape::HELD_OUT[..], &GeneratedShape::UNTRIED].concat();
    let is_held_out = |shape: &GeneratedShape| held_out.contains(shape);
    assert!(!GeneratedShape::TRAINED.iter().any(is_held_out));
    assert!(!GeneratorRanges::default().shapes.iter().any(is_held_out));
}

#[test]
fn every_seed_gives_a_course_with_the_configured_free_space() {
    let ranges = GeneratorRanges::default();
    let mut outlines = Vec::new();
    for seed in 0..40 {
        let course = Course::generate(seed, &ranges).unwrap();
        assert_eq!(course.walls().len(), 5);
        for wall in course.walls() {
            assert!(
                (0.89..=1.16).contains(&wall.clearance_m()),
                "{}",
                wall.clearance_m()
            );
        }
        outlines.push(course.walls()[0].outline().to_vec());
    }
    outlines.dedup();
    assert_eq!(outlines.len(), 40, "different seeds give different courses");
}

#[test]
fn the_same_seed_gives_the_same_course() {
    let ranges = GeneratorRanges::default();
    assert_eq!(Course::generate(3, &ranges), Course::generate(3, &ranges));
}

#[test]
fn impossible_ranges_are_refused_and_say_why() {
    let upside_down = GeneratorRanges {
        clearance_m: [1.2, 1.0],
        ..Default::default()
    };
    let error = Course::generate(0, &upside_down).unwrap_err().to_string();
    assert!(error.contains("clearance_m = [1.2, 1]"), "{error}");

    let no_corridor = GeneratorRanges {
        corridor: Corridor {
            width_m: f32::NAN,
            ..Corridor::default()
        },
        ..Default::default()
    };
    let error = Course::generate(0, &no_corridor).unwrap_err().to_string();
    assert!(error.contains("corridor.width_m = NaN"), "{error}");

    let too_wide = GeneratorRanges {
        clearance_m: [3.5, 3.5],
        ..Default::default()
    };
    let error = Course::generate(0, &too_wide).unwrap_err().to_string();
    assert!(
        error.contains("no opening drawn for wall 1") && error.contains("must stay within"),
        "{error}"
    );
}

/// Returns ranges of corridors as wide as those of `configs/evaluations/generalist.toml`.
fn varied() -> GeneratorRanges {
    GeneratorRanges {
        layout: Some(LayoutRanges {
            width_m: [4.0, 12.0],
            height_m: [4.0, 12.0],
            walls: [1, 8],
            spacing_m: [6.0, 15.0],
            wall_thickness_m: [0.1, 0.5],
            end_m: [4.0, 15.0],
            start_offset_m: [1.2, 1.8],
            start_jitter_y_m: [0.2, 0.5],
            start_jitter_z_m: [0.2, 0.5],
            first_wall_m: None,
            slalom: false,
        }),
        ..Default::default()
    }
}

#[test]
fn corridors_vary_within_their_ranges_and_use_all_of_them() {
    let ranges = varied();
    assert_eq!(ranges.check(), Ok(()));
    let (longest, farthest) = ranges.longest();
    let mut walls_seen = [0; 9];
    let (mut narrowest_m, mut widest_m) = (f32::INFINITY, 0.0_f32);
    for seed in 0..200 {
        let course = Course::generate(seed, &ranges).unwrap();
        let (corridor, start) = (course.corridor(), course.start());
        walls_seen[course.walls().len()] += 1;
        assert!((4.0..=12.0).contains(&corridor.width_m));
        assert!((4.0..=12.0).contains(&corridor.height_m));
        assert!((0.1..=0.5).contains(&course.wall_thickness_m()));
        assert!(start.offset_m >= farthest.offset_m && start.jitter_y_m <= 0.5);
        let ends_m: Vec<f32> = [0.0]
            .into_iter()
            .chain(course.walls().iter().map(|wall| wall.x_m()))
            .collect();
        assert!(
            ends_m
                .windows(2)
                .all(|pair| (5.99..=15.01).contains(&(pair[1] - pair[0])))
        );
        assert!((3.99..=15.01).contains(&(corridor.length_m - ends_m.last().unwrap())));
        assert!(corridor.length_m <= longest.length_m);
        narrowest_m = narrowest_m.min(corridor.width_m.min(corridor.height_m));
        widest_m = widest_m.max(corridor.width_m.max(corridor.height_m));
    }
    assert!(
        walls_seen[1..].iter().all(|&count| count > 5),
        "{walls_seen:?}"
    );
    assert!(narrowest_m < 4.2 && widest_m > 11.8);
}

#[test]
fn a_course_for_a_level_has_that_levels_wall() {
    let ranges = varied();
    for (seed, level) in (0..40).zip((1..=8).cycle()) {
        let course = Course::generate_from_level(seed, level, &ranges).unwrap();
        assert!(course.levels() >= level && course.levels() <= 8);
    }
    // More walls than the ranges allow there cannot be.
    let most = Course::generate_from_level(1, 9, &ranges).unwrap();
    assert_eq!(most.levels(), 8);
}

#[test]
fn a_layout_of_single_values_gives_the_openings_of_the_fixed_corridor() {
    let fixed = Course::generate(4, &GeneratorRanges::default()).unwrap();
    let layout = GeneratorRanges {
        layout: Some(LayoutRanges::default()),
        ..Default::default()
    };
    assert_eq!(Course::generate(4, &layout).unwrap(), fixed);
}

#[test]
fn layouts_that_cannot_be_flown_are_refused_by_key() {
    let refusal = |change: fn(&mut LayoutRanges)| {
        let mut ranges = varied();
        change(ranges.layout.as_mut().unwrap());
        Course::generate(0, &ranges).unwrap_err().to_string()
    };
    for (message, part) in [
        (
            refusal(|layout| layout.spacing_m[0] = 4.0),
            "layout.spacing_m = [4, 15]",
        ),
        (
            refusal(|layout| layout.spacing_m[1] = 500.0),
            "layout.spacing_m = [6, 500]",
        ),
        (
            refusal(|layout| layout.width_m = [f32::NAN, 6.0]),
            "layout.width_m = [NaN, 6]",
        ),
        (
            refusal(|layout| layout.walls = [0, 3]),
            "layout.walls = [0, 3]",
        ),
        (
            refusal(|layout| layout.walls = [3, 33]),
            "layout.walls = [3, 33]",
        ),
        (
            refusal(|layout| layout.end_m = [1.0, 3.0]),
            "layout.end_m = [1, 3]",
        ),
        (
            refusal(|layout| layout.start_offset_m = [1.0, 2.0]),
            "layout.start_offset_m = [1, 2]",
        ),
        (
            refusal(|layout| layout.start_jitter_y_m = [0.0, 1.5]),
            "layout.start_jitter_y_m = [0, 1.5]",
        ),
    ] {
        assert!(message.contains(part), "{message}");
    }
    let twice = GeneratorRanges {
        wall_x_m: vec![12.0],
        ..varied()
    };
    let message = Course::generate(0, &twice).unwrap_err().to_string();
    assert!(
        message.contains("wall_x_m and layout exclude each other"),
        "{message}"
    );
}

#[test]
fn hardest_corridors_without_room_for_an_opening_are_found_by_the_check() {
    let mut ranges = varied();
    // The narrowest corridor has no room for a disc of 1.8 m with its frame; most have.
    ranges.layout.as_mut().unwrap().width_m = [3.7, 12.0];
    ranges.clearance_m = [1.8, 1.8];
    let message = ranges.check().unwrap_err().to_string();
    assert!(message.contains("no opening drawn for wall"), "{message}");
}
