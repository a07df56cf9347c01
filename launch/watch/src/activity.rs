//! Present doings of the actors of a run: the last lines of their logs.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::time::SystemTime;

use serde::Serialize;
use skein_run::RunDirectory;

use crate::catalogue::Catalogue;

/// Bytes at the end of a log that are looked at.
const TAIL: u64 = 4096;
/// Most actors that are shown: more than a run may have.
const MOST_ACTORS: usize = 256;

/// The last thing that an actor has logged.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Activity {
    line: String,
    /// Seconds since 1970.
    changed_secs: u64,
}

/// Returns the last line of each actor's log, by the actor's number.
pub(crate) fn of_actors(catalogue: &Catalogue, run: &RunDirectory) -> BTreeMap<u32, Activity> {
    let folder = catalogue.inside(&run.logs());
    let entries = folder.and_then(fs::read_dir).into_iter().flatten();
    let of_entry = |entry: fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let number = name.strip_prefix("actor-")?.strip_suffix(".log")?;
        let path = catalogue.inside(&entry.path()).ok()?;
        Some((number.parse().ok()?, last_line(&path)?))
    };
    let found = entries.flatten().filter_map(of_entry);
    found.take(MOST_ACTORS).collect()
}

fn last_line(path: &Path) -> Option<Activity> {
    let about = fs::metadata(path).ok().filter(fs::Metadata::is_file)?;
    let since_1970 = about
        .modified()
        .ok()?
        .duration_since(SystemTime::UNIX_EPOCH);
    let mut file = File::open(path).ok()?;
    file.seek(SeekFrom::Start(about.len().saturating_sub(TAIL)))
        .ok()?;
    let mut tail = Vec::new();
    file.take(TAIL).read_to_end(&mut tail).ok()?;
    let text = String::from_utf8_lossy(&tail);
    Some(Activity {
        line: text.trim_end().lines().next_back()?.to_owned(),
        changed_secs: since_1970.ok()?.as_secs(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_actor_is_doing_what_its_last_line_says() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path().join("run"));
        fs::create_dir_all(run.logs()).unwrap();
        let long = format!("{}\nlearner joined\n", "x".repeat(9000));
        fs::write(run.logs().join("actor-3.log"), long).unwrap();
        fs::write(run.logs().join("actor-4.log"), b"\xff\n").unwrap();
        fs::write(run.logs().join("actor-5.log"), "").unwrap();
        fs::write(run.logs().join("learner.log"), "no actor\n").unwrap();
        std::os::unix::fs::symlink("/etc/passwd", run.logs().join("actor-6.log")).unwrap();
        let catalogue = Catalogue::open(folder.path()).unwrap();
        let activity = of_actors(&catalogue, &run);
        assert_eq!(activity.keys().copied().collect::<Vec<_>>(), [3, 4]);
        assert_eq!(activity[&3].line, "learner joined");
    }
}
