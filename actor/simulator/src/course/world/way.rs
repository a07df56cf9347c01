//! Ways to the goal through the free space of a world: for every place, how far it is, and where to
//! fly next.
//!
//! The space is divided into cells. A cell is free if the drone's body, level, with a margin,
//! touches nothing at its middle, and roomy if all cells around it are free. From the goal, lengths
//! spread over the free cells (Dijkstra's algorithm). In cells that are not roomy they count
//! double, so that ways keep away from obstacles where they can. So do lengths sideways and, more,
//! lengths back: a drone flies forward. Motion is ignored: ways lead past the places where moving
//! obstacles start.

use std::cmp::Ordering;

use nalgebra::{Point3, Vector3};

use super::Region;
use crate::course::{Corridor, DRONE_WIDTH_M};

/// Side of a cell, metres. Larger worlds have larger cells, up to [`LARGEST_CELL_M`].
const CELL_M: f32 = 0.25;
const LARGEST_CELL_M: f32 = 0.4;
/// Number of cells above which cells grow.
const USUAL_CELLS: f32 = 80_000.0;
/// Most cells of a world: 64,000 cubic metres, which are searched in some tenths of a second.
const MOST_CELLS: usize = 1_000_000;

/// Half the body, forward, left and up, with 0.1 m of air at the sides and a tilted body's height,
/// metres.
pub(super) const BODY_M: Vector3<f32> =
    Vector3::new(DRONE_WIDTH_M / 2.0 + 0.1, DRONE_WIDTH_M / 2.0 + 0.1, 0.3);

/// Length of a step to the next cell along an axis; diagonal ones are longer.
const STEP: u32 = 10;
const STEPS: [u32; 4] = [0, STEP, 14, 17];
/// Factor of lengths in cells that are not roomy.
const TIGHT: u32 = 2;
/// Factor of lengths straight to the side, up or down, and of lengths back.
const ASIDE: u32 = 2;
const BACK: u32 = 3;
/// Length of a cell from which no way leads to the goal.
const NO_WAY: u32 = u32::MAX;

/// Cells of a world.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Grid {
    cell_m: f32,
    /// Middle of the first cell, metres.
    first_m: Point3<f32>,
    /// Number of cells along each axis.
    cells: [usize; 3],
}

/// Ways from all cells to the goal.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Ways {
    grid: Grid,
    /// Length of the way from each cell, in [`STEP`]s of a cell.
    lengths: Vec<u32>,
    is_free: Vec<bool>,
}

impl Grid {
    /// Returns the cells of `bounds`; `None` if there would be too many.
    pub(super) fn of(bounds: Corridor) -> Option<Self> {
        let Corridor {
            length_m,
            width_m,
            height_m,
        } = bounds;
        let volume_m3 = length_m * width_m * height_m;
        let cell_m = (volume_m3 / USUAL_CELLS)
            .cbrt()
            .clamp(CELL_M, LARGEST_CELL_M);
        let cells = [length_m, width_m, height_m].map(|side_m| (side_m / cell_m).ceil() as usize);
        let spare_m = |axis: usize, side_m: f32| (side_m - (cells[axis] - 1) as f32 * cell_m) / 2.0;
        let first_m = Point3::new(
            spare_m(0, length_m),
            spare_m(1, width_m) - width_m / 2.0,
            spare_m(2, height_m),
        );
        let is_small = cells.iter().product::<usize>() <= MOST_CELLS;
        is_small.then_some(Self {
            cell_m,
            first_m,
            cells,
        })
    }

    pub(super) fn count(&self) -> usize {
        self.cells.iter().product()
    }

    pub(super) fn middle_m(&self, cell: usize) -> Point3<f32> {
        let [x, y, z] = self.place(cell).map(|number| number as f32 * self.cell_m);
        self.first_m + Vector3::new(x, y, z)
    }

    /// Returns the cells whose middles lie between two corners.
    pub(super) fn between(
        &self,
        least: &Point3<f32>,
        most: &Point3<f32>,
    ) -> impl Iterator<Item = usize> + use<> {
        let range = |axis: usize| {
            let number = |at: f32| (at - self.first_m[axis]) / self.cell_m;
            let first = number(least[axis]).ceil().max(0.0) as usize;
            let end = (number(most[axis]).floor() + 1.0).max(0.0) as usize;
            first..end.min(self.cells[axis])
        };
        let (xs, ys, zs) = (range(0), range(1), range(2));
        let [_, across, up] = self.cells;
        xs.flat_map(move |x| {
            let zs = zs.clone();
            ys.clone()
                .flat_map(move |y| zs.clone().map(move |z| (x * across + y) * up + z))
        })
    }

    /// Returns the cell that holds a point; the nearest one for a point outside.
    fn at(&self, point: &Point3<f32>) -> usize {
        let number = |axis: usize| {
            let number = ((point[axis] - self.first_m[axis]) / self.cell_m).round();
            // A NaN becomes the first cell.
            (number.max(0.0) as usize).min(self.cells[axis] - 1)
        };
        let [_, across, up] = self.cells;
        (number(0) * across + number(1)) * up + number(2)
    }

    fn place(&self, cell: usize) -> [usize; 3] {
        let [_, across, up] = self.cells;
        [cell / up / across, cell / up % across, cell % up]
    }

    /// Returns the cells around one: each with the number of axes along which it differs, and where
    /// it lies along x.
    fn around(&self, cell: usize) -> impl Iterator<Item = (usize, usize, Ordering)> {
        let [x, y, z] = self.place(cell);
        let [along, across, up] = self.cells;
        let near = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        near(x, along).flat_map(move |to_x| {
            near(y, across).flat_map(move |to_y| {
                near(z, up).filter_map(move |to_z| {
                    let axes =
                        usize::from(to_x != x) + usize::from(to_y != y) + usize::from(to_z != z);
                    let next = (to_x * across + to_y) * up + to_z;
                    (axes > 0).then_some((next, axes, to_x.cmp(&x)))
                })
            })
        })
    }
}

/// Returns the length of a step along `axes` axes into a cell of this [`room`], ahead (`Greater`),
/// aside or back along x.
fn step_length(axes: usize, along_x: Ordering, room: u32) -> u32 {
    let aside = match along_x {
        Ordering::Greater => 1,
        Ordering::Equal => ASIDE,
        Ordering::Less => BACK,
    };
    STEPS[axes] * aside * room
}

impl Ways {
    /// Finds the ways to `goal`. `is_free`: of each cell.
    pub(super) fn to(goal: &Region, grid: Grid, is_free: Vec<bool>) -> Self {
        const LONGEST: usize = (STEPS[3] * TIGHT * BACK) as usize;
        let mut lengths = vec![NO_WAY; grid.count()];
        // No step is longer than LONGEST, so cells of so many lengths at a time are under way.
        let mut under_way: [Vec<usize>; LONGEST + 1] = std::array::from_fn(|_| Vec::new());
        for cell in grid.between(&goal.least(), &goal.most()) {
            if is_free[cell] {
                lengths[cell] = 0;
                under_way[0].push(cell);
            }
        }
        let (mut length, mut idle) = (0, 0);
        while idle <= LONGEST {
            let reached = std::mem::take(&mut under_way[length as usize % (LONGEST + 1)]);
            idle = if reached.is_empty() { idle + 1 } else { 0 };
            for cell in reached {
                if lengths[cell] != length {
                    continue;
                }
                let room = room(&grid, &is_free, cell);
                for (next, axes, along_x) in grid.around(cell) {
                    let to_next = length + step_length(axes, along_x.reverse(), room);
                    if is_free[next] && to_next < lengths[next] {
                        lengths[next] = to_next;
                        under_way[to_next as usize % (LONGEST + 1)].push(next);
                    }
                }
            }
            length += 1;
        }
        Self {
            grid,
            lengths,
            is_free,
        }
    }

    /// Returns `true` if the body fits at a point.
    pub(super) fn fits(&self, point: &Point3<f32>) -> bool {
        self.is_free[self.grid.at(point)]
    }

    /// Returns `true` if the body fits anywhere in the goal.
    pub(super) fn have_an_end(&self) -> bool {
        self.lengths.contains(&0)
    }

    /// Returns `true` if the goal can be reached from the cell of a point.
    pub(super) fn leads_from(&self, point: &Point3<f32>) -> bool {
        self.lengths[self.grid.at(point)] != NO_WAY
    }

    /// Returns `true` if the body has room around it at a point from which the goal can be reached.
    pub(super) fn is_roomy(&self, point: &Point3<f32>) -> bool {
        self.leads_from(point) && is_roomy(&self.grid, &self.is_free, self.grid.at(point))
    }

    /// Returns the length of the way from a point, metres; `None` if there is none. Near obstacles
    /// it counts double.
    pub(super) fn length_m(&self, point: &Point3<f32>) -> Option<f32> {
        let cell = self.nearest(point)?;
        Some(self.lengths[cell] as f32 / STEP as f32 * self.grid.cell_m)
    }

    /// Returns the way from a point, cell by cell, without the point itself. It is empty at the
    /// goal and where no way begins.
    pub(super) fn from(&self, point: &Point3<f32>) -> impl Iterator<Item = Point3<f32>> {
        let next = |&cell: &usize| {
            let around = self.grid.around(cell);
            let best = around
                .filter(|&(next, ..)| self.lengths[next] < self.lengths[cell])
                .min_by_key(|&(next, axes, along_x)| {
                    let room = room(&self.grid, &self.is_free, next);
                    self.lengths[next] + step_length(axes, along_x, room)
                })?;
            Some(best.0)
        };
        std::iter::successors(self.nearest(point).as_ref().and_then(next), next)
            .map(|cell| self.grid.middle_m(cell))
    }

    /// Returns the point of the way from `point` that is about `ahead_m` away, or nearer if
    /// something stands between: where to fly next. At the goal, it is the point itself.
    pub(super) fn aim(&self, point: &Point3<f32>, ahead_m: f32) -> Point3<f32> {
        let mut aim = None;
        for next in self.from(point) {
            if aim.is_some() && !self.is_straight(point, &next) {
                break;
            }
            aim = Some(next);
            if nalgebra::distance(point, &next) > ahead_m {
                break;
            }
        }
        aim.unwrap_or(*point)
    }

    /// Returns `true` if the body fits everywhere on the line between two points.
    fn is_straight(&self, from: &Point3<f32>, to: &Point3<f32>) -> bool {
        let steps = (2.0 * nalgebra::distance(from, to) / self.grid.cell_m).ceil();
        (1..=steps as usize).all(|step| {
            let at = from + (to - from) * (step as f32 / steps);
            is_roomy(&self.grid, &self.is_free, self.grid.at(&at))
        })
    }

    /// Returns the cell of a point, or the best one beside it if the body does not fit there.
    fn nearest(&self, point: &Point3<f32>) -> Option<usize> {
        let has_way = |cell: &usize| self.lengths[*cell] != NO_WAY;
        let cell = self.grid.at(point);
        let around = self.grid.around(cell).map(|(next, ..)| next);
        Some(cell).filter(has_way).or_else(|| {
            around
                .filter(has_way)
                .min_by_key(|&cell| self.lengths[cell])
        })
    }
}

/// Returns the factor of lengths in a cell: 1 if it is roomy.
fn room(grid: &Grid, is_free: &[bool], cell: usize) -> u32 {
    match is_roomy(grid, is_free, cell) {
        true => 1,
        false => TIGHT,
    }
}

/// Returns `true` if a cell and all cells around it are free.
fn is_roomy(grid: &Grid, is_free: &[bool], cell: usize) -> bool {
    is_free[cell] && grid.around(cell).all(|(next, ..)| is_free[next])
}
