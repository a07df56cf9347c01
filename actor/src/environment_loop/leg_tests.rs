//! A leg is a function of its ticket, whoever flew what came before.

use skein_protocol::ids::{Attempt, FlightId, PolicyVersion};
use skein_protocol::ticket::{CourseChoice, Exploration};

use super::tests::{ACTOR, LIFE, STORMY, Tape, flown, fly, network, pilot, raw, ticket};
use super::*;

/// `ticket` for the `steps` that follow `flown`.
fn leg(ticket: &Ticket, steps: u32, flown: &[[f32; ACTION]]) -> Ticket {
    Ticket {
        leg: Some(Leg {
            steps,
            flown: flown.into(),
        }),
        ..ticket.clone()
    }
}

/// Flies `ticket` in legs of `steps`, each with what `fly` makes of it; the records without the legs' ends, and those apart.
fn flown_in_legs(
    ticket: &Ticket,
    steps: u32,
    mut fly: impl FnMut(&Ticket) -> (Option<FlightScore>, Tape),
) -> (Vec<Box<TransitionRecord>>, Vec<Box<TransitionRecord>>) {
    let (mut records, mut ends, mut flown): (Vec<Box<TransitionRecord>>, Vec<_>, Vec<_>) = Default::default();
    loop {
        let leg = leg(ticket, steps, &flown);
        let (score, mut tape) = fly(&leg);
        let kind = match score {
            Some(_) => RecordKind::Closing,
            None => RecordKind::LegEnd,
        };
        let (first, last) = (leg.first_step(), tape.sent.len() - 1);
        for (step, record) in tape.sent.iter().enumerate() {
            let kind = if step == last { kind } else { RecordKind::Step };
            assert_eq!(record.check(&leg, ACTOR, LIFE, first + step as u32), Ok(kind));
        }
        if score.is_some() {
            records.extend(tape.sent);
            return (records, ends);
        }
        assert_eq!(last, steps as usize);
        ends.extend(tape.sent.pop());
        flown.extend(tape.sent.iter().map(|record| record.action));
        records.extend(tape.sent);
    }
}

#[test]
fn a_flight_in_legs_without_noise_is_the_flight_flown_whole() {
    for simulator in ["", STORMY] {
        for course in [CourseChoice::Training, CourseChoice::Generated(1)] {
            let ticket = Ticket {
                course,
                ..ticket(Exploration::Mode, 1)
            };
            let mut used = pilot(simulator);
            let (_, whole) = flown(&mut used, &ticket);
            for steps in [1, 3, 200] {
                let (records, ends) = flown_in_legs(&ticket, steps, |leg| fly(&mut used, leg));
                assert!(raw(&records) == raw(&whole.sent), "in legs of {steps}");
                // What a leg ends with is what the next one begins with.
                for (end, next) in ends
                    .iter()
                    .zip(records.iter().skip(steps as usize).step_by(steps as usize))
                {
                    let seen = |record: &TransitionRecord| {
                        (record.position_m, record.velocity_mps, record.latent, record.depth)
                    };
                    assert!(seen(end) == seen(next));
                    assert_eq!(end.action, [0.0; ACTION]);
                }
            }
        }
    }
}

#[test]
fn a_leg_is_the_same_whoever_flew_what_came_before() {
    for simulator in ["", STORMY] {
        for exploration in [Exploration::Uniform, Exploration::Sample] {
            let ticket = ticket(exploration, 1);
            let mut one = pilot(simulator);
            let (alone, _) = flown_in_legs(&ticket, 2, |leg| fly(&mut one, leg));
            assert!(alone.len() > 6, "too short to compare anything");
            // Each leg by a pilot that has flown nothing, or something else meanwhile.
            let (strangers, _) = flown_in_legs(&ticket, 2, |leg| fly(&mut pilot(simulator), leg));
            assert!(raw(&strangers) == raw(&alone));
            let (distracted, _) = flown_in_legs(&ticket, 2, |next| {
                let other = Ticket {
                    seed: 7,
                    ..ticket.clone()
                };
                fly(&mut one, &leg(&other, 2, &[]));
                fly(&mut one, next)
            });
            assert!(raw(&distracted) == raw(&alone));
            let (longer, _) = flown_in_legs(&ticket, 3, |leg| fly(&mut one, leg));
            assert!(raw(&longer) != raw(&alone), "the noise of each leg is its own");
        }
    }
}

#[test]
fn a_pilot_flies_on_from_where_it_is_and_from_nowhere_else() {
    let mut pilot = pilot("");
    let ticket = ticket(Exploration::Uniform, 1);
    let (_, tape) = fly(&mut pilot, &leg(&ticket, 2, &[]));
    let flown: Vec<_> = tape.sent[..2].iter().map(|record| record.action).collect();
    let flies_on = |pilot: &Pilot, ticket: &Ticket| {
        let under_way = pilot.under_way.as_ref();
        under_way.is_some_and(|under_way| under_way.is_before(ticket, ticket.leg.as_ref().unwrap()))
    };
    let next = leg(&ticket, 5, &flown);
    let again = Ticket {
        attempt: Attempt(9),
        policy_version: PolicyVersion(99),
        exploration: Exploration::Sample,
        ..next.clone()
    };
    assert!(flies_on(&pilot, &next) && flies_on(&pilot, &again));
    let nearly = [flown[0], [flown[1][0], f32::from_bits(flown[1][1].to_bits() ^ 1)]];
    for elsewhere in [
        leg(&ticket, 5, &flown[..1]),
        leg(&ticket, 5, &nearly),
        leg(&ticket, 5, &[]),
        Ticket {
            seed: 2,
            ..next.clone()
        },
        Ticket {
            flight: FlightId(6),
            ..next.clone()
        },
        Ticket {
            course: CourseChoice::Evaluation(0),
            ..next.clone()
        },
        Ticket {
            start_level: 1,
            ..next.clone()
        },
    ] {
        assert!(!flies_on(&pilot, &elsewhere), "{elsewhere:?}");
    }
    // A whole flight leaves nothing in the air.
    super::tests::flown(&mut pilot, &ticket);
    assert!(pilot.under_way.is_none());
}

#[test]
fn a_leg_after_the_flights_end_is_a_fault() {
    let ticket = ticket(Exploration::Mode, 1);
    let (_, whole) = flown(&mut pilot(""), &ticket);
    let actions: Vec<_> = whole.sent.iter().map(|record| record.action).collect();
    let mut tape = Tape::default();
    let end = pilot("").fly(&leg(&ticket, 1, &actions), &network(|_| {}), &mut tape);
    let Err(FlightError::Fault(fault)) = end else {
        panic!("{end:?}")
    };
    let steps = whole.sent.len() - 1;
    assert_eq!(
        fault.to_string(),
        format!(
            "the flight ends in step {steps} of the {} that are said to have been flown before the leg",
            steps + 1
        )
    );
    assert_eq!(tape.sent[0].kind, RecordKind::Failed.code());
}
