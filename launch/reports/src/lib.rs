//! Plots of a run, drawn from its files.
//!
//! No running process is involved: every run, however it ended, can be drawn again later.

mod canvas;
mod clock;
pub mod comparison;
mod courses;
pub mod curves;
pub mod growth;
mod reconstructions;
mod trajectories;

use std::io;
use std::path::PathBuf;

use skein_run::RunDirectory;

pub use clock::Clock;
pub use courses::{NamedCourse, ideal_walls_passed, load_courses};

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
#[derive(Debug)]
pub struct RunMaterial {
    episodes: Option<Vec<curves::EpisodeRow>>,
    reconstructions: Option<reconstructions::Pairs>,
    paths: Option<trajectories::TrajectoriesByCourse>,
}

impl RunMaterial {
    /// Reads all files before anything is drawn.
    ///
    /// # Errors
    /// [`ReportError`] names the invalid file.
    pub fn read(run: &RunDirectory) -> Result<Self, ReportError> {
        Ok(Self {
            episodes: existing(run.episodes_csv())
                .map(|path| curves::read_episodes(&path))
                .transpose()?,
            reconstructions: existing(run.reconstructions())
                .map(|path| reconstructions::Pairs::read(&path))
                .transpose()?,
            paths: existing(run.evaluation_trajectories_csv())
                .map(|path| trajectories::read_trajectories(&path))
                .transpose()?,
        })
    }
}

/// Draws every plot whose input exists, and returns the pictures. A run that ended early has fewer.
///
/// `courses` are those of the final evaluation. `window` is the number of episodes to average over,
/// and `ideal_walls_passed` the average of a perfect agent.
///
/// # Errors
/// [`ReportError`] names the invalid file, or the picture that cannot be written.
pub fn draw_all(
    run: &RunDirectory,
    courses: &[NamedCourse],
    window: usize,
    ideal_walls_passed: f64,
) -> Result<Vec<PathBuf>, ReportError> {
    let material = RunMaterial::read(run)?;
    let mut pictures = Vec::new();
    let mut picture = |name: &str| {
        let path = run.plots().join(name);
        pictures.push(path.clone());
        path
    };
    if let Some(episodes) = &material.episodes {
        curves::draw_return(episodes, window, &picture("return.png"))?;
        curves::draw_walls_passed(
            episodes,
            window,
            ideal_walls_passed,
            &picture("walls_passed.png"),
        )?;
    }
    if let Some(pairs) = &material.reconstructions {
        reconstructions::draw(pairs, &picture("reconstructions.png"))?;
    }
    if let Some(paths) = &material.paths {
        trajectories::draw(courses, paths, &picture("trajectories.png"))?;
    }
    Ok(pictures)
}

fn existing(path: PathBuf) -> Option<PathBuf> {
    path.exists().then_some(path)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

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

        let pictures = draw_all(&run, &[training()], 50, 3.0).unwrap();
        assert_eq!(pictures.len(), 4);
        for picture in pictures {
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
        assert!(draw_all(&run, &[training()], 50, 3.0).unwrap().is_empty());
        write_episodes(&run);
        assert_eq!(draw_all(&run, &[training()], 50, 3.0).unwrap().len(), 2);
    }
}
