//! Failed episodes, one beside the other: the wall from the front and from above with the last two
//! metres of the flight, and what the camera saw a second before the end.
//!
//! Episodes are grouped by what was hit and by the shape of the opening; the largest group comes
//! first.

use std::collections::BTreeMap;
use std::path::Path;

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH};
use skein_simulator::course::{Course, DRONE_WIDTH_M, Wall};

use super::{Failure, FlownEpisode};
use crate::ReportError;
use crate::canvas::{Area, Canvas, GRID, INK, STRONG, font, px};
use crate::obstacles::draw_obstacles;
use crate::trajectories::{CORRIDOR, WALL, colour_of, open_in_cut_m, plural};

/// Most groups in one picture.
const MOST_GROUPS: usize = 12;
/// Most episodes of a group that are drawn: a row.
const IN_A_ROW: usize = 4;
/// Length of the flight that is drawn, metres.
const LAST_M: f32 = 2.0;
/// Length of the corridor beyond the end that the view from above shows, metres.
const BEYOND_M: f32 = 1.5;
/// Length of the corridor before the drawn flight, metres.
const BACK_M: f32 = 1.0;
/// Height of the drone's body, metres. Source: as for [`DRONE_WIDTH_M`].
const DRONE_HEIGHT_M: f32 = 0.29;
/// Share of the wall's colour in the closed part of a view.
const SHADE: f64 = 0.45;

const LEFT: u32 = 24;
const TITLE: u32 = 84;
const HEADING: u32 = 40;
const CAPTION: u32 = 24;
const ZOOM: u32 = 2;
const TILE: u32 = IMAGE_WIDTH as u32 * ZOOM;
const GAP: u32 = 28;
const FRONT_WIDTH: f32 = 138.0;
const FRONT_HEIGHT: f32 = 161.0;
const BETWEEN: u32 = 14;
const VIEWS: u32 = FRONT_HEIGHT as u32 + 8;
const ROW: u32 = HEADING + CAPTION + VIEWS + IMAGE_HEIGHT as u32 * ZOOM + 26;
const WIDTH: u32 = 2 * LEFT + IN_A_ROW as u32 * (TILE + GAP) - GAP;

/// Failed episodes that ended alike.
struct Group<'a> {
    failure: Failure,
    /// Shape of the opening at or before which they ended.
    shape: Option<&'static str>,
    episodes: Vec<&'a FlownEpisode<'a>>,
}

/// Draws the failed ones of `episodes` to `path`, as a PNG file. Of many, the largest groups and
/// the first episodes of each are drawn, and the numbers of the others are stated.
///
/// # Errors
/// Returns [`ReportError`] if the picture cannot be drawn or written.
pub fn draw_failures(episodes: &[FlownEpisode<'_>], path: &Path) -> Result<(), ReportError> {
    let groups = groups(episodes);
    let shown = &groups[..groups.len().min(MOST_GROUPS)];
    let mut canvas = Canvas::new(WIDTH, TITLE + shown.len() as u32 * ROW + LEFT);
    canvas.draw(|area| {
        draw_title(area, episodes, groups.len())?;
        for (row, group) in (0..).zip(shown) {
            draw_group(area, group, TITLE + row * ROW)?;
        }
        Ok(())
    })?;
    for (row, group) in (0..).zip(shown) {
        let top = TITLE + row * ROW + HEADING + CAPTION + VIEWS;
        for (column, episode) in (0..).zip(group.shown()) {
            if let Some(image) = episode.seen_before_end {
                canvas.put_grey(image, IMAGE_WIDTH, (tile_left(column), top), ZOOM);
            }
        }
    }
    canvas.save(path)
}

fn tile_left(column: u32) -> u32 {
    LEFT + column * (TILE + GAP)
}

/// Groups the failed episodes; the largest group comes first.
fn groups<'a>(episodes: &'a [FlownEpisode<'a>]) -> Vec<Group<'a>> {
    let mut groups = BTreeMap::<_, Vec<_>>::new();
    for episode in episodes {
        if let Some(failure) = episode.failure() {
            let shape = episode.last_wall().map(|wall| episode.shape(wall));
            groups.entry((failure, shape)).or_default().push(episode);
        }
    }
    let mut groups: Vec<_> = groups
        .into_iter()
        .map(|((failure, shape), episodes)| Group {
            failure,
            shape,
            episodes,
        })
        .collect();
    groups.sort_by_key(|group| std::cmp::Reverse(group.episodes.len()));
    groups
}

impl Group<'_> {
    fn shown(&self) -> impl Iterator<Item = &FlownEpisode<'_>> {
        self.episodes.iter().copied().take(IN_A_ROW)
    }

    fn is_in_a_world(&self) -> bool {
        self.episodes
            .iter()
            .any(|episode| episode.course.is_world())
    }

    fn heading(&self) -> String {
        let at = match (self.failure, self.shape) {
            (Failure::HitWall, Some(shape)) => format!(", opening: {shape}"),
            (_, Some(shape)) => format!(", before an opening: {shape}"),
            (_, None) if self.is_in_a_world() => String::new(),
            (_, None) => ", behind the last wall".to_owned(),
        };
        let others = match self.episodes.len() > IN_A_ROW {
            true => format!("; the first {IN_A_ROW} are drawn"),
            false => String::new(),
        };
        let count = plural(self.episodes.len(), "episode");
        format!("{count} {}{at}{others}", self.failure.name())
    }
}

fn draw_title(
    area: &Area<'_>,
    episodes: &[FlownEpisode<'_>],
    groups: usize,
) -> Result<(), Box<dyn std::error::Error>> {
    let failed = episodes
        .iter()
        .filter(|episode| episode.failure().is_some())
        .count();
    let mut title = format!("Failed evaluation episodes: {failed} of {}", episodes.len());
    if groups > MOST_GROUPS {
        title.push_str(&format!("; the {MOST_GROUPS} largest of {groups} groups"));
    }
    let at = |y| (px(LEFT) as i32, px(y) as i32);
    area.draw_text(&title, &font(22), at(14))?;
    let legend = "Left: the wall from the front, with the drone's last 2 m, its body (level) at \
                  the end, and a ring at the middle of the opening.";
    area.draw_text(legend, &font(14), at(44))?;
    let legend = "Right: the same from above, flying up. Below: what the camera saw a second \
                  before the end; brighter is farther.";
    area.draw_text(legend, &font(14), at(62))?;
    Ok(())
}

fn draw_group(
    area: &Area<'_>,
    group: &Group<'_>,
    top: u32,
) -> Result<(), Box<dyn std::error::Error>> {
    let at = |y| (px(LEFT) as i32, px(y) as i32);
    let rule = [at(top + 6), (px(WIDTH - LEFT) as i32, px(top + 6) as i32)];
    area.draw(&PathElement::new(rule, GRID.stroke_width(px(1))))?;
    area.draw_text(&group.heading(), &font(18), at(top + 14))?;
    for (column, episode) in (0..).zip(group.shown()) {
        let tile = Tile::of(episode, tile_left(column), top + HEADING + CAPTION);
        tile.draw(area)?;
    }
    Ok(())
}

/// Views of one failed episode.
struct Tile<'a> {
    episode: &'a FlownEpisode<'a>,
    /// Where it ended, metres.
    end_m: [f32; 3],
    /// The points of its last metres.
    last_m: Vec<[f32; 3]>,
    /// Saved pixels per metre.
    scale: f32,
    left: u32,
    top: u32,
}

impl<'a> Tile<'a> {
    fn of(episode: &'a FlownEpisode<'a>, left: u32, top: u32) -> Self {
        let corridor = episode.course.corridor();
        let end_m = episode.points_m.last().copied().unwrap_or_default();
        Self {
            episode,
            end_m,
            last_m: last_metres(episode.points_m),
            scale: (FRONT_WIDTH / corridor.width_m).min(FRONT_HEIGHT / corridor.height_m),
            left,
            top,
        }
    }

    fn course(&self) -> &Course {
        &self.episode.course
    }

    fn draw(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        self.draw_caption(area)?;
        self.draw_front(area)?;
        self.draw_above(area)
    }

    fn draw_caption(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        let wall = match self.episode.last_wall() {
            Some(wall) => format!(
                ", wall {} at {} m",
                self.episode.walls_passed + 1,
                wall.x_m()
            ),
            None => String::new(),
        };
        let name: String = self.episode.course_name.chars().take(16).collect();
        let caption = format!("{name}, episode {}{wall}", self.episode.number);
        let left_aligned = font(13).pos(Pos::new(HPos::Left, VPos::Bottom));
        let place = (px(self.left) as i32, px(self.top - 5) as i32);
        area.draw_text(&caption, &left_aligned, place)?;
        Ok(())
    }

    /// Returns the place of `[y, z]` in the view from the front: y to the left, z up.
    fn front(&self, [y_m, z_m]: [f32; 2]) -> (i32, i32) {
        let corridor = self.course().corridor();
        let x = self.left as f32 + (corridor.width_m / 2.0 - y_m) * self.scale;
        let y = self.top as f32 + (corridor.height_m - z_m) * self.scale;
        drawn(x, y)
    }

    fn draw_front(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        let corridor = self.course().corridor();
        let half_m = corridor.width_m / 2.0;
        let frame = [
            self.front([half_m, corridor.height_m]),
            self.front([-half_m, 0.0]),
        ];
        match self.episode.last_wall() {
            Some(wall) => {
                area.draw(&Rectangle::new(frame, WALL.mix(SHADE).filled()))?;
                self.draw_opening(area, wall)?;
            }
            None => area.draw(&Rectangle::new(frame, CORRIDOR.filled()))?,
        }
        area.draw(&Rectangle::new(frame, WALL.stroke_width(px(2))))?;
        let [_, y_m, z_m] = self.end_m;
        let (half_width_m, half_height_m) = (DRONE_WIDTH_M / 2.0, DRONE_HEIGHT_M / 2.0);
        let body = [
            self.front([y_m + half_width_m, z_m + half_height_m]),
            self.front([y_m - half_width_m, z_m - half_height_m]),
        ];
        area.draw(&Rectangle::new(body, INK.stroke_width(px(1))))?;
        self.draw_track(area, &|[_, y_m, z_m]| self.front([y_m, z_m]))
    }

    fn draw_opening(&self, area: &Area<'_>, wall: &Wall) -> Result<(), Box<dyn std::error::Error>> {
        let outline = wall.outline();
        let points: Vec<_> = outline.iter().map(|&point| self.front(point)).collect();
        area.draw(&Polygon::new(points.clone(), CORRIDOR.filled()))?;
        let closed: Vec<_> = points.iter().chain(points.first()).copied().collect();
        area.draw(&PathElement::new(closed, WALL.stroke_width(px(1))))?;
        let ring = Circle::new(
            self.front(wall.safe_point()),
            px(4),
            STRONG.stroke_width(px(1)),
        );
        area.draw(&ring)?;
        Ok(())
    }

    /// Returns the place of a point in the view from above: x up, y to the left.
    fn above(&self, x_m: f32, y_m: f32) -> (i32, i32) {
        let room = (TILE - FRONT_WIDTH as u32 - BETWEEN) as f32;
        let along_m = LAST_M + BACK_M + BEYOND_M;
        let scale = (room / self.course().corridor().width_m).min(FRONT_HEIGHT / along_m);
        let x = (self.left + TILE) as f32 - room / 2.0 - y_m * scale;
        let y = self.top as f32 + (self.end_m[0] + BEYOND_M - x_m) * scale;
        drawn(x, y)
    }

    fn draw_above(&self, area: &Area<'_>) -> Result<(), Box<dyn std::error::Error>> {
        let corridor = self.course().corridor();
        let half_m = corridor.width_m / 2.0;
        let (from_m, to_m) = (self.end_m[0] - LAST_M - BACK_M, self.end_m[0] + BEYOND_M);
        let frame = [self.above(to_m, half_m), self.above(from_m, -half_m)];
        area.draw(&Rectangle::new(frame, CORRIDOR.filled()))?;
        let within = |[x_m, y_m, _]: [f32; 3]| {
            self.above(x_m.clamp(from_m, to_m), y_m.clamp(-half_m, half_m))
        };
        draw_obstacles(area, self.course(), 0, within)?;
        for wall in self.course().walls() {
            let front_m = wall.x_m().max(from_m);
            let back_m = (wall.x_m() + self.course().wall_thickness_m()).min(to_m);
            if front_m < back_m {
                self.draw_cut(area, wall, [front_m, back_m])?;
            }
        }
        area.draw(&Rectangle::new(frame, WALL.stroke_width(px(1))))?;
        let half_width_m = DRONE_WIDTH_M / 2.0;
        let [x_m, y_m, _] = self.end_m;
        let body = [
            self.above(x_m + half_width_m, y_m + half_width_m),
            self.above(x_m - half_width_m, y_m - half_width_m),
        ];
        area.draw(&Rectangle::new(body, INK.stroke_width(px(1))))?;
        self.draw_track(area, &|[x_m, y_m, _]| self.above(x_m, y_m))
    }

    /// Draws the closed parts of a wall in a cut at the drone's height.
    fn draw_cut(
        &self,
        area: &Area<'_>,
        wall: &Wall,
        [front_m, back_m]: [f32; 2],
    ) -> Result<(), Box<dyn std::error::Error>> {
        let half_m = self.course().corridor().width_m / 2.0;
        let mut closed_from_m = -half_m;
        let end = (half_m, half_m);
        let open = open_in_cut_m(wall, 0, self.end_m[2]);
        for (from_m, to_m) in open.into_iter().chain([end]) {
            let part = [
                self.above(back_m, closed_from_m),
                self.above(front_m, from_m),
            ];
            area.draw(&Rectangle::new(part, WALL.filled()))?;
            closed_from_m = to_m;
        }
        Ok(())
    }

    /// Draws the last metres in a view, with a dot for each step and a cross at the end.
    fn draw_track(
        &self,
        area: &Area<'_>,
        place: &dyn Fn([f32; 3]) -> (i32, i32),
    ) -> Result<(), Box<dyn std::error::Error>> {
        let colour = colour_of(self.episode.outcome);
        let points: Vec<_> = self.last_m.iter().map(|&point| place(point)).collect();
        for &point in &points {
            area.draw(&Circle::new(point, px(2), colour.filled()))?;
        }
        area.draw(&PathElement::new(points, colour.stroke_width(px(2))))?;
        area.draw(&Cross::new(
            place(self.end_m),
            px(5),
            colour.stroke_width(px(2)),
        ))?;
        Ok(())
    }
}

fn drawn(x: f32, y: f32) -> (i32, i32) {
    let scale = px(1) as f32;
    ((x * scale).round() as i32, (y * scale).round() as i32)
}

/// Returns the points of the last metres before the end; the first lies on the way between two
/// steps.
fn last_metres(points_m: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let mut last = Vec::new();
    let mut left_m = LAST_M;
    let mut later: Option<[f32; 3]> = None;
    for &point in points_m.iter().rev() {
        if let Some(later) = later {
            let length_m = (0..3)
                .map(|axis| (later[axis] - point[axis]).powi(2))
                .sum::<f32>()
                .sqrt();
            if length_m > left_m {
                let share = left_m / length_m;
                let between = |axis: usize| later[axis] + share * (point[axis] - later[axis]);
                last.push(std::array::from_fn(between));
                break;
            }
            left_m -= length_m;
        }
        last.push(point);
        later = Some(point);
    }
    last.reverse();
    last
}

#[cfg(test)]
mod tests {
    use super::super::tests::collided;
    use super::*;

    #[test]
    fn the_last_two_metres_begin_between_two_steps() {
        let points_m = [[0.0, 0.0, 3.0], [1.5, 0.0, 3.0], [3.0, 0.0, 3.0]];
        let expected = [[1.0, 0.0, 3.0], [1.5, 0.0, 3.0], [3.0, 0.0, 3.0]];
        assert_eq!(last_metres(&points_m), expected);
        assert_eq!(last_metres(&points_m[..1]), points_m[..1]);
        assert!(last_metres(&[]).is_empty());
    }

    #[test]
    fn episodes_that_ended_alike_lie_together_and_the_most_frequent_end_comes_first() {
        let points_m = [[18.0, -1.0, 3.5], [19.8, -2.0, 3.5]];
        let episodes = [
            collided(&points_m, 0, None),
            collided(&points_m, 1, Some(2)),
            collided(&points_m, 2, None),
            collided(&points_m, 1, Some(2)),
        ];
        let headings: Vec<_> = groups(&episodes).iter().map(Group::heading).collect();
        assert_eq!(
            headings,
            [
                "2 episodes hit the wall, opening: triangle",
                "1 episode hit the corridor, behind the last wall",
                "1 episode hit the corridor, before an opening: circle",
            ]
        );
    }

    #[test]
    fn a_tile_shows_the_opening_the_track_and_what_was_seen() {
        let points_m = [[18.0, -1.0, 3.5], [19.5, -2.4, 3.5]];
        let image = vec![9; skein_protocol::IMAGE_PIXELS];
        let mut episode = collided(&points_m, 1, Some(2));
        episode.seen_before_end = Some(&image);
        let tile = Tile::of(&episode, 100, 60);
        let mut canvas = Canvas::new(500, 400);
        canvas.draw(|area| tile.draw(area)).unwrap();
        let front = |point| canvas.colour_at(tile.front(point));
        assert_eq!(front([-0.6, 3.6]), CORRIDOR, "the triangle is open");
        assert_ne!(front([2.0, 6.0]), CORRIDOR, "the wall is closed");
        assert_eq!(front([-2.4, 3.5]), colour_of(episode.outcome), "its end");
        let above = |x_m, y_m| canvas.colour_at(tile.above(x_m, y_m));
        assert_eq!(above(20.1, 2.5), WALL);
        assert_eq!(above(20.1, -0.6), CORRIDOR, "a cut at the drone's height");

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("failures.png");
        draw_failures(&[episode], &path).unwrap();
        draw_failures(&[], &path).unwrap();
        assert!(std::fs::read(&path).unwrap().starts_with(b"\x89PNG"));
    }
}
