//! Suite files, in TOML. An error names the file, the entry and the key.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use super::{EntryCourses, MOST_EPISODES, MOST_WALLS_TO_ORDER, Suite, SuiteEntry, orders};
use crate::course::{Course, CourseError, CourseFault, GeneratorRanges, RangesError};
use crate::disturbances::DisturbanceSettings;
use crate::text::{first_repeated, fits_in_a_table, message_of, parse_whole, read_text};

/// Most entries of a suite.
const MOST_ENTRIES: usize = 64;

/// Reason why a suite cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    /// The file cannot be read.
    #[error("{}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not TOML, or has an unknown key or a value of the wrong kind.
    #[error("{}: {message}", path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The line and the problem.
        message: String,
    },
    /// Too few or too many entries.
    #[error("{}: has {count} [[entry]] tables: give it 1 to {MOST_ENTRIES}", path.display())]
    Count {
        /// The file.
        path: PathBuf,
        /// Entries found.
        count: usize,
    },
    /// A name that cannot be shown.
    #[error(
        "{}: name = {name:?} cannot be shown: give one line without |, not empty",
        path.display()
    )]
    Name {
        /// The file.
        path: PathBuf,
        /// The name found.
        name: String,
    },
    /// An entry cannot be flown.
    #[error("{}: entry {entry:?}: {source}", path.display())]
    Entry {
        /// The file.
        path: PathBuf,
        /// The entry's name.
        entry: String,
        /// The entry's fault.
        source: Box<SuiteEntryError>,
    },
}

/// Reason why an entry of a suite cannot be flown.
#[derive(Debug, thiserror::Error)]
pub enum SuiteEntryError {
    /// The name cannot be shown in a table.
    #[error("its name cannot be shown in a table: give one line without |, not empty")]
    Name,
    /// Another entry has the same name.
    #[error("another entry has this name: give each entry its own name")]
    RepeatedName,
    /// The entry has no courses, or courses of several kinds.
    #[error(
        "names its courses by {0} of the keys course, orders_of and generated: give it exactly one"
    )]
    Courses(usize),
    /// A path that names nothing.
    #[error("{0} = \"\" names no file: give the path of a course, relative to the suite")]
    NoFile(&'static str),
    /// `first_seed` without generated courses.
    #[error("has first_seed but no generated courses: remove first_seed or add generated")]
    SeedWithoutGenerated,
    /// Too few or too many episodes.
    #[error("episodes = {0} is outside 1 to {MOST_EPISODES}")]
    Episodes(u64),
    /// Neither the entry nor the suite has a number of episodes.
    #[error("has no episodes, and neither has the suite: add episodes to one of them")]
    NoEpisodes,
    /// `max_steps = 0`.
    #[error("max_steps = 0: an episode needs at least one step")]
    NoSteps,
    /// A course file cannot be flown.
    #[error(transparent)]
    Course(#[from] CourseError),
    /// Too many orders.
    #[error(
        "orders_of: {} has {walls} walls, more than {MOST_WALLS_TO_ORDER}: there are too many \
         orders",
        path.display()
    )]
    TooManyOrders {
        /// The course file.
        path: PathBuf,
        /// Number of its walls.
        walls: usize,
    },
    /// An order cannot be flown.
    #[error("orders_of: {}: order {order:?}: {source}", path.display())]
    Order {
        /// The course file.
        path: PathBuf,
        /// The walls' labels in this order.
        order: Vec<u32>,
        /// The course's fault.
        source: CourseFault,
    },
    /// No course can be generated.
    #[error(transparent)]
    Ranges(#[from] RangesError),
    /// A shape of generated courses is listed twice.
    #[error("generated.shapes lists {0:?} twice: name each shape once")]
    RepeatedShape(&'static str),
}

/// Contents of a suite file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SuiteFile {
    name: String,
    /// Episodes of every entry that does not set its own number.
    episodes: Option<u64>,
    #[serde(default)]
    entry: Vec<EntryTable>,
}

/// Contents of an `[[entry]]` table. Paths are relative to the suite file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct EntryTable {
    name: String,
    episodes: Option<u64>,
    course: Option<PathBuf>,
    orders_of: Option<PathBuf>,
    generated: Option<GeneratorRanges>,
    first_seed: Option<u64>,
    /// Step limit of the entry's episodes, if not the policy's own.
    max_steps: Option<u32>,
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

    /// Reads a suite from the text of a suite file. `path` serves errors, and its folder is the
    /// base of relative course paths.
    ///
    /// # Errors
    /// Like [`Suite::load`].
    pub fn parse(text: &str, path: impl AsRef<Path>) -> Result<Self, SuiteError> {
        let path = path.as_ref();
        let file: SuiteFile = parse_whole(text).map_err(|error| SuiteError::Syntax {
            path: path.to_owned(),
            message: syntax_message(text, &error),
        })?;
        if !(1..=MOST_ENTRIES).contains(&file.entry.len()) {
            return Err(SuiteError::Count {
                path: path.to_owned(),
                count: file.entry.len(),
            });
        }
        if !names(&file.name) {
            return Err(SuiteError::Name {
                path: path.to_owned(),
                name: file.name,
            });
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut suite = Self {
            name: file.name,
            entries: Vec::new(),
        };
        for table in file.entry {
            let entry = table.name.clone();
            let checked = suite.entry(table, file.episodes, folder);
            suite
                .entries
                .push(checked.map_err(|source| SuiteError::Entry {
                    path: path.to_owned(),
                    entry,
                    source: Box::new(source),
                })?);
        }
        Ok(suite)
    }

    /// Returns the next entry if it can be flown and its name is new.
    fn entry(
        &self,
        table: EntryTable,
        episodes: Option<u64>,
        folder: &Path,
    ) -> Result<SuiteEntry, SuiteEntryError> {
        if !names(&table.name) {
            return Err(SuiteEntryError::Name);
        }
        if self.entries.iter().any(|entry| entry.name == table.name) {
            return Err(SuiteEntryError::RepeatedName);
        }
        let episodes = table
            .episodes
            .or(episodes)
            .ok_or(SuiteEntryError::NoEpisodes)?;
        if !(1..=MOST_EPISODES).contains(&episodes) {
            return Err(SuiteEntryError::Episodes(episodes));
        }
        if table.max_steps == Some(0) {
            return Err(SuiteEntryError::NoSteps);
        }
        Ok(SuiteEntry {
            episodes,
            courses: courses(&table, folder)?,
            disturbances: table.disturbances,
            max_steps: table.max_steps,
            name: table.name,
        })
    }
}

/// Returns `true` if a suite or an entry can be called `name`.
fn names(name: &str) -> bool {
    !name.trim().is_empty() && fits_in_a_table(name)
}

fn courses(table: &EntryTable, folder: &Path) -> Result<EntryCourses, SuiteEntryError> {
    if table.first_seed.is_some() && table.generated.is_none() {
        return Err(SuiteEntryError::SeedWithoutGenerated);
    }
    for (key, file) in [("course", &table.course), ("orders_of", &table.orders_of)] {
        if file
            .as_ref()
            .is_some_and(|file| file.as_os_str().is_empty())
        {
            return Err(SuiteEntryError::NoFile(key));
        }
    }
    match (&table.course, &table.orders_of, &table.generated) {
        (Some(file), None, None) => Ok(EntryCourses::Listed(vec![Arc::new(Course::load(
            folder.join(file),
        )?)])),
        (None, Some(file), None) => all_orders(&folder.join(file)).map(EntryCourses::Listed),
        (None, None, Some(ranges)) => {
            if let Some(shape) = first_repeated(&ranges.shapes) {
                return Err(SuiteEntryError::RepeatedShape(shape.name()));
            }
            let first_seed = table.first_seed.unwrap_or(0);
            ranges.check()?;
            Course::generate(first_seed, ranges)?;
            Ok(EntryCourses::Generated {
                first_seed,
                ranges: ranges.clone(),
            })
        }
        (course, orders_of, generated) => Err(SuiteEntryError::Courses(
            usize::from(course.is_some())
                + usize::from(orders_of.is_some())
                + usize::from(generated.is_some()),
        )),
    }
}

/// Returns the course of the file in every order of its walls, its own order first.
fn all_orders(path: &Path) -> Result<Vec<Arc<Course>>, SuiteEntryError> {
    let course = Course::load(path)?;
    let walls = course.walls();
    if walls.len() > MOST_WALLS_TO_ORDER {
        return Err(SuiteEntryError::TooManyOrders {
            path: path.to_owned(),
            walls: walls.len(),
        });
    }
    let reordered = |order: Vec<usize>| {
        course
            .reordered(&order)
            .map(Arc::new)
            .map_err(|source| SuiteEntryError::Order {
                path: path.to_owned(),
                order: order.iter().map(|&place| walls[place].label().0).collect(),
                source,
            })
    };
    orders(walls.len()).into_iter().map(reordered).collect()
}

/// Returns the parser's error on one line; its own text takes several.
fn syntax_message(text: &str, error: &toml::de::Error) -> String {
    let message = message_of(text, error);
    let Some(place) = error.span() else {
        return message;
    };
    let before = text.get(..place.start).unwrap_or("");
    let line = before.matches('\n').count() + 1;
    format!("line {line}: {message}")
}
