//! Trajectories of evaluation episodes from above and from the side, and each wall from the front.

use std::collections::BTreeMap;
use std::path::Path;

use plotters::prelude::*;
use serde::Deserialize;
use skein_protocol::transition::{MAX_MAGNITUDE, Outcome};
use skein_simulator::course::{Course, Wall};

use super::ReportError;
use super::canvas::{Area, Canvas, INK, REFERENCE, STRONG, font, px};
use super::complete_rows::{TornRow, complete_rows};
use super::front_views::FrontViews;
use super::obstacles::draw_obstacles;
use crate::NamedCourse;

/// Most trajectories drawn of one course: more would only cover each other.
pub const MOST_DRAWN: usize = 500;
/// Most courses in one picture, which is held in memory.
const MOST_COURSES: usize = 12;
/// Most characters of a course's name in its caption.
const LONGEST_NAME: usize = 60;

pub(super) const WIDTH: u32 = 1280;
pub(super) const LEFT: u32 = 70;
pub(super) const RIGHT: u32 = 20;
const TOP: u32 = 72;
const CAPTION: u32 = 34;
/// Height of the line on courses that are not shown.
const OMITTED: u32 = 34;
const PANEL_GAP: u32 = 20;
const AXIS: u32 = 44;
const HIGHEST_PANEL: u32 = 600;

pub(super) const CORRIDOR: RGBColor = RGBColor(0xf3, 0xf5, 0xf8);
pub(super) const WALL: RGBColor = RGBColor(0x4a, 0x50, 0x5a);
/// Part of a wall that is open, but not in the cut through the opening's middle; an obstacle above,
/// below or beside the cut.
pub(super) const PARTLY_OPEN: RGBColor = RGBColor(0xb4, 0xb8, 0xc0);
const TIMED_OUT: RGBColor = RGBColor(0x8a, 0x5f, 0xb5);

/// Trajectory of one evaluation episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// Position of the vehicle's centre at each step, world frame, metres. Without positions, the
    /// episode is counted but not drawn.
    pub points_m: Vec<[f32; 3]>,
    /// End of the episode.
    pub outcome: Outcome,
}

/// Evaluation episodes on one course.
#[derive(Debug, Clone, Copy)]
pub struct FlownCourse<'a> {
    /// Name in the caption.
    pub name: &'a str,
    /// The course.
    pub course: &'a Course,
    /// Its episodes.
    pub episodes: &'a [Trajectory],
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

/// Reads the complete rows of `evaluation_trajectories.csv`; says so if the last one is cut off.
/// The steps of an episode are consecutive.
///
/// # Errors
/// [`ReportError::Malformed`] names the line.
pub(super) fn read_trajectories(
    path: &Path,
) -> Result<(TrajectoriesByCourse, Option<TornRow>), ReportError> {
    let malformed = |problem: String| ReportError::Malformed {
        path: path.to_owned(),
        problem,
    };
    let mut courses = TrajectoriesByCourse::new();
    let mut current = None;
    let (text, torn) = complete_rows(path)?;
    let mut reader = csv::Reader::from_reader(&text[..]);
    // Otherwise an unreadable header would pass for a file without rows.
    reader
        .headers()
        .map_err(|error| malformed(error.to_string()))?;
    let mut rows = reader.into_deserialize();
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
    Ok((courses, torn))
}

/// Returns the episodes of each course of a run. Courses without episodes are left out.
pub(super) fn flown<'a>(
    courses: &'a [NamedCourse],
    trajectories: &'a TrajectoriesByCourse,
) -> Vec<FlownCourse<'a>> {
    let flown = |NamedCourse { name, course }: &'a NamedCourse| {
        Some(FlownCourse {
            name,
            course,
            episodes: trajectories.get(name)?,
        })
    };
    courses.iter().filter_map(flown).collect()
}

/// Draws the episodes of each course from above and from the side, and its walls from the front,
/// as a PNG file. Of many courses, the first are drawn, and the number of the others is stated.
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub fn draw_trajectories(courses: &[FlownCourse<'_>], path: &Path) -> Result<(), ReportError> {
    let (shown, others) = courses.split_at(courses.len().min(MOST_COURSES));
    let blocks: u32 = shown.iter().map(|flown| block_height(flown.course)).sum();
    let omitted = if others.is_empty() { 0 } else { OMITTED };
    let mut canvas = Canvas::new(WIDTH, TOP + blocks + omitted);
    canvas.draw(|area| {
        draw_legend(area, shown)?;
        let mut top = TOP;
        for flown in shown {
            draw_course(area, flown, top)?;
            top += block_height(flown.course);
        }
        if !others.is_empty() {
            let text = format!("Not shown: {} more", plural(others.len(), "course"));
            area.draw_text(&text, &font(18), (px(LEFT) as i32, px(top) as i32))?;
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

fn panel_height(course: &Course, view: ViewedFrom) -> u32 {
    let (low, high) = view.range_m(course);
    ((high - low) * pixels_per_metre(course)) as u32
}

fn block_height(course: &Course) -> u32 {
    CAPTION
        + panel_height(course, ViewedFrom::Above)
        + PANEL_GAP
        + panel_height(course, ViewedFrom::Side)
        + AXIS
        + FrontViews::of(course, pixels_per_metre(course)).height()
}

/// Side from which a panel shows the corridor.
#[derive(Clone, Copy)]
enum ViewedFrom {
    /// From above: x to the right, y (left of the drone) up.
    Above,
    /// From the side: x to the right, z up.
    Side,
}

impl ViewedFrom {
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

    /// Index of the axis across the corridor in a point `[y, z]` of a wall.
    fn axis(self) -> usize {
        match self {
            Self::Above => 0,
            Self::Side => 1,
        }
    }

    /// Returns the parts of a wall that are open in a cut through the safe point of its opening:
    /// a horizontal cut for the view from above, a vertical one for the view from the side.
    fn open_in_cut_m(self, wall: &Wall) -> Vec<(f32, f32)> {
        open_in_cut_m(wall, self.axis(), wall.safe_point()[1 - self.axis()])
    }

    /// Returns the range over which a wall is open in any cut.
    fn opening_m(self, wall: &Wall) -> (f32, f32) {
        let axis = self.axis();
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

/// Returns the parts of a wall that are open along axis `across` (0: y, 1: z), in a cut at `cut_m`
/// on the other axis.
pub(super) fn open_in_cut_m(wall: &Wall, across: usize, cut_m: f32) -> Vec<(f32, f32)> {
    let along = 1 - across;
    let outline = wall.outline();
    let mut ends: Vec<f32> = outline
        .iter()
        .zip(outline.iter().cycle().skip(1))
        .filter(|(from, to)| (from[along] > cut_m) != (to[along] > cut_m))
        .map(|(from, to)| {
            let share = (cut_m - from[along]) / (to[along] - from[along]);
            from[across] + share * (to[across] - from[across])
        })
        .collect();
    ends.sort_by(f32::total_cmp);
    ends.chunks_exact(2)
        .map(|pair| (pair[0], pair[1]))
        .collect()
}

/// Position of one panel in drawn pixels.
struct Panel<'a> {
    course: &'a Course,
    view: ViewedFrom,
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
        draw_obstacles(area, self.course, self.view.axis(), |point| {
            self.at(point[0], self.view.across_m(point))
        })?;
        // Failed episodes are drawn last, over the others: readers look for them.
        let (well, wrong): (Vec<_>, Vec<_>) = episodes
            .iter()
            .partition(|episode| episode.outcome == Outcome::ReachedEnd);
        for episode in well.into_iter().chain(wrong) {
            self.draw_episode(area, episode, opacity_of(episode.outcome, episodes.len()))?;
        }
        for wall in self.course.walls() {
            let x_m = (wall.x_m(), wall.x_m() + self.course.wall_thickness_m());
            let (open_low, open_high) = self.view.opening_m(wall);
            let mut parts = vec![(low, open_low, WALL), (open_high, high, WALL)];
            let mut closed_from = open_low;
            for (from, to) in self.view.open_in_cut_m(wall) {
                parts.push((closed_from, from, PARTLY_OPEN));
                closed_from = to;
            }
            parts.push((closed_from, open_high, PARTLY_OPEN));
            for (from, to, colour) in parts.into_iter().filter(|part| part.0 < part.1) {
                area.draw(&Rectangle::new(
                    self.rectangle(x_m, (from, to)),
                    colour.filled(),
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
        opacity: f64,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let points: Vec<_> = episode
            .points_m
            .iter()
            .map(|&point| self.at(point[0], self.view.across_m(point)))
            .collect();
        let colour = colour_of(episode.outcome);
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

/// Returns the colour of an episode that ended like this.
pub(super) fn colour_of(outcome: Outcome) -> RGBColor {
    match outcome {
        Outcome::ReachedEnd => STRONG,
        Outcome::Collided => REFERENCE,
        Outcome::TimedOut => TIMED_OUT,
    }
}

/// Returns the opacity of one of `episodes` that ended like this. Failed episodes are few and
/// looked for; of many that reached the end, each is pale.
pub(super) fn opacity_of(outcome: Outcome, episodes: usize) -> f64 {
    match outcome {
        Outcome::ReachedEnd => (5.0 / episodes as f64).clamp(0.3, 0.9),
        Outcome::Collided | Outcome::TimedOut => 0.9,
    }
}

pub(super) fn plural(count: usize, what: &str) -> String {
    match count {
        1 => format!("1 {what}"),
        count => format!("{count} {what}s"),
    }
}

/// Returns the caption of a course: its name, and how its episodes ended.
fn caption(flown: &FlownCourse<'_>) -> String {
    let printable = |character: char| match character.is_control() {
        true => ' ',
        false => character,
    };
    let mut name: String = flown.name.chars().map(printable).collect();
    if let Some((end, _)) = name.char_indices().nth(LONGEST_NAME) {
        name.truncate(end);
        name.push('…');
    }
    let count = |outcome| {
        let episodes = flown.episodes.iter();
        episodes
            .filter(|episode| episode.outcome == outcome)
            .count()
    };
    let mut caption = format!(
        "{name}: {}, {} reached the end, {} collided, {} timed out",
        plural(flown.episodes.len(), "episode"),
        count(Outcome::ReachedEnd),
        count(Outcome::Collided),
        count(Outcome::TimedOut)
    );
    if flown.episodes.len() > MOST_DRAWN {
        caption.push_str(&format!("; the first {MOST_DRAWN} are drawn"));
    }
    caption
}

fn draw_course(
    area: &Area<'_>,
    flown: &FlownCourse<'_>,
    top: u32,
) -> Result<(), Box<dyn std::error::Error>> {
    use plotters::style::text_anchor::{HPos, Pos, VPos};
    let FlownCourse {
        course, episodes, ..
    } = *flown;
    let episodes = &episodes[..episodes.len().min(MOST_DRAWN)];
    area.draw_text(
        &caption(flown),
        &font(18),
        (px(LEFT) as i32, px(top + 8) as i32),
    )?;
    let above = Panel {
        course,
        view: ViewedFrom::Above,
        top: top + CAPTION,
    };
    let side = Panel {
        course,
        view: ViewedFrom::Side,
        top: above.top + panel_height(course, ViewedFrom::Above) + PANEL_GAP,
    };
    above.draw(area, episodes)?;
    side.draw(area, episodes)?;
    let centred = font(14).pos(Pos::new(HPos::Center, VPos::Top));
    for x_m in (0..=course.corridor().length_m as u32).step_by(10) {
        let (x, y) = side.at(x_m as f32, 0.0);
        area.draw_text(&format!("{x_m} m"), &centred, (x, y + px(5) as i32))?;
    }
    let below = side.top + panel_height(course, ViewedFrom::Side) + AXIS;
    FrontViews::of(course, pixels_per_metre(course)).draw(area, episodes, below)
}

/// Explains the picture of courses with walls, or of worlds, which have only obstacles.
fn draw_legend(
    area: &Area<'_>,
    courses: &[FlownCourse<'_>],
) -> Result<(), Box<dyn std::error::Error>> {
    let (note, [dark, pale]) = match courses.iter().any(|flown| !flown.course.is_world()) {
        true => (
            "Below each course, its walls from the front: a dot where the drone's centre crossed \
             the wall, a cross where it collided within its own width of the wall.",
            ["walls", "partly open: see the wall's front; obstacles"],
        ),
        false => (
            "Each way begins where its episode did, at the left, and ends where the episode ended.",
            ["obstacles in the middle", "at any height or side"],
        ),
    };
    let y = px(22) as i32;
    area.draw_text(
        "Evaluation episodes",
        &font(22),
        (px(LEFT) as i32, y - px(11) as i32),
    )?;
    area.draw_text(note, &font(15), (px(LEFT) as i32, y + px(22) as i32))?;
    let mut x = px(LEFT + 230) as i32;
    for (label, colour) in [
        ("reached the end", STRONG),
        ("collided", REFERENCE),
        ("timed out", TIMED_OUT),
        (dark, WALL),
        (pale, PARTLY_OPEN),
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
        let (paths, _) = read_trajectories(&path).unwrap();
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
        let fronts = FrontViews::of(&hall, pixels_per_metre(&hall)).height();
        assert!(
            (100..200).contains(&fronts),
            "one row, {fronts} pixels high"
        );
        assert_eq!(
            block_height(&hall),
            CAPTION + 2 * HIGHEST_PANEL + PANEL_GAP + AXIS + fronts
        );
    }

    /// From above and from the side, a wall is closed where the cut through its opening's middle
    /// is, not as far as the opening reaches anywhere.
    #[test]
    fn an_opening_is_cut_by_its_shape_and_not_by_its_bounding_box() {
        let text = "name = \"c\"\norder = [1]\nwall_x_m = [8.0]\nwall_thickness_m = 0.5\n\
                    corridor = { length_m = 20.0, width_m = 6.0, height_m = 7.0 }\nstart = \
                    { offset_m = 1.5, jitter_y_m = 0.0, jitter_z_m = 0.0 }\n[[wall]]\nlabel = 1\n\
                    shape = \"triangle\"\ncentre_m = [0.0, 3.5]\nwidth_m = 3.6\nheight_m = 3.2\n";
        let course = Course::parse(text, "c.toml").unwrap();
        let wall = &course.walls()[0];
        let view = ViewedFrom::Above;
        let (low_m, high_m) = view.opening_m(wall);
        assert!((high_m - low_m - 3.6).abs() < 0.01, "{low_m} {high_m}");
        let cut = view.open_in_cut_m(wall);
        let &[(from_m, to_m)] = &cut[..] else {
            panic!("a triangle is cut once: {cut:?}");
        };
        // Its base lies at 3.5 - 1.6 m and its width falls to zero over 3.2 m.
        let width_m = 3.6 * (1.0 - (wall.safe_point()[1] - 1.9) / 3.2);
        assert!((to_m - from_m - width_m).abs() < 0.01, "{cut:?}, {width_m}");

        let mut canvas = Canvas::new(WIDTH, 500);
        let panel = Panel {
            course: &course,
            view,
            top: 20,
        };
        canvas.draw(|area| panel.draw(area, &[])).unwrap();
        let colour = |across_m| canvas.colour_at(panel.at(8.25, across_m));
        let partly_m = (to_m + high_m) / 2.0;
        let found = [0.0, partly_m, -partly_m, high_m + 0.2].map(colour);
        assert_eq!(found, [CORRIDOR, PARTLY_OPEN, PARTLY_OPEN, WALL]);
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
