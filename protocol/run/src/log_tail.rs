//! The last lines of a log file, for error messages.

use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use skein_protocol::files;

/// Number of lines quoted.
const LINES: usize = 12;
/// Bytes read from the end of a log.
const MAX_BYTES: u64 = 16 * 1024;

/// Returns the last lines of the log at `path`, indented, or a remark if there are none.
pub fn log_tail(path: &Path) -> String {
    let text = read_end(path).unwrap_or_default();
    let lines: Vec<_> = text
        .lines()
        .filter(|line| !line.trim().is_empty())
        .collect();
    if lines.is_empty() {
        return "    (the log is empty)".to_owned();
    }
    let first = lines.len().saturating_sub(LINES);
    lines[first..]
        .iter()
        .map(|line| format!("    {line}"))
        .collect::<Vec<_>>()
        .join("\n")
}

/// Returns the last error message of `program` without its name: Skein's programs write `name:
/// reason` on standard error, which goes to their log. Returns `None` if the log holds no such
/// message.
pub fn last_words(path: &Path, program: &Path) -> Option<String> {
    let start = format!("{}: ", program.file_name()?.to_str()?);
    let text = read_end(path).ok()?;
    let lines: Vec<_> = text.lines().collect();
    let first = lines.iter().rposition(|line| line.starts_with(&start))?;
    lines[first..]
        .join("\n")
        .strip_prefix(&start)
        .map(str::to_owned)
}

fn read_end(path: &Path) -> std::io::Result<String> {
    let mut file = files::open(path, u64::MAX)?.into_inner();
    let length = file.metadata()?.len();
    file.seek(SeekFrom::Start(length.saturating_sub(MAX_BYTES)))?;
    let mut bytes = Vec::new();
    file.take(MAX_BYTES).read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_last_lines_are_shown() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("learner.log");
        let text: String = (0..5000).map(|line| format!("line {line}\n")).collect();
        std::fs::write(&path, text).unwrap();
        let tail = log_tail(&path);
        assert_eq!(tail.lines().count(), LINES);
        assert!(tail.ends_with("    line 4999"), "{tail}");
    }

    #[test]
    fn the_last_error_message_is_the_programs_own_and_its_newest() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("learner.log");
        let program = Path::new("/bin/skein-learner");
        std::fs::write(
            &path,
            "INFO starts\nskein-learner: old\nERROR x\nskein-learner: no device\nuse cpu\n",
        )
        .unwrap();
        assert_eq!(last_words(&path, program).unwrap(), "no device\nuse cpu");
        assert_eq!(last_words(&path, Path::new("/bin/skein-actor")), None);
    }

    #[test]
    fn a_missing_log_is_reported_as_empty() {
        let folder = tempfile::tempdir().unwrap();
        assert!(log_tail(&folder.path().join("learner.log")).contains("empty"));
    }
}
