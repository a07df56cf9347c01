//! Walls of a course from the front, as the drone meets them: the opening's real shape, and where
//! each episode crossed the wall or ended at it.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use skein_protocol::transition::Outcome;
use skein_simulator::course::{Course, DRONE_WIDTH_M, Wall};

use super::canvas::{Area, font, px};
use super::trajectories::{CORRIDOR, LEFT, RIGHT, Trajectory, WALL, WIDTH, colour_of, opacity_of};

/// Largest width of a view.
const MOST_WIDTH: f32 = 150.0;
/// Largest height of a view.
const MOST_HEIGHT: f32 = 130.0;
/// Least gap between two views in a row: their labels need it.
const GAP: u32 = 24;
/// Height of the label above each view.
const LABEL: u32 = 22;
/// Space below a row of views.
const BELOW: u32 = 22;
/// Share of the wall's colour in the closed part of a view.
const SHADE: f64 = 0.45;

/// Views of all walls of a course: below the walls in the other views if there is room, otherwise
/// side by side in rows.
pub(super) struct FrontViews<'a> {
    course: &'a Course,
    /// Saved pixels per metre.
    scale: f32,
    /// Left edge of each view and its row, from 0. Saved pixels.
    places: Vec<(u32, u32)>,
}

impl<'a> FrontViews<'a> {
    /// Places the views. `along` is the number of saved pixels per metre along the corridor.
    pub(super) fn of(course: &'a Course, along: f32) -> Self {
        let corridor = course.corridor();
        let scale = (MOST_WIDTH / corridor.width_m).min(MOST_HEIGHT / corridor.height_m);
        let width = ((corridor.width_m * scale) as u32).max(1);
        let below: Vec<u32> = course
            .walls()
            .iter()
            .map(|wall| {
                let centre_m = wall.x_m() + course.wall_thickness_m() / 2.0;
                (LEFT + (centre_m * along) as u32).saturating_sub(width / 2)
            })
            .collect();
        let step = width.max(LABEL_WIDTH) + GAP;
        let fits = below.first().is_none_or(|left| *left >= LEFT)
            && below
                .last()
                .is_none_or(|left| left + width + RIGHT <= WIDTH)
            && below.windows(2).all(|pair| pair[1] >= pair[0] + step);
        let places = match fits {
            true => below.into_iter().map(|left| (left, 0)).collect(),
            false => {
                let in_a_row = ((WIDTH - LEFT - RIGHT) / step).max(1);
                (0..course.walls().len() as u32)
                    .map(|number| (LEFT + number % in_a_row * step, number / in_a_row))
                    .collect()
            }
        };
        Self {
            course,
            scale,
            places,
        }
    }

    fn row_height(&self) -> u32 {
        LABEL + (self.course.corridor().height_m * self.scale) as u32 + BELOW
    }

    /// Returns the height of all views, saved pixels.
    pub(super) fn height(&self) -> u32 {
        let rows = self.places.last().map_or(0, |(_, row)| row + 1);
        rows * self.row_height()
    }

    /// Draws the views below `top`.
    pub(super) fn draw(
        &self,
        area: &Area<'_>,
        episodes: &[Trajectory],
        top: u32,
    ) -> Result<(), Box<dyn std::error::Error>> {
        for ((number, wall), &(left, row)) in (1..).zip(self.course.walls()).zip(&self.places) {
            let view = FrontView {
                course: self.course,
                wall,
                scale: self.scale * px(1) as f32,
                left: px(left) as f32,
                top: px(top + row * self.row_height() + LABEL) as f32,
            };
            view.draw(area, number, episodes)?;
        }
        Ok(())
    }
}

/// Width of the longest usual label.
const LABEL_WIDTH: u32 = 140;

/// View of one wall; y to the left, z up. Drawn pixels.
struct FrontView<'a> {
    course: &'a Course,
    wall: &'a Wall,
    scale: f32,
    left: f32,
    top: f32,
}

impl FrontView<'_> {
    fn at(&self, [y_m, z_m]: [f32; 2]) -> (i32, i32) {
        let corridor = self.course.corridor();
        let x = self.left + (corridor.width_m / 2.0 - y_m) * self.scale;
        let y = self.top + (corridor.height_m - z_m) * self.scale;
        (x.round() as i32, y.round() as i32)
    }

    fn contains(&self, [y_m, z_m]: [f32; 2]) -> bool {
        let corridor = self.course.corridor();
        y_m.abs() <= corridor.width_m / 2.0 && (0.0..=corridor.height_m).contains(&z_m)
    }

    fn draw(
        &self,
        area: &Area<'_>,
        number: usize,
        episodes: &[Trajectory],
    ) -> Result<(), Box<dyn std::error::Error>> {
        let corridor = self.course.corridor();
        let half_m = corridor.width_m / 2.0;
        let frame = [
            self.at([half_m, corridor.height_m]),
            self.at([-half_m, 0.0]),
        ];
        area.draw(&Rectangle::new(frame, WALL.mix(SHADE).filled()))?;
        let opening: Vec<_> = self
            .wall
            .outline()
            .iter()
            .map(|&point| self.at(point))
            .collect();
        area.draw(&Polygon::new(opening.clone(), CORRIDOR.filled()))?;
        let closed = opening.iter().chain(opening.first()).copied();
        area.draw(&PathElement::new(
            closed.collect::<Vec<_>>(),
            WALL.stroke_width(px(1)),
        ))?;
        area.draw(&Rectangle::new(frame, WALL.stroke_width(px(2))))?;
        self.draw_marks(area, episodes)?;

        let label = match self.wall.label().0 as usize == number {
            true => format!("wall {number} at {} m", self.wall.x_m()),
            false => format!(
                "wall {number} (no. {}) at {} m",
                self.wall.label(),
                self.wall.x_m()
            ),
        };
        let middle = self.at([0.0, corridor.height_m]);
        let centred = font(14).pos(Pos::new(HPos::Center, VPos::Bottom));
        area.draw_text(&label, &centred, (middle.0, middle.1 - px(4) as i32))?;
        Ok(())
    }

    /// Draws where the episodes crossed the wall, and over it where others ended at it.
    fn draw_marks(
        &self,
        area: &Area<'_>,
        episodes: &[Trajectory],
    ) -> Result<(), Box<dyn std::error::Error>> {
        for episode in episodes {
            let opacity = opacity_of(episode.outcome, episodes.len());
            let style = colour_of(episode.outcome).mix(opacity);
            if let Some(point) = crossing(episode, self.wall).filter(|at| self.contains(*at)) {
                area.draw(&Circle::new(self.at(point), px(3), style.filled()))?;
            }
        }
        for episode in episodes {
            let colour = colour_of(episode.outcome);
            if let Some(point) = self.end_at_wall(episode).filter(|at| self.contains(*at)) {
                area.draw(&Cross::new(
                    self.at(point),
                    px(4),
                    colour.stroke_width(px(2)),
                ))?;
            }
        }
        Ok(())
    }

    /// Returns where a collided episode ended, `[y, z]` in metres, if that is within reach of the
    /// wall.
    fn end_at_wall(&self, episode: &Trajectory) -> Option<[f32; 2]> {
        let &[x_m, y_m, z_m] = episode.points_m.last()?;
        let from_m = self.wall.x_m() - DRONE_WIDTH_M;
        let to_m = self.wall.x_m() + self.course.wall_thickness_m() + DRONE_WIDTH_M;
        let is_here = episode.outcome == Outcome::Collided && (from_m..=to_m).contains(&x_m);
        is_here.then_some([y_m, z_m])
    }
}

/// Returns where an episode first crossed the wall's front face, `[y, z]` in metres, on the
/// straight line between two steps.
fn crossing(episode: &Trajectory, wall: &Wall) -> Option<[f32; 2]> {
    let pair = episode
        .points_m
        .windows(2)
        .find(|pair| pair[0][0] < wall.x_m() && pair[1][0] >= wall.x_m())?;
    let [from, to] = [pair[0], pair[1]];
    let share = (wall.x_m() - from[0]) / (to[0] - from[0]);
    Some([1, 2].map(|axis| from[axis] + share * (to[axis] - from[axis])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canvas::Canvas;

    fn course(walls: usize) -> Course {
        course_of(walls, "shape = \"circle\"\ndiameter_m = 2.2")
    }

    fn course_of(walls: usize, shape: &str) -> Course {
        let xs: Vec<_> = (1..=walls).map(|wall| format!("{}.0", 6 * wall)).collect();
        let order: Vec<_> = (1..=walls).map(|wall| wall.to_string()).collect();
        let mut text = format!(
            "name = \"c\"\norder = [{}]\nwall_x_m = [{}]\nwall_thickness_m = 0.3\ncorridor = {{ \
             length_m = {}.0, width_m = 6.0, height_m = 7.0 }}\nstart = {{ offset_m = 1.5, \
             jitter_y_m = 0.0, jitter_z_m = 0.0 }}\n",
            order.join(", "),
            xs.join(", "),
            6 * walls + 10
        );
        for wall in 1..=walls {
            text.push_str(&format!(
                "[[wall]]\nlabel = {wall}\ncentre_m = [0.0, 3.5]\n{shape}\n"
            ));
        }
        Course::parse(&text, "c.toml").unwrap()
    }

    #[test]
    fn an_episode_crosses_a_wall_between_two_steps() {
        let course = course(1);
        let wall = &course.walls()[0];
        let flown = |points_m: &[[f32; 3]], outcome| Trajectory {
            points_m: points_m.to_vec(),
            outcome,
        };
        let through = flown(&[[5.0, 0.0, 3.0], [7.0, 1.0, 4.0]], Outcome::ReachedEnd);
        assert_eq!(crossing(&through, wall), Some([0.5, 3.5]));
        let before = flown(&[[2.0, 0.0, 3.0], [5.5, 1.0, 4.0]], Outcome::Collided);
        assert_eq!(crossing(&before, wall), None);
        let view = FrontView {
            course: &course,
            wall,
            scale: 1.0,
            left: 0.0,
            top: 0.0,
        };
        assert_eq!(view.end_at_wall(&before), Some([1.0, 4.0]));
        assert_eq!(view.end_at_wall(&through), None);
        // The drone flies with y to its left: left in the view as well.
        assert!(view.at([1.0, 3.0]).0 < view.at([-1.0, 3.0]).0);
    }

    /// The corners of its bounding box belong to the wall; in a view of the box they were open.
    #[test]
    fn an_opening_is_drawn_by_its_shape() {
        let (triangle, l) = (
            "shape = \"triangle\"\nwidth_m = 3.6\nheight_m = 3.2",
            "shape = \"l\"\nwidth_m = 3.0\nheight_m = 3.0\narm_m = 1.8",
        );
        let circle = "shape = \"circle\"\ndiameter_m = 2.2";
        for (shape, closed_corners) in [(circle, 4), (triangle, 2), (l, 1)] {
            let course = course_of(1, shape);
            let wall = &course.walls()[0];
            let view = FrontView {
                course: &course,
                wall,
                scale: 40.0,
                left: 20.0,
                top: 40.0,
            };
            let mut canvas = Canvas::new(300, 300);
            canvas.draw(|area| view.draw(area, 1, &[])).unwrap();
            let colour = |at| canvas.colour_at(view.at(at));
            let closed = colour([2.7, 6.7]);
            assert_ne!(closed, CORRIDOR);
            assert_eq!(colour(wall.safe_point()), CORRIDOR, "{shape}");
            let outline = wall.outline();
            let ends = [0, 1].map(|axis| {
                let along = outline.iter().map(|point| point[axis]);
                let (low, high) = along.fold((f32::MAX, f32::MIN), |(low, high), metres| {
                    (low.min(metres), high.max(metres))
                });
                [low + 0.1, high - 0.1]
            });
            let corners = ends[0].map(|y_m| ends[1].map(|z_m| [y_m, z_m]));
            let is_closed = |corner: &&[f32; 2]| colour(**corner) == closed;
            let count = corners.iter().flatten().filter(is_closed).count();
            assert_eq!(count, closed_corners, "{shape}");
        }
    }

    #[test]
    fn views_lie_below_their_walls_or_side_by_side_and_never_overlap() {
        for walls in [1, 2, 32] {
            let course = course(walls);
            let along = (WIDTH - LEFT - RIGHT) as f32 / course.corridor().length_m;
            let views = FrontViews::of(&course, along);
            for pair in views.places.windows(2) {
                assert!(pair[1].1 > pair[0].1 || pair[1].0 > pair[0].0 + LABEL_WIDTH);
            }
            let within = |&(left, _): &(u32, u32)| left >= LEFT && left + 130 + RIGHT <= WIDTH;
            assert!(views.places.iter().all(within), "{:?}", views.places);
        }
    }
}
