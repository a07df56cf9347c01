//! Benchmark of an actor's whole step, from the camera to the sent record, against the sum of its
//! stages.
//!
//! An iteration is a training episode through real shared memory, as short as possible: shorter
//! iterations are disturbed less often. Every stage gets the same inputs as in the whole, so the
//! excess of the whole over the sum of the stages is the loop's own cost. The learner's buffer is
//! emptied after each episode, outside the measured time. Neither side includes an actor's reading
//! of messages and sending of heartbeats between two steps (`control` in the table of a run): it
//! depends on the learner.

mod common;

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, Throughput};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use skein_inference::{Network, Scratch};
use skein_protocol::config::{ObservationLayout, SeenStep};
use skein_protocol::ids::{ActorId, ActorIncarnation};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::snapshot::SnapshotLayout;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::{RecordKind, TransitionRecord};
use skein_protocol::{IMAGE_PIXELS, MAX_ACTION};
use skein_rollout::agent::Agent;
use skein_rollout::courses::{Courses, Simulators};
use skein_rollout::environment_loop::{Directive, EnvironmentLoop, RecordLink};
use skein_transport::{ActorPorts, LoanedTransition, ServiceError};

use common::{Learner, ticket};

const ACTOR: ActorId = ActorId(0);
const INCARNATION: ActorIncarnation = ActorIncarnation(0);

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    let transport = Transport::open();
    let config = &transport.learner.config;
    let network = Network::new(&transport.learner.snapshot(), &SnapshotLayout::of(config));
    let courses = Arc::new(Courses::of_run(config).expect("shipped courses can be flown"));
    let tickets = [ticket(transport.learner.identity.run, 1, 1)];
    let mut environment_loop = EnvironmentLoop::new(
        ACTOR,
        INCARNATION,
        Simulators::new(Arc::clone(&courses)),
        Agent::new(config.observation_layout()),
    );
    let episodes: Vec<Vec<TransitionRecord>> = tickets
        .iter()
        .map(|ticket| {
            fly(&mut environment_loop, ticket, &network, &transport);
            transport.received()
        })
        .collect();
    let steps = episodes
        .iter()
        .map(|records| records.len() - 1)
        .sum::<usize>();

    let mut group = criterion.benchmark_group("actor_step");
    group.throughput(Throughput::Elements(steps as u64));
    group.bench_function("whole", |bencher| {
        bencher.iter_custom(|iterations| {
            timed(iterations, episodes.len(), &transport, |episode| {
                fly(
                    &mut environment_loop,
                    &tickets[episode],
                    &network,
                    &transport,
                );
            })
        });
    });
    environment(
        &mut group,
        &tickets,
        &episodes,
        &mut Simulators::new(courses),
    );
    inference(
        &mut group,
        &episodes,
        &network,
        &config.observation_layout(),
    );
    sending(&mut group, &tickets, &episodes, &transport);
    group.finish();
    criterion.final_summary();
}

fn fly(
    environment_loop: &mut EnvironmentLoop,
    ticket: &Ticket,
    network: &Network,
    transport: &Transport,
) {
    let flown = environment_loop.fly(ticket, network, &mut Link(&transport.actor));
    black_box(flown.expect("memory is free, because all records were read"));
}

/// Reset, physics and camera, with the same starts and actions.
fn environment(
    group: &mut BenchmarkGroup<'_, WallTime>,
    tickets: &[Ticket],
    episodes: &[Vec<TransitionRecord>],
    simulators: &mut Simulators,
) {
    let mut image = [0; IMAGE_PIXELS];
    group.bench_function("environment", |bencher| {
        bencher.iter(|| {
            for (ticket, records) in tickets.iter().zip(episodes) {
                let simulator = simulators.of(ticket).expect("the course is loaded");
                let [mut start, mut disturbances] = [Purpose::StartPosition, Purpose::Disturbances]
                    .map(|purpose| Pcg64Mcg::seed_from_u64(derive(ticket.seed, purpose, 0)));
                simulator
                    .reset(ticket.start_level, &mut start, &mut disturbances)
                    .expect("the course has this level");
                simulator.render(&mut image);
                for record in steps_of(records) {
                    black_box(
                        simulator
                            .step(record.action)
                            .expect("the episode was flown before"),
                    );
                    simulator.render(&mut image);
                    black_box(&image);
                }
            }
        });
    });
}

/// Encoder and policy, with the same images and observations.
fn inference(
    group: &mut BenchmarkGroup<'_, WallTime>,
    episodes: &[Vec<TransitionRecord>],
    network: &Network,
    observation_layout: &ObservationLayout,
) {
    let mut scratch = Scratch::default();
    group.bench_function("encoder", |bencher| {
        bencher.iter(|| {
            for record in episodes.iter().flatten() {
                black_box(network.encode(black_box(&record.depth), &mut scratch));
            }
        });
    });
    let mut noise = Pcg64Mcg::seed_from_u64(3);
    let mut observed = vec![0.0; observation_layout.len()];
    group.bench_function("policy", |bencher| {
        bencher.iter(|| {
            for record in episodes.iter().flat_map(|records| steps_of(records)) {
                let seen = SeenStep {
                    latent: &record.latent,
                    velocity_mps: &record.velocity_mps,
                    orientation: &record.orientation,
                    goal_m: &record.goal_m,
                    previous_action: &[0.0; MAX_ACTION],
                };
                observation_layout.write_step(&seen, &mut observed);
                black_box(
                    network
                        .distribution(&observed, &mut scratch)
                        .sample(&mut noise),
                );
            }
        });
    });
}

/// Loan, header and sending of as many records, two on loan at a time.
fn sending(
    group: &mut BenchmarkGroup<'_, WallTime>,
    tickets: &[Ticket],
    episodes: &[Vec<TransitionRecord>],
    transport: &Transport,
) {
    let begin = |ticket: &Ticket, step| {
        let mut record = transport
            .actor
            .loan_transition()
            .expect("all records were read");
        record.begin(ticket, ACTOR, INCARNATION, step);
        record
    };
    let send = |record| {
        transport
            .actor
            .send_transition(record)
            .expect("the learner exists")
    };
    group.bench_function("sending", |bencher| {
        bencher.iter_custom(|iterations| {
            timed(iterations, episodes.len(), transport, |episode| {
                let mut record = begin(&tickets[episode], 0);
                for step in 1..episodes[episode].len() as u32 {
                    let next = begin(&tickets[episode], step);
                    send(std::mem::replace(&mut record, next));
                }
                send(record);
            })
        });
    });
}

/// Returns the time of `work` on all episodes, `iterations` times. The learner's buffer is emptied
/// after each, outside the measured time.
fn timed(
    iterations: u64,
    episodes: usize,
    transport: &Transport,
    mut work: impl FnMut(usize),
) -> Duration {
    let mut spent = Duration::ZERO;
    for _ in 0..iterations {
        for episode in 0..episodes {
            let start = Instant::now();
            work(episode);
            spent += start.elapsed();
            transport.empty();
        }
    }
    spent
}

fn steps_of(records: &[TransitionRecord]) -> impl Iterator<Item = &TransitionRecord> {
    records
        .iter()
        .filter(|record| record.kind == RecordKind::Step.code())
}

/// Ports of actor and learner, on one thread.
struct Transport {
    actor: ActorPorts,
    learner: Learner,
}

impl Transport {
    fn open() -> Self {
        let learner = Learner::open();
        let actor =
            ActorPorts::join(&learner.identity, &learner.config).expect("the learner exists");
        learner
            .ports
            .maintain()
            .expect("the actor's memory can be mapped");
        Self { actor, learner }
    }

    fn empty(&self) {
        while let Some(record) = self
            .learner
            .ports
            .receive_transition()
            .expect("the actor's memory is mapped")
        {
            drop(record);
        }
    }

    fn received(&self) -> Vec<TransitionRecord> {
        let mut records = Vec::new();
        while let Some(record) = self
            .learner
            .ports
            .receive_transition()
            .expect("the actor's memory is mapped")
        {
            records.push(*record);
        }
        records
    }
}

struct Link<'a>(&'a ActorPorts);

impl RecordLink for Link<'_> {
    type Loan = LoanedTransition;
    type Error = ServiceError;

    fn loan(&mut self) -> Result<LoanedTransition, ServiceError> {
        self.0.loan_transition()
    }

    fn send(&mut self, record: LoanedTransition) -> Result<(), ServiceError> {
        self.0.send_transition(record)
    }

    fn directive(&mut self) -> Result<Directive, ServiceError> {
        Ok(Directive::Continue)
    }
}
