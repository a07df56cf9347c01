//! Test that the depth image's bytes are written once: the learner reads them where the camera
//! rendered them.

#![allow(
    clippy::unwrap_used,
    reason = "a test's helpers fail by panicking, as tests do"
)]

use std::sync::Arc;

use skein_inference::Network;
use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation, Attempt, EpisodeId, PolicyVersion};
use skein_protocol::snapshot::{Snapshot, SnapshotLayout};
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};
use skein_rollout::agent::Agent;
use skein_rollout::courses::{Courses, Simulators};
use skein_rollout::environment_loop::{Directive, EnvironmentLoop, RecordLink};
use skein_run::{LearnerLock, RunDirectory};
use skein_transport::{ActorPorts, LearnerPorts, LoanedTransition, ServiceError};

/// A byte of memory, independent of the address it is mapped to: a file and an offset in it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct FileOffset {
    inode: String,
    offset: usize,
}

impl FileOffset {
    fn of(address: *const u8) -> Self {
        let address = address as usize;
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let number = |text: &str| usize::from_str_radix(text, 16).unwrap();
        // "start-end permissions offset device inode path"
        let location = maps.lines().find_map(|line| {
            let fields: Vec<_> = line.split_whitespace().collect();
            let (start, end) = fields[0].split_once('-')?;
            (number(start) <= address && address < number(end)).then(|| Self {
                inode: fields[4].to_owned(),
                offset: address - number(start) + number(fields[2]),
            })
        });
        let location = location.expect("every address of this process is mapped");
        assert_ne!(location.inode, "0", "private memory has no file");
        location
    }
}

/// Link that records where each image lies, when loaned and when sent.
struct Watched<'a> {
    ports: &'a ActorPorts,
    loaned: Vec<FileOffset>,
    sent: Vec<FileOffset>,
}

impl RecordLink for Watched<'_> {
    type Loan = LoanedTransition;
    type Error = ServiceError;

    fn loan(&mut self) -> Result<LoanedTransition, ServiceError> {
        let record = self.ports.loan_transition()?;
        self.loaned.push(FileOffset::of(record.depth.as_ptr()));
        Ok(record)
    }

    fn send(&mut self, record: LoanedTransition) -> Result<(), ServiceError> {
        self.sent.push(FileOffset::of(record.depth.as_ptr()));
        self.ports.send_transition(record)
    }

    fn directive(&mut self) -> Result<Directive, ServiceError> {
        Ok(Directive::Continue)
    }
}

#[test]
fn the_learner_reads_images_where_the_camera_wrote_them() {
    let directory = tempfile::tempdir().unwrap();
    let run = RunDirectory::new(directory.path());
    let mut config = Config::default();
    config.sac.hidden_width = 8;
    config.transport.max_actors = 1;
    let configs = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../configs/courses/training.toml"
    );
    config.courses.training = configs.into();
    config.courses.evaluation = vec![configs.into()];
    run.create(&config).unwrap();
    let (identity, config) = run.open().unwrap();
    let lock = LearnerLock::take(&run, &identity).unwrap();
    let learner = LearnerPorts::open(&identity, lock.incarnation(), &config).unwrap();
    let actor = ActorPorts::join(&identity, &config).unwrap();
    learner.maintain().unwrap();

    let layout = SnapshotLayout::of(&config);
    let snapshot = Snapshot {
        version: PolicyVersion(0),
        values: vec![0.01; layout.values()],
    };
    let ticket = Ticket {
        run: identity.run,
        episode: EpisodeId(0),
        attempt: Attempt(0),
        policy_version: PolicyVersion(0),
        course: CourseChoice::Training,
        start_level: 1,
        exploration: Exploration::Uniform,
        seed: 5,
        teacher_share: None,
        segment: None,
    };
    let simulators = Simulators::new(Arc::new(Courses::of_run(&config).unwrap()));
    let mut environment_loop = EnvironmentLoop::new(
        ActorId(0),
        ActorIncarnation(0),
        simulators,
        Agent::new(config.observation_layout()),
    );
    let mut watched = Watched {
        ports: &actor,
        loaned: Vec::new(),
        sent: Vec::new(),
    };
    let flown = environment_loop.fly(&ticket, &Network::new(&snapshot, &layout), &mut watched);

    let mut received = Vec::new();
    while let Some(record) = learner.receive_transition().unwrap() {
        received.push(FileOffset::of(record.depth.as_ptr()));
    }
    flown.unwrap();
    assert!(received.len() > 3);
    assert_eq!(watched.loaned, watched.sent);
    assert_eq!(watched.sent, received);
}
