//! Evaluation suites: what a policy is put to, entry by entry.
//!
//! An entry names courses (a file, all orders of a file's walls, or generated ones), how many
//! episodes are spread over them, and what disturbs them. A suite says all of it by itself, so that
//! two policies that were trained on different courses, and with different disturbances, are put to
//! the same.

mod file;
#[cfg(test)]
mod tests;

use std::sync::Arc;

pub use file::{EntryFault, SuiteError};

use crate::course::{Course, GeneratorRanges, RangesError};
use crate::disturbances::DisturbanceSettings;

/// Most episodes of an entry.
pub const MOST_EPISODES: u64 = 1_000_000;
/// Most walls of a course of which all orders are flown: 720 courses.
pub const MOST_WALLS_TO_ORDER: usize = 6;

/// A list of entries, none of which is called as another.
#[derive(Debug, Clone, PartialEq)]
pub struct Suite {
    /// What reports call it.
    pub name: String,
    /// What is flown, in order.
    pub entries: Vec<SuiteEntry>,
}

/// Episodes of one kind.
#[derive(Debug, Clone, PartialEq)]
pub struct SuiteEntry {
    /// What reports call it.
    pub name: String,
    /// How many.
    pub episodes: u64,
    /// Where.
    pub courses: EntryCourses,
    /// What disturbs them.
    pub disturbances: DisturbanceSettings,
}

/// The courses of an entry. Episode n flies course n, and begins anew after the last.
#[derive(Debug, Clone, PartialEq)]
pub enum EntryCourses {
    /// These; at least one.
    Listed(Vec<Arc<Course>>),
    /// One for each episode: that of the seed `first_seed` + n.
    Generated {
        /// Seed of the first episode's course.
        first_seed: u64,
        /// What they are drawn from.
        ranges: GeneratorRanges,
    },
}

impl EntryCourses {
    /// Number of the course that episode `episode`, from 0, flies: two episodes with one number fly
    /// one course.
    #[must_use]
    pub fn number_of(&self, episode: u64) -> u64 {
        match self {
            Self::Listed(courses) => episode % courses.len() as u64,
            Self::Generated { .. } => episode,
        }
    }

    /// The course of episode `episode`, from 0.
    ///
    /// # Errors
    /// [`RangesError`] if none can be generated for it.
    pub fn of_episode(&self, episode: u64) -> Result<Arc<Course>, RangesError> {
        match self {
            Self::Listed(courses) => Ok(Arc::clone(&courses[self.number_of(episode) as usize])),
            Self::Generated { first_seed, ranges } => {
                Course::generate(first_seed.wrapping_add(episode), ranges).map(Arc::new)
            }
        }
    }
}

/// All orders of `count` things, the first of which leaves everything where it is. However few are
/// taken from the beginning, they are spread over all: in lexicographic order, the first 24 of 120
/// would all begin alike.
fn orders(count: usize) -> Vec<Vec<usize>> {
    let lexicographic = all_orders(count);
    let length = lexicographic.len();
    // Steps of about the golden section of the way, which meet every order once when their length
    // and the number of orders have no common factor.
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

/// All orders of `count` things in lexicographic order.
fn all_orders(count: usize) -> Vec<Vec<usize>> {
    let mut all = vec![Vec::new()];
    for _ in 0..count {
        all = all
            .into_iter()
            .flat_map(|begun: Vec<usize>| {
                let free = (0..count)
                    .filter(|next| !begun.contains(next))
                    .collect::<Vec<_>>();
                free.into_iter()
                    .map(move |next| [begun.as_slice(), &[next]].concat())
            })
            .collect();
    }
    all
}
