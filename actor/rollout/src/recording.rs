//! Recordings of evaluation episodes: a `.npz` file for NumPy (`numpy.load(FILE)`).
//!
//! One row per observation: the steps of an episode in order, then its closing observation;
//! episodes in order, courses in order. [`COLUMNS`] lists the arrays. The format is a zip file with
//! one `.npy` file per array; rows are written directly from the records.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use skein_protocol::files::destination;
use skein_protocol::transition::{RecordKind, RecordLengths, TransitionRecord};
use skein_protocol::{IMAGE_HEIGHT, IMAGE_WIDTH, REWARD_TERM_NAMES, REWARD_TERMS};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::evaluation::EvaluatedEpisode;
use AxisLength::{Fixed, Latent, Numbers};

// The arrays' types say little-endian, and rows are copied from memory.
const _: () = assert!(cfg!(target_endian = "little"));

/// Array of a recording.
pub struct Column {
    /// Its name.
    pub name: &'static str,
    /// Type, in NumPy's notation.
    pub kind: &'static str,
    /// Shape after the first axis, which counts rows.
    pub shape: &'static [AxisLength],
    /// Meaning.
    pub meaning: &'static str,
    write_value: fn(&RecordingRow<'_>, &mut Vec<u8>),
}

/// Length of an axis of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AxisLength {
    /// A fixed length.
    Fixed(usize),
    /// The length of the run's latent code.
    Latent,
    /// The numbers of the run's actions.
    Numbers,
}

impl AxisLength {
    fn len(self, lengths: RecordLengths) -> usize {
        match self {
            Fixed(len) => len,
            Latent => lengths.latent,
            Numbers => lengths.action.numbers(),
        }
    }
}

impl fmt::Display for AxisLength {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Fixed(len) => len.fmt(f),
            Latent => f.write_str("latent"),
            Numbers => f.write_str("action"),
        }
    }
}

/// One observation of a recording.
#[derive(Debug, Clone, Copy)]
pub struct RecordingRow<'a> {
    /// Number of the course.
    pub course: i32,
    /// Number of the episode on that course.
    pub episode: i32,
    /// Lengths of code and action.
    pub lengths: RecordLengths,
    /// The observation.
    pub record: &'a TransitionRecord,
}

/// All arrays with one row per observation. [`NAME_LISTS`] are written in addition.
pub const COLUMNS: [Column; 17] = [
    Column::new(
        "course",
        "<i4",
        &[],
        "index into course_names",
        |row, out| put(out, &[row.course]),
    ),
    Column::new(
        "episode",
        "<i4",
        &[],
        "episode on that course, from 0",
        |row, out| put(out, &[row.episode]),
    ),
    Column::new(
        "step",
        "<i4",
        &[],
        "step of the episode, from 0",
        |row, out| put(out, &[row.record.step]),
    ),
    Column::new(
        "closing",
        "|u1",
        &[],
        "1 in the last row of an episode, which has no action",
        |row, out| {
            out.push(u8::from(row.record.kind == RecordKind::Closing.code()));
        },
    ),
    Column::new(
        "position_m",
        "<f4",
        &[Fixed(3)],
        "along the corridor, left, up; metres, world frame",
        |row, out| {
            put(out, &row.record.position_m);
        },
    ),
    Column::new(
        "orientation",
        "<f4",
        &[Fixed(4)],
        "world from body, unit quaternion (i, j, k, w)",
        |row, out| {
            put(out, &row.record.orientation);
        },
    ),
    Column::new(
        "velocity_mps",
        "<f4",
        &[Fixed(3)],
        "forward, left, up; metres per second, world frame",
        |row, out| {
            put(out, &row.record.velocity_mps);
        },
    ),
    Column::new(
        "depth",
        "|u1",
        &[Fixed(IMAGE_HEIGHT), Fixed(IMAGE_WIDTH)],
        "depth image, top row first; 255 is farthest",
        |row, out| {
            out.extend_from_slice(&row.record.depth);
        },
    ),
    Column::new(
        "latent",
        "<f4",
        &[Latent],
        "latent code of the depth image",
        |row, out| put(out, &row.record.latent[..row.lengths.latent]),
    ),
    Column::new(
        "action",
        "<f4",
        &[Numbers],
        "action, each number in [-1, 1], in the order of action_names; 0 in closing rows",
        |row, out| {
            put(out, &row.record.action[..row.lengths.action.numbers()]);
        },
    ),
    Column::new(
        "oracle_action",
        "<f4",
        &[Numbers],
        "what the oracle would have commanded; 0 in closing rows",
        |row, out| {
            put(
                out,
                &row.record.teacher_action[..row.lengths.action.numbers()],
            );
        },
    ),
    Column::new(
        "reward_terms",
        "<f4",
        &[Fixed(REWARD_TERMS)],
        "terms of the reward for the action above: reward_term_names",
        |row, out| {
            put(out, &row.record.reward_terms);
        },
    ),
    Column::new("reward", "<f4", &[], "sum of reward_terms", |row, out| {
        put(out, &[row.record.reward])
    }),
    Column::new(
        "walls_passed",
        "|u1",
        &[],
        "walls passed in this episode, this step included",
        |row, out| {
            out.push(row.record.walls_passed);
        },
    ),
    Column::new(
        "terminated",
        "|u1",
        &[],
        "1 where the step ended in a collision or at the destination",
        |row, out| {
            out.push(row.record.terminated);
        },
    ),
    Column::new(
        "truncated",
        "|u1",
        &[],
        "1 where the step limit ended the episode",
        |row, out| {
            out.push(row.record.truncated);
        },
    ),
    Column::new(
        "goal_m",
        "<f4",
        &[Fixed(3)],
        "the goal from the drone, forward, left, up; metres, heading frame",
        |row, out| {
            put(out, &row.record.goal_m);
        },
    ),
];

/// Arrays of names: name, shape, meaning.
pub const NAME_LISTS: [(&str, &str, &str); 3] = [
    ("course_names", "[courses]", "names of the courses"),
    (
        "reward_term_names",
        "[terms]",
        "names of the reward's terms",
    ),
    ("action_names", "[action]", "names of the action's numbers"),
];

impl Column {
    const fn new(
        name: &'static str,
        kind: &'static str,
        shape: &'static [AxisLength],
        meaning: &'static str,
        write_value: fn(&RecordingRow<'_>, &mut Vec<u8>),
    ) -> Self {
        Self {
            name,
            kind,
            shape,
            meaning,
            write_value,
        }
    }

    /// Appends the value of `row` to `out`, in memory order.
    pub fn write(&self, row: &RecordingRow<'_>, out: &mut Vec<u8>) {
        (self.write_value)(row, out);
    }
}

/// Reason why a recording was not written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write the recording {}: {source}", path.display())]
pub struct RecordingError {
    /// The file.
    pub path: PathBuf,
    /// Cause.
    #[source]
    pub source: io::Error,
}

/// Writes the records of `episodes`, course by course, to `path` atomically.
///
/// # Errors
/// [`RecordingError`] names the file.
pub fn write_recording(
    path: &Path,
    courses: &[&str],
    lengths: RecordLengths,
    episodes: &[Vec<EvaluatedEpisode>],
) -> Result<(), RecordingError> {
    write_atomically(path, |file| write_npz(file, courses, lengths, episodes))
}

/// Writes the recording `path` with `write`, under another name until it is complete.
///
/// # Errors
/// [`RecordingError`] names the file.
pub fn write_atomically(
    path: &Path,
    write: impl FnOnce(&Path) -> io::Result<()>,
) -> Result<(), RecordingError> {
    // A link stays a link: the recording goes where it leads.
    let target = destination(path).unwrap_or_else(|| path.to_owned());
    let temporary = temporary_path(&target);
    write(&temporary)
        .and_then(|()| fs::rename(&temporary, &target))
        .map_err(|source| {
            // A partial recording is useless. If there is none, removing it does nothing.
            let _ = fs::remove_file(&temporary);
            failed(path, source)
        })
}

/// Checks before any episode that [`write_recording`] can write to `path`. Leaves no file behind
/// and does not change an existing one.
///
/// # Errors
/// [`RecordingError`] names the file.
pub fn check_recordable(path: &Path) -> Result<(), RecordingError> {
    if fs::metadata(path).is_ok_and(|there| !there.is_file()) {
        let source = io::Error::other("it is not a regular file, so a recording cannot replace it");
        return Err(failed(path, source));
    }
    let target = destination(path).unwrap_or_else(|| path.to_owned());
    let temporary = temporary_path(&target);
    File::create(&temporary)
        .and_then(|_| fs::remove_file(&temporary))
        .map_err(|source| failed(path, source))
}

/// Returns the temporary path of a recording.
pub fn temporary_path(path: &Path) -> PathBuf {
    path.with_extension(match path.extension() {
        Some(extension) if extension == "mcap" => "mcap.tmp",
        _ => "npz.tmp",
    })
}

fn failed(path: &Path, source: io::Error) -> RecordingError {
    RecordingError {
        path: path.to_owned(),
        source,
    }
}

fn write_npz(
    path: &Path,
    courses: &[&str],
    lengths: RecordLengths,
    episodes: &[Vec<EvaluatedEpisode>],
) -> io::Result<()> {
    let rows: Vec<RecordingRow<'_>> = (0i32..)
        .zip(episodes)
        .flat_map(|(course, episodes)| rows_of(course, lengths, episodes))
        .collect();
    let mut zip = ZipWriter::new(BufWriter::new(File::create(path)?));
    for column in &COLUMNS {
        let shape: Vec<_> = column.shape.iter().map(|axis| axis.len(lengths)).collect();
        start_array(&mut zip, column.name, column.kind, rows.len(), &shape)?;
        let mut bytes = Vec::new();
        for row in &rows {
            bytes.clear();
            column.write(row, &mut bytes);
            zip.write_all(&bytes)?;
        }
    }
    let [
        (course_names, ..),
        (reward_term_names, ..),
        (action_names, ..),
    ] = NAME_LISTS;
    let axes: Vec<_> = lengths
        .action
        .axes()
        .iter()
        .map(|axis| axis.name())
        .collect();
    write_names(&mut zip, course_names, courses)?;
    write_names(&mut zip, reward_term_names, &REWARD_TERM_NAMES)?;
    write_names(&mut zip, action_names, &axes)?;
    zip.finish()
        .map_err(io::Error::from)?
        .into_inner()?
        .sync_all()
}

/// Writes an array of strings. NumPy's have a fixed number of four-byte characters.
fn write_names(
    zip: &mut ZipWriter<BufWriter<File>>,
    array: &str,
    names: &[&str],
) -> io::Result<()> {
    let lengths = names.iter().map(|name| name.chars().count());
    let longest = lengths.max().unwrap_or(0).max(1);
    start_array(zip, array, &format!("<U{longest}"), names.len(), &[])?;
    for name in names {
        let letters = name
            .chars()
            .map(u32::from)
            .chain(std::iter::repeat(0))
            .take(longest);
        zip.write_all(&letters.flat_map(u32::to_le_bytes).collect::<Vec<_>>())?;
    }
    Ok(())
}

fn rows_of(
    course: i32,
    lengths: RecordLengths,
    episodes: &[EvaluatedEpisode],
) -> impl Iterator<Item = RecordingRow<'_>> {
    (0i32..).zip(episodes).flat_map(move |(episode, flown)| {
        flown.records.iter().map(move |record| RecordingRow {
            course,
            episode,
            lengths,
            record,
        })
    })
}

/// Begins a `.npy` file. Source: numpy.lib.format, version 1.0.
fn start_array(
    zip: &mut ZipWriter<BufWriter<File>>,
    name: &str,
    kind: &str,
    rows: usize,
    shape: &[usize],
) -> io::Result<()> {
    const PREFIX: usize = 10;
    let options = SimpleFileOptions::default()
        .compression_level(Some(1))
        .large_file(true);
    zip.start_file(format!("{name}.npy"), options)
        .map_err(io::Error::from)?;
    let axes: String = shape.iter().map(|length| format!(" {length},")).collect();
    let mut header =
        format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({rows},{axes}), }}");
    // The data begins at a multiple of 64 bytes, after the newline that ends the header.
    let padding = (PREFIX + header.len() + 1).next_multiple_of(64) - PREFIX - header.len() - 1;
    header.extend(std::iter::repeat_n(' ', padding));
    header.push('\n');
    zip.write_all(b"\x93NUMPY\x01\x00")?;
    zip.write_all(&(header.len() as u16).to_le_bytes())?;
    zip.write_all(header.as_bytes())
}

fn put<T: bytemuck::NoUninit>(out: &mut Vec<u8>, values: &[T]) {
    out.extend_from_slice(bytemuck::cast_slice(values));
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use bytemuck::Zeroable;
    use skein_protocol::ActionSpace;
    use skein_protocol::evaluation::EpisodeScore;
    use skein_protocol::transition::Outcome;

    use super::*;

    const LENGTHS: RecordLengths = RecordLengths {
        latent: 8,
        action: ActionSpace::Velocity,
    };

    fn episode(first: u8, records: u8) -> EvaluatedEpisode {
        let record = |number: u8| {
            let mut record = Box::new(TransitionRecord::zeroed());
            record.depth.fill(number);
            record.latent = std::array::from_fn(|index| f32::from(number) + index as f32);
            record.position_m = [f32::from(number), 0.5, -1.0];
            record.action = [f32::from(number), 0.25, 0.5, 0.0];
            record
        };
        let score = EpisodeScore {
            walls_passed: 0,
            walls: 5,
            episode_return: 0.0,
            outcome: Outcome::Collided,
            hit_wall: None,
        };
        EvaluatedEpisode {
            score,
            positions_m: Vec::new(),
            records: (first..first + records).map(record).collect(),
        }
    }

    /// Returns header and data of an array.
    fn array(file: &Path, name: &str) -> (String, Vec<u8>) {
        let mut zip = zip::ZipArchive::new(File::open(file).unwrap()).unwrap();
        let mut bytes = Vec::new();
        zip.by_name(&format!("{name}.npy"))
            .unwrap()
            .read_to_end(&mut bytes)
            .unwrap();
        assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
        let end = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        assert!(end % 64 == 0 && bytes[end - 1] == b'\n');
        (
            String::from_utf8(bytes[10..end].to_vec()).unwrap(),
            bytes[end..].to_vec(),
        )
    }

    /// Returns the values of an array's data.
    fn values<T: bytemuck::AnyBitPattern>(bytes: &[u8]) -> Vec<T> {
        bytes
            .chunks_exact(size_of::<T>())
            .map(bytemuck::pod_read_unaligned)
            .collect()
    }

    #[test]
    fn rows_are_all_observations_in_course_and_episode_order() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("episodes.npz");
        let episodes = [vec![episode(1, 2), episode(3, 1)], vec![episode(4, 1)]];
        write_recording(&file, &["near", "far \u{e4}"], LENGTHS, &episodes).unwrap();

        let (header, depth) = array(&file, "depth");
        assert!(
            header
                .starts_with("{'descr': '|u1', 'fortran_order': False, 'shape': (4, 72, 128,), }"),
            "{header}"
        );
        assert_eq!(
            depth.iter().step_by(72 * 128).copied().collect::<Vec<_>>(),
            [1, 2, 3, 4]
        );
        let integers = |name| values::<i32>(&array(&file, name).1);
        assert_eq!(integers("course"), [0, 0, 0, 1]);
        assert_eq!(integers("episode"), [0, 0, 1, 0]);
        let (header, position) = array(&file, "position_m");
        assert!(
            header.contains("'<f4'") && header.contains("(4, 3,)"),
            "{header}"
        );
        assert_eq!(values::<f32>(&position)[3..6], [2.0, 0.5, -1.0]);
        let (header, latent) = array(&file, "latent");
        assert!(header.contains("(4, 8,)"), "{header}");
        assert_eq!(values::<f32>(&latent)[14..18], [8.0, 9.0, 3.0, 4.0]);
        let (header, actions) = array(&file, "action");
        assert!(header.contains("(4, 3,)"), "{header}");
        assert_eq!(values::<f32>(&actions)[3..6], [2.0, 0.25, 0.5]);
        let (header, _) = array(&file, "action_names");
        assert!(
            header.contains("'<U7'") && header.contains("(3,)"),
            "{header}"
        );
        let (header, names) = array(&file, "course_names");
        assert!(
            header.contains("'<U5'") && header.contains("(2,)"),
            "{header}"
        );
        assert_eq!(values::<u32>(&names)[9], 0xe4);
        let (header, names) = array(&file, "reward_term_names");
        assert!(
            header.contains("'<U13'") && header.contains(&format!("({REWARD_TERMS},)")),
            "{header}"
        );
        let letters: String = values::<u32>(&names)
            .into_iter()
            .filter_map(char::from_u32)
            .collect();
        assert!(
            letters.starts_with("collision\0\0\0\0level_up"),
            "{letters:?}"
        );
    }

    #[test]
    fn every_array_has_as_many_values_as_its_header_says() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("episodes.npz");
        write_recording(&file, &["near"], LENGTHS, &[vec![episode(0, 3)]]).unwrap();
        for column in &COLUMNS {
            let value_bytes: usize = column.kind[2..].parse().unwrap();
            let expected = 3
                * column
                    .shape
                    .iter()
                    .map(|axis| axis.len(LENGTHS))
                    .product::<usize>()
                * value_bytes;
            assert_eq!(
                array(&file, column.name).1.len(),
                expected,
                "{}",
                column.name
            );
        }
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("missing/episodes.npz");
        for error in [
            write_recording(&file, &[], LENGTHS, &[]),
            check_recordable(&file),
        ] {
            let error = error.unwrap_err().to_string();
            assert!(error.contains(file.to_str().unwrap()), "{error}");
        }
    }

    #[test]
    fn a_recording_goes_where_a_link_leads_and_the_link_stays() {
        let folder = tempfile::tempdir().unwrap();
        let [target, link] = ["there.npz", "link.npz"].map(|name| folder.path().join(name));
        std::os::unix::fs::symlink(&target, &link).unwrap();
        check_recordable(&link).unwrap();
        write_recording(&link, &[], LENGTHS, &[]).unwrap();
        assert!(link.is_symlink() && target.is_file());
    }

    #[test]
    fn an_unwritable_recording_is_refused_early_and_leaves_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let names = || {
            let mut names: Vec<_> = fs::read_dir(folder.path())
                .unwrap()
                .map(|entry| entry.unwrap().file_name())
                .collect();
            names.sort();
            names
        };
        fs::create_dir(at("folder")).unwrap();
        fs::write(at("earlier.npz"), b"earlier").unwrap();
        assert!(check_recordable(&at("folder")).is_err());
        let _socket = std::os::unix::net::UnixListener::bind(at("socket")).unwrap();
        assert!(check_recordable(&at("socket")).is_err());
        write_recording(&at("folder"), &["near"], LENGTHS, &[vec![episode(0, 1)]]).unwrap_err();
        check_recordable(&at("earlier.npz")).unwrap();
        check_recordable(&at("new.npz")).unwrap();
        assert_eq!(names(), ["earlier.npz", "folder", "socket"]);
        assert_eq!(fs::read(at("earlier.npz")).unwrap(), b"earlier");
    }
}
