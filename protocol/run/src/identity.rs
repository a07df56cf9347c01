//! The identity of a run, and the announcement of its learner's current incarnation.
//!
//! Each start of the learner is a new incarnation with its own transport: new services in a new
//! folder and under a new prefix. So no process ever meets what a killed one left half done. The
//! learner announces its incarnation in a small file once its services are open. Actors read the
//! file when they start, and again whenever they have lost the learner.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::private_files::{PathError, is_locked};
use skein_protocol::PROTOCOL_VERSION;
use skein_protocol::config::Config;
use skein_protocol::files::{self, REPORT_BYTES};
use skein_protocol::ids::RunId;
use skein_protocol::record_layout;
use skein_protocol::snapshot::SnapshotLayout;

/// Identity of a run, by which its processes find each other.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunIdentity {
    /// [`PROTOCOL_VERSION`] of the program that started the run.
    pub protocol_version: u32,
    /// The run.
    pub run: RunId,
    /// [`Config::digest`].
    pub config_digest: u64,
    /// Checksum (xxh3, hexadecimal) of each file in [`courses`](super::RunDirectory::courses) at
    /// the start of the run, by file name.
    pub courses: BTreeMap<String, String>,
    /// Checksum of each file of [`parameters`](super::RunDirectory::parameters) at the start of the
    /// run, likewise.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parameters: BTreeMap<String, String>,
}

/// Number of a learner start, counted since the first of the run's living processes started. It is
/// small because the path of a listener's socket contains it twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct LearnerIncarnation(u32);

impl fmt::Display for LearnerIncarnation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

impl LearnerIncarnation {
    /// Returns the incarnation after `previous`.
    pub(super) fn after(previous: Option<Self>) -> Self {
        Self(previous.map_or(1, |incarnation| incarnation.0.saturating_add(1)))
    }

    /// Parses the name of an incarnation's folder; returns `None` for any other name.
    pub(super) fn parse(name: &str) -> Option<Self> {
        /// No run restarts as often, and a listener's socket has room for so many digits.
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
    pub(super) fn new(
        config: &Config,
        courses: BTreeMap<String, String>,
        parameters: BTreeMap<String, String>,
    ) -> Self {
        let nanos = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .map_or(0, |elapsed| elapsed.as_nanos() as u64);
        Self {
            protocol_version: PROTOCOL_VERSION,
            run: RunId(nanos ^ u64::from(std::process::id()).rotate_left(48)),
            config_digest: config.digest(),
            courses,
            parameters,
        }
    }

    /// Returns the folder of the run's transport. It exists while a process of the run is alive.
    /// The path is short, because a listener's socket below it may have at most 108 characters.
    pub fn transport_folder(&self) -> PathBuf {
        super::sweep::MACHINE.transport_folder(self.run)
    }

    /// Returns the first characters of the names of this run's shared-memory segments.
    pub fn shared_memory_prefix(&self) -> String {
        super::sweep::shared_memory_prefix(self.run)
    }

    /// Returns the folder in which iceoryx2 keeps the services of an incarnation.
    pub fn incarnation_folder(&self, incarnation: LearnerIncarnation) -> PathBuf {
        self.transport_folder().join(incarnation.to_string())
    }

    /// Returns the first characters of the names of an incarnation's shared-memory segments.
    pub fn incarnation_prefix(&self, incarnation: LearnerIncarnation) -> String {
        format!("{}{incarnation}_", self.shared_memory_prefix())
    }

    /// Restricts the segments of `incarnation` to their owner: iceoryx2 makes one of them, a
    /// counter, accessible to all users of the machine.
    ///
    /// # Errors
    /// If the segments cannot be listed or changed.
    pub fn restrict_to_owner(&self, incarnation: LearnerIncarnation) -> io::Result<()> {
        self.shared_memory(incarnation)
            .try_for_each(|segment| fs::set_permissions(segment, fs::Permissions::from_mode(0o600)))
    }

    /// Returns the shared-memory segments of `incarnation`.
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

    /// Returns the announcement of this run's living learner; `None` if there is none, or it has
    /// not opened its services yet. The call leaves no trace.
    ///
    /// # Errors
    /// [`PathError`] if the run belongs to another user, or its folder cannot be read.
    pub fn current_incarnation(&self) -> Result<Option<Announcement>, PathError> {
        if !is_locked(&self.learner_lock())? {
            return Ok(None);
        }
        Announcement::read(&self.announcement_file())
    }

    /// Returns `true` if a learner of this run is alive on this machine, its services open or not.
    /// The call leaves no trace.
    ///
    /// # Errors
    /// [`PathError`] if the run belongs to another user, or its folder cannot be read.
    pub fn is_learner_alive(&self) -> Result<bool, PathError> {
        is_locked(&self.learner_lock())
    }
}

/// Announcement of a learner's incarnation: everything in which a joining process must match it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Announcement {
    /// The incarnation.
    pub incarnation: LearnerIncarnation,
    /// Process id of the learner.
    pub pid: u32,
    protocol_version: u32,
    run: RunId,
    config_digest: u64,
    snapshot_layout: u64,
    record_layout: String,
}

/// The first difference between a process and the learner it tries to join.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the learner and this process differ in {what}: the learner's is {expected}, this process's \
    {found}; start it from the same build and run directory"
)]
pub struct JoinMismatch {
    /// Name of the differing value.
    pub what: &'static str,
    /// The learner's value.
    pub expected: String,
    /// This process's value.
    pub found: String,
}

impl Announcement {
    /// Returns the announcement of the learner of `incarnation`.
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

    /// Checks that a process of `identity` and `config` may join.
    ///
    /// # Errors
    /// [`JoinMismatch`] names the difference.
    pub fn check(&self, identity: &RunIdentity, config: &Config) -> Result<(), JoinMismatch> {
        let own = Self::new(identity, self.incarnation, config);
        let digest = |digest: u64| format!("{digest:016x}");
        let same = |what, expected: String, found: String| {
            if expected == found {
                Ok(())
            } else {
                Err(JoinMismatch {
                    what,
                    expected,
                    found,
                })
            }
        };
        same(
            "protocol version",
            self.protocol_version.to_string(),
            own.protocol_version.to_string(),
        )?;
        same("run", digest(self.run.0), digest(own.run.0))?;
        same(
            "configuration",
            digest(self.config_digest),
            digest(own.config_digest),
        )?;
        same(
            "snapshot layout",
            digest(self.snapshot_layout),
            digest(own.snapshot_layout),
        )?;
        same(
            "record layout",
            self.record_layout.clone(),
            own.record_layout,
        )
    }

    pub(super) fn read(path: &Path) -> Result<Option<Self>, PathError> {
        match files::read(path, REPORT_BYTES) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map(Some)
                .map_err(|source| PathError::at(path)(source.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(PathError::at(path)(error)),
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
        let identity = RunIdentity::new(&Config::default(), BTreeMap::new(), BTreeMap::new());
        let incarnation = LearnerIncarnation(9999);
        assert!(
            identity.incarnation_folder(incarnation).as_os_str().len()
                + identity.incarnation_prefix(incarnation).len()
                <= ROOM
        );
    }

    #[test]
    fn a_process_that_does_not_match_is_refused_with_what_differs() {
        let config = Config::default();
        let identity = RunIdentity::new(&config, BTreeMap::new(), BTreeMap::new());
        let announcement = Announcement::new(&identity, LearnerIncarnation::after(None), &config);
        assert_eq!(announcement.check(&identity, &config), Ok(()));
        let refusal = |identity: &RunIdentity, config: &Config| {
            announcement
                .check(identity, config)
                .unwrap_err()
                .to_string()
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
            ..announcement
        };
        let refusal = longer.check(&identity, &config).unwrap_err().to_string();
        assert!(
            refusal.contains("record layout: the learner's is transition 1"),
            "{refusal}"
        );
    }
}
