//! The final evaluation of a run: courses, trajectories, and where episodes failed.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context;
use serde::{Deserialize, Serialize};
use skein_protocol::transition::Outcome;
use skein_run::RunDirectory;
use skein_simulator::course::Course;

use crate::catalogue::Catalogue;

/// Most trajectories of a course on the page; failed ones come first.
const MOST_EPISODES: usize = 60;

/// A course, and the evaluation episodes on it.
#[derive(Debug, Serialize)]
pub(crate) struct FlownCourse {
    name: String,
    /// Length, width, height.
    corridor_m: [f32; 3],
    walls: Vec<WallShape>,
    /// Triangles of the obstacles of a world that stand still.
    obstacles_m: Vec<[[f32; 3]; 3]>,
    /// Number of all episodes.
    episodes: usize,
    failed: usize,
    flights: Vec<Flight>,
}

#[derive(Debug, Serialize)]
struct WallShape {
    x_m: f32,
    /// Corners `[y, z]` of the opening.
    outline_m: Vec<[f32; 2]>,
    triangles_m: Vec<[[f32; 3]; 3]>,
}

#[derive(Debug, Serialize)]
struct Flight {
    episode: u64,
    outcome: Outcome,
    points_m: Vec<[f32; 3]>,
}

/// Row of `evaluation_trajectories.csv`.
#[derive(Deserialize)]
struct Row {
    course: String,
    episode: u64,
    x_m: f32,
    y_m: f32,
    z_m: f32,
    outcome: Outcome,
}

/// Returns the evaluation of a run, course by course; none before its end.
///
/// # Errors
/// Names the file and the line.
pub(crate) fn read(catalogue: &Catalogue, run: &RunDirectory) -> anyhow::Result<Vec<FlownCourse>> {
    let path = run.evaluation_trajectories_csv();
    if !path.exists() {
        return Ok(Vec::new());
    }
    let flights = flights(&catalogue.read_text(&path)?)?;
    let mut flown = Vec::new();
    for course in courses(catalogue, run)? {
        if let Some(flights) = flights.get(course.name()) {
            flown.push(of_course(&course, flights));
        }
    }
    Ok(flown)
}

/// Returns the courses in the run's folder.
fn courses(catalogue: &Catalogue, run: &RunDirectory) -> anyhow::Result<Vec<Course>> {
    let folder = catalogue.inside(&run.courses())?;
    let mut files: Vec<_> = std::fs::read_dir(&folder)
        .context("cannot read courses")?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            path.extension()
                .is_some_and(|extension| extension == "toml")
        })
        .collect();
    files.sort();
    let load = |path: &PathBuf| {
        let path = catalogue.inside(path)?;
        for mesh in Course::mesh_files(&path)? {
            let outside = || format!("mesh {} of {}", mesh.display(), path.display());
            catalogue
                .inside(&folder.join(&mesh))
                .with_context(outside)?;
        }
        Ok(Course::load(path)?)
    };
    files.iter().map(load).collect()
}

fn flights(text: &str) -> anyhow::Result<BTreeMap<String, Vec<Flight>>> {
    let mut courses = BTreeMap::<String, Vec<Flight>>::new();
    // The last row may be half written.
    let complete = text.rfind('\n').map_or("", |end| &text[..=end]);
    let mut reader = csv::Reader::from_reader(complete.as_bytes());
    for row in reader.deserialize() {
        let row: Row = row.context("evaluation_trajectories.csv is damaged")?;
        let flights = courses.entry(row.course).or_default();
        if flights
            .last()
            .is_none_or(|last| last.episode != row.episode)
        {
            flights.push(Flight {
                episode: row.episode,
                outcome: row.outcome,
                points_m: Vec::new(),
            });
        }
        if let Some(flight) = flights.last_mut() {
            flight.points_m.push([row.x_m, row.y_m, row.z_m]);
        }
    }
    Ok(courses)
}

fn of_course(course: &Course, flights: &[Flight]) -> FlownCourse {
    let corridor = course.corridor();
    let has_failed = |flight: &&Flight| flight.outcome != Outcome::ReachedEnd;
    let (failed, well): (Vec<_>, Vec<_>) = flights.iter().partition(has_failed);
    let walls = course.walls().iter().zip(course.wall_triangles());
    let shape = |(wall, triangles_m): (&skein_simulator::course::Wall, _)| WallShape {
        x_m: wall.x_m(),
        outline_m: wall.outline().to_vec(),
        triangles_m,
    };
    FlownCourse {
        name: course.name().to_owned(),
        corridor_m: [corridor.length_m, corridor.width_m, corridor.height_m],
        walls: walls.map(shape).collect(),
        obstacles_m: course.obstacle_triangles(),
        episodes: flights.len(),
        failed: failed.len(),
        flights: failed
            .into_iter()
            .chain(well)
            .take(MOST_EPISODES)
            .map(|flight| Flight {
                episode: flight.episode,
                outcome: flight.outcome,
                points_m: flight.points_m.clone(),
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_mesh_outside_the_folder_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path().join("watched/run"));
        std::fs::create_dir_all(run.courses()).unwrap();
        std::fs::write(folder.path().join("m.obj"), "v 0 0 0\n").unwrap();
        let text = "[[obstacle]]\nshape = \"mesh\"\nfile = \"../../../m.obj\"\n";
        std::fs::write(run.courses().join("a.toml"), text).unwrap();
        let catalogue = Catalogue::open(&folder.path().join("watched")).unwrap();
        let error = format!("{:#}", courses(&catalogue, &run).unwrap_err());
        assert!(error.contains("leads out of the watched folder"), "{error}");
    }

    #[test]
    fn flights_are_told_apart_and_a_torn_row_is_left_out() {
        let text = "course,episode,step,x_m,y_m,z_m,outcome\na,0,0,1,0,3,collided\n\
                    a,0,1,2,0,3,collided\na,1,0,1,0,3,reached_end\nb,0,0,1,0,3,timed_out\nb,0,1,";
        let courses = flights(text).unwrap();
        let lengths = |name: &str| -> Vec<usize> {
            let flights = courses[name].iter();
            flights.map(|flight| flight.points_m.len()).collect()
        };
        assert_eq!((lengths("a"), lengths("b")), (vec![2, 1], vec![1]));
        assert!(flights("course\n\u{0}\n").is_err());
    }
}
