//! `episodes.csv`: one row per committed training episode, in episode order.
//!
//! Row n is episode n, whichever actor flew it, and whenever. A resumed run cuts the file back to
//! its checkpoint's episodes. So the file never contains more than what was learned from, and
//! nothing twice.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use skein_protocol::files;
use skein_protocol::transition::Outcome;
use xxhash_rust::xxh3::Xxh3Default;

use crate::disk::{Disk, PatientWriter};
use crate::episode::CommittedEpisode;

/// A row of `episodes.csv`; the fields are its columns.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EpisodeRow {
    /// Number of the episode, from 0 without a gap.
    pub episode: u64,
    /// Epoch that the episode belongs to.
    pub epoch: u64,
    /// Version of its snapshot; of several segments, the first one's.
    pub policy_version: u64,
    /// Actor that flew it: the one column that may differ between two runs of one configuration.
    pub actor: u32,
    /// Level whose start it was reset to, from 1.
    pub level: u8,
    /// Number of steps.
    pub steps: usize,
    /// Number of walls passed.
    pub walls_passed: u8,
    /// Sum of the rewards, in the shortest decimal notation that reads back as the same number.
    #[serde(rename = "return")]
    pub total_reward: f32,
    /// `collided`, `reached_end` or `timed_out`.
    pub outcome: Outcome,
}

/// Columns in order, which a continued file must have.
const COLUMNS: [&str; 9] = [
    "episode",
    "epoch",
    "policy_version",
    "actor",
    "level",
    "steps",
    "walls_passed",
    "return",
    "outcome",
];

/// Row of an episode that has ended.
impl From<&CommittedEpisode> for EpisodeRow {
    fn from(episode: &CommittedEpisode) -> Self {
        Self {
            episode: episode.episode.0,
            epoch: episode.epoch.0,
            policy_version: episode.policy_version.0,
            actor: episode.actor.0,
            level: episode.level,
            steps: episode.steps(),
            walls_passed: episode.walls_passed,
            total_reward: episode.total_reward(),
            outcome: episode.ending(),
        }
    }
}

/// Length and checksum of the first bytes of `episodes.csv`, which identify its content; part of a
/// checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpisodesExtent {
    /// Number of bytes.
    pub bytes: u64,
    /// Checksum of the bytes.
    pub xxh3: u64,
}

impl EpisodesExtent {
    /// Extent of a file that is empty or does not exist.
    pub fn empty() -> Self {
        Self {
            bytes: 0,
            xxh3: Xxh3Default::new().digest(),
        }
    }

    /// Checks that the file at `path` begins with these bytes; writes nothing. `episodes`: number
    /// of rows in them.
    ///
    /// # Errors
    /// [`EpisodesError::Damaged`]; [`EpisodesError::Io`] when the file cannot be read.
    pub fn check(&self, path: &Path, episodes: u64) -> Result<(), EpisodesError> {
        if self.bytes == 0 {
            return Ok(());
        }
        let found = match files::open(path, u64::MAX).and_then(|file| checksum_of(file, self.bytes))
        {
            Ok((bytes, _)) if bytes < self.bytes => {
                Err(format!("ends after {bytes} bytes of {}", self.bytes))
            }
            Ok((_, sum)) if sum.digest() != self.xxh3 => Err(format!(
                "was changed within its first {} bytes: \
                 their checksum is {:016x} where {:016x} is expected",
                self.bytes,
                sum.digest(),
                self.xxh3
            )),
            Ok(_) => Ok(()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Err("is missing".to_owned()),
            Err(source) => {
                return Err(EpisodesError::Io {
                    path: path.to_owned(),
                    source,
                });
            }
        };
        found.map_err(|problem| EpisodesError::Damaged {
            path: path.to_owned(),
            episodes,
            problem,
        })
    }
}

/// Reads at most `bytes` bytes of `file` from its position; returns their number and checksum.
fn checksum_of(file: impl Read, bytes: u64) -> io::Result<(u64, Xxh3Default)> {
    let mut sum = Xxh3Default::new();
    let read = io::copy(&mut file.take(bytes), &mut sum)?;
    Ok((read, sum))
}

/// A writer that keeps a checksum of everything in the file.
struct Checksummed<W> {
    inner: W,
    bytes: u64,
    sum: Xxh3Default,
}

impl<W> Checksummed<W> {
    fn extent(&self) -> EpisodesExtent {
        EpisodesExtent {
            bytes: self.bytes,
            xxh3: self.sum.digest(),
        }
    }
}

impl<W: Write> Write for Checksummed<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = self.inner.write(bytes)?;
        self.sum.update(&bytes[..taken]);
        self.bytes += taken as u64;
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl<W> std::fmt::Debug for Checksummed<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.extent().fmt(f)
    }
}

/// Writes `episodes.csv`.
#[derive(Debug)]
pub struct EpisodesCsv {
    path: PathBuf,
    writer: csv::Writer<Checksummed<PatientWriter<File>>>,
}

/// Reason why `episodes.csv` cannot be written or continued.
#[derive(Debug, thiserror::Error)]
pub enum EpisodesError {
    /// The file system refuses.
    #[error("cannot write {}: {source}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
    /// A row cannot be read back or written.
    #[error("{}: {source}", path.display())]
    Row {
        /// Path of the file.
        path: PathBuf,
        /// Row and cause.
        #[source]
        source: csv::Error,
    },
    /// The file does not begin with the checkpoint's content.
    #[error(
        "{} {problem}, but the checkpoint of episode {episodes} relies on it; put the file back",
        path.display()
    )]
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// Episodes committed at the checkpoint.
        episodes: u64,
        /// Description of the damage.
        problem: String,
    },
    /// The rows do not match the checkpoint's episodes.
    #[error("{} cannot be continued after {expected} episodes: {problem}", path.display())]
    Content {
        /// Path of the file.
        path: PathBuf,
        /// Number of episodes that the file should contain.
        expected: u64,
        /// Description of what it contains instead.
        problem: String,
    },
}

impl EpisodesCsv {
    /// Starts an empty file, in place of an existing one.
    ///
    /// # Errors
    /// [`EpisodesError::Io`].
    pub fn create(path: &Path, disk: &Disk) -> Result<Self, EpisodesError> {
        let file = File::create(path).map_err(|source| EpisodesError::Io {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self {
            path: path.to_owned(),
            writer: csv::Writer::from_writer(Checksummed {
                inner: disk.patient(path, file),
                bytes: 0,
                sum: Xxh3Default::new(),
            }),
        })
    }

    /// Continues after the first `episodes` rows, which `each` is called with. Later rows belong to
    /// episodes whose learning was lost, and are cut off.
    ///
    /// # Errors
    /// [`EpisodesError`] when the file does not contain episodes 0 to `episodes` - 1 in order.
    pub fn resume(
        path: &Path,
        episodes: u64,
        disk: &Disk,
        each: impl FnMut(&EpisodeRow),
    ) -> Result<Self, EpisodesError> {
        if episodes == 0 {
            return Self::create(path, disk);
        }
        let io = |source| EpisodesError::Io {
            path: path.to_owned(),
            source,
        };
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .open(path)
            .map_err(io)?;
        let end = end_of_rows(path, &file, episodes, each)?;
        file.set_len(end).map_err(io)?;
        end_line(&mut file).map_err(io)?;
        file.rewind().map_err(io)?;
        let (bytes, sum) = checksum_of(&file, u64::MAX).map_err(io)?;
        let inner = disk.patient(path, file);
        let writer = csv::WriterBuilder::new()
            .has_headers(false)
            .from_writer(Checksummed { inner, bytes, sum });
        Ok(Self {
            path: path.to_owned(),
            writer,
        })
    }

    /// Appends a row; it reaches the file with [`EpisodesCsv::flush`].
    ///
    /// # Errors
    /// [`EpisodesError::Row`].
    pub fn write(&mut self, row: &EpisodeRow) -> Result<(), EpisodesError> {
        self.writer
            .serialize(row)
            .map_err(|source| EpisodesError::Row {
                path: self.path.clone(),
                source,
            })
    }

    /// Extent of the file: everything written before the last [flush](EpisodesCsv::flush), and
    /// perhaps some later rows.
    pub fn extent(&self) -> EpisodesExtent {
        self.writer.get_ref().extent()
    }

    /// Hands everything written to the operating system.
    ///
    /// # Errors
    /// [`EpisodesError::Io`].
    pub fn flush(&mut self) -> Result<(), EpisodesError> {
        self.writer.flush().map_err(|source| EpisodesError::Io {
            path: self.path.clone(),
            source,
        })
    }
}

/// Goes to the end of the file, and adds a missing line end, so that the next row starts a line.
fn end_line(file: &mut File) -> io::Result<()> {
    let mut last = [0];
    file.seek(SeekFrom::End(-1))?;
    file.read_exact(&mut last)?;
    if last != *b"\n" {
        file.write_all(b"\n")?;
    }
    Ok(())
}

/// Position after the first `episodes` rows, which must be episodes 0, 1, 2, …
fn end_of_rows(
    path: &Path,
    file: &File,
    episodes: u64,
    mut each: impl FnMut(&EpisodeRow),
) -> Result<u64, EpisodesError> {
    let content = |problem| EpisodesError::Content {
        path: path.to_owned(),
        expected: episodes,
        problem,
    };
    let row_error = |source| EpisodesError::Row {
        path: path.to_owned(),
        source,
    };
    // No row of ours is quoted, and an unclosed quote would swallow what is appended.
    let mut reader = csv::ReaderBuilder::new().quoting(false).from_reader(file);
    let headers = reader.headers().map_err(row_error)?.clone();
    if headers != COLUMNS[..] {
        return Err(content(format!("its columns are {headers:?}")));
    }
    let mut record = csv::StringRecord::new();
    for expected in 0..episodes {
        if !reader.read_record(&mut record).map_err(row_error)? {
            return Err(content(format!("it ends after {expected}")));
        }
        let row: EpisodeRow = record.deserialize(Some(&headers)).map_err(row_error)?;
        if row.episode != expected {
            return Err(content(format!(
                "its row {expected} is episode {}",
                row.episode
            )));
        }
        each(&row);
    }
    Ok(reader.position().byte())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use proptest::prelude::*;

    use super::*;
    use crate::episode::samples;

    fn resume(path: &Path, episodes: u64) -> Result<EpisodesCsv, EpisodesError> {
        EpisodesCsv::resume(path, episodes, &disk(), |_| {})
    }

    fn disk() -> Disk {
        Disk::new(std::sync::Arc::default())
    }

    fn row(number: u64) -> EpisodeRow {
        EpisodeRow::from(&samples::episode(number, 3, Outcome::ReachedEnd))
    }

    fn write(csv: &mut EpisodesCsv, episodes: std::ops::Range<u64>) {
        episodes.for_each(|episode| csv.write(&row(episode)).unwrap());
        csv.flush().unwrap();
    }

    #[test]
    fn columns_are_those_documented() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 0..1);
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n\
             0,0,0,0,1,3,0,0.03,reached_end\n"
        );
    }

    proptest! {
        #[test]
        fn returns_read_back_as_the_same_number(bits in any::<u32>()) {
            let value = f32::from_bits(bits);
            prop_assume!(value.is_finite());
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("episodes.csv");
            let mut csv = EpisodesCsv::create(&path, &disk()).unwrap();
            csv.write(&EpisodeRow { total_reward: value, ..row(0) }).unwrap();
            csv.flush().unwrap();
            let mut reader = csv::Reader::from_path(&path).unwrap();
            let read: EpisodeRow = reader.deserialize().next().unwrap().unwrap();
            prop_assert_eq!(read.total_reward.to_bits(), bits);
        }
    }

    #[test]
    fn a_file_that_lost_the_end_of_its_last_line_is_continued_on_the_next() {
        let directory = tempfile::tempdir().unwrap();
        let (whole, cut) = (
            directory.path().join("whole.csv"),
            directory.path().join("cut.csv"),
        );
        write(&mut EpisodesCsv::create(&whole, &disk()).unwrap(), 0..5);
        write(&mut EpisodesCsv::create(&cut, &disk()).unwrap(), 0..4);
        let text = fs::read_to_string(&cut).unwrap();
        fs::write(&cut, text.trim_end()).unwrap();
        write(&mut resume(&cut, 4).unwrap(), 4..5);
        assert_eq!(fs::read(&whole).unwrap(), fs::read(&cut).unwrap());
    }

    #[test]
    fn a_file_of_other_columns_is_not_continued() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 0..4);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, text.replacen("episode,epoch", "epoch,episode", 1)).unwrap();
        let error = resume(&path, 2).unwrap_err().to_string();
        assert!(
            error.contains("episodes.csv") && error.contains("its columns are"),
            "{error}"
        );
    }

    #[test]
    fn a_resumed_file_is_that_of_a_run_never_interrupted() {
        let directory = tempfile::tempdir().unwrap();
        let (whole, resumed) = (
            directory.path().join("whole.csv"),
            directory.path().join("resumed.csv"),
        );
        write(&mut EpisodesCsv::create(&whole, &disk()).unwrap(), 0..30);
        for checkpoint in [0, 1, 20] {
            write(&mut EpisodesCsv::create(&resumed, &disk()).unwrap(), 0..25);
            write(&mut resume(&resumed, checkpoint).unwrap(), checkpoint..30);
            assert_eq!(
                fs::read(&whole).unwrap(),
                fs::read(&resumed).unwrap(),
                "resumed after {checkpoint}"
            );
        }
    }

    #[test]
    fn a_row_cut_short_after_the_checkpoint_does_not_matter() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 0..5);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, &text[..text.len() - 7]).unwrap();
        write(&mut resume(&path, 4).unwrap(), 4..5);
        assert_eq!(fs::read_to_string(&path).unwrap(), text);
    }

    #[test]
    fn a_row_with_a_quote_that_would_swallow_the_next_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 0..2);
        let text = fs::read_to_string(&path).unwrap();
        let (whole, last) = text.trim_end().rsplit_once(',').unwrap();
        fs::write(&path, format!("{whole},\"{last}\n")).unwrap();
        let refusal = resume(&path, 2).unwrap_err().to_string();
        assert!(refusal.contains("episodes.csv"), "{refusal}");
    }

    #[test]
    fn a_file_that_is_not_what_was_written_before_the_checkpoint_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        let mut csv = EpisodesCsv::create(&path, &disk()).unwrap();
        write(&mut csv, 0..3);
        drop(csv);
        // Extent over two incarnations.
        let mut csv = resume(&path, 2).unwrap();
        write(&mut csv, 2..5);
        let extent = csv.extent();
        write(&mut csv, 5..7);
        let sound = fs::read(&path).unwrap();
        extent.check(&path, 5).unwrap();
        let refused = |problem: &str| {
            let error = extent.check(&path, 5).unwrap_err().to_string();
            assert!(
                error.contains(path.to_str().unwrap()) && error.contains(problem),
                "{error}"
            );
        };
        for index in 0..extent.bytes as usize {
            let mut damaged = sound.clone();
            damaged[index] ^= 1 << (index % 8);
            fs::write(&path, damaged).unwrap();
            refused("was changed within");
            fs::write(&path, &sound[..index]).unwrap();
            refused(&format!("ends after {index} bytes"));
        }
        fs::write(&path, &sound[..extent.bytes as usize]).unwrap();
        extent.check(&path, 5).unwrap();
        fs::remove_file(&path).unwrap();
        refused("is missing");
    }

    #[test]
    fn a_file_of_other_episodes_is_not_continued() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("episodes.csv");
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 0..5);
        let error = resume(&path, 6).unwrap_err().to_string();
        assert!(
            error.contains("episodes.csv") && error.contains("ends after 5"),
            "{error}"
        );
        write(&mut EpisodesCsv::create(&path, &disk()).unwrap(), 3..9);
        let error = resume(&path, 2).unwrap_err().to_string();
        assert!(error.contains("row 0 is episode 3"), "{error}");
    }
}
