//! Plots of a run, drawn from its files.
//!
//! No running process is involved: every run, however it ended, can be drawn again later.

mod canvas;
mod clock;
pub mod comparison;
mod complete_rows;
mod courses;
pub mod curves;
pub mod failures;
pub mod flight;
mod front_views;
pub mod growth;
mod head;
mod obstacles;
mod reconstructions;
mod trajectories;

use std::io;
use std::path::{Path, PathBuf};

use skein_run::RunDirectory;

pub use canvas::unfinished_picture;
pub use clock::Clock;
pub use complete_rows::TornRow;
pub use courses::{NamedCourse, ideal_walls_passed, load_courses};
pub use trajectories::{FlownCourse, MOST_DRAWN, Trajectory, draw_trajectories};

/// Reason why a plot could not be made.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// The contents of a file are invalid.
    #[error("{} cannot be plotted: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Problem and its position.
        problem: String,
    },
    /// The plotting library failed.
    #[error("cannot draw: {0}")]
    Draw(String),
    /// A picture cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The picture.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
}

/// Contents of the files to be drawn. A run that ended early has fewer.
#[derive(Debug, Default)]
pub struct RunMaterial {
    episodes: Option<Vec<curves::PlottedEpisode>>,
    reconstructions: Option<reconstructions::Pairs>,
    trajectories: Option<trajectories::TrajectoriesByCourse>,
    torn: Vec<TornRow>,
}

impl RunMaterial {
    /// Reads all files before anything is drawn. Also returns a [`ReportError`] for each file that
    /// is invalid; the others are read nevertheless. So are the complete rows of a table whose last
    /// row is cut off.
    pub fn read(run: &RunDirectory) -> (Self, Vec<ReportError>) {
        let mut failures = Vec::new();
        let episodes = existing(run.episodes_csv(), curves::read_episodes, &mut failures);
        let reconstructions = existing(
            run.reconstructions(),
            reconstructions::Pairs::read,
            &mut failures,
        );
        let trajectories = existing(
            run.evaluation_trajectories_csv(),
            trajectories::read_trajectories,
            &mut failures,
        );
        let (episodes, episodes_torn) = episodes.unzip();
        let (trajectories, trajectories_torn) = trajectories.unzip();
        let torn = [episodes_torn, trajectories_torn];
        let material = Self {
            episodes,
            reconstructions,
            trajectories,
            torn: torn.into_iter().flatten().flatten().collect(),
        };
        (material, failures)
    }
}

/// Plots of a run.
#[derive(Debug, Default)]
pub struct DrawnPlots {
    /// The pictures.
    pub pictures: Vec<PathBuf>,
    /// A [`ReportError`] for each file that is invalid and each picture that cannot be written.
    pub failures: Vec<ReportError>,
    /// Rows that the pictures lack.
    pub torn: Vec<TornRow>,
}

/// Draws every plot whose input exists. A run that ended early has fewer. A plot that fails leaves
/// the others alone.
///
/// `courses` are those of the final evaluation; without them, trajectories are not drawn. `window`
/// is the number of episodes to average over, and `ideal_walls_passed` the average of a perfect
/// agent, if it is known.
pub fn draw_all(
    run: &RunDirectory,
    courses: &[NamedCourse],
    window: usize,
    ideal_walls_passed: Option<f64>,
) -> DrawnPlots {
    let (material, failures) = RunMaterial::read(run);
    let mut plots = DrawnPlots {
        pictures: Vec::new(),
        failures,
        torn: material.torn,
    };
    let mut picture = |name: &str, draw: &dyn Fn(&Path) -> Result<(), ReportError>| {
        let path = run.plots().join(name);
        match draw(&path) {
            Ok(()) => plots.pictures.push(path),
            Err(error) => plots.failures.push(error),
        }
    };
    if let Some(episodes) = material.episodes.filter(|episodes| !episodes.is_empty()) {
        picture("return.png", &|path| {
            curves::draw_return(&episodes, window, path)
        });
        picture("walls_passed.png", &|path| {
            curves::draw_walls_passed(&episodes, window, ideal_walls_passed, path)
        });
    }
    if let Some(pairs) = &material.reconstructions {
        picture("reconstructions.png", &|path| {
            reconstructions::draw(pairs, path)
        });
    }
    let trajectories = material.trajectories.unwrap_or_default();
    let flown = trajectories::flown(courses, &trajectories);
    if !flown.is_empty() {
        picture("trajectories.png", &|path| draw_trajectories(&flown, path));
    } else if let Some(name) = trajectories.keys().next().filter(|_| !courses.is_empty()) {
        plots.failures.push(ReportError::Malformed {
            path: run.evaluation_trajectories_csv(),
            problem: format!("{name:?}, like its other courses, is not one of this run's"),
        });
    }
    plots
}

/// Draws depth images above their reconstructions, both `[n, 72, 128]`, to `path`.
///
/// # Errors
/// Returns [`ReportError`] if there are not as many of both, or the picture cannot be drawn or
/// written.
pub fn draw_reconstructions(
    depth: &[u8],
    reconstructions: &[u8],
    path: &Path,
) -> Result<(), ReportError> {
    let pairs = reconstructions::Pairs::of(depth.to_vec(), reconstructions.to_vec());
    let pairs = pairs.map_err(|problem| ReportError::Malformed {
        path: path.to_owned(),
        problem,
    })?;
    reconstructions::draw(&pairs, path)
}

/// Reads a file if it exists and is valid.
fn existing<T>(
    path: PathBuf,
    read: impl FnOnce(&Path) -> Result<T, ReportError>,
    failures: &mut Vec<ReportError>,
) -> Option<T> {
    if !path.exists() {
        return None;
    }
    read(&path).map_err(|error| failures.push(error)).ok()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use safetensors::Dtype;
    use safetensors::tensor::TensorView;

    use skein_simulator::course::Course;

    use super::*;

    fn training() -> NamedCourse {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/courses/training.toml");
        NamedCourse {
            name: "training".to_owned(),
            course: Course::load(path).unwrap(),
        }
    }

    fn write_episodes(run: &RunDirectory) {
        let rows = "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n\
                    0,0,0,0,1,12,0,-0.9,collided\n1,0,0,1,1,33,1,0.2,collided\n";
        fs::write(run.episodes_csv(), rows).unwrap();
    }

    #[test]
    fn a_complete_run_has_four_pictures() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        write_episodes(&run);
        let rows = "course,episode,step,x_m,y_m,z_m,outcome\ntraining,0,0,1.5,0,3,collided\n\
                    training,0,1,9.7,1,3,collided\n";
        fs::write(run.evaluation_trajectories_csv(), rows).unwrap();
        let image = vec![7; skein_protocol::IMAGE_PIXELS];
        let shape = vec![1, skein_protocol::IMAGE_HEIGHT, skein_protocol::IMAGE_WIDTH];
        let view = TensorView::new(Dtype::U8, shape, &image).unwrap();
        let tensors = [("depth", view.clone()), ("reconstruction", view)];
        fs::write(
            run.reconstructions(),
            safetensors::serialize(tensors, None).unwrap(),
        )
        .unwrap();

        let plots = draw_all(&run, &[training()], 50, Some(3.0));
        assert_eq!((plots.pictures.len(), plots.failures.len()), (4, 0));
        for picture in plots.pictures {
            let bytes = fs::read(&picture).unwrap();
            assert!(
                bytes.starts_with(b"\x89PNG") && bytes.ends_with(b"IEND\xaeB`\x82"),
                "{}",
                picture.display()
            );
        }
    }

    #[test]
    fn a_run_that_ended_early_has_the_pictures_of_its_files() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let drawn = || {
            let plots = draw_all(&run, &[training()], 50, Some(3.0));
            assert!(plots.failures.is_empty(), "{:?}", plots.failures);
            plots.pictures.len()
        };
        assert_eq!(drawn(), 0);
        write_episodes(&run);
        assert_eq!(drawn(), 2);
    }

    #[test]
    fn a_plot_that_cannot_be_drawn_is_named_and_leaves_the_others_alone() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        write_episodes(&run);
        fs::write(run.evaluation_trajectories_csv(), b"course\n\xff\n").unwrap();
        fs::write(run.reconstructions(), b"{").unwrap();
        // In the place of a picture.
        fs::create_dir_all(run.plots().join("return.png")).unwrap();
        // Without courses and the level of a perfect agent: their files are damaged.
        let plots = draw_all(&run, &[], 50, None);
        assert_eq!(plots.pictures, [run.plots().join("walls_passed.png")]);
        let failures: Vec<_> = plots.failures.iter().map(ToString::to_string).collect();
        for name in [
            "reconstructions.safetensors",
            "evaluation_trajectories.csv",
            "return.png",
        ] {
            assert!(
                failures.iter().any(|failure| failure.contains(name)),
                "{name} is not named: {failures:?}"
            );
        }
        assert_eq!(failures.len(), 3);
    }

    #[test]
    fn a_row_that_is_cut_off_is_named_and_costs_no_picture() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        for (rows, pictures) in [("4,2,1.0\n4,2,1", 2), ("\0\0\0", 0)] {
            fs::write(
                run.episodes_csv(),
                format!("steps,walls_passed,return\n{rows}"),
            )
            .unwrap();
            let plots = draw_all(&run, &[training()], 50, Some(3.0));
            assert_eq!(plots.pictures.len(), pictures, "{rows:?}");
            assert!(plots.failures.is_empty(), "{:?}", plots.failures);
            let [torn] = &plots.torn[..] else {
                panic!("{rows:?}: nobody says that a row is missing");
            };
            assert!(torn.to_string().contains("episodes.csv"), "{torn}");
        }
        let (episodes, _) = curves::read_episodes(&run.episodes_csv()).unwrap();
        assert!(episodes.is_empty());
    }

    #[test]
    fn damaged_and_short_files_are_drawn_or_named() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(directory.path());
        let header = "steps,walls_passed,return\n";
        for (rows, pictures) in [
            (String::new(), 0),
            (header.to_owned(), 0),
            (format!("{header}4,2,1.0\n"), 2),
            (format!("{header}4,2,1e11\n4,4294967295,-1e11\n"), 2),
        ] {
            fs::write(run.episodes_csv(), &rows).unwrap();
            let plots = draw_all(&run, &[training()], 50, Some(3.0));
            assert_eq!(plots.pictures.len(), pictures, "{rows}");
            assert!(plots.failures.is_empty(), "{rows}");
        }
        fs::remove_file(run.episodes_csv()).unwrap();
        fs::create_dir(run.episodes_csv()).unwrap();
        let rows = "course,episode,step,x_m,y_m,z_m,outcome\nother,0,0,1.5,0,3,collided\n";
        fs::write(run.evaluation_trajectories_csv(), rows).unwrap();
        let plots = draw_all(&run, &[training()], 50, Some(3.0));
        let failures: Vec<_> = plots.failures.iter().map(ToString::to_string).collect();
        assert!(failures[0].contains("episodes.csv"), "{failures:?}");
        assert!(
            failures[1].contains("\"other\", like its other"),
            "{failures:?}"
        );
        fs::remove_file(run.evaluation_trajectories_csv()).unwrap();
        fs::remove_dir(run.episodes_csv()).unwrap();
        for rows in ["4,2\n", "4,2,inf\n", "4,-1,1\n", "\0\0\0\n"] {
            fs::write(run.episodes_csv(), format!("{header}{rows}")).unwrap();
            let plots = draw_all(&run, &[training()], 50, Some(3.0));
            let [failure] = &plots.failures[..] else {
                panic!("{rows:?} is drawn");
            };
            assert!(failure.to_string().contains("episodes.csv"), "{failure}");
            assert!(failure.to_string().contains("line"), "{failure}");
        }
    }
}
