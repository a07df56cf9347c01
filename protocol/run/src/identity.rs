//! Who a run is, and which incarnation of its learner is the present one.
//!
//! Each start of the learner, the first or one after a death, is an incarnation with a transport of
//! its own: fresh services in a folder and under a prefix that no incarnation before it had. So
//! nothing that a killed process left half done is ever met again. The learner announces its
//! incarnation by a small file once its services are open; actors look there, and again whenever
//! they have lost it.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::place::{PlaceError, is_locked};
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::Config;
use skein_protocol::ids::RunId;
use skein_protocol::record_layout;
use skein_protocol::snapshot::SnapshotLayout;

/// Who a run is: what its processes need to find each other, and nobody else.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunIdentity {
    /// [`PROTOCOL_VERSION`] of the program that started it.
    pub protocol_version: u32,
    /// The run.
    pub run: RunId,
    /// [`Config::digest`].
    pub config_digest: u64,
    /// Checksum (xxh3, hexadecimal) of each file in [`courses`](super::RunDirectory::courses) as
    /// the run was started with it, by its name.
    pub courses: BTreeMap<String, String>,
}

/// One start of a learner: its number among those of its run since the first of the processes that
/// live now was started. A small number, because it stands twice in the path of a listener's
/// socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct LearnerIncarnation(u32);

impl fmt::Display for LearnerIncarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl LearnerIncarnation {
    /// The incarnation after `previous`.
    pub(super) fn after(previous: Option<Self>) -> Self {
        Self(previous.map_or(1, |incarnation| incarnation.0.saturating_add(1)))
    }

    /// From the name of its folder; `None` for what is none.
    pub(super) fn parse(name: &str) -> Option<Self> {
        /// No run dies as often; and a listener's socket has room for so many digits.
        const MOST: u32 = 9_999_999;
        let incarnation = name
            .parse()
            .ok()
            .filter(|&incarnation| incarnation < MOST)
            .map(Self)?;
        (incarnation.to_string() == name).then_some(incarnation)
    }
}

impl RunIdentity {
    pub(super) fn new(config: &Config, courses: BTreeMap<String, String>) -> Self {
        let nanos = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |elapsed| elapsed.as_nanos() as u64);
        Self {
            protocol_version: PROTOCOL_VERSION,
            run: RunId(nanos ^ u64::from(std::process::id()).rotate_left(48)),
            config_digest: config.digest(),
            courses,
        }
    }

    /// Where the run's transport lies; the folder is there while a process of the run incarnations.
    /// Short, because a listener's socket below it may have no more than 108 characters.
    pub fn transport_folder(&self) -> PathBuf {
        super::sweep::MACHINE.transport_folder(self.run)
    }

    /// First characters of every shared-memory segment of this run.
    pub fn shared_memory_prefix(&self) -> String {
        super::sweep::shared_memory_prefix(self.run)
    }

    /// Where iceoryx2 keeps the services of an incarnation.
    pub fn incarnation_folder(&self, incarnation: LearnerIncarnation) -> PathBuf {
        self.transport_folder().join(incarnation.to_string())
    }

    /// First characters of every shared-memory segment of an incarnation.
    pub fn incarnation_prefix(&self, incarnation: LearnerIncarnation) -> String {
        format!("{}{incarnation}_", self.shared_memory_prefix())
    }

    /// Takes everybody else's rights to the segments of `incarnation` away: iceoryx2 gives one of
    /// them, a counter, to all users of the machine.
    ///
    /// # Errors
    /// When the segments cannot be looked at or changed.
    pub fn close_to_others(&self, incarnation: LearnerIncarnation) -> io::Result<()> {
        self.shared_memory(incarnation)
            .try_for_each(|segment| fs::set_permissions(segment, fs::Permissions::from_mode(0o600)))
    }

    /// The shared-memory segments of `incarnation`.
    pub fn shared_memory(&self, incarnation: LearnerIncarnation) -> impl Iterator<Item = PathBuf> {
        super::sweep::MACHINE.segments(&self.incarnation_prefix(incarnation))
    }

    pub(super) fn announcement_file(&self) -> PathBuf {
        self.transport_folder().join("incarnation")
    }

    pub(super) fn learner_lock(&self) -> PathBuf {
        super::sweep::learner_lock(&self.transport_folder())
    }

    pub(super) fn supervisor_lock(&self) -> PathBuf {
        super::sweep::supervisor_lock(&self.transport_folder())
    }

    /// What the living learner of this run has announced; `None` when there is none, or it has not
    /// opened its services yet. Looking leaves no trace.
    ///
    /// # Errors
    /// [`PlaceError`] when the run belongs to another user, or its folder cannot be read.
    pub fn present_incarnation(&self) -> Result<Option<Announcement>, PlaceError> {
        if !is_locked(&self.learner_lock())? {
            return Ok(None);
        }
        Announcement::read(&self.announcement_file())
    }

    /// Whether a learner of this run lives on this machine, its services open or not. Looking
    /// leaves no trace.
    ///
    /// # Errors
    /// [`PlaceError`] when the run belongs to another user, or its folder cannot be read.
    pub fn is_learner_alive(&self) -> Result<bool, PlaceError> {
        is_locked(&self.learner_lock())
    }
}

/// What a learner says of its present incarnation: everything in which a process that joins it must
/// not differ.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Announcement {
    /// The incarnation.
    pub incarnation: LearnerIncarnation,
    /// The learner's process.
    pub pid: u32,
    protocol_version: u32,
    run: RunId,
    config_digest: u64,
    snapshot_layout: u64,
    record_layout: String,
}

/// In what a process and the learner it would join differ.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the learner and this process differ in {what}: the learner's is {expected}, this process's {found}; start it from the same build and run directory"
)]
pub struct Difference {
    /// In what.
    pub what: &'static str,
    /// The learner's.
    pub expected: String,
    /// This process's.
    pub found: String,
}

impl Announcement {
    /// What the learner of `incarnation` says of itself.
    pub fn new(identity: &RunIdentity, incarnation: LearnerIncarnation, config: &Config) -> Self {
        Self {
            incarnation,
            pid: std::process::id(),
            protocol_version: identity.protocol_version,
            run: identity.run,
            config_digest: identity.config_digest,
            snapshot_layout: SnapshotLayout::of(config).digest(),
            record_layout: record_layout(),
        }
    }

    /// Whether a process of `identity` and `config` may join.
    ///
    /// # Errors
    /// [`Difference`] says what differs.
    pub fn check(&self, identity: &RunIdentity, config: &Config) -> Result<(), Difference> {
        let mine = Self::new(identity, self.incarnation, config);
        let digest = |digest: u64| format!("{digest:016x}");
        let same = |what, expected: String, found: String| {
            if expected == found {
                Ok(())
            } else {
                Err(Difference {
                    what,
                    expected,
                    found,
                })
            }
        };
        same(
            "protocol version",
            self.protocol_version.to_string(),
            mine.protocol_version.to_string(),
        )?;
        same("run", digest(self.run.0), digest(mine.run.0))?;
        same(
            "configuration",
            digest(self.config_digest),
            digest(mine.config_digest),
        )?;
        same(
            "snapshot layout",
            digest(self.snapshot_layout),
            digest(mine.snapshot_layout),
        )?;
        same(
            "record layout",
            self.record_layout.clone(),
            mine.record_layout,
        )
    }

    pub(super) fn read(path: &Path) -> Result<Option<Self>, PlaceError> {
        match fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map(Some)
                .map_err(|source| PlaceError::at(path)(source.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(PlaceError::at(path)(error)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_incarnation_is_known_by_the_name_of_its_folder() {
        let incarnation = LearnerIncarnation::after(Some(LearnerIncarnation(41)));
        assert_eq!(
            LearnerIncarnation::parse(&incarnation.to_string()),
            Some(incarnation)
        );
        for strange in [
            "",
            "incarnation",
            "-1",
            "+1",
            "01",
            "1f",
            "../1",
            "4294967296",
        ] {
            assert_eq!(LearnerIncarnation::parse(strange), None, "{strange}");
        }
    }

    #[test]
    fn the_transport_leaves_room_for_socket_names() {
        // folder/prefix<number of a port>.event, ended by a zero byte; the number has up to 39
        // digits.
        const ROOM: usize = 108 - 1 - "/".len() - ".event".len() - 39;
        let identity = RunIdentity::new(&Config::default(), BTreeMap::new());
        let incarnation = LearnerIncarnation(9999);
        assert!(
            identity.incarnation_folder(incarnation).as_os_str().len()
                + identity.incarnation_prefix(incarnation).len()
                <= ROOM
        );
    }

    #[test]
    fn whoever_differs_is_told_in_what() {
        let config = Config::default();
        let identity = RunIdentity::new(&config, BTreeMap::new());
        let told = Announcement::new(&identity, LearnerIncarnation::after(None), &config);
        assert_eq!(told.check(&identity, &config), Ok(()));
        let refusal = |identity: &RunIdentity, config: &Config| {
            told.check(identity, config).unwrap_err().to_string()
        };
        let other = |change: fn(&mut RunIdentity)| {
            let mut other = identity.clone();
            change(&mut other);
            refusal(&other, &config)
        };
        let version = other(|identity| identity.protocol_version = 77);
        assert!(version.contains(&format!(
            "protocol version: the learner's is {PROTOCOL_VERSION}, this process's 77"
        )));
        assert!(other(|identity| identity.run.0 ^= 1).contains("differ in run"));
        assert!(other(|identity| identity.config_digest ^= 1).contains("differ in configuration"));
        let mut wide = config.clone();
        wide.sac.hidden_width += 1;
        assert!(refusal(&identity, &wide).contains("differ in snapshot layout"));
        let longer = Announcement {
            record_layout: "transition 1".to_owned(),
            ..told
        };
        let refusal = longer.check(&identity, &config).unwrap_err().to_string();
        assert!(
            refusal.contains("record layout: the learner's is transition 1"),
            "{refusal}"
        );
    }
}
