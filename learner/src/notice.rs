//! Notices to the user while the learner runs.

use std::io::Write;

/// Shows `line` to the user. The program that reads the progress lines shows every line that is not
/// JSON as it is.
pub(crate) fn notify_user(line: &str) {
    tracing::warn!("{line}");
    // Standard output may be closed; the line is in the log.
    let _ = writeln!(std::io::stdout().lock(), "{line}");
}
