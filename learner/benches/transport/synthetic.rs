//! A synthetic actor: takes tickets and sends whole episodes of valid records, without simulating.

use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::Config;
use skein_protocol::ids::{ActorId, ActorIncarnation, PolicyVersion};
use skein_protocol::stages::StageTimes;
use skein_protocol::status::{ActorState, ActorStatus, StatusRecord};
use skein_protocol::ticket::{Control, Ticket};
use skein_protocol::transition::{Outcome, RecordKind};
use skein_run::{Presence, RunDirectory};
use skein_transport::{ActorPorts, LoanedTransition};

/// Steps of every episode: as many as from one end of the corridor to the other.
pub(crate) const STEPS: u32 = 120;
/// Time without a message from the learner after which the actor gives up.
const PATIENCE: Duration = Duration::from_secs(10);

struct SyntheticActor {
    ports: ActorPorts,
    id: ActorId,
    incarnation: ActorIncarnation,
    heartbeat: Duration,
    last_heard: Instant,
    last_report: Instant,
    tickets: VecDeque<Ticket>,
    has_reported_waiting: bool,
    is_over: bool,
    /// Length of the latent codes.
    latent: usize,
    image: Box<[u8; IMAGE_PIXELS]>,
}

/// Serves the learner of the run in `directory` as actor number `id`, until the run is over or the
/// learner is silent.
pub(crate) fn serve(directory: &Path, id: u32) {
    let (identity, config) = RunDirectory::new(directory).open().unwrap();
    let _presence = Presence::enter(&identity).unwrap();
    let mut actor = SyntheticActor::new(
        ActorPorts::join(&identity, &config).unwrap(),
        ActorId(id),
        &config,
    );
    actor.report(ActorState::Serving);
    while !actor.is_over && actor.last_heard.elapsed() < PATIENCE {
        actor.listen();
        match actor.tickets.pop_front() {
            Some(ticket) => actor.fly(&ticket),
            None => actor.wait(),
        }
    }
    actor.report(ActorState::Leaving);
}

impl SyntheticActor {
    fn new(ports: ActorPorts, id: ActorId, config: &Config) -> Self {
        Self {
            ports,
            id,
            incarnation: ActorIncarnation(1),
            heartbeat: config.transport.heartbeat(),
            last_heard: Instant::now(),
            last_report: Instant::now(),
            tickets: VecDeque::new(),
            has_reported_waiting: false,
            is_over: false,
            latent: config.vae.latent,
            image: Box::new([id.0 as u8; IMAGE_PIXELS]),
        }
    }

    /// Reads pending messages and sends a heartbeat when one is due, as an actor does before every
    /// step.
    fn listen(&mut self) {
        while let Some(record) = self.ports.receive_control().unwrap() {
            self.last_heard = Instant::now();
            if record.is_for(self.id, self.incarnation) {
                match record.read(self.ports.run()).unwrap() {
                    Control::Fly(ticket) => self.tickets.push_back(ticket),
                    Control::Stop => self.is_over = true,
                    Control::Heartbeat | Control::Rejoin => {}
                }
            }
        }
        if self.last_report.elapsed() >= self.heartbeat {
            self.ports.maintain().unwrap();
            self.report(ActorState::Serving);
        }
    }

    fn wait(&mut self) {
        if !self.has_reported_waiting {
            self.has_reported_waiting = true;
            self.report(ActorState::Serving);
        }
        self.ports.wait(self.heartbeat).unwrap();
    }

    fn fly(&mut self, ticket: &Ticket) {
        self.has_reported_waiting = false;
        for step in 0..STEPS {
            self.listen();
            let mut record = self.record(ticket, step);
            record.action = [0.25, -0.25, 0.0, 0.0];
            record.terminated = u8::from(step + 1 == STEPS);
            self.ports.send_transition(record).unwrap();
        }
        let mut closing = self.record(ticket, STEPS);
        closing.kind = RecordKind::Closing.code();
        closing.outcome = Outcome::Collided.code();
        closing.course_walls = 5;
        self.ports.send_transition(closing).unwrap();
        self.ports.wake_learner().unwrap();
    }

    /// Returns a record with everything that an actor writes when it observes, the image included.
    fn record(&self, ticket: &Ticket, step: u32) -> LoanedTransition {
        let mut record = self.ports.loan_transition().unwrap();
        record.begin(ticket, self.id, self.incarnation, step);
        record.position_m = [0.5 * step as f32, 0.0, 3.5];
        record.orientation = [0.0, 0.0, 0.0, 1.0];
        record.velocity_mps = [1.0, 0.0, 0.0];
        record.latent[..self.latent].fill(0.5);
        record.depth.copy_from_slice(&self.image[..]);
        record
    }

    fn report(&mut self, state: ActorState) {
        self.last_report = Instant::now();
        let status = ActorStatus {
            actor: self.id,
            incarnation: self.incarnation,
            pid: std::process::id(),
            state,
            // As if a snapshot had arrived.
            newest_policy: Some(PolicyVersion(0)),
            episodes_flown: 0,
            times: StageTimes::default(),
        };
        self.ports
            .send_status(StatusRecord::new(self.ports.run(), &status))
            .unwrap();
        self.ports.wake_learner().unwrap();
    }
}
