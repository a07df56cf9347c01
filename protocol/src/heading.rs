//! The heading frame: x where the nose points, y to its left, z up. A drone knows its velocity
//! there.

/// Returns cosine and sine of the angle between the world's x axis and the nose, seen from above.
/// `orientation`: world from body, as a unit quaternion (i, j, k, w).
pub fn heading([i, j, k, w]: [f32; 4]) -> [f32; 2] {
    let (along, beside) = (1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j + w * k));
    let level = (along * along + beside * beside).sqrt();
    if level > 0.0 {
        [along / level, beside / level]
    } else {
        // The nose points straight up or down.
        [1.0, 0.0]
    }
}

/// Returns a vector of the world in the heading frame of a drone with this `orientation`.
pub fn in_heading_frame([x, y, z]: [f32; 3], orientation: [f32; 4]) -> [f32; 3] {
    let [cos, sin] = heading(orientation);
    [cos * x + sin * y, cos * y - sin * x, z]
}

#[cfg(test)]
mod tests {
    use std::f32::consts::FRAC_1_SQRT_2;

    use super::*;

    #[test]
    fn a_motion_to_the_left_is_forward_for_a_drone_that_faces_left() {
        let left = [0.0, 0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2];
        let [forward, beside, up] = in_heading_frame([0.0, 2.0, 0.5], left);
        assert!((forward - 2.0).abs() < 1e-6 && beside.abs() < 1e-6 && up == 0.5);
        assert_eq!(
            in_heading_frame([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]),
            [1.0, 2.0, 3.0]
        );
    }

    #[test]
    fn a_drone_on_its_tail_has_a_heading() {
        let up = [0.0, -FRAC_1_SQRT_2, 0.0, FRAC_1_SQRT_2];
        assert!(heading(up).iter().all(|part| part.is_finite()));
        assert_eq!(heading([0.0; 4]), [1.0, 0.0]);
    }
}
