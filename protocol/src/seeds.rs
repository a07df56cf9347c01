//! One seed for the run, and from it an independent one for every purpose.
//!
//! Nothing that draws at random keeps a generator alive: it derives one from (run seed, purpose,
//! index). So the draws depend on *what* is drawn for, never on when or where, and there is no
//! generator state to store in a checkpoint.

use xxhash_rust::xxh3::xxh3_64_with_seed;

/// What randomness is drawn for. The discriminants are part of every result: never renumber them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Start position and exploration noise of one training episode; indexed by episode.
    Episode = 1,
    /// Start position of one evaluation episode; indexed by its number within the evaluation.
    EvaluationEpisode = 2,
    /// Whether a training episode is flown on a generated course, and which; indexed by episode.
    Course = 3,
    /// Initial parameters of the VAE.
    VaeParameters = 4,
    /// Initial parameters of policy and critic.
    PolicyParameters = 5,
    /// Minibatches drawn for the policy updates between two snapshots; indexed by the former's
    /// version, which is the epoch unless episodes are flown in segments.
    PolicyBatches = 6,
    /// Action noise inside the policy updates between two snapshots; indexed likewise.
    PolicyNoise = 7,
    /// Minibatches drawn for the VAE steps between two snapshots; indexed likewise.
    VaeBatches = 8,
    /// Reparameterisation noise of the VAE steps between two snapshots; indexed likewise.
    VaeNoise = 9,
    /// Where one episode starts; derived from the ticket's seed.
    StartPosition = 10,
    /// Exploration noise of one episode, or of the segment of it that begins at the step of this
    /// index; derived from the ticket's seed, so that a start drawn otherwise does not shift it.
    ActionNoise = 11,
    /// What disturbs one episode; derived from the ticket's seed.
    Disturbances = 12,
    /// Resamples of the runs of an experiment, from which the uncertainty of what it found is told;
    /// the seed is their number, the index that of the resamples.
    Bootstrap = 13,
    /// Generated course on which a candidate for the best snapshot is confirmed; indexed by
    /// episode.
    ConfirmationCourse = 14,
}

/// The seed for the `index`-th use of `purpose` in the run seeded `run_seed`.
pub fn derive(run_seed: u64, purpose: Purpose, index: u64) -> u64 {
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&(purpose as u64).to_le_bytes());
    bytes[8..].copy_from_slice(&index.to_le_bytes());
    xxh3_64_with_seed(&bytes, run_seed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_differ_by_run_purpose_and_index() {
        let base = derive(1, Purpose::Episode, 0);
        assert_ne!(base, derive(2, Purpose::Episode, 0));
        assert_ne!(base, derive(1, Purpose::EvaluationEpisode, 0));
        assert_ne!(base, derive(1, Purpose::Episode, 1));
        assert_eq!(base, derive(1, Purpose::Episode, 0));
    }
}
