//! Suites as TOML files. A file that is refused is refused by file, entry and key.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use super::{EntryCourses, MOST_EPISODES, MOST_WALLS_TO_ORDER, Suite, SuiteEntry, orders};
use crate::course::{Course, CourseError, CourseFault, GeneratorRanges, RangesError};
use crate::disturbances::DisturbanceSettings;
use crate::text::read_text;

/// Most entries of a suite.
const MOST_ENTRIES: usize = 64;

/// Why a suite cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    /// The file cannot be read.
    #[error("{}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong kind.
    #[error("{}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Where, and what is wrong, on one line.
        message: String,
    },
    /// Too few or too many entries.
    #[error("{}: has {count} [[entry]] tables: give it 1 to {MOST_ENTRIES}", path.display())]
    Count {
        /// The file.
        path: PathBuf,
        /// How many it has.
        count: usize,
    },
    /// An entry cannot be flown.
    #[error("{}: entry \"{entry}\": {source}", path.display())]
    Entry {
        /// The file.
        path: PathBuf,
        /// The entry's name.
        entry: String,
        /// What is wrong with it.
        source: Box<EntryFault>,
    },
}

/// Why an entry of a suite cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum EntryFault {
    /// It would be taken for another.
    #[error("another entry has this name: reports could not tell them apart")]
    RepeatedName,
    /// No courses, or of several kinds.
    #[error(
        "names its courses by {0} of the keys course, orders_of and generated: give it exactly one"
    )]
    Courses(usize),
    /// A seed without anything to generate.
    #[error("has first_seed, but nothing generated: leave it out, or add generated")]
    SeedOfNothing,
    /// No episodes, or too many.
    #[error("episodes = {0} is outside 1 to {MOST_EPISODES}")]
    Episodes(u64),
    /// No number of episodes.
    #[error("has no episodes, and the suite has none for all its entries: add episodes to either")]
    NoEpisodes,
    /// A course file cannot be flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// Too many orders.
    #[error("orders_of: {} has {walls} walls, more than {MOST_WALLS_TO_ORDER}: they have too many orders", path.display())]
    TooManyOrders {
        /// The course file.
        path: PathBuf,
        /// How many walls it has.
        walls: usize,
    },
    /// An order cannot be flown.
    #[error("orders_of: {}: order {order:?}: {source}", path.display())]
    Order {
        /// The course file.
        path: PathBuf,
        /// Labels in the order.
        order: Vec<u32>,
        /// Why.
        source: CourseFault,
    },
    /// Nothing can be generated.
    #[error(transparent)]
    Ranges(#[from] RangesError),
}

/// A suite file as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SuiteFile {
    name: String,
    /// Of every entry that says nothing else.
    episodes: Option<u64>,
    #[serde(default)]
    entry: Vec<EntryFile>,
}

/// An entry as it is written. Paths are relative to the suite file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EntryFile {
    name: String,
    episodes: Option<u64>,
    course: Option<PathBuf>,
    orders_of: Option<PathBuf>,
    generated: Option<GeneratorRanges>,
    first_seed: Option<u64>,
    #[serde(default)]
    disturbances: DisturbanceSettings,
}

impl Suite {
    /// Reads a suite file and every course file that it names.
    ///
    /// # Errors
    /// [`SuiteError`] names the file, the entry and the key, and says what to change.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, SuiteError> {
        let path = path.as_ref();
        let text = read_text(path).map_err(|source| SuiteError::Read {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text, path)
    }

    /// Reads a suite from the text of a suite file. `path` is named in errors, and course files are
    /// looked for from its folder.
    ///
    /// # Errors
    /// As [`Suite::load`].
    pub fn parse(text: &str, path: impl AsRef<Path>) -> Result<Self, SuiteError> {
        let path = path.as_ref();
        let file: SuiteFile = toml::from_str(text).map_err(|error| SuiteError::Syntax {
            path: path.to_owned(),
            message: located(text, &error),
        })?;
        if !(1..=MOST_ENTRIES).contains(&file.entry.len()) {
            return Err(SuiteError::Count {
                path: path.to_owned(),
                count: file.entry.len(),
            });
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut suite = Self {
            name: file.name,
            entries: Vec::new(),
        };
        for written in file.entry {
            let entry = written.name.clone();
            let read = suite.entry(written, file.episodes, folder);
            suite.entries.push(read.map_err(|source| SuiteError::Entry {
                path: path.to_owned(),
                entry,
                source: Box::new(source),
            })?);
        }
        Ok(suite)
    }

    /// The next entry, if it can be flown beside those already there.
    fn entry(
        &self,
        written: EntryFile,
        episodes: Option<u64>,
        folder: &Path,
    ) -> Result<SuiteEntry, EntryFault> {
        if self.entries.iter().any(|entry| entry.name == written.name) {
            return Err(EntryFault::RepeatedName);
        }
        let episodes = written
            .episodes
            .or(episodes)
            .ok_or(EntryFault::NoEpisodes)?;
        if !(1..=MOST_EPISODES).contains(&episodes) {
            return Err(EntryFault::Episodes(episodes));
        }
        Ok(SuiteEntry {
            episodes,
            courses: courses(&written, folder)?,
            disturbances: written.disturbances,
            name: written.name,
        })
    }
}

fn courses(written: &EntryFile, folder: &Path) -> Result<EntryCourses, EntryFault> {
    if written.first_seed.is_some() && written.generated.is_none() {
        return Err(EntryFault::SeedOfNothing);
    }
    match (&written.course, &written.orders_of, &written.generated) {
        (Some(file), None, None) => Ok(EntryCourses::Listed(vec![Arc::new(Course::load(
            folder.join(file),
        )?)])),
        (None, Some(file), None) => all_orders(&folder.join(file)).map(EntryCourses::Listed),
        (None, None, Some(ranges)) => {
            let first_seed = written.first_seed.unwrap_or(0);
            // What is wrong with the ranges shows with the first course.
            Course::generate(first_seed, ranges)?;
            Ok(EntryCourses::Generated {
                first_seed,
                ranges: ranges.clone(),
            })
        }
        (course, orders_of, generated) => Err(EntryFault::Courses(
            usize::from(course.is_some())
                + usize::from(orders_of.is_some())
                + usize::from(generated.is_some()),
        )),
    }
}

/// The course of the file in every order of its walls, its own first.
fn all_orders(path: &Path) -> Result<Vec<Arc<Course>>, EntryFault> {
    let course = Course::load(path)?;
    let walls = course.walls();
    if walls.len() > MOST_WALLS_TO_ORDER {
        return Err(EntryFault::TooManyOrders {
            path: path.to_owned(),
            walls: walls.len(),
        });
    }
    let reordered = |order: Vec<usize>| {
        course
            .reordered(&order)
            .map(Arc::new)
            .map_err(|source| EntryFault::Order {
                path: path.to_owned(),
                order: order.iter().map(|&place| walls[place].label().0).collect(),
                source,
            })
    };
    orders(walls.len()).into_iter().map(reordered).collect()
}

/// The parser's refusal on one line; its own draws a picture over several.
fn located(text: &str, error: &toml::de::Error) -> String {
    let before = text
        .get(..error.span().unwrap_or_default().start)
        .unwrap_or("");
    let line = before.matches('\n').count() + 1;
    format!(
        "line {line}: {}",
        error.message().trim_end().replace('\n', " ")
    )
}
