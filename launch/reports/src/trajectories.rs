//! Trajectories of evaluation episodes from above and from the side, with walls and openings.

use std::collections::BTreeMap;
use std::path::Path;

use plotters::prelude::*;
use serde::Deserialize;
use skein_protocol::transition::{MAX_MAGNITUDE, Outcome};
use skein_simulator::course::{Course, Wall};

use super::ReportError;
use super::canvas::{Area, Canvas, INK, REFERENCE, STRONG, font, px};
use crate::NamedCourse;

const WIDTH: u32 = 1280;
const LEFT: u32 = 70;
const RIGHT: u32 = 20;
const TOP: u32 = 52;
const CAPTION: u32 = 34;
const PANEL_GAP: u32 = 20;
const AXIS: u32 = 44;
const HIGHEST_PANEL: u32 = 600;

const CORRIDOR: RGBColor = RGBColor(0xf3, 0xf5, 0xf8);
const WALL: RGBColor = RGBColor(0x4a, 0x50, 0x5a);
const TIMED_OUT: RGBColor = RGBColor(0x8a, 0x5f, 0xb5);

/// Trajectory of one evaluation episode.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Trajectory {
    /// Position of the vehicle's centre at each step, world frame, metres.
    points_m: Vec<[f32; 3]>,
    /// End of the episode.
    outcome: Outcome,
}

/// Trajectories by the name of their course.
pub(super) type TrajectoriesByCourse = BTreeMap<String, Vec<Trajectory>>;

/// Row of `evaluation_trajectories.csv`.
#[derive(Deserialize)]
struct TrajectoryRow {
    course: String,
    episode: u64,
    x_m: f32,
    y_m: f32,
    z_m: f32,
    outcome: Outcome,
}

/// Reads `evaluation_trajectories.csv`. The steps of an episode are consecutive.
///
/// # Errors
/// [`ReportError::Malformed`] names the line.
pub(super) fn read_trajectories(path: &Path) -> Result<TrajectoriesByCourse, ReportError> {
    let malformed = |problem: String| ReportError::Malformed {
        path: path.to_owned(),
        problem,
    };
    let mut courses = TrajectoriesByCourse::new();
    let mut current = None;
    let mut rows = csv::Reader::from_path(path)
        .map_err(|error| malformed(error.to_string()))?
        .into_deserialize();
    while let Some(row) = rows.next() {
        let row: TrajectoryRow = row.map_err(|error| malformed(error.to_string()))?;
        let at_m = [row.x_m, row.y_m, row.z_m];
        if !at_m
            .iter()
            .all(|metres| (-MAX_MAGNITUDE..=MAX_MAGNITUDE).contains(metres))
        {
            let line = rows.reader().position().line() - 1;
            return Err(malformed(format!(
                "line {line}: {at_m:?} is not a possible position"
            )));
        }
        let episodes = courses.entry(row.course.clone()).or_default();
        let key = Some((row.course, row.episode));
        if current != key {
            episodes.push(Trajectory {
                points_m: Vec::new(),
                outcome: row.outcome,
            });
            current = key;
        }
        if let Some(episode) = episodes.last_mut() {
            episode.points_m.push(at_m);
        }
    }
    Ok(courses)
}

/// Draws the episodes of each course from above and from the side. Courses without episodes are
/// left out.
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub(super) fn draw(
    courses: &[NamedCourse],
    paths: &TrajectoriesByCourse,
    path: &Path,
) -> Result<(), ReportError> {
    let flown: Vec<_> = courses
        .iter()
        .filter_map(|NamedCourse { name, course }| Some((name, course, paths.get(name)?)))
        .collect();
    let height = TOP
        + flown
            .iter()
            .map(|(_, course, _)| block_height(course))
            .sum::<u32>();
    let mut canvas = Canvas::new(WIDTH, height);
    canvas.draw(|area| {
        draw_legend(area)?;
        let mut top = TOP;
        for (name, course, episodes) in &flown {
            draw_course(area, name, course, episodes, top)?;
            top += block_height(course);
        }
        Ok(())
    })?;
    canvas.save(path)
}

/// Returns the saved pixels per metre, the same along and across the corridor, so that angles are
/// true. A corridor that is wider or higher than long does not fill the picture's width; otherwise
/// its panels would be too high for memory.
fn pixels_per_metre(course: &Course) -> f32 {
    let corridor = course.corridor();
    let along = (WIDTH - LEFT - RIGHT) as f32 / corridor.length_m;
    along.min(HIGHEST_PANEL as f32 / corridor.width_m.max(corridor.height_m))
}

fn panel_height(course: &Course, view: Projection) -> u32 {
    let (low, high) = view.range_m(course);
    ((high - low) * pixels_per_metre(course)) as u32
}

fn block_height(course: &Course) -> u32 {
    CAPTION
        + panel_height(course, Projection::Above)
        + PANEL_GAP
        + panel_height(course, Projection::Side)
        + AXIS
}

/// Projection of the corridor.
#[derive(Clone, Copy)]
enum Projection {
    /// From above: x to the right, y (left of the drone) up.
    Above,
    /// From the side: x to the right, z up.
    Side,
}

impl Projection {
    fn range_m(self, course: &Course) -> (f32, f32) {
        let corridor = course.corridor();
        match self {
            Self::Above => (-corridor.width_m / 2.0, corridor.width_m / 2.0),
            Self::Side => (0.0, corridor.height_m),
        }
    }

    fn across_m(self, [_, y, z]: [f32; 3]) -> f32 {
        match self {
            Self::Above => y,
            Self::Side => z,
        }
    }

    fn opening_m(self, wall: &Wall) -> (f32, f32) {
        let axis = match self {
            Self::Above => 0,
            Self::Side => 1,
        };
        wall.outline()
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), point| {
                (low.min(point[axis]), high.max(point[axis]))
            })
    }

    fn axis_label(self) -> &'static str {
        match self {
            Self::Above => "from above: y, m",
            Self::Side => "from the side: z, m",
        }
    }
}

/// Position of one panel in drawn pixels.
struct Panel<'a> {
    course: &'a Course,
    view: Projection,
    top: u32,
}

impl Panel<'_> {
    fn at(&self, x_m: f32, across_m: f32) -> (i32, i32) {
        let scale = px(1) as f32 * pixels_per_metre(self.course);
        let (_, high) = self.view.range_m(self.course);
        let x = px(LEFT) as f32 + x_m * scale;
        let y = px(self.top) as f32 + (high - across_m) * scale;
        (x.round() as i32, y.round() as i32)
    }

    fn rectangle(&self, x_m: (f32, f32), across_m: (f32, f32)) -> [(i32, i32); 2] {
        [self.at(x_m.0, across_m.1), self.at(x_m.1, across_m.0)]
    }

    fn draw(
        &self,
        area: &Area<'_>,
        episodes: &[Trajectory],
    ) -> Result<(), Box<dyn std::error::Error>> {
        let length_m = self.course.corridor().length_m;
        let (low, high) = self.view.range_m(self.course);
        area.draw(&Rectangle::new(
            self.rectangle((0.0, length_m), (low, high)),
            CORRIDOR.filled(),
        ))?;
        // Failed episodes are drawn last, over the others: readers look for them.
        let (well, wrong): (Vec<_>, Vec<_>) = episodes
            .iter()
            .partition(|episode| episode.outcome == Outcome::ReachedEnd);
        for episode in well.into_iter().chain(wrong) {
            self.draw_episode(area, episode)?;
        }
        for wall in self.course.walls() {
            let x_m = (wall.x_m(), wall.x_m() + self.course.wall_thickness_m());
            let (open_low, open_high) = self.view.opening_m(wall);
            for across_m in [(low, open_low), (open_high, high)] {
                area.draw(&Rectangle::new(
                    self.rectangle(x_m, across_m),
                    WALL.filled(),
                ))?;
            }
        }
        let outline = Rectangle::new(
            self.rectangle((0.0, length_m), (low, high)),
            WALL.stroke_width(px(2)),
        );
        area.draw(&outline)?;
        self.draw_scale(area)
    }

    fn draw_episode(
        &self,
        area: &Area<'_>,
        episode: &Trajectory,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let points: Vec<_> = episode
            .points_m
            .iter()
            .map(|&point| self.at(point[0], self.view.across_m(point)))
            .collect();
        let (colour, opacity) = match episode.outcome {
            Outcome::ReachedEnd => (STRONG, 0.3),
            Outcome::Collided => (REFERENCE, 0.9),
            Outcome::TimedOut => (TIMED_OUT, 0.9),
        };
        area.draw(&PathElement::new(
            points.clone(),
            colour.mix(opacity).stroke_width(px(1)),
        ))?;
        if let Some(&end) = points
            .last()
            .filter(|_| episode.outcome != Outcome::ReachedEnd)
        {
            area.draw(&Cross::new(end, px(5), colour.stroke_width(px(2))))?;
        }
        Ok(())
    }

    fn draw_scale(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        use plotters::style::text_anchor::{HPos, Pos, VPos};
        let (low, high) = self.view.range_m(self.course);
        let (left, middle) = (self.at(0.0, 0.0).0, self.at(0.0, (low + high) / 2.0).1);
        let right_aligned = font(14).pos(Pos::new(HPos::Right, VPos::Center));
        for across_m in [low, (low + high) / 2.0, high] {
            let (x, y) = self.at(0.0, across_m);
            area.draw_text(
                &format!("{across_m}"),
                &right_aligned,
                (x - px(6) as i32, y),
            )?;
        }
        let turned = font(14)
            .transform(FontTransform::Rotate270)
            .pos(Pos::new(HPos::Center, VPos::Center));
        area.draw_text(
            self.view.axis_label(),
            &turned,
            (left - px(46) as i32, middle),
        )?;
        Ok(())
    }
}

fn draw_course(
    area: &Area<'_>,
    name: &str,
    course: &Course,
    episodes: &[Trajectory],
    top: u32,
) -> Result<(), Box<dyn std::error::Error>> {
    use plotters::style::text_anchor::{HPos, Pos, VPos};
    let count = |outcome| {
        episodes
            .iter()
            .filter(|episode| episode.outcome == outcome)
            .count()
    };
    let caption = format!(
        "{name}: {} episodes, {} reached the end, {} collided, {} timed out",
        episodes.len(),
        count(Outcome::ReachedEnd),
        count(Outcome::Collided),
        count(Outcome::TimedOut)
    );
    area.draw_text(&caption, &font(18), (px(LEFT) as i32, px(top + 8) as i32))?;
    let above = Panel {
        course,
        view: Projection::Above,
        top: top + CAPTION,
    };
    let side = Panel {
        course,
        view: Projection::Side,
        top: above.top + panel_height(course, Projection::Above) + PANEL_GAP,
    };
    above.draw(area, episodes)?;
    side.draw(area, episodes)?;
    let centred = font(14).pos(Pos::new(HPos::Center, VPos::Top));
    for x_m in (0..=course.corridor().length_m as u32).step_by(10) {
        let (x, y) = side.at(x_m as f32, 0.0);
        area.draw_text(&format!("{x_m} m"), &centred, (x, y + px(5) as i32))?;
    }
    Ok(())
}

fn draw_legend(area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
    let y = px(22) as i32;
    area.draw_text(
        "Evaluation episodes",
        &font(22),
        (px(LEFT) as i32, y - px(11) as i32),
    )?;
    let mut x = px(LEFT + 230) as i32;
    for (label, colour) in [
        ("reached the end", STRONG),
        ("collided", REFERENCE),
        ("timed out", TIMED_OUT),
        ("walls and their openings", WALL),
    ] {
        area.draw(&PathElement::new(
            [(x, y), (x + px(26) as i32, y)],
            colour.stroke_width(px(3)),
        ))?;
        area.draw_text(
            label,
            &font(16).color(&INK),
            (x + px(34) as i32, y - px(8) as i32),
        )?;
        x += px(60 + 9 * label.len() as u32) as i32;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn episodes_are_distinguished_by_course_and_number() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("evaluation_trajectories.csv");
        let rows = "course,episode,step,x_m,y_m,z_m,outcome\na,0,0,1,0,3,collided\n\
                    a,0,1,2,0,3,collided\na,1,0,1,0,3,reached_end\nb,1,0,1,0,3,timed_out\n";
        std::fs::write(&path, rows).unwrap();
        let paths = read_trajectories(&path).unwrap();
        let lengths = |name: &str| {
            paths[name]
                .iter()
                .map(|episode| episode.points_m.len())
                .collect::<Vec<_>>()
        };
        assert_eq!((lengths("a"), lengths("b")), (vec![2, 1], vec![1]));
        assert_eq!(paths["a"][0].outcome, Outcome::Collided);
        assert_eq!(paths["a"][0].points_m[1], [2.0, 0.0, 3.0]);
    }

    #[test]
    fn a_corridor_wider_than_long_has_a_picture_of_bounded_height() {
        let text = "name = \"hall\"\norder = [1]\nwall_x_m = [8.0]\nwall_thickness_m = 0.3\n\
                    corridor = { length_m = 10.0, width_m = 100.0, height_m = 100.0 }\nstart = \
                    { offset_m = 1.5, jitter_y_m = 0.0, jitter_z_m = 0.0 }\n[[wall]]\nlabel = 1\n\
                    shape = \"circle\"\ncentre_m = [0.0, 50.0]\ndiameter_m = 2.2\n";
        let hall = Course::parse(text, "hall.toml").unwrap();
        assert_eq!(
            block_height(&hall),
            CAPTION + 2 * HIGHEST_PANEL + PANEL_GAP + AXIS
        );
    }

    #[test]
    fn an_impossible_position_is_named_by_its_line() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("evaluation_trajectories.csv");
        for place in ["nan,0,0", "0,-inf,0", "0,0,1e30"] {
            let rows = format!("course,episode,step,x_m,y_m,z_m,outcome\na,0,0,{place},collided\n");
            std::fs::write(&path, rows).unwrap();
            let error = read_trajectories(&path).unwrap_err().to_string();
            assert!(error.contains("line 2:"), "{error}");
        }
    }
}
