//! Errors of a stereo camera, compared with the settings.

use nalgebra::Isometry3;

use super::{CameraSettings, DepthCamera, IMAGE_HEIGHT, IMAGE_PIXELS, IMAGE_WIDTH, InstructionSet};
use crate::course::{
    Corridor, Course, CourseLayout, Opening, Shape, StartArea, WallLabel, WallLayout, test_course,
};
use crate::disturbances::{DepthModel, DepthNoiseSettings};

/// Returns settings with noise alone: no shadows, no patches.
fn noise_alone() -> DepthNoiseSettings {
    DepthNoiseSettings {
        model: DepthModel::Stereo,
        baseline_m: 0.0,
        dropout_share: 0.0,
        ..Default::default()
    }
}

/// Returns a course with one wall at 41 m, in a corridor so wide that a camera before the wall sees
/// only the wall around the middle. The opening is far to the side.
fn wide_hall() -> Course {
    Course::new(CourseLayout {
        name: "hall".into(),
        corridor: Corridor {
            length_m: 60.0,
            width_m: 80.0,
            height_m: 60.0,
        },
        start: StartArea::default(),
        wall_thickness_m: 0.3,
        walls: vec![WallLayout {
            label: WallLabel(1),
            x_m: 41.0,
            opening: Opening {
                shape: Shape::Rectangle {
                    width_m: 2.0,
                    height_m: 2.0,
                },
                centre_m: [34.0, 30.0],
                rotation_deg: 0.0,
            },
        }],
    })
    .unwrap()
}

/// Returns settings of a camera in the middle of the body.
fn lens() -> CameraSettings {
    CameraSettings {
        mount_m: [0.0; 3],
        ..Default::default()
    }
}

/// Returns an image of the wall from `depth_m` before it.
fn facing_wall(noise: &DepthNoiseSettings, depth_m: f32, key: u64) -> Box<[u8; IMAGE_PIXELS]> {
    let mut image = Box::new([0; IMAGE_PIXELS]);
    let mut camera = DepthCamera::new(&lens(), &wide_hall())
        .unwrap()
        .with_noise(noise);
    camera.render_with_noise(
        &Isometry3::translation(41.0 - depth_m, 0.0, 30.0),
        key,
        &mut image,
    );
    image
}

/// Returns an image of the test course's first opening from `depth_m` before its wall.
fn facing_opening(noise: &DepthNoiseSettings, depth_m: f32, key: u64) -> Box<[u8; IMAGE_PIXELS]> {
    let mut image = Box::new([0; IMAGE_PIXELS]);
    let course = test_course();
    let wall = &course.walls()[0];
    let [y_m, z_m] = wall.safe_point();
    let mut camera = DepthCamera::new(&lens(), &course)
        .unwrap()
        .with_noise(noise);
    camera.render_with_noise(
        &Isometry3::translation(wall.x_m() - depth_m, y_m, z_m),
        key,
        &mut image,
    );
    image
}

#[test]
fn readings_scatter_by_sigma_around_the_true_depth() {
    let noise = noise_alone();
    for depth_m in [1.0, 2.0, 5.0, 10.0, 15.0] {
        let readings: Vec<f64> = (0..20)
            .flat_map(|key| *facing_wall(&noise, depth_m, key))
            .map(|level| f64::from(level) / 255.0 * 20.0)
            .collect();
        let mean = readings.iter().sum::<f64>() / readings.len() as f64;
        let variance =
            readings.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / readings.len() as f64;
        // Rounding to whole levels adds a twelfth of a squared level to the variance.
        let level_m = 20.0 / 255.0;
        let sigma = f64::from(noise.sigma_m(depth_m));
        assert!(
            (mean - f64::from(depth_m)).abs() < 0.5 * level_m,
            "{depth_m} m: mean {mean}"
        );
        let expected = (sigma.powi(2) + level_m.powi(2) / 12.0).sqrt();
        // Noise below one level is not independent of the rounding.
        if sigma > level_m {
            assert!(
                (variance.sqrt() / expected - 1.0).abs() < 0.02,
                "{depth_m} m: {} m, not {expected} m",
                variance.sqrt()
            );
        } else {
            assert!(
                variance.sqrt() < level_m,
                "{depth_m} m: {} m",
                variance.sqrt()
            );
        }
    }
}

#[test]
fn the_mean_level_shows_a_depth_between_two_grey_levels() {
    // 6.00 m is level 76.5, and sigma is 0.15 m or two levels.
    let image = facing_wall(&noise_alone(), 6.0, 1);
    let mean = image.iter().map(|&level| f64::from(level)).sum::<f64>() / IMAGE_PIXELS as f64;
    assert!((mean - 76.5).abs() < 0.1, "{mean}");
}

#[test]
fn errors_of_two_keys_are_independent_and_of_one_key_equal() {
    let noise = noise_alone();
    let deviation = |key| facing_wall(&noise, 10.0, key).map(|level| f64::from(level) - 127.5);
    let (one, other) = (deviation(1), deviation(2));
    assert!(one == deviation(1));
    let product = |a: &[f64], b: &[f64]| {
        a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / IMAGE_PIXELS as f64
    };
    assert!((product(&one, &other) / product(&one, &one)).abs() < 0.04);
    // Neighbours to the right and below are independent as well.
    for lag in [1, IMAGE_WIDTH] {
        assert!(
            (product(&one[lag..], &one) / product(&one, &one)).abs() < 0.04,
            "lag {lag}"
        );
    }
}

#[test]
fn a_surface_out_of_range_has_no_noise() {
    assert!(
        facing_wall(&noise_alone(), 30.0, 1)
            .iter()
            .all(|&level| level == 255)
    );
}

#[test]
fn a_shadow_lies_left_of_a_near_edge_and_is_as_wide_as_the_disparity_difference() {
    let shadows_alone = |baseline_m| DepthNoiseSettings {
        model: DepthModel::Stereo,
        sigma_quadratic_per_m: 0.0,
        sigma_linear: 0.0,
        sigma_constant_m: 0.0,
        baseline_m,
        dropout_share: 0.0,
        ..Default::default()
    };
    // The opening shows the next wall 10 m behind. With a focal length of 64 pixels and a baseline
    // of 0.2 m, the disparities at 2 m and 12.3 m are 6.4 and 1.0 pixels.
    let row = IMAGE_HEIGHT / 2;
    let of_row = |image: &[u8; IMAGE_PIXELS]| image[row * IMAGE_WIDTH..][..IMAGE_WIDTH].to_vec();
    let (seen, truth) = (
        of_row(&facing_opening(&shadows_alone(0.2), 2.0, 1)),
        of_row(&facing_opening(&shadows_alone(0.0), 2.0, 1)),
    );
    let lost: Vec<usize> = (0..IMAGE_WIDTH)
        .filter(|&column| seen[column] == 0 && truth[column] != 0)
        .collect();
    // The opening's right edge, where the near wall begins again. The left edge casts no shadow,
    // because the left lens sees less there than the right one.
    let edge = (IMAGE_WIDTH / 2..IMAGE_WIDTH)
        .find(|&column| truth[column] < truth[column - 1] / 2)
        .unwrap();
    let (border, within): (Vec<usize>, Vec<usize>) = lost.iter().partition(|&&column| column < 16);
    assert!(
        (4..=6).contains(&within.len()),
        "{within:?}, edge at {edge}"
    );
    assert!(
        within
            .iter()
            .all(|&column| column < edge && column + 7 > edge),
        "{within:?}, edge at {edge}"
    );
    // The right lens does not see the image's left border: 6.4 pixels at 2 m, more where the
    // corridor's side is nearer.
    assert!((5..=8).contains(&border.len()), "{border:?}");
    // All other pixels are unchanged.
    assert!((0..IMAGE_WIDTH).all(|column| lost.contains(&column) || seen[column] == truth[column]));
}

#[test]
fn patches_cover_the_configured_share_and_are_contiguous() {
    let patches_alone = DepthNoiseSettings {
        baseline_m: 0.0,
        dropout_share: 0.05,
        ..noise_alone()
    };
    let (mut lost, mut with_lost_neighbour) = (0, 0);
    let images = 200;
    for key in 0..images {
        let image = facing_wall(&patches_alone, 5.0, key);
        for (number, _) in image.iter().enumerate().filter(|(_, level)| **level == 0) {
            lost += 1;
            with_lost_neighbour += usize::from(number % IMAGE_WIDTH > 0 && image[number - 1] == 0);
        }
    }
    let share = lost as f64 / (images as usize * IMAGE_PIXELS) as f64;
    // Overlaps make the share slightly less than configured.
    assert!((0.045..0.051).contains(&share), "{share}");
    assert!(
        with_lost_neighbour as f64 > 0.8 * lost as f64,
        "{with_lost_neighbour} of {lost}"
    );
}

#[test]
fn a_noisy_reading_is_never_zero() {
    // Noise as large as the depth.
    let wild = DepthNoiseSettings {
        sigma_constant_m: 5.0,
        ..noise_alone()
    };
    assert!(facing_wall(&wild, 2.0, 1).iter().all(|&level| level > 0));
}

#[test]
fn a_camera_without_noise_ignores_the_key() {
    let off = DepthNoiseSettings::default();
    let mut truth = [0; IMAGE_PIXELS];
    DepthCamera::new(&lens(), &wide_hall())
        .unwrap()
        .render(&Isometry3::translation(36.0, 0.0, 30.0), &mut truth);
    assert!(*facing_wall(&off, 5.0, 1) == truth && *facing_wall(&off, 5.0, 2) == truth);
}

#[test]
fn instruction_sets_change_no_bit_of_the_errors() {
    let settings = DepthNoiseSettings {
        model: DepthModel::Stereo,
        ..Default::default()
    };
    let course = test_course();
    let mut camera = DepthCamera::new(&CameraSettings::default(), &course)
        .unwrap()
        .with_noise(&settings);
    let pose = Isometry3::translation(7.0, 0.4, 3.0);
    let [mut plain, mut wider] = [[0; IMAGE_PIXELS]; 2];
    camera.draw = super::draw;
    camera.render_with_noise(&pose, 9, &mut plain);
    for set in InstructionSet::ALL
        .into_iter()
        .filter(|set| set.is_available())
    {
        camera.draw = set.draw();
        camera.render_with_noise(&pose, 9, &mut wider);
        assert!(plain == wider, "{set}");
    }
}
