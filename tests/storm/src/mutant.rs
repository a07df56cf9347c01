//! Planted bugs, which show that the storm would find such ones.
//!
//! None of them is in the code under test: each alters what goes into it or comes out of it, as if
//! one of its decisions were missing.

use std::collections::BTreeMap;
use std::rc::Rc;

use skein_protocol::ids::Attempt;
use skein_protocol::ticket::Ticket;
use skein_protocol::transition::TransitionRecord;

/// A planted bug.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mutant {
    /// The assembly takes a record that came twice for the next one.
    DuplicateRecord,
    /// The dispatcher takes records of an attempt that was given up.
    OldAttempt,
    /// The dispatcher does not issue a ticket again.
    NoReissue,
    /// Episodes are delivered as they arrive.
    ArrivalOrder,
    /// A checkpoint is put in place before the results that it counts on are on the disk.
    EarlyCheckpoint,
    /// An actor flies a ticket with the newest snapshot instead of the named one.
    OtherSnapshot,
    /// A resumed learner orders again what was in flight, with the present snapshot.
    ForgottenOrders,
}

impl Mutant {
    /// All planted bugs.
    pub const ALL: [Self; 7] = [
        Self::DuplicateRecord,
        Self::OldAttempt,
        Self::NoReissue,
        Self::ArrivalOrder,
        Self::EarlyCheckpoint,
        Self::OtherSnapshot,
        Self::ForgottenOrders,
    ];
}

/// The mutants of dispatcher and assembly: what they see, and change, of the messages.
#[derive(Debug, Default)]
pub(crate) struct Tampering {
    pub(crate) mutant: Option<Mutant>,
    /// Step of the last record, by actor, its incarnation, episode and attempt.
    last_steps: BTreeMap<(u32, u64, u64, u32), u32>,
    /// Newest attempt, by episode.
    attempts: BTreeMap<u64, u32>,
}

impl Tampering {
    pub(crate) fn of(mutant: Option<Mutant>) -> Self {
        Self {
            mutant,
            ..Self::default()
        }
    }

    /// Returns `record` as the learner's code gets it.
    pub(crate) fn received(&mut self, mut record: Rc<TransitionRecord>) -> Rc<TransitionRecord> {
        match self.mutant {
            Some(Mutant::DuplicateRecord) => {
                let key = (
                    record.actor,
                    record.incarnation,
                    record.episode,
                    record.attempt,
                );
                if self.last_steps.get(&key) == Some(&record.step) {
                    Rc::make_mut(&mut record).step += 1;
                }
                self.last_steps.insert(key, record.step);
            }
            Some(Mutant::OldAttempt) => {
                if let Some(newest) = self.attempts.get(&record.episode) {
                    Rc::make_mut(&mut record).attempt = *newest;
                }
            }
            _ => {}
        }
        record
    }

    /// Notes a ticket that the learner's code issues; returns `false` if it is to be lost.
    pub(crate) fn lets_pass(&mut self, ticket: &Ticket) -> bool {
        if self.mutant == Some(Mutant::OldAttempt) {
            self.attempts.insert(ticket.episode.0, ticket.attempt.0);
        }
        self.mutant != Some(Mutant::NoReissue) || ticket.attempt == Attempt(0)
    }
}
