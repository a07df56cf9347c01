//! Approaches to walls, and how they ended: by shape of the opening, by its clearance, and by how
//! far the drone had to move across the corridor.

use skein_run::tables::rates_table;

use super::{Failure, FlownEpisode};

/// Lower ends of the classes of clearance, metres. Below the first nothing can be flown.
const CLEARANCES_M: [f32; 6] = [0.0, 0.7, 0.75, 0.8, 0.9, 1.1];
/// Lower ends of the classes of offset, metres.
const OFFSETS_M: [f32; 6] = [0.0, 0.5, 1.0, 1.5, 2.0, 3.0];

/// The way of an episode from one wall, or its start, to the next wall.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Approach {
    /// Shape of the opening.
    shape: &'static str,
    /// Radius of the widest circle inside the opening, metres.
    clearance_m: f32,
    /// Distance across the corridor from where the approach began to the middle of that circle,
    /// metres.
    offset_m: f32,
    /// The failure that ended it; `None` if the wall was passed.
    failure: Option<Failure>,
}

impl Approach {
    /// Returns the approaches of an episode. One that failed behind the last wall passed them all.
    fn of(episode: &FlownEpisode<'_>) -> Vec<Self> {
        let thickness_m = episode.course.wall_thickness_m();
        let mut begins_at_m = f32::NEG_INFINITY;
        let mut approaches = Vec::new();
        for (number, wall) in episode.course.walls().iter().enumerate() {
            let failure = match number < episode.walls_passed {
                true => None,
                false => episode.failure(),
            };
            let begin = episode.points_m.iter().find(|at| at[0] >= begins_at_m);
            let Some([_, y_m, z_m]) = begin else { break };
            let [safe_y_m, safe_z_m] = wall.safe_point();
            approaches.push(Self {
                shape: episode.shape(wall),
                clearance_m: wall.clearance_m(),
                offset_m: (safe_y_m - y_m).hypot(safe_z_m - z_m),
                failure,
            });
            if number >= episode.walls_passed {
                break;
            }
            begins_at_m = wall.x_m() + thickness_m;
        }
        approaches
    }
}

/// Returns how the approaches of `episodes` ended, as a table of at most `columns`: by shape, worst
/// first, by clearance and by offset. Names the worlds, which have no walls to approach.
pub fn approaches_table(episodes: &[FlownEpisode<'_>], columns: usize) -> String {
    let approaches: Vec<_> = episodes.iter().flat_map(Approach::of).collect();
    let mut rows = by_shape(&approaches);
    let clearance: Measure = ("clearance", |approach| approach.clearance_m);
    let offset: Measure = ("offset", |approach| approach.offset_m);
    rows.extend(by_class(&approaches, clearance, &CLEARANCES_M));
    rows.extend(by_class(&approaches, offset, &OFFSETS_M));
    let titles = [
        "approaches",
        "number",
        "passed",
        "hit the wall",
        "hit the corridor",
        "timed out",
    ];
    let table = (!rows.is_empty()).then(|| rates_table(&titles, &rows, columns));
    let texts: Vec<_> = table.into_iter().chain(worlds(episodes)).collect();
    texts.join("\n")
}

/// Returns a sentence that names the worlds among the courses of `episodes`, if there are any.
fn worlds(episodes: &[FlownEpisode<'_>]) -> Option<String> {
    let in_worlds = episodes.iter().filter(|episode| episode.course.is_world());
    let mut names: Vec<_> = in_worlds.map(|episode| episode.course_name).collect();
    names.dedup();
    (!names.is_empty()).then(|| {
        let names = names.join("; ");
        format!("Not among the approaches, because a world has no walls: {names}.")
    })
}

/// Name and value of what approaches are classed by.
type Measure = (&'static str, fn(&Approach) -> f32);

fn by_shape(approaches: &[Approach]) -> Vec<Vec<String>> {
    let mut shapes: Vec<_> = approaches.iter().map(|approach| approach.shape).collect();
    shapes.sort_unstable();
    shapes.dedup();
    let of_shape = |shape| {
        let of_shape = approaches.iter().filter(|approach| approach.shape == shape);
        (shape, of_shape.collect::<Vec<_>>())
    };
    let mut groups: Vec<_> = shapes.into_iter().map(of_shape).collect();
    groups.sort_by(|(_, one), (_, other)| passed(one).total_cmp(&passed(other)));
    groups
        .into_iter()
        .map(|(shape, group)| row(format!("shape: {shape}"), &group))
        .collect()
}

fn by_class(
    approaches: &[Approach],
    (name, value): Measure,
    lower_ends_m: &[f32],
) -> Vec<Vec<String>> {
    let classes = lower_ends_m.iter().enumerate().map(|(number, &from_m)| {
        let to_m = lower_ends_m.get(number + 1).copied();
        let within = |approach: &&Approach| {
            value(approach) >= from_m && to_m.is_none_or(|to_m| value(approach) < to_m)
        };
        let label = match to_m {
            Some(to_m) => format!("{name}: {from_m:.2} to {to_m:.2} m"),
            None => format!("{name}: {from_m:.2} m or more"),
        };
        row(label, &approaches.iter().filter(within).collect::<Vec<_>>())
    });
    // A class that nobody met says nothing.
    classes.filter(|row| row[1] != "0").collect()
}

fn passed(group: &[&Approach]) -> f64 {
    let passed = group.iter().filter(|approach| approach.failure.is_none());
    passed.count() as f64 / group.len().max(1) as f64
}

fn row(label: String, group: &[&Approach]) -> Vec<String> {
    let count = |failure| {
        let failed = group
            .iter()
            .filter(|approach| approach.failure == Some(failure));
        match failed.count() {
            0 => "·".to_owned(),
            count => count.to_string(),
        }
    };
    vec![
        label,
        group.len().to_string(),
        format!("{:.1} %", 100.0 * passed(group)),
        count(Failure::HitWall),
        count(Failure::HitCorridor),
        count(Failure::TimedOut),
    ]
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use skein_simulator::course::Course;

    use super::super::tests::collided;
    use super::*;

    #[test]
    fn an_approach_begins_behind_the_wall_before_and_ends_with_the_wall_or_the_episode() {
        let points_m = [
            [1.5, 0.0, 3.5],
            [9.9, 1.0, 3.5],
            [10.4, 1.0, 3.5],
            [19.8, -2.0, 3.5],
        ];
        let episode = collided(&points_m, 1, Some(2));
        let [first, second] = Approach::of(&episode)[..] else {
            panic!("two walls were approached");
        };
        assert_eq!((first.shape, first.failure), ("circle", None));
        assert!((first.offset_m - 1.0).abs() < 0.01, "{first:?}");
        assert_eq!(
            (second.shape, second.failure),
            ("triangle", Some(Failure::HitWall))
        );
        // From y = 1 to the widest circle of the triangle, at y = -0.6 and 0.5 m below the middle.
        assert!((second.offset_m - 1.68).abs() < 0.05, "{second:?}");
        let before = collided(&points_m[..2], 0, None);
        let [only] = Approach::of(&before)[..] else {
            panic!("one wall was approached");
        };
        assert_eq!(only.failure, Some(Failure::HitCorridor));
        let behind = collided(&points_m, 2, None);
        assert!(Approach::of(&behind).iter().all(|at| at.failure.is_none()));
    }

    #[test]
    fn the_worst_shape_comes_first_and_every_approach_counts_once_in_each_class() {
        let points_m = [[1.5, 0.0, 3.5], [10.4, 1.0, 3.5], [19.8, -2.0, 3.5]];
        let episodes = [
            collided(&points_m, 1, Some(2)),
            collided(&points_m, 1, None),
            collided(&points_m[..1], 0, Some(1)),
        ];
        let table = approaches_table(&episodes, 200);
        let line = |of: &str| {
            let lines: Vec<_> = table.lines().collect();
            let at = lines.iter().position(|line| line.contains(of));
            at.unwrap_or_else(|| panic!("{of} is missing in\n{table}"))
        };
        assert!(line("shape: triangle") < line("shape: circle"));
        let cells = |of: &str| -> Vec<String> {
            let row = table.lines().nth(line(of)).unwrap_or_default();
            row.split(['│', '┆'])
                .map(|cell| cell.trim().to_owned())
                .collect()
        };
        assert_eq!(
            cells("shape: triangle")[2..7],
            ["2", "0.0 %", "1", "1", "·"]
        );
        assert_eq!(cells("shape: circle")[2..7], ["3", "66.7 %", "1", "·", "·"]);
        assert_eq!(cells("offset: 0.50 to 1.00 m")[2], "3");
        assert_eq!(cells("offset: 1.50 to 2.00 m")[2], "2");
        assert!(!table.contains("world"), "{table}");
    }

    #[test]
    fn worlds_are_named_instead_of_an_empty_table() {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../configs/worlds/forest.toml"
        );
        let world = FlownEpisode {
            course_name: "a forest",
            course: Arc::new(Course::load(path).unwrap()),
            ..collided(&[[1.5, 0.0, 3.5]], 0, Some(1))
        };
        let alone = approaches_table(&[world.clone(), world.clone()], 200);
        assert_eq!(
            alone,
            "Not among the approaches, because a world has no walls: a forest."
        );
        let both = approaches_table(&[collided(&[[1.5, 0.0, 3.5]], 0, Some(1)), world], 200);
        assert!(
            both.contains("shape: circle") && both.ends_with("a forest."),
            "{both}"
        );
    }
}
