//! Curves in a run's TensorBoard files, read as they grow.
//!
//! Field numbers are those of TensorFlow's `event.proto` and `summary.proto`.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use prost::Message;
use skein_run::{EventRecordError, split_event_record};

/// Most points kept of a curve; then every second is dropped.
const MOST_POINTS: usize = 4096;
/// Most bytes read at once, so that a long file needs no second copy in memory.
const AT_ONCE: u64 = 1 << 20;
/// Longest record: many times a picture's.
const LONGEST: usize = 16 << 20;

/// A curve's point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Point {
    /// Training episodes.
    pub(crate) episode: u64,
    /// Seconds since 1970.
    pub(crate) unix_secs: f64,
    pub(crate) value: f32,
}

/// The curves read so far, by tag.
#[derive(Debug, Default)]
pub(crate) struct Events {
    curves: BTreeMap<String, Curve>,
    /// Bytes read of each file.
    read: HashMap<PathBuf, u64>,
}

#[derive(Debug)]
struct Curve {
    points: Vec<Point>,
    /// Only every so many points are kept.
    stride: u64,
    seen: u64,
}

impl Events {
    pub(crate) fn tags(&self) -> impl Iterator<Item = &str> {
        self.curves.keys().map(String::as_str)
    }

    pub(crate) fn points(&self, tag: &str) -> &[Point] {
        self.curves.get(tag).map_or(&[], |curve| &curve.points)
    }

    /// Reads what was added to the files of `folder`.
    ///
    /// # Errors
    /// If a file cannot be read. A folder that does not exist is empty.
    pub(crate) fn update(&mut self, folder: &Path) -> io::Result<()> {
        let mut files: Vec<_> = match fs::read_dir(folder) {
            Ok(entries) => entries
                .flatten()
                // Links could lead out of the watched folder, and pipes would be waited for.
                .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
                .map(|entry| entry.path())
                .collect(),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error),
        };
        files.retain(|path| path.to_string_lossy().contains("tfevents"));
        files.sort();
        let lengths: Vec<u64> = files
            .iter()
            .map(|path| fs::metadata(path).map_or(0, |file| file.len()))
            .collect();
        let cut_back = |(path, &length): (&PathBuf, &u64)| {
            self.read.get(path).is_some_and(|&read| length < read)
        };
        if files.iter().zip(&lengths).any(cut_back) {
            *self = Self::default();
        }
        for path in files {
            self.read_on(&path)?;
        }
        Ok(())
    }

    fn read_on(&mut self, path: &Path) -> io::Result<()> {
        let mut at = self.read.get(path).copied().unwrap_or(0);
        let mut file = File::open(path)?;
        if file.metadata()?.len() == at {
            return Ok(());
        }
        file.seek(SeekFrom::Start(at))?;
        let mut bytes = Vec::new();
        while (&file).take(AT_ONCE).read_to_end(&mut bytes)? > 0 {
            let mut rest = bytes.as_slice();
            let ended_by = loop {
                match split_event_record(rest) {
                    Ok((message, after)) => {
                        if let Ok(event) = Event::decode(message) {
                            self.take(event);
                        }
                        rest = after;
                    }
                    Err(error) => break error,
                }
            };
            let read = bytes.len() - rest.len();
            at += read as u64;
            bytes.drain(..read);
            // Damage ends the file. A record may still be being written.
            if ended_by != EventRecordError::Truncated || bytes.len() > LONGEST {
                break;
            }
        }
        self.read.insert(path.to_owned(), at);
        Ok(())
    }

    fn take(&mut self, event: Event) {
        let (episode, unix_secs) = (event.step.unsigned_abs(), event.wall_time);
        for Value { tag, simple_value } in event.summary.into_iter().flat_map(|all| all.value) {
            let Some(value) = simple_value.filter(|value| value.is_finite()) else {
                continue;
            };
            // Each episode's own values stand in episodes.csv.
            if tag.starts_with("episode/") {
                continue;
            }
            self.curves
                .entry(tag)
                .or_insert_with(Curve::new)
                .push(Point {
                    episode,
                    unix_secs,
                    value,
                });
        }
    }
}

impl Curve {
    fn new() -> Self {
        Self {
            points: Vec::new(),
            stride: 1,
            seen: 0,
        }
    }

    fn push(&mut self, point: Point) {
        // A resumed run repeats episodes after its checkpoint.
        while self
            .points
            .last()
            .is_some_and(|last| last.episode > point.episode)
        {
            self.points.pop();
        }
        if self.seen.is_multiple_of(self.stride) {
            self.points.push(point);
        }
        self.seen += 1;
        if self.points.len() == MOST_POINTS {
            let mut number = 0;
            self.points.retain(|_| {
                number += 1;
                number % 2 == 1
            });
            self.stride *= 2;
        }
    }
}

/// `tensorflow.Event`.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

/// `tensorflow.Summary.Value`.
#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[cfg(test)]
mod tests {
    use skein_run::write_event_record;

    use super::*;

    fn frame(step: i64, value: f32) -> Vec<u8> {
        let event = Event {
            wall_time: step as f64,
            step,
            summary: Some(Summary {
                value: vec![Value {
                    tag: "policy/temperature".to_owned(),
                    simple_value: Some(value),
                }],
            }),
        };
        let mut record = Vec::new();
        write_event_record(&mut record, &event.encode_to_vec()).unwrap();
        record
    }

    #[test]
    fn a_file_is_read_as_it_grows_and_damage_ends_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("events.out.tfevents.1");
        let mut events = Events::default();
        let mut values = |bytes: &[u8]| -> Vec<f32> {
            fs::write(&path, bytes).unwrap();
            events.update(folder.path()).unwrap();
            let points = events.points("policy/temperature").iter();
            points.map(|point| point.value).collect()
        };
        let two = [frame(1, 0.5), frame(2, 0.25)].concat();
        assert_eq!(values(&two[..two.len() - 3]), [0.5]);
        assert_eq!(values(&two), [0.5, 0.25]);
        assert_eq!(values(&[&two[..], &[0xff; 40]].concat()), [0.5, 0.25]);
        assert_eq!(values(&frame(1, 1.5)), [1.5], "cut back");
    }

    #[test]
    fn links_and_pipes_are_left_alone() {
        let (folder, outside) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let elsewhere = outside.path().join("events");
        fs::write(&elsewhere, frame(1, 0.5)).unwrap();
        let at = |name: &str| folder.path().join(name);
        std::os::unix::fs::symlink(elsewhere, at("link.tfevents.1")).unwrap();
        let made = std::process::Command::new("mkfifo")
            .arg(at("pipe.tfevents.2"))
            .status();
        assert!(made.unwrap().success());
        let mut events = Events::default();
        events.update(folder.path()).unwrap();
        assert!(events.points("policy/temperature").is_empty());
    }

    #[test]
    fn a_long_curve_keeps_its_whole_length_in_bounded_memory() {
        let mut curve = Curve::new();
        for episode in 0..1_000_000 {
            curve.push(Point {
                episode,
                unix_secs: 0.0,
                value: 0.0,
            });
        }
        assert!(curve.points.len() < MOST_POINTS);
        let last = curve.points.last().map_or(0, |point| point.episode);
        assert!(curve.points[0].episode == 0 && last > 999_000, "{last}");
    }
}
