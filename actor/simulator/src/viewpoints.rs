//! Depth images from random poses in a course, as a flying drone sees them, without a flight.
//!
//! Images of flights show what the present policy meets. An encoder that is to serve any policy
//! needs the others too: far from the way, close to walls, inside openings, behind the last wall.

use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use rand::{Rng, RngExt};

use crate::camera::{DepthCamera, IMAGE_PIXELS};
use crate::course::Course;
use crate::disturbances::standard_normal;
use crate::simulator::{OpeningAhead, SimulatorError, SimulatorSettings};
use crate::vehicle::{Vehicle, VehicleState};
use crate::world::World;

/// Share of poses near the straight way from one opening to the next. The others are anywhere.
const ON_THE_WAY: f32 = 0.5;
/// Standard deviation of those poses from the way, left and up, metres.
const OFF_THE_WAY_M: f32 = 0.5;
/// Standard deviation of roll and pitch, radians. The oracle's roll and pitch are 0.02 and 0.01
/// root mean square; a policy that explores tilts more. Every vehicle keeps its nose along the
/// corridor.
const TILT_RAD: f32 = 0.03;
/// Distance of a wall below which the edges of its opening leave the image, metres.
const TOO_NEAR_M: f32 = 0.5;
/// Positions tried in a cross-section before another one is drawn.
const TRIES: u32 = 8;

/// A body and a camera that appear anywhere in a course.
pub struct Viewpoints {
    course: Arc<Course>,
    world: World,
    camera: DepthCamera,
    half_length_m: f32,
    /// Tangents of half the angles of view, horizontal and vertical.
    half_view: [f32; 2],
    /// The camera's range, metres.
    range_m: f32,
    noisy_share: f32,
}

/// Openings ahead of a viewpoint, if their safe point is in sight and within the camera's range:
/// the next wall's, and that of the wall behind it.
pub type OpeningsInSight = [Option<OpeningAhead>; 2];

impl Viewpoints {
    /// Returns the viewpoints of `course`, for the drone and camera of `settings`. A share of the
    /// images has the depth errors of `settings`, as many as there are disturbed episodes.
    ///
    /// # Errors
    /// [`SimulatorError`] names the setting or the course at fault.
    pub fn new(course: Arc<Course>, settings: &SimulatorSettings) -> Result<Self, SimulatorError> {
        settings.vehicle.validate()?;
        settings
            .disturbances
            .validate(&settings.vehicle, settings.camera.range_m)?;
        let body = Vehicle::trimmed(&settings.vehicle).body();
        let world = World::new(&course, body, 1.0).map_err(|source| SimulatorError::Mesh {
            course: course.name().to_owned(),
            source,
        })?;
        let camera = DepthCamera::new(&settings.camera, &course)?;
        Ok(Self {
            course,
            world,
            camera: camera.with_noise(&settings.disturbances.depth),
            half_length_m: body.half_extents_m.x,
            half_view: settings.camera.half_view(),
            range_m: settings.camera.range_m,
            noisy_share: settings.disturbances.share,
        })
    }

    /// Draws a pose at which the body touches nothing, its depth image into `image`, and the same
    /// without the camera's errors into `clean`. Returns the openings in sight.
    pub fn draw(
        &mut self,
        rng: &mut impl Rng,
        image: &mut [u8; IMAGE_PIXELS],
        clean: &mut [u8; IMAGE_PIXELS],
    ) -> OpeningsInSight {
        let pose = loop {
            if let Some(pose) = self.pose(rng) {
                break pose;
            }
        };
        // Always drawn, so that the poses do not depend on the disturbances.
        let (noisy, key) = (rng.random::<f32>() < self.noisy_share, rng.random());
        self.camera.move_obstacles(self.world.moment());
        self.camera.render(&pose, clean);
        match noisy {
            true => self.camera.render_with_noise(&pose, key, image),
            false => *image = *clean,
        }
        self.in_sight(&pose)
    }

    /// Draws a cross-section and a free pose in it; `None` if it finds none.
    fn pose(&self, rng: &mut impl Rng) -> Option<Isometry3<f32>> {
        let corridor = self.course.corridor();
        let margin_m = self.half_length_m;
        let x_m = rng.random_range(margin_m..=corridor.length_m - margin_m);
        let way = self.way_at(x_m);
        let (half_y, height) = (corridor.width_m / 2.0, corridor.height_m);
        (0..TRIES).find_map(|_| {
            let on_the_way = rng.random::<f32>() < ON_THE_WAY;
            let [y_m, z_m] = match on_the_way {
                true => way.map(|way_m| way_m + OFF_THE_WAY_M * normal(rng)),
                false => [
                    rng.random_range(-half_y..=half_y),
                    rng.random_range(0.0..=height),
                ],
            };
            let [roll, pitch] = [0; 2].map(|_| TILT_RAD * normal(rng));
            let pose = Isometry3::from_parts(
                Translation3::new(x_m, y_m, z_m),
                UnitQuaternion::from_euler_angles(roll, pitch, 0.0),
            );
            let inside = y_m.abs() < half_y && (0.0..height).contains(&z_m);
            let is_free = inside
                && self
                    .course
                    .is_reachable(&Point3::from(pose.translation.vector))
                && self.world.is_free_at(&pose);
            is_free.then_some(pose)
        })
    }

    /// Returns the point `[y, z]` at `x_m` of the straight way through the openings, metres. In a
    /// world, it is the middle of the cross-section.
    fn way_at(&self, x_m: f32) -> [f32; 2] {
        let corridor = self.course.corridor();
        let middle = [0.0, corridor.height_m / 2.0];
        let (mut from_m, mut from) = (0.0, middle);
        for wall in self.course.walls() {
            let (to_m, to) = (wall.x_m(), wall.safe_point());
            if x_m <= to_m {
                let share = (x_m - from_m) / (to_m - from_m);
                return [0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis]));
            }
            (from_m, from) = (to_m + self.course.wall_thickness_m(), to);
            if x_m <= from_m {
                return from;
            }
        }
        from
    }

    fn in_sight(&self, pose: &Isometry3<f32>) -> OpeningsInSight {
        let state = VehicleState {
            world_from_body: pose.rotation,
            ..VehicleState::at_rest(Point3::from(pose.translation.vector))
        };
        let mut ahead = self
            .course
            .walls()
            .iter()
            .filter(|wall| wall.x_m() > state.position_m.x)
            .map(|wall| OpeningAhead::of_wall(wall, &state));
        let next = ahead.next();
        let after = ahead.next().zip(next).and_then(|(after, next)| {
            // Where the line of sight passes the next wall.
            let share = next.distance_m / after.distance_m;
            let miss = [0, 1].map(|axis| share * after.offset_m[axis] - next.offset_m[axis]);
            (miss[0].hypot(miss[1]) < next.clearance_m).then_some(after)
        });
        [next, after].map(|opening| opening.filter(|opening| self.is_in_view(opening)))
    }

    fn is_in_view(&self, opening: &OpeningAhead) -> bool {
        (TOO_NEAR_M..self.range_m).contains(&opening.distance_m)
            && (0..2).all(|axis| {
                opening.offset_m[axis].abs() < opening.distance_m * self.half_view[axis]
            })
    }
}

/// Draws a number of mean 0 and variance 1.
fn normal(rng: &mut impl Rng) -> f32 {
    standard_normal(rng.next_u32(), rng.next_u32())
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    use super::*;
    use crate::course::test_course;
    use crate::disturbances::DepthModel;

    fn drawn(
        settings: &SimulatorSettings,
        count: usize,
    ) -> Vec<(Vec<u8>, Vec<u8>, OpeningsInSight)> {
        let mut points = Viewpoints::new(Arc::new(test_course()), settings).unwrap();
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let (mut image, mut clean) = ([0; IMAGE_PIXELS], [0; IMAGE_PIXELS]);
        let mut draw = || {
            let openings = points.draw(&mut rng, &mut image, &mut clean);
            (image.to_vec(), clean.to_vec(), openings)
        };
        (0..count).map(|_| draw()).collect()
    }

    #[test]
    fn poses_are_free_everywhere_along_the_corridor_and_inside_openings() {
        let settings = SimulatorSettings::default();
        let course = test_course();
        let points = Viewpoints::new(Arc::new(course.clone()), &settings).unwrap();
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let drawn: Vec<_> = (0..4000).filter_map(|_| points.pose(&mut rng)).collect();
        assert!(drawn.len() > 3000, "{}", drawn.len());
        assert!(drawn.iter().all(|pose| points.world.is_free_at(pose)));
        let within = |least_m: f32, most_m: f32| {
            let x_m = drawn.iter().map(|pose| pose.translation.x);
            x_m.filter(|x_m| (least_m..most_m).contains(x_m)).count()
        };
        let thickness_m = course.wall_thickness_m();
        for wall in course.walls() {
            assert!(within(wall.x_m(), wall.x_m() + thickness_m) > 3);
        }
        let last_m = course.walls().last().unwrap().x_m();
        assert!(within(last_m + 1.0, course.corridor().length_m) > 100);
        let across: Vec<_> = drawn.iter().map(|pose| pose.translation.y.abs()).collect();
        assert!(
            across.iter().any(|y_m| *y_m > 2.2),
            "close to the corridor's sides"
        );
    }

    #[test]
    fn openings_in_sight_are_within_the_image_and_nothing_else_is_known() {
        let drawn = drawn(&SimulatorSettings::default(), 500);
        let [mut next, mut after] = [0, 0];
        for (_, _, openings) in &drawn {
            for opening in openings.iter().flatten() {
                assert!((TOO_NEAR_M..20.0).contains(&opening.distance_m));
                let [left, up] = opening.offset_m.map(f32::abs);
                assert!(left < opening.distance_m && up < 0.5625 * opening.distance_m + 1e-3);
            }
            next += usize::from(openings[0].is_some());
            after += usize::from(openings[1].is_some());
        }
        assert!(
            next > 200 && after > 20 && after < next && next < 480,
            "{next}, {after}"
        );
    }

    #[test]
    fn a_share_of_the_images_has_the_cameras_errors_and_all_have_a_clean_one() {
        let mut settings = SimulatorSettings::default();
        let calm = drawn(&settings, 60);
        assert!(calm.iter().all(|(image, clean, _)| image == clean));
        settings.disturbances.depth.model = DepthModel::Stereo;
        settings.disturbances.share = 0.5;
        let noisy = drawn(&settings, 60);
        let disturbed = noisy
            .iter()
            .filter(|(image, clean, _)| image != clean)
            .count();
        assert!((15..45).contains(&disturbed), "{disturbed} of 60");
        let same = calm
            .iter()
            .zip(&noisy)
            .all(|(calm, noisy)| calm.1 == noisy.1);
        assert!(same, "errors change no pose");
    }
}
