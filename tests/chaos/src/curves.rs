//! Reads every point of every TensorBoard curve of a run, across all its event files.
//!
//! Field numbers are those that the learner writes; every length and checksum is checked.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use prost::Message;
use skein_run::split_event_record;

/// Values of each curve at each step, in the order of the files. A sound run has one value per
/// step.
pub type Curves = BTreeMap<String, BTreeMap<i64, Vec<f32>>>;

/// Reason why curves cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum CurvesError {
    /// The file system reported an error.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: io::Error,
    },
    /// An event is truncated, damaged, or not an event.
    #[error("{} is damaged after {offset} bytes: {problem}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Byte offset of the event.
        offset: usize,
        /// Problem of the event.
        problem: String,
    },
}

/// Returns all points in the event files of `folder`.
///
/// # Errors
/// [`CurvesError`] names the file.
pub fn read_curves(folder: &Path) -> Result<Curves, CurvesError> {
    let at = |path: &Path| {
        let path = path.to_owned();
        move |source| CurvesError::Io { path, source }
    };
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(at(folder))? {
        let path = entry.map_err(at(folder))?.path();
        // The curves over environment steps lie in a folder of their own.
        if !path.is_dir() {
            files.push(path);
        }
    }
    // TensorBoard reads files in this order.
    files.sort();
    let mut curves = Curves::new();
    for path in files {
        let bytes = fs::read(&path).map_err(at(&path))?;
        read_file(&bytes, &mut curves).map_err(|(offset, problem)| CurvesError::Damaged {
            path: path.clone(),
            offset,
            problem,
        })?;
    }
    Ok(curves)
}

fn read_file(bytes: &[u8], curves: &mut Curves) -> Result<(), (usize, String)> {
    let mut rest = bytes;
    while !rest.is_empty() {
        let offset = bytes.len() - rest.len();
        let event = take_event(&mut rest).map_err(|problem| (offset, problem))?;
        for value in event
            .summary
            .map(|summary| summary.value)
            .unwrap_or_default()
        {
            let points = curves.entry(value.tag).or_default();
            points
                .entry(event.step)
                .or_default()
                .push(value.simple_value.unwrap_or(f32::NAN));
        }
    }
    Ok(())
}

fn take_event(rest: &mut &[u8]) -> Result<CurveEvent, String> {
    let (message, after) = split_event_record(rest).map_err(|error| error.to_string())?;
    *rest = after;
    CurveEvent::decode(message).map_err(|error| error.to_string())
}

#[derive(Clone, PartialEq, Message)]
struct CurveEvent {
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(message, optional, tag = "5")]
    summary: Option<CurveSummary>,
}

#[derive(Clone, PartialEq, Message)]
struct CurveSummary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<CurveValue>,
}

#[derive(Clone, PartialEq, Message)]
struct CurveValue {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[cfg(test)]
pub(super) mod samples {
    use skein_run::write_event_record;

    use super::*;

    /// Returns an event file with one point per element of `points`: tag, step, value.
    pub(crate) fn file(points: &[(&str, i64, f32)]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for &(tag, step, value) in points {
            let value = CurveValue {
                tag: tag.to_owned(),
                simple_value: Some(value),
            };
            let summary = Some(CurveSummary { value: vec![value] });
            let message = CurveEvent { step, summary }.encode_to_vec();
            write_event_record(&mut bytes, &message).expect("a vector takes all bytes");
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_several_files_are_read_as_one() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(
            folder.path().join("events.1"),
            samples::file(&[("a", 1, 0.5), ("b", 1, 1.0)]),
        )
        .unwrap();
        fs::write(
            folder.path().join("events.2"),
            samples::file(&[("a", 2, -1.0), ("a", 1, 7.0)]),
        )
        .unwrap();
        let curves = read_curves(folder.path()).unwrap();
        assert_eq!(
            curves["a"],
            BTreeMap::from([(1, vec![0.5, 7.0]), (2, vec![-1.0])])
        );
        assert_eq!(curves["b"], BTreeMap::from([(1, vec![1.0])]));
    }

    #[test]
    fn a_truncated_or_damaged_event_is_named() {
        let sound = samples::file(&[("a", 1, 0.5), ("a", 2, 1.0)]);
        let second = sound.len() / 2;
        for length in second + 1..sound.len() {
            let error = read_file(&sound[..length], &mut Curves::new()).unwrap_err();
            assert_eq!(error.0, second, "{error:?}");
        }
        for index in second..sound.len() {
            let mut damaged = sound.clone();
            damaged[index] ^= 1;
            let error = read_file(&damaged, &mut Curves::new()).unwrap_err();
            assert_eq!(error.0, second, "{error:?}");
        }
    }
}
