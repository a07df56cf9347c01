//! `incarnations.csv`: when the learner of a run was started, and from which episode it resumed.

use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use skein_protocol::files::{self, REPORT_BYTES};
use skein_run::durable;

const HEADER: &str = "incarnation,unix_secs,episodes\n";

/// Appends the row of a new incarnation that starts after `episodes` episodes; returns the number
/// of earlier incarnations. A file that is not text is started again: nothing learned depends on
/// it.
///
/// # Errors
/// Errors of the file system.
pub(crate) fn begin_incarnation(path: &Path, episodes: u64) -> io::Result<u64> {
    let mut text = match files::read_text(path, REPORT_BYTES) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => HEADER.to_owned(),
        Err(error) if error.kind() == io::ErrorKind::InvalidData => {
            tracing::warn!(
                path = %path.display(),
                "damaged: started again, earlier incarnations are no longer counted"
            );
            HEADER.to_owned()
        }
        text => text?,
    };
    if text.is_empty() {
        text.push_str(HEADER);
    } else if !text.ends_with('\n') {
        text.push('\n');
    }
    let earlier = text.lines().skip(1).count() as u64;
    let now = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |elapsed| elapsed.as_secs());
    text.push_str(&format!("{earlier},{now},{episodes}\n"));
    durable::replace(path, text.as_bytes())?;
    Ok(earlier)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn each_incarnation_has_a_row() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("incarnations.csv");
        assert_eq!(begin_incarnation(&path, 0).unwrap(), 0);
        assert_eq!(begin_incarnation(&path, 0).unwrap(), 1);
        assert_eq!(begin_incarnation(&path, 500).unwrap(), 2);
        let text = fs::read_to_string(path).unwrap();
        let rows: Vec<_> = text.lines().collect();
        assert_eq!(rows.len(), 4);
        assert!(
            rows[3].starts_with("2,") && rows[3].ends_with(",500"),
            "{text}"
        );
    }

    #[test]
    fn a_damaged_file_is_started_again() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("incarnations.csv");
        begin_incarnation(&path, 0).unwrap();
        let mut bytes = fs::read(&path).unwrap();
        // Cut off the end of the last line.
        bytes.pop();
        fs::write(&path, &bytes).unwrap();
        assert_eq!(begin_incarnation(&path, 500).unwrap(), 1);
        assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), 3);
        bytes.push(0xff);
        fs::write(&path, bytes).unwrap();
        assert_eq!(begin_incarnation(&path, 500).unwrap(), 0);
        assert_eq!(begin_incarnation(&path, 500).unwrap(), 1);
    }
}
