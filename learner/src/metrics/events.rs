//! TensorBoard event files.
//!
//! An event file is a sequence of framed protocol buffer messages. The two crates that write them are built on protocol buffer libraries long
//! superseded, so the few messages we need stand here. Field numbers are those of TensorFlow's `event.proto` and `summary.proto`; the frame is
//! `length u64 | masked CRC of length u32 | message | masked CRC of message u32`, little-endian, where the CRC is CRC-32C and masking rotates
//! it and adds a constant, so that the checksum of data that itself holds checksums stays a good one (TensorFlow's `record_writer.h`).

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

/// Appends scalars to an event file of its own.
#[derive(Debug)]
pub struct EventWriter {
    path: PathBuf,
    file: BufWriter<File>,
}

/// Why events cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write TensorBoard events to {}: {source}", path.display())]
pub struct EventError {
    /// The file.
    pub path: PathBuf,
    /// Why.
    #[source]
    pub source: io::Error,
}

impl EventWriter {
    /// Starts a new event file in `directory`. TensorBoard reads all files of a directory as one; of files from before an interruption it drops
    /// what lies at `first_step` or later.
    ///
    /// # Errors
    /// [`EventError`] when the file cannot be created.
    pub fn create(directory: &Path, first_step: u64) -> Result<Self, EventError> {
        let at = |path: PathBuf| move |source| EventError { path, source };
        std::fs::create_dir_all(directory).map_err(at(directory.to_owned()))?;
        // TensorBoard takes files whose name has `tfevents` in it, in alphabetical order; a second start within one second is told apart by the number.
        let started = now_secs() as u64;
        let (path, file) = (0..1000)
            .map(|number| directory.join(format!("events.out.tfevents.{started}.skein.{number:03}")))
            .find_map(|path| match File::create_new(&path) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => None,
                result => Some((path, result)),
            })
            .unwrap_or_else(|| (directory.to_owned(), Err(io::ErrorKind::AlreadyExists.into())));
        let file = BufWriter::new(file.map_err(at(path.clone()))?);
        let mut writer = Self { path, file };
        writer.write(first_step, event::What::FileVersion("brain.Event:2".to_owned()))?;
        writer.write(
            first_step,
            event::What::SessionLog(SessionLog { status: SESSION_START }),
        )?;
        Ok(writer)
    }

    /// Appends one value for each tag at `step`.
    ///
    /// # Errors
    /// [`EventError`].
    pub fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> Result<(), EventError> {
        let value = values
            .iter()
            .map(|&(tag, value)| SummaryValue {
                tag: tag.to_owned(),
                simple_value: Some(value as f32),
            })
            .collect();
        self.write(step, event::What::Summary(Summary { value }))
    }

    /// Hands everything written to the operating system.
    ///
    /// # Errors
    /// [`EventError`].
    pub fn flush(&mut self) -> Result<(), EventError> {
        self.file.flush().map_err(|source| EventError {
            path: self.path.clone(),
            source,
        })
    }

    fn write(&mut self, step: u64, what: event::What) -> Result<(), EventError> {
        let event = Event {
            wall_time: now_secs(),
            step: step.cast_signed(),
            what: Some(what),
        };
        write_record(&mut self.file, &event.encode_to_vec()).map_err(|source| EventError {
            path: self.path.clone(),
            source,
        })
    }
}

fn now_secs() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |elapsed| elapsed.as_secs_f64())
}

fn write_record(into: &mut impl Write, message: &[u8]) -> io::Result<()> {
    let length = (message.len() as u64).to_le_bytes();
    into.write_all(&length)?;
    into.write_all(&masked_crc(&length).to_le_bytes())?;
    into.write_all(message)?;
    into.write_all(&masked_crc(message).to_le_bytes())
}

fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "event::What", tags = "3, 5, 7")]
    what: Option<event::What>,
}

mod event {
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(super) enum What {
        #[prost(string, tag = "3")]
        FileVersion(String),
        #[prost(message, tag = "5")]
        Summary(super::Summary),
        #[prost(message, tag = "7")]
        SessionLog(super::SessionLog),
    }
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<SummaryValue>,
}

#[derive(Clone, PartialEq, Message)]
struct SummaryValue {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

/// `SessionLog.SessionStatus.START`.
const SESSION_START: i32 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads records back, checking every length and checksum.
    fn read_records(mut bytes: &[u8]) -> Result<Vec<Event>, String> {
        let mut events = Vec::new();
        while !bytes.is_empty() {
            let (length, rest) = bytes.split_first_chunk::<8>().ok_or("length cut short")?;
            let (length_crc, rest) = rest.split_first_chunk::<4>().ok_or("checksum cut short")?;
            if masked_crc(length) != u32::from_le_bytes(*length_crc) {
                return Err("length damaged".to_owned());
            }
            let (message, rest) = rest
                .split_at_checked(u64::from_le_bytes(*length) as usize)
                .ok_or("message cut short")?;
            let (crc, rest) = rest.split_first_chunk::<4>().ok_or("checksum cut short")?;
            if masked_crc(message) != u32::from_le_bytes(*crc) {
                return Err("message damaged".to_owned());
            }
            events.push(Event::decode(message).map_err(|error| error.to_string())?);
            bytes = rest;
        }
        Ok(events)
    }

    fn sample_file(first_step: u64) -> Vec<u8> {
        let directory = tempfile::tempdir().unwrap();
        let mut writer = EventWriter::create(directory.path(), first_step).unwrap();
        writer
            .scalars(7, &[("flight/return", -1.5), ("flight/steps", 12.0)])
            .unwrap();
        writer.scalars(8, &[("flight/return", 0.0)]).unwrap();
        writer.flush().unwrap();
        std::fs::read(&writer.path).unwrap()
    }

    #[test]
    fn masking_agrees_with_the_published_vector() {
        // CRC-32C of 32 zero bytes is 8a9136aa (RFC 3720, B.4); rotated right by 15 bits it is 6d551522.
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(masked_crc(&[0; 32]), 0x6d55_1522_u32.wrapping_add(0xa282_ead8));
    }

    #[test]
    fn what_was_written_reads_back() {
        let events = read_records(&sample_file(5)).unwrap();
        let what: Vec<_> = events.iter().map(|event| event.what.clone().unwrap()).collect();
        let value = |tag: &str, value| SummaryValue {
            tag: tag.to_owned(),
            simple_value: Some(value),
        };
        assert_eq!(
            what,
            [
                event::What::FileVersion("brain.Event:2".to_owned()),
                event::What::SessionLog(SessionLog { status: SESSION_START }),
                event::What::Summary(Summary {
                    value: vec![value("flight/return", -1.5), value("flight/steps", 12.0)]
                }),
                event::What::Summary(Summary {
                    value: vec![value("flight/return", 0.0)]
                }),
            ]
        );
        assert_eq!(events.iter().map(|event| event.step).collect::<Vec<_>>(), [5, 5, 7, 8]);
        assert!(events.iter().all(|event| event.wall_time > 1.7e9));
    }

    #[test]
    fn a_damaged_byte_anywhere_is_noticed() {
        let sound = sample_file(0);
        for index in 0..sound.len() {
            let mut damaged = sound.clone();
            damaged[index] ^= 0x10;
            assert!(read_records(&damaged).is_err(), "byte {index}");
        }
    }

    #[test]
    fn two_writers_started_at_one_time_have_files_of_their_own() {
        let directory = tempfile::tempdir().unwrap();
        let first = EventWriter::create(directory.path(), 0).unwrap();
        let second = EventWriter::create(directory.path(), 0).unwrap();
        assert_ne!(first.path, second.path);
    }
}
