//! Tables of a run, one row a line, of which the last row may be half written.

use std::path::{Path, PathBuf};

use skein_protocol::files::{self, TABLE_BYTES};

use super::ReportError;

/// Last row of a table that was cut off, by a full disk or because it is still being written.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{}: its last row is cut off and was left out", path.display())]
pub struct TornRow {
    /// The table.
    pub path: PathBuf,
}

/// Reads the complete rows of the table at `path`; says so if there is more.
///
/// # Errors
/// [`ReportError::Read`] names the file.
pub(crate) fn complete_rows(path: &Path) -> Result<(Vec<u8>, Option<TornRow>), ReportError> {
    let mut rows = files::read(path, TABLE_BYTES).map_err(|source| ReportError::Read {
        path: path.to_owned(),
        source,
    })?;
    let end = rows.iter().rposition(|&byte| byte == b'\n');
    let complete = end.map_or(0, |end| end + 1);
    let torn = (complete < rows.len()).then(|| TornRow {
        path: path.to_owned(),
    });
    rows.truncate(complete);
    Ok((rows, torn))
}
