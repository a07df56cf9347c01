//! The runs in a folder. Nothing outside the folder is ever read, wherever links lead.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::Context;
use serde::Serialize;
use skein_protocol::files::{self, REPORT_BYTES};
use skein_run::RunDirectory;

/// Deepest folder below the watched one that may be a run: `experiments/NAME/ARM/seed-N`.
const DEEPEST: usize = 4;
/// Most runs that are shown: more than a page can compare.
const MOST_RUNS: usize = 500;
/// Time after which a run that has written nothing no longer counts as under way.
const QUIET: Duration = Duration::from_secs(30);

/// A folder with runs.
#[derive(Debug, Clone)]
pub(crate) struct Catalogue {
    /// Without links.
    root: PathBuf,
}

/// A run in the list.
#[derive(Debug, Serialize)]
pub(crate) struct ListedRun {
    /// Path below the folder; it names the run in requests.
    pub(crate) id: String,
    state: State,
    /// Seconds since 1970 of the last change.
    changed_secs: u64,
    /// Bytes of `episodes.csv`: changes with every episode.
    pub(crate) episodes_bytes: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum State {
    Running,
    Complete,
    Stopped,
}

impl Catalogue {
    /// Opens the folder.
    ///
    /// # Errors
    /// If it does not exist.
    pub(crate) fn open(folder: &Path) -> anyhow::Result<Self> {
        let root = fs::canonicalize(folder).with_context(|| {
            format!(
                "cannot watch {}: name the folder that holds the runs",
                folder.display()
            )
        })?;
        if !root.is_dir() {
            anyhow::bail!("cannot watch {}: it is not a folder", folder.display());
        }
        Ok(Self { root })
    }

    /// Returns the runs, the last changed first. One that disappears meanwhile is left out.
    pub(crate) fn runs(&self) -> Vec<ListedRun> {
        let mut found = Vec::new();
        self.collect(&self.root, 0, &mut found);
        let mut runs: Vec<_> = found.iter().filter_map(|path| self.list(path)).collect();
        runs.sort_by(|one, other| {
            let newest = other.changed_secs.cmp(&one.changed_secs);
            newest.then_with(|| one.id.cmp(&other.id))
        });
        runs
    }

    /// Returns the run that `id` names, if it lies in the folder.
    pub(crate) fn find(&self, id: &str) -> Option<RunDirectory> {
        let path = Path::new(id);
        let plain = |part: Component<'_>| matches!(part, Component::Normal(_) | Component::CurDir);
        if !path.components().all(plain) {
            return None;
        }
        let path = self.inside(&self.root.join(path)).ok()?;
        is_run(&path).then(|| RunDirectory::new(path))
    }

    /// Returns `path` without links, if it lies in the folder.
    ///
    /// # Errors
    /// If it does not, or does not exist.
    pub(crate) fn inside(&self, path: &Path) -> io::Result<PathBuf> {
        let real = fs::canonicalize(path)?;
        match real.starts_with(&self.root) {
            true => Ok(real),
            false => Err(io::Error::other("it leads out of the watched folder")),
        }
    }

    /// Returns the text of a file of a run.
    ///
    /// # Errors
    /// Names the file.
    pub(crate) fn read_text(&self, path: &Path) -> anyhow::Result<String> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        self.inside(path)
            .and_then(|path| files::read_text(&path, REPORT_BYTES))
            .with_context(|| format!("cannot read {name}"))
    }

    fn collect(&self, folder: &Path, depth: usize, found: &mut Vec<PathBuf>) {
        if is_run(folder) {
            found.push(folder.to_owned());
            return;
        }
        if depth == DEEPEST {
            return;
        }
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        let mut folders: Vec<_> = entries
            // A link could lead in circles: what it leads to is listed where it lies.
            .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
            .map(|entry| entry.path())
            .collect();
        folders.sort();
        for folder in folders {
            if found.len() == MOST_RUNS {
                return;
            }
            self.collect(&folder, depth + 1, found);
        }
    }

    /// Returns `true` if a run has ended by itself. One that is lengthened has an older summary.
    fn is_complete(&self, run: &RunDirectory) -> bool {
        let changed = |path: PathBuf| fs::metadata(path).and_then(|file| file.modified()).ok();
        let text = self.read_text(&run.summary_json()).unwrap_or_default();
        let summary = serde_json::from_str::<serde_json::Value>(&text).unwrap_or_default();
        summary["ending"] == "completed"
            && changed(run.summary_json()) >= changed(run.episodes_csv())
    }

    fn list(&self, path: &Path) -> Option<ListedRun> {
        let run = RunDirectory::new(path);
        let metadata = |path: PathBuf| fs::metadata(path).ok();
        let changed = |path: PathBuf| metadata(path)?.modified().ok();
        let last = [
            run.episodes_csv(),
            run.learner_log(),
            run.summary_json(),
            run.config(),
        ];
        let last = last.into_iter().filter_map(changed).max()?;
        let id = path.strip_prefix(&self.root).ok()?.to_str()?.to_owned();
        let age = SystemTime::now().duration_since(last).unwrap_or_default();
        let state = if self.is_complete(&run) {
            State::Complete
        } else if age < QUIET || is_locked(&run.learner_lock()) {
            State::Running
        } else {
            State::Stopped
        };
        let since_1970 = last.duration_since(SystemTime::UNIX_EPOCH);
        Some(ListedRun {
            // The folder itself may be a run.
            id: if id.is_empty() { ".".to_owned() } else { id },
            state,
            changed_secs: since_1970.map_or(0, |time| time.as_secs()),
            episodes_bytes: metadata(run.episodes_csv()).map_or(0, |file| file.len()),
        })
    }
}

/// Returns `true` if a process on this machine holds the lock of `file`: a learner in its final
/// evaluation may write nothing for long. The kernel's table tells it without a try, which a
/// learner that starts could notice.
fn is_locked(file: &Path) -> bool {
    let Ok(there) = fs::metadata(file) else {
        return false;
    };
    let named = format!(":{}", there.ino());
    let holds = |line: &str| line.split(' ').any(|field| field.ends_with(&named));
    fs::read_to_string("/proc/locks").is_ok_and(|table| table.lines().any(holds))
}

fn is_run(path: &Path) -> bool {
    path.join("config.toml").is_file()
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::os::unix::fs::symlink;

    use super::*;

    fn run(folder: &Path, id: &str) {
        fs::create_dir_all(folder.join(id)).unwrap();
        fs::write(folder.join(id).join("config.toml"), "[run]\n").unwrap();
    }

    #[test]
    fn a_run_is_complete_once_its_summary_says_so() {
        let folder = tempfile::tempdir().unwrap();
        run(folder.path(), "one");
        let summary = folder.path().join("one/summary.json");
        let state = |text: &str| {
            fs::write(&summary, text).unwrap();
            Catalogue::open(folder.path()).unwrap().runs()[0].state
        };
        assert_eq!(state("{\"ending\":\"completed\"}"), State::Complete);
        assert_eq!(
            state("{\"ending\":\"interrupted\"}"),
            State::Running,
            "just written"
        );
        assert_eq!(state("{"), State::Running);
    }

    #[test]
    fn a_quiet_run_whose_learner_lives_is_under_way() {
        let folder = tempfile::tempdir().unwrap();
        run(folder.path(), "one");
        let long_ago = SystemTime::now() - 100 * QUIET;
        let config = File::options()
            .write(true)
            .open(folder.path().join("one/config.toml"));
        config.unwrap().set_modified(long_ago).unwrap();
        let lock = File::create(folder.path().join("one/learner.lock")).unwrap();
        let state = || Catalogue::open(folder.path()).unwrap().runs()[0].state;
        assert_eq!(state(), State::Stopped);
        lock.lock().unwrap();
        assert_eq!(state(), State::Running);
        drop(lock);
        assert_eq!(state(), State::Stopped);
    }

    #[test]
    fn runs_are_found_at_any_depth_and_nothing_outside_is_one() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("runs");
        run(&root, "one");
        run(&root, "experiments/e/arm/seed-1");
        run(folder.path(), "secret");
        symlink(folder.path().join("secret"), root.join("link")).unwrap();
        let catalogue = Catalogue::open(&root).unwrap();
        let mut ids: Vec<_> = catalogue.runs().into_iter().map(|run| run.id).collect();
        ids.sort();
        assert_eq!(ids, ["experiments/e/arm/seed-1", "one"]);
        assert!(catalogue.find("one").is_some());
        for outside in [
            "../secret",
            "link",
            "one/../../secret",
            "/etc",
            "",
            "none",
            "one\0",
        ] {
            assert!(catalogue.find(outside).is_none(), "{outside:?}");
        }
        let leads_out = root.join("one/summary.json");
        symlink("/etc/passwd", &leads_out).unwrap();
        assert!(catalogue.read_text(&leads_out).is_err());
        fs::remove_dir_all(root.join("one")).unwrap();
        assert_eq!(catalogue.runs().len(), 1);
    }
}
