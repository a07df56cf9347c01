//! Seeds: one for the run, and derived from it an independent one for every purpose.
//!
//! No code keeps a random generator alive: each draw derives one from (run seed, purpose, index).
//! So random numbers depend on their purpose, never on time or place, and a checkpoint stores no
//! generator state.

use xxhash_rust::xxh3::xxh3_64_with_seed;

/// Purpose of random numbers. The discriminants are part of every result: never renumber them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Start position and exploration noise of one training episode; indexed by episode.
    Episode = 1,
    /// Start position of one evaluation episode; indexed by its number within the evaluation.
    EvaluationEpisode = 2,
    /// Choice of a generated course for a training episode; indexed by episode.
    Course = 3,
    /// Initial parameters of the VAE.
    VaeParameters = 4,
    /// Initial parameters of policy and critic.
    PolicyParameters = 5,
    /// Minibatches of the policy updates between two snapshots; indexed by the version of the
    /// first, which is the epoch unless episodes are flown in segments.
    PolicyBatches = 6,
    /// Action noise of the policy updates between two snapshots; indexed likewise.
    PolicyNoise = 7,
    /// Minibatches of the VAE updates between two snapshots; indexed likewise.
    VaeBatches = 8,
    /// Reparameterisation noise of the VAE updates between two snapshots; indexed likewise.
    VaeNoise = 9,
    /// Start position of an episode; derived from the ticket's seed.
    StartPosition = 10,
    /// Exploration noise of an episode or segment, indexed by its first step; derived from the
    /// ticket's seed, so that it does not depend on how the start is drawn.
    ActionNoise = 11,
    /// Disturbances of an episode; derived from the ticket's seed.
    Disturbances = 12,
    /// Bootstrap resamples of the runs of an experiment, for the uncertainty of its results. The
    /// seed is the number of runs, the index that of the resamples.
    Bootstrap = 13,
    /// Generated course of a confirmation episode; indexed by episode.
    ConfirmationCourse = 14,
    /// Steps of an episode that the teacher flies; derived from the ticket's seed.
    TeacherSteps = 15,
    /// Courses and poses of the views that an encoder is trained on; indexed by course.
    EncoderViews = 16,
    /// Reparameterisation noise of a step that trains an encoder; indexed by step.
    EncoderNoise = 17,
    /// Courses and poses of the views on which an encoder is measured; indexed by course.
    MeasuredViews = 18,
}

/// Returns the seed for the `index`-th use of `purpose` in the run seeded `run_seed`.
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
