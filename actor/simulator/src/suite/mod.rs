//! Evaluation suites: lists of entries that a policy flies.
//!
//! An entry names its courses (a file, all orders of a file's walls, or generated ones), the number
//! of episodes on them, and their disturbances. A suite is self-contained, so that it compares
//! policies that were trained on different courses and with different disturbances.

mod file;
#[cfg(test)]
mod tests;

use std::sync::Arc;

pub use file::{SuiteEntryError, SuiteError};

use crate::course::{Course, GeneratorRanges, RangesError};
use crate::disturbances::DisturbanceSettings;
use crate::simulator::{OutOfReach, SimulatorSettings};

/// Most episodes of an entry.
pub const MOST_EPISODES: u64 = 1_000_000;
/// Most walls of a course for `orders_of`: 6 walls have 720 orders.
pub const MOST_WALLS_TO_ORDER: usize = 6;

/// An evaluation suite: entries with distinct names.
#[derive(Debug, Clone, PartialEq)]
pub struct Suite {
    /// Name for reports.
    pub name: String,
    /// Entries in the order in which they are flown.
    pub entries: Vec<SuiteEntry>,
}

/// Entry of a suite: episodes of one kind.
#[derive(Debug, Clone, PartialEq)]
pub struct SuiteEntry {
    /// Name for reports.
    pub name: String,
    /// Number of episodes.
    pub episodes: u64,
    /// Courses of the episodes.
    pub courses: EntryCourses,
    /// Disturbances of the episodes.
    pub disturbances: DisturbanceSettings,
    /// Step limit of the episodes; `None` for the policy's own.
    pub max_steps: Option<u32>,
}

impl SuiteEntry {
    /// Returns the settings `of_policy`, with the entry's disturbances and step limit.
    #[must_use]
    pub fn settings(&self, of_policy: &SimulatorSettings) -> SimulatorSettings {
        SimulatorSettings {
            disturbances: self.disturbances.clone(),
            max_steps: self.max_steps.unwrap_or(of_policy.max_steps),
            ..of_policy.clone()
        }
    }
}

/// Courses of an entry. Episode n flies course n; after the last course, the first follows again.
#[derive(Debug, Clone, PartialEq)]
pub enum EntryCourses {
    /// A list of at least one course.
    Listed(Vec<Arc<Course>>),
    /// One course per episode, generated from the seed `first_seed` + n.
    Generated {
        /// Seed of the first episode's course.
        first_seed: u64,
        /// Ranges from which the courses are drawn.
        ranges: GeneratorRanges,
    },
}

impl EntryCourses {
    /// Returns the number of the course that episode `episode`, from 0, flies. Episodes with the
    /// same number fly the same course.
    #[must_use]
    pub fn number_of(&self, episode: u64) -> u64 {
        match self {
            Self::Listed(courses) => episode % courses.len() as u64,
            Self::Generated { .. } => episode,
        }
    }

    /// Checks that an episode with `settings` can reach the end of each course.
    ///
    /// # Errors
    /// [`OutOfReach`] of the first course whose end lies too far.
    pub fn check_reach(&self, settings: &SimulatorSettings) -> Result<(), OutOfReach> {
        match self {
            Self::Listed(courses) => courses
                .iter()
                .try_for_each(|course| settings.check_reach(course.corridor(), course.start())),
            Self::Generated { ranges, .. } => {
                let (corridor, start) = ranges.longest();
                settings.check_reach(corridor, start)
            }
        }
    }

    /// Returns the course of episode `episode`, from 0.
    ///
    /// # Errors
    /// [`RangesError`] if no course can be generated for it.
    pub fn of_episode(&self, episode: u64) -> Result<Arc<Course>, RangesError> {
        match self {
            Self::Listed(courses) => Ok(Arc::clone(&courses[self.number_of(episode) as usize])),
            Self::Generated { first_seed, ranges } => {
                Course::generate(first_seed.wrapping_add(episode), ranges).map(Arc::new)
            }
        }
    }
}

/// Returns all orders of `count` items, the identity first.
///
/// They are shuffled so that the first few already cover all kinds: in lexicographic order, the
/// first 24 of 120 would all start with the same item.
fn orders(count: usize) -> Vec<Vec<usize>> {
    let lexicographic = all_orders(count);
    let length = lexicographic.len();
    // Steps of about the golden section of the list. They meet every order once if their length and
    // the number of orders have no common factor.
    let step = (length * 618 / 1000..)
        .find(|&step| common_factor(step, length) == 1)
        .unwrap_or(1);
    (0..length)
        .map(|number| lexicographic[number * step % length].clone())
        .collect()
}

fn common_factor(a: usize, b: usize) -> usize {
    if b == 0 { a } else { common_factor(b, a % b) }
}

/// Returns all orders of `count` items in lexicographic order.
fn all_orders(count: usize) -> Vec<Vec<usize>> {
    let mut all = vec![Vec::new()];
    for _ in 0..count {
        all = all
            .into_iter()
            .flat_map(|prefix: Vec<usize>| {
                let free = (0..count)
                    .filter(|next| !prefix.contains(next))
                    .collect::<Vec<_>>();
                free.into_iter()
                    .map(move |next| [prefix.as_slice(), &[next]].concat())
            })
            .collect();
    }
    all
}
