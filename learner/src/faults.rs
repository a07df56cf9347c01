//! Faults between ticket and committed episode that were repaired, counted by reason.

use std::collections::BTreeMap;

use skein_protocol::transition::RecordFault;

macro_rules! reasons {
    ($(#[$doc:meta])* $name:ident {
        $($(#[$variant_doc:meta])* $variant:ident => $text:literal),* $(,)?
    }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
        pub enum $name { $($(#[$variant_doc])* $variant),* }

        impl $name {
            /// All reasons.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// Text in logs, reports and the summary.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),* }
            }
        }
    };
}

reasons! {
    /// Reason why a ticket was issued again.
    Reissue {
        /// Records of a later ticket of the same actor came first: the ticket or its records were
        /// lost.
        Skipped => "was skipped",
        /// One of its records was lost.
        Hole => "has a hole",
        /// Its records are invalid, or the simulator failed.
        Failed => "failed",
        /// It took longer than `transport.episode_deadline_secs`.
        Late => "took too long",
        /// Its actor gave no heartbeat for `transport.actor_silence_secs`.
        Silent => "is silent",
        /// Its actor started another incarnation.
        Restarted => "restarted",
        /// Its actor left.
        Left => "left",
    }
}

reasons! {
    /// Reason why a record was refused.
    Refusal {
        /// Its sender is not attached, or a former incarnation.
        Stranger => "of no living actor",
        /// It belongs to no ticket that its actor holds: a record of an episode that was given up.
        NoTicket => "of no ticket",
        /// It does not follow the one before, or belongs to something else.
        OutOfOrder => "out of order",
        /// A field has a value that no episode produces.
        Impossible => "impossible value",
        /// A number is infinite or NaN.
        NotFinite => "not finite",
        /// A number, an action or the episode is larger than possible.
        TooLarge => "too large",
        /// It contradicts itself or the records before it.
        Contradiction => "contradiction",
        /// A heartbeat is invalid.
        Status => "status",
    }
}

impl From<&RecordFault> for Refusal {
    fn from(fault: &RecordFault) -> Self {
        match fault {
            RecordFault::Mismatch { .. } => Self::OutOfOrder,
            RecordFault::Code { .. } => Self::Impossible,
            RecordFault::NotFinite { .. } => Self::NotFinite,
            RecordFault::TooLarge { .. }
            | RecordFault::TooLong { .. }
            | RecordFault::ActionOutOfRange { .. } => Self::TooLarge,
            RecordFault::Contradiction { .. } => Self::Contradiction,
        }
    }
}

/// Counts of faults that were repaired.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Faults {
    reissued: [u64; Reissue::ALL.len()],
    refused: [u64; Refusal::ALL.len()],
}

impl Faults {
    /// Counts a ticket that is issued again.
    pub fn reissue(&mut self, why: Reissue) {
        self.reissued[why as usize] += 1;
    }

    /// Counts a record that is refused.
    pub fn refuse(&mut self, why: Refusal) {
        self.refused[why as usize] += 1;
    }

    /// Number of tickets issued again, for any reason.
    pub fn reissued(&self) -> u64 {
        self.reissued.iter().sum()
    }

    /// Number of records refused, for any reason.
    pub fn refused(&self) -> u64 {
        self.refused.iter().sum()
    }

    /// Number of tickets issued again by reason; reasons that did not occur are left out.
    pub fn reissued_by_reason(&self) -> BTreeMap<String, u64> {
        occurred(
            self.reissue_counts()
                .map(|(why, count)| (why.name(), count)),
        )
    }

    /// Number of records refused by reason; reasons that did not occur are left out.
    pub fn refused_by_reason(&self) -> BTreeMap<String, u64> {
        occurred(
            self.refusal_counts()
                .map(|(why, count)| (why.name(), count)),
        )
    }

    /// Returns the count of each reason to issue a ticket again.
    pub fn reissue_counts(&self) -> impl Iterator<Item = (Reissue, u64)> {
        Reissue::ALL.iter().copied().zip(self.reissued)
    }

    /// Returns the count of each reason to refuse a record.
    pub fn refusal_counts(&self) -> impl Iterator<Item = (Refusal, u64)> {
        Refusal::ALL.iter().copied().zip(self.refused)
    }
}

fn occurred(counts: impl Iterator<Item = (&'static str, u64)>) -> BTreeMap<String, u64> {
    counts
        .filter(|(_, count)| *count > 0)
        .map(|(why, count)| (why.to_owned(), count))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_its_own_count() {
        let mut faults = Faults::default();
        for (count, why) in (1..).zip(Reissue::ALL) {
            (0..count).for_each(|_| faults.reissue(*why));
        }
        faults.refuse(Refusal::Status);
        let by_reason = faults.reissued_by_reason();
        assert_eq!(by_reason["was skipped"], 1);
        assert_eq!(by_reason["left"], Reissue::ALL.len() as u64);
        assert_eq!(by_reason.values().sum::<u64>(), faults.reissued());
        assert_eq!(
            faults.refused_by_reason(),
            [("status".to_owned(), 1)].into()
        );
    }
}
