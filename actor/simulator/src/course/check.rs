//! Rules that a layout must satisfy to become a course.
//!
//! Without each rule, an episode could be impossible or a number meaningless. Each error names what
//! to change.

use super::{
    BODY_CLEARANCE_M, Course, CourseFault, DRONE_WIDTH_M, FRAME_M, FaultLocation, MAX_CORNERS,
    MAX_WALLS, Shape, Sidestep, Wall, WallLabel, WallLayout, polygon,
};
use crate::oracle::{HOVER_BEHIND_START_M, HOVER_BEHIND_WALL_M};

/// Distance flown at 1 m/s until a sidestep has settled, metres: three time constants of the
/// slowest vehicle (0.9 s) plus half its length.
pub(super) const SETTLING_M: f32 = 3.2;

impl Sidestep {
    /// Returns the distance that a sidestep of `shift_m` takes, metres. `to_hover_m`: distance that
    /// hovering takes.
    fn needed_m(self, shift_m: f32, to_hover_m: f32) -> f32 {
        match self {
            Self::Flying => shift_m + SETTLING_M,
            Self::Hovering => to_hover_m,
        }
    }

    /// Returns how far to the side the drone gets within `gap_m`, metres; negative for nowhere.
    fn reach_m(self, gap_m: f32, to_hover_m: f32) -> f32 {
        match self {
            Self::Flying => gap_m - SETTLING_M,
            Self::Hovering if gap_m >= to_hover_m => LARGEST_M,
            Self::Hovering => -LARGEST_M,
        }
    }
}

/// Least room for the openings of a random course that the drone can reach, metres.
pub(super) const NEAR_MIDDLE_M: f32 = 0.5;

/// Largest length accepted for any key, metres.
pub(super) const LARGEST_M: f32 = 1000.0;

pub(super) fn corridor_and_start(course: &Course) -> Result<(), CourseFault> {
    let corridor = course.corridor;
    let thickness_m = course.wall_thickness_m;
    let check = |key, value, least, most| in_range(FaultLocation::Course, key, value, least, most);
    check("corridor.length_m", corridor.length_m, 5.0, LARGEST_M)?;
    check("corridor.width_m", corridor.width_m, 2.0, 100.0)?;
    check("corridor.height_m", corridor.height_m, 2.0, 100.0)?;
    check("wall_thickness_m", thickness_m, 0.01, 2.0)?;

    let start = course.start;
    let behind_m = thickness_m + BODY_CLEARANCE_M;
    check(
        "start.offset_m",
        start.offset_m,
        behind_m,
        corridor.length_m - BODY_CLEARANCE_M,
    )?;
    check(
        "start.jitter_y_m",
        start.jitter_y_m,
        0.0,
        corridor.width_m / 2.0 - BODY_CLEARANCE_M,
    )?;
    check(
        "start.jitter_z_m",
        start.jitter_z_m,
        0.0,
        corridor.height_m / 2.0 - BODY_CLEARANCE_M,
    )
}

/// Returns the wall if the drone can fly through it, also after the walls already in the course.
pub(super) fn next_wall(course: &Course, candidate: WallLayout) -> Result<Wall, CourseFault> {
    if course
        .walls
        .iter()
        .any(|wall| wall.label == candidate.label)
    {
        return Err(CourseFault::RepeatedWall {
            wall: candidate.label,
            key: "order",
        });
    }
    let wall = wall(course, candidate)?;
    reachable(course, &wall)?;
    Ok(wall)
}

/// Checks the number of walls: a `u8` must count the levels.
pub(super) fn wall_count(count: usize) -> Result<(), CourseFault> {
    match count {
        1..=MAX_WALLS => Ok(()),
        _ => Err(CourseFault::WallCount { count }),
    }
}

fn wall(course: &Course, candidate: WallLayout) -> Result<Wall, CourseFault> {
    let label = candidate.label;
    let least_m = course.start.offset_m + BODY_CLEARANCE_M;
    // A tilted drone must leave the last wall before it touches the end.
    let most_m = course.corridor.length_m - course.wall_thickness_m - 2.0 * BODY_CLEARANCE_M;
    // Written so that a NaN is refused as well.
    if !(least_m..=most_m).contains(&candidate.x_m) {
        return Err(CourseFault::OutsideCorridor {
            wall: label,
            x_m: candidate.x_m,
            least_m,
            most_m,
        });
    }
    sizes(label, &candidate)?;
    let outline = outline(course, &candidate)?;
    let (safe_point, clearance_m) = polygon::widest_circle(&outline);
    if clearance_m < BODY_CLEARANCE_M {
        let shape = candidate.opening.shape.name();
        return Err(CourseFault::TooSmall {
            wall: label,
            shape,
            clearance_m,
        });
    }
    Ok(Wall {
        label,
        x_m: candidate.x_m,
        opening: candidate.opening,
        outline,
        safe_point,
        clearance_m,
    })
}

/// Checks the opening's numbers, key by key.
fn sizes(wall: WallLabel, candidate: &WallLayout) -> Result<(), CourseFault> {
    let location = FaultLocation::Wall(wall);
    let opening = &candidate.opening;
    for centre in opening.centre_m {
        in_range(location, "centre_m", centre, -LARGEST_M, LARGEST_M)?;
    }
    in_range(
        location,
        "rotation_deg",
        opening.rotation_deg,
        -360.0,
        360.0,
    )?;
    for (key, value_m) in opening.shape.lengths_m() {
        in_range(location, key, value_m, 0.0, LARGEST_M)?;
        if key != "arm_m" && value_m < DRONE_WIDTH_M {
            return Err(CourseFault::NarrowerThanDrone { wall, key, value_m });
        }
    }
    match opening.shape {
        Shape::Cross {
            width_m,
            height_m,
            arm_m,
        }
        | Shape::L {
            width_m,
            height_m,
            arm_m,
        } => {
            // An arm as thick as the whole shape would give corners on top of each other.
            in_range(location, "arm_m", arm_m, 0.01, 0.99 * width_m.min(height_m))
        }
        Shape::Polygon { ref points_m } => {
            if !(3..=MAX_CORNERS).contains(&points_m.len()) {
                return Err(CourseFault::CornerCount {
                    wall,
                    count: points_m.len(),
                });
            }
            points_m.iter().flatten().try_for_each(|&value| {
                in_range(location, "points_m", value, -LARGEST_M, LARGEST_M)
            })?;
            match polygon::edges(points_m).position(|(from, to)| from == to) {
                Some(place) => Err(CourseFault::RepeatedCorner {
                    wall,
                    corner: place + 1,
                }),
                None => Ok(()),
            }
        }
        _ => Ok(()),
    }
}

/// Returns the outline if it is a simple polygon within the wall's frame.
fn outline(course: &Course, candidate: &WallLayout) -> Result<Vec<[f32; 2]>, CourseFault> {
    let wall = candidate.label;
    let outline = candidate.opening.outline();
    if let Some((first, second)) = polygon::self_intersection(&outline) {
        // The outline of corners listed clockwise runs the other way round.
        let count = outline.len();
        let edges = match polygon::signed_area(&candidate.opening.shape.corners()) < 0.0 {
            true => [second, first].map(|edge| (2 * count - 2 - edge) % count),
            false => [first, second],
        };
        let edges = (edges[0].min(edges[1]), edges[0].max(edges[1]));
        return Err(CourseFault::SelfIntersecting { wall, edges });
    }
    let limit_y_m = course.corridor.width_m / 2.0 - FRAME_M;
    let limit_z_m = course.corridor.height_m - FRAME_M;
    match outline
        .iter()
        .find(|[y, z]| y.abs() > limit_y_m || !(FRAME_M..=limit_z_m).contains(z))
    {
        Some(&[y_m, z_m]) => Err(CourseFault::OutsideWall {
            wall,
            y_m,
            z_m,
            limit_y_m,
            limit_z_m,
        }),
        None => Ok(outline),
    }
}

/// Checks that the drone has room to sidestep to this opening from the previous opening and from
/// the start area.
fn reachable(course: &Course, wall: &Wall) -> Result<(), CourseFault> {
    let previous = course.walls.last();
    if let Some(previous) = previous.filter(|previous| wall.x_m <= previous.x_m) {
        return Err(CourseFault::NotBehind {
            wall: wall.label,
            x_m: wall.x_m,
            previous: previous.label,
            previous_x_m: previous.x_m,
        });
    }
    let start = course.start;
    let behind_m = previous.map_or(0.0, |previous| previous.x_m);
    let from_start = (
        wall.x_m - behind_m - start.offset_m,
        wall.safe_point[0].abs() + start.jitter_y_m,
        (wall.safe_point[1] - course.corridor.height_m / 2.0).abs() + start.jitter_z_m,
        HOVER_BEHIND_START_M,
    );
    let from_wall = previous.map(|previous| {
        (
            wall.x_m - previous.x_m - course.wall_thickness_m,
            (wall.safe_point[0] - previous.safe_point[0]).abs(),
            (wall.safe_point[1] - previous.safe_point[1]).abs(),
            HOVER_BEHIND_WALL_M,
        )
    });
    for (gap_m, along_y_m, along_z_m, to_hover_m) in
        [Some(from_start), from_wall].into_iter().flatten()
    {
        let shift_m = along_y_m.max(along_z_m);
        let needed_m = course.sidestep.needed_m(shift_m, to_hover_m);
        if gap_m < needed_m {
            return Err(CourseFault::TooClose {
                wall: wall.label,
                gap_m,
                shift_m,
                needed_m,
            });
        }
    }
    Ok(())
}

/// Returns the ranges `[least, most]` along y and z within which the drone can reach the safe point
/// of a wall at `x_m`, from the previous wall and from the start area. They may be empty.
pub(super) fn in_reach(course: &Course, x_m: f32) -> [[f32; 2]; 2] {
    let (start, previous) = (course.start, course.walls.last());
    let behind_m = previous.map_or(0.0, |previous| previous.x_m);
    let gap_m = x_m - behind_m - start.offset_m;
    let free_m = course.sidestep.reach_m(gap_m, HOVER_BEHIND_START_M);
    let middle_m = course.corridor.height_m / 2.0;
    let (along_y_m, along_z_m) = (free_m - start.jitter_y_m, free_m - start.jitter_z_m);
    let mut ranges = [
        [-along_y_m, along_y_m],
        [middle_m - along_z_m, middle_m + along_z_m],
    ];
    if let Some(previous) = previous {
        let gap_m = x_m - previous.x_m - course.wall_thickness_m;
        let free_m = course.sidestep.reach_m(gap_m, HOVER_BEHIND_WALL_M);
        for ([least, most], from_m) in ranges.iter_mut().zip(previous.safe_point) {
            *least = least.max(from_m - free_m);
            *most = most.min(from_m + free_m);
        }
    }
    ranges
}

/// Checks that a wall at `next_x_m` can have an opening that the drone reaches from the last wall
/// and from the start area.
pub(super) fn leads_on(course: &Course, next_x_m: f32) -> Result<(), CourseFault> {
    let (Some(last), ranges) = (course.walls.last(), in_reach(course, next_x_m)) else {
        return Ok(());
    };
    let room_m = ranges
        .map(|[least, most]| most - least)
        .into_iter()
        .fold(f32::INFINITY, f32::min);
    if room_m >= NEAR_MIDDLE_M {
        return Ok(());
    }
    let gap_m = next_x_m - last.x_m - course.wall_thickness_m;
    let missing_m = NEAR_MIDDLE_M - room_m;
    Err(CourseFault::TooClose {
        wall: WallLabel(last.label.0 + 1),
        gap_m,
        shift_m: gap_m - SETTLING_M + missing_m,
        needed_m: gap_m + missing_m,
    })
}

pub(super) fn in_range(
    location: FaultLocation,
    key: &'static str,
    value: f32,
    least: f32,
    most: f32,
) -> Result<(), CourseFault> {
    // Written so that a NaN is refused as well.
    if (least..=most).contains(&value) {
        Ok(())
    } else {
        Err(CourseFault::OutOfRange {
            location,
            key,
            value,
            least,
            most,
        })
    }
}
