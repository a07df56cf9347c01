//! Simple polygons in a wall's plane: orientation, self-intersection, widest inner circle.
//!
//! Points are `[y, z]` in metres. This is plain arithmetic on a few points, so it needs no
//! dependency.

/// Returns the signed area, m²: positive if the points run counter-clockwise.
pub(crate) fn signed_area(points: &[[f32; 2]]) -> f32 {
    edges(points)
        .map(|([ay, az], [by, bz])| ay * bz - by * az)
        .sum::<f32>()
        * 0.5
}

/// Returns the centroid of a polygon with non-zero area.
fn centroid(points: &[[f32; 2]]) -> [f32; 2] {
    let mut sum = [0.0; 2];
    for ([ay, az], [by, bz]) in edges(points) {
        let cross = ay * bz - by * az;
        sum[0] += (ay + by) * cross;
        sum[1] += (az + bz) * cross;
    }
    let scale = 1.0 / (6.0 * signed_area(points));
    [sum[0] * scale, sum[1] * scale]
}

/// Returns the numbers of the first two edges that touch without being neighbours, or that fold
/// back on each other.
pub(crate) fn self_intersection(points: &[[f32; 2]]) -> Option<(usize, usize)> {
    let sides: Vec<_> = edges(points).collect();
    let count = sides.len();
    for (i, &first) in sides.iter().enumerate() {
        for (j, &second) in sides.iter().enumerate().skip(i + 1) {
            let crossing = if j == i + 1 {
                folds_back(first.0, first.1, second.1)
            } else if i == 0 && j == count - 1 {
                folds_back(second.0, second.1, first.1)
            } else {
                segments_touch(first, second)
            };
            if crossing {
                return Some((i, j));
            }
        }
    }
    None
}

/// Returns the distance from `point` to the nearest edge: positive inside, negative outside.
pub(crate) fn signed_distance(points: &[[f32; 2]], point: [f32; 2]) -> f32 {
    let mut inside = false;
    let mut nearest = f32::INFINITY;
    for (a, b) in edges(points) {
        nearest = nearest.min(distance_to_segment(point, a, b));
        let straddles = (a[1] > point[1]) != (b[1] > point[1]);
        if straddles && point[0] < a[0] + (b[0] - a[0]) * (point[1] - a[1]) / (b[1] - a[1]) {
            inside = !inside;
        }
    }
    if inside { nearest } else { -nearest }
}

/// Returns the centre and the radius of the widest circle that fits inside, to a millimetre.
///
/// If several circles are equally wide (a long rectangle), the one nearest to the centroid wins: an
/// opening is flown through its middle. The search divides squares into quarters as long as they
/// can hold a better centre.
pub(crate) fn widest_circle(points: &[[f32; 2]]) -> ([f32; 2], f32) {
    /// Metres of clearance worth one metre nearer to the centroid.
    const PULL_TO_CENTROID: f32 = 0.02;
    const PRECISION_M: f32 = 0.001;
    /// Largest change of the score over a metre.
    const STEEPEST: f32 = 1.0 + PULL_TO_CENTROID;

    let middle = centroid(points);
    let score = |at: [f32; 2]| {
        let off_centre = (at[0] - middle[0]).hypot(at[1] - middle[1]);
        signed_distance(points, at) - PULL_TO_CENTROID * off_centre
    };

    let mut half_side = points
        .iter()
        .map(|p| (p[0] - middle[0]).abs().max((p[1] - middle[1]).abs()))
        .fold(0.0, f32::max);
    let mut best = (middle, score(middle));
    let mut squares = vec![middle];
    while !squares.is_empty() {
        let scored: Vec<_> = squares.into_iter().map(|at| (at, score(at))).collect();
        best = scored
            .iter()
            .copied()
            .fold(best, |a, b| if b.1 > a.1 { b } else { a });
        let corner_gains = half_side * std::f32::consts::SQRT_2 * STEEPEST;
        half_side /= 2.0;
        squares = scored
            .into_iter()
            .filter(|(_, here)| here + corner_gains > best.1 + PRECISION_M)
            .flat_map(|([y, z], _)| {
                let (left, right) = (y - half_side, y + half_side);
                let (low, high) = (z - half_side, z + half_side);
                [[left, low], [right, low], [left, high], [right, high]]
            })
            .collect();
    }
    (best.0, signed_distance(points, best.0))
}

/// Returns the edges in order; the last one closes the loop.
pub(crate) fn edges(points: &[[f32; 2]]) -> impl Iterator<Item = ([f32; 2], [f32; 2])> + '_ {
    let next = points.iter().cycle().skip(1);
    points.iter().copied().zip(next.copied())
}

/// Returns `true` if the path `a b c` reverses at `b`: the edges `a b` and `b c` cover each other.
fn folds_back(a: [f32; 2], b: [f32; 2], c: [f32; 2]) -> bool {
    let along = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]);
    turn(a, b, c) == 0.0 && along <= 0.0
}

fn segments_touch((a, b): ([f32; 2], [f32; 2]), (c, d): ([f32; 2], [f32; 2])) -> bool {
    let (abc, abd) = (turn(a, b, c), turn(a, b, d));
    let (cda, cdb) = (turn(c, d, a), turn(c, d, b));
    if abc * abd < 0.0 && cda * cdb < 0.0 {
        return true;
    }
    (abc == 0.0 && in_box(a, b, c))
        || (abd == 0.0 && in_box(a, b, d))
        || (cda == 0.0 && in_box(c, d, a))
        || (cdb == 0.0 && in_box(c, d, b))
}

/// Returns a positive number if the path `a b c` turns left.
fn turn(a: [f32; 2], b: [f32; 2], c: [f32; 2]) -> f32 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

fn in_box(a: [f32; 2], b: [f32; 2], p: [f32; 2]) -> bool {
    (0..2).all(|axis| a[axis].min(b[axis]) <= p[axis] && p[axis] <= a[axis].max(b[axis]))
}

fn distance_to_segment(p: [f32; 2], a: [f32; 2], b: [f32; 2]) -> f32 {
    let along = [b[0] - a[0], b[1] - a[1]];
    let to_point = [p[0] - a[0], p[1] - a[1]];
    let length_squared = along[0] * along[0] + along[1] * along[1];
    let share = if length_squared > 0.0 {
        ((to_point[0] * along[0] + to_point[1] * along[1]) / length_squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (to_point[0] - share * along[0]).hypot(to_point[1] - share * along[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f32; 2]; 4] = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];

    #[test]
    fn widest_circle_of_a_square_is_its_incircle() {
        let (centre, radius) = widest_circle(&SQUARE);
        assert!((radius - 1.0).abs() < 2e-3, "{radius}");
        assert!(
            (centre[0] - 1.0).hypot(centre[1] - 1.0) < 2e-3,
            "{centre:?}"
        );
    }

    #[test]
    fn a_long_rectangle_is_flown_through_its_middle() {
        let (centre, _) = widest_circle(&[[-3.0, -1.0], [3.0, -1.0], [3.0, 1.0], [-3.0, 1.0]]);
        assert!(centre[0].hypot(centre[1]) < 5e-3, "{centre:?}");
    }

    #[test]
    fn widest_circle_of_an_l_lies_in_its_corner() {
        let l = [
            [0.0, 0.0],
            [3.0, 0.0],
            [3.0, 1.0],
            [1.0, 1.0],
            [1.0, 3.0],
            [0.0, 3.0],
        ];
        let (centre, radius) = widest_circle(&l);
        // The circle touches both outer sides and the inner corner: r = (1 - r) * sqrt 2.
        let expected = 2f32.sqrt() / (1.0 + 2f32.sqrt());
        assert!(
            (radius - expected).abs() < 5e-3,
            "{radius} against {expected}"
        );
        assert!((centre[0] - centre[1]).abs() < 5e-3);
    }

    #[test]
    fn a_bow_tie_crosses_itself_and_a_square_does_not() {
        let bow_tie = [[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        assert_eq!(self_intersection(&bow_tie), Some((0, 2)));
        assert_eq!(self_intersection(&SQUARE), None);
    }

    #[test]
    fn a_spike_without_width_counts_as_crossing() {
        let spike = [[0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [1.0, 1.0]];
        assert!(self_intersection(&spike).is_some());
    }

    #[test]
    fn a_corner_resting_on_a_far_edge_counts_as_crossing() {
        let pinched = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 0.0], [0.0, 2.0]];
        assert!(self_intersection(&pinched).is_some());
    }
}
