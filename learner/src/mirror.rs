//! An episode seen in a mirror: left and right change places.
//!
//! Corridor, drone and reward are symmetric, so a mirrored episode is a valid episode through
//! another course, at no cost in flying. Only a stereo camera has sides: its shadows lie to the
//! left of near objects. In the mirror they lie to the right, as if its second lens were on the
//! other side.

use skein_protocol::{ActionSpace, GROUND_TRUTH, IMAGE_WIDTH};

use crate::episode::{CommittedEpisode, StepObservation};

/// Indices of the ground truth's leftward numbers: both openings' offsets, the distance from the
/// middle, and the gust.
const TO_THE_LEFT: [usize; 4] = [1, 5, 8, 14];

impl CommittedEpisode {
    /// Returns the mirrored episode, flown with the numbers of `action`. Its latent codes are still
    /// the unmirrored ones: a caller that needs codes encodes the mirrored images.
    #[must_use]
    pub fn mirrored(&self, action: ActionSpace) -> Self {
        let mut mirrored = self.without_images();
        mirrored.action_before = action.mirrored(&self.action_before);
        let taken = mirrored.actions.iter_mut();
        for taken in taken.chain(&mut mirrored.teacher_actions) {
            *taken = action.mirrored(taken);
        }
        mirrored.observations.iter_mut().for_each(mirror);
        mirrored.depth = self.depth.clone();
        for row in mirrored
            .depth
            .iter_mut()
            .flat_map(|depth| depth.chunks_exact_mut(IMAGE_WIDTH))
        {
            row.reverse();
        }
        mirrored
    }
}

fn mirror(seen: &mut StepObservation) {
    seen.position_m[1] *= -1.0;
    seen.velocity_mps[1] *= -1.0;
    seen.goal_m[1] *= -1.0;
    // Roll and yaw change sign, pitch does not.
    seen.orientation[0] *= -1.0;
    seen.orientation[2] *= -1.0;
    for place in TO_THE_LEFT {
        seen.ground_truth[place] *= -1.0;
    }
}

const _: () = assert!(TO_THE_LEFT[3] < GROUND_TRUTH);

#[cfg(test)]
mod tests {
    use skein_protocol::transition::Outcome;
    use skein_protocol::{ActionSpace, IMAGE_PIXELS};

    use crate::episode::samples::{episode, with_images};

    #[test]
    fn an_episode_in_two_mirrors_is_the_episode() {
        let mut flown = with_images(episode(3, 5, Outcome::Collided));
        flown.depth.as_mut().unwrap()[IMAGE_PIXELS..][..3].copy_from_slice(&[1, 2, 3]);
        for action in ActionSpace::ALL {
            let mirrored = flown.mirrored(action);
            assert_eq!(mirrored.check(), Ok(()));
            assert_ne!(mirrored, flown);
            assert_eq!(mirrored.mirrored(action), flown);
        }
    }
}
