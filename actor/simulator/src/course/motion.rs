//! Motion of an obstacle: a function of time and the episode's seed.

use std::f32::consts::TAU;

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Instant of an episode.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moment {
    /// Time since the episode's start, seconds.
    pub secs: f32,
    /// Draws how far each moving obstacle is on its way at the start.
    pub seed: u64,
}

/// Way of an obstacle that moves at constant speed. It never turns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Along a line from its place and back again.
    ToAndFro {
        /// From its place to the turning point, metres.
        by_m: [f32; 3],
        /// Speed, m/s.
        speed_mps: f32,
    },
    /// Around its place in a level circle, counter-clockwise seen from above.
    Circle {
        /// Radius of the circle, metres.
        radius_m: f32,
        /// Speed along the circle, m/s.
        speed_mps: f32,
    },
    /// Along a line from its place, where it appears again after the end.
    Across {
        /// From its place to the end, metres.
        by_m: [f32; 3],
        /// Speed, m/s.
        speed_mps: f32,
    },
}

impl Motion {
    /// Returns the offset of the obstacle `number` of a course from its place, metres.
    pub(crate) fn offset_m(&self, number: usize, at: Moment) -> Vector3<f32> {
        let mut phase = Pcg64Mcg::seed_from_u64(at.seed ^ number as u64);
        let turns = phase.random::<f32>() + at.secs / self.period_secs();
        let share = turns.fract();
        match *self {
            Self::ToAndFro { by_m, .. } => Vector3::from(by_m) * (1.0 - (2.0 * share - 1.0).abs()),
            Self::Circle { radius_m, .. } => {
                let (sin, cos) = (share * TAU).sin_cos();
                Vector3::new(radius_m * cos, radius_m * sin, 0.0)
            }
            Self::Across { by_m, .. } => Vector3::from(by_m) * share,
        }
    }

    /// Returns the largest offset in each direction, metres.
    pub(crate) fn reach_m(&self) -> [Vector3<f32>; 2] {
        match *self {
            Self::ToAndFro { by_m, .. } | Self::Across { by_m, .. } => {
                let by_m = Vector3::from(by_m);
                [by_m.inf(&Vector3::zeros()), by_m.sup(&Vector3::zeros())]
            }
            Self::Circle { radius_m, .. } => {
                let out_m = Vector3::new(radius_m, radius_m, 0.0);
                [-out_m, out_m]
            }
        }
    }

    fn period_secs(&self) -> f32 {
        match *self {
            Self::ToAndFro { by_m, speed_mps } => 2.0 * Vector3::from(by_m).norm() / speed_mps,
            Self::Circle {
                radius_m,
                speed_mps,
            } => TAU * radius_m / speed_mps,
            Self::Across { by_m, speed_mps } => Vector3::from(by_m).norm() / speed_mps,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_SECS: f32 = 0.005;

    fn moments(seed: u64) -> impl Iterator<Item = Moment> + Clone {
        (0..4000).map(move |step| Moment {
            secs: step as f32 * STEP_SECS,
            seed,
        })
    }

    #[test]
    fn obstacles_move_at_their_speed_and_stay_within_their_reach() {
        let to_and_fro = Motion::ToAndFro {
            by_m: [0.0, 3.0, -1.0],
            speed_mps: 0.8,
        };
        let circle = Motion::Circle {
            radius_m: 2.0,
            speed_mps: 0.8,
        };
        for motion in [to_and_fro, circle] {
            let [least, most] = motion.reach_m();
            let offsets: Vec<_> = moments(3).map(|at| motion.offset_m(1, at)).collect();
            for pair in offsets.windows(2) {
                let moved_m = (pair[1] - pair[0]).norm();
                assert!(moved_m < 0.8 * STEP_SECS + 1e-4, "{motion:?}: {moved_m}");
            }
            let way_m: f32 = offsets
                .windows(2)
                .map(|pair| (pair[1] - pair[0]).norm())
                .sum();
            assert!((way_m - 16.0).abs() < 0.1, "{motion:?}: {way_m}");
            let inside = |at: &Vector3<f32>| at.inf(&most) == *at && at.sup(&least) == *at;
            assert!(offsets.iter().all(inside), "{motion:?}");
        }
    }

    #[test]
    fn the_start_depends_on_the_seed_and_on_the_obstacle() {
        let across = Motion::Across {
            by_m: [0.0, 6.0, 0.0],
            speed_mps: 1.0,
        };
        let start = |number, seed| across.offset_m(number, Moment { secs: 0.0, seed });
        assert_ne!(start(0, 1), start(0, 2));
        assert_ne!(start(0, 1), start(1, 1));
        assert_eq!(start(0, 1), start(0, 1));
    }
}
