//! `episodes.csv` of a run, read as it grows.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use skein_protocol::files;

/// Most bytes read at once, so that a long table needs no second copy in memory.
const AT_ONCE: usize = 1 << 20;
/// Bytes before the end of what was read that must not have changed: a resumed run cuts the table
/// back and writes it again.
const OVERLAP: usize = 64;

/// An episode, as far as curves need it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Episode {
    pub(crate) steps: u32,
    pub(crate) episode_return: f32,
    pub(crate) actor: u16,
    pub(crate) walls_passed: u8,
    /// Epochs that its policy was behind.
    pub(crate) lag: u32,
}

/// The complete rows read so far.
#[derive(Debug, Default)]
pub(crate) struct Episodes {
    rows: Vec<Episode>,
    /// Bytes of these rows, the header included.
    bytes: u64,
    inode: u64,
    /// The last of these bytes.
    tail: Vec<u8>,
    /// Rows that could not be read.
    pub(crate) damaged: u64,
}

impl Episodes {
    pub(crate) fn rows(&self) -> &[Episode] {
        &self.rows
    }

    /// Reads the rows that were added; all of them if the table was cut back or replaced.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub(crate) fn update(&mut self, path: &Path) -> io::Result<()> {
        // A pipe would be waited for.
        let mut file = files::open(path, u64::MAX)?.into_inner();
        let metadata = file.metadata()?;
        if metadata.ino() != self.inode || !self.continues(&mut file, metadata.len())? {
            *self = Self {
                inode: metadata.ino(),
                ..Self::default()
            };
        }
        file.seek(SeekFrom::Start(self.bytes))?;
        let mut text = Vec::new();
        let mut buffer = vec![0; AT_ONCE];
        loop {
            let count = file.read(&mut buffer)?;
            if count == 0 {
                return Ok(());
            }
            text.extend_from_slice(&buffer[..count]);
            let complete = text.iter().rposition(|&byte| byte == b'\n');
            let complete = complete.map_or(0, |end| end + 1);
            self.take(&text[..complete]);
            text.drain(..complete);
            // A row has a hundred bytes at most; what is longer is no table.
            if text.len() > AT_ONCE {
                return Err(io::Error::other("a row is longer than 1 MiB"));
            }
        }
    }

    /// Returns `true` if the file still begins with what was read.
    fn continues(&self, file: &mut File, length: u64) -> io::Result<bool> {
        if length < self.bytes {
            return Ok(false);
        }
        let mut tail = vec![0; self.tail.len()];
        file.seek(SeekFrom::Start(self.bytes - self.tail.len() as u64))?;
        file.read_exact(&mut tail)?;
        Ok(tail == self.tail)
    }

    fn take(&mut self, text: &[u8]) {
        for line in text.split(|&byte| byte == b'\n') {
            if line.is_empty() || line.starts_with(b"episode,") {
                continue;
            }
            match row(line) {
                Some(row) => self.rows.push(row),
                None => self.damaged += 1,
            }
        }
        self.bytes += text.len() as u64;
        self.tail
            .extend_from_slice(&text[text.len().saturating_sub(OVERLAP)..]);
        let excess = self.tail.len().saturating_sub(OVERLAP);
        self.tail.drain(..excess);
    }
}

/// Reads episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome.
fn row(line: &[u8]) -> Option<Episode> {
    let mut cells = std::str::from_utf8(line).ok()?.split(',').skip(1);
    let epoch: u32 = cells.next()?.parse().ok()?;
    let version = cells.next()?.parse().ok()?;
    let actor = cells.next()?.parse().ok()?;
    let steps = cells.nth(1)?.parse().ok()?;
    let walls_passed = cells.next()?.parse().ok()?;
    let episode_return: f32 = cells.next()?.parse().ok()?;
    episode_return.is_finite().then_some(Episode {
        steps,
        episode_return,
        actor,
        walls_passed,
        lag: epoch.saturating_sub(version),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const HEADER: &str =
        "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n";

    #[test]
    fn a_table_is_read_as_it_grows_and_again_when_it_was_cut_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("episodes.csv");
        let row = |number: usize, steps: u32| format!("{number},0,0,1,1,{steps},2,0.5,collided\n");
        let mut episodes = Episodes::default();
        let mut steps = |text: &str| -> Vec<u32> {
            fs::write(&path, text).unwrap();
            episodes.update(&path).unwrap();
            episodes.rows().iter().map(|row| row.steps).collect()
        };
        let two = format!("{HEADER}{}{}", row(0, 7), row(1, 8));
        assert_eq!(
            steps(&two[..two.len() - 4]),
            [7],
            "the second is half written"
        );
        assert_eq!(steps(&two), [7, 8]);
        assert_eq!(steps(&format!("{HEADER}{}", row(0, 7))), [7], "cut back");
        let other = format!("{HEADER}{}{}", row(0, 9), row(1, 8));
        assert_eq!(steps(&other), [9, 8], "written again");
        let damaged = format!("{other}\u{0}\n1,2\n{}", row(2, 3));
        assert_eq!(steps(&damaged), [9, 8, 3]);
        assert_eq!(episodes.damaged, 2);
    }

    #[test]
    fn a_pipe_in_the_tables_place_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("episodes.csv");
        let made = std::process::Command::new("mkfifo").arg(&path).status();
        assert!(made.unwrap().success());
        let error = Episodes::default().update(&path).unwrap_err().to_string();
        assert!(error.contains("not a regular file"), "{error}");
    }
}
