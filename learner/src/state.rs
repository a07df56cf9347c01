//! What a checkpoint must hold of the networks, as tensors with names.
//!
//! Everything that an update changes is a tensor and is listed once, by [`Stateful::named_tensors`]; storing and restoring both go through that list,
//! so that nothing can be stored and not restored, or the other way round.

use std::collections::HashMap;

use tch::{Kind, Tensor, no_grad_guard};

/// Tensors by name.
pub type NamedTensors = Vec<(String, Tensor)>;

/// Something whose whole state is tensors.
pub trait Stateful {
    /// Every tensor of the state, under a name that is unique in the learner.
    ///
    /// The tensors share their storage with the state: whoever writes them later than the next update copies them first.
    fn named_tensors(&self) -> NamedTensors;

    /// Takes the state from `stored`, which may hold other tensors besides. The next update is then bit for bit the one that would have followed.
    ///
    /// # Errors
    /// [`RestoreError`] names the first tensor that does not fit; the state is untouched then.
    fn load_named(&mut self, stored: &[(String, Tensor)]) -> Result<(), RestoreError> {
        let stored: HashMap<&str, &Tensor> = stored.iter().map(|(name, tensor)| (name.as_str(), tensor)).collect();
        let mut pairs = Vec::new();
        for (name, own) in self.named_tensors() {
            let found = *stored
                .get(name.as_str())
                .ok_or_else(|| RestoreError::Missing { name: name.clone() })?;
            if (found.size(), found.kind()) != (own.size(), own.kind()) {
                return Err(RestoreError::Shape {
                    name,
                    expected: (own.kind(), own.size()),
                    found: (found.kind(), found.size()),
                });
            }
            pairs.push((own, found));
        }
        let _guard = no_grad_guard();
        for (mut own, found) in pairs {
            own.copy_(found);
        }
        Ok(())
    }
}

/// Why a stored state cannot be taken over.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// A tensor is not there.
    #[error("the stored state lacks the tensor {name}: it comes from another version or is damaged")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape or kind of number.
    #[error(
        "the stored tensor {name} is {found:?}, not {expected:?}: it was stored under another configuration of the networks"
    )]
    Shape {
        /// Its name.
        name: String,
        /// Kind and shape this configuration needs.
        expected: (Kind, Vec<i64>),
        /// Kind and shape found.
        found: (Kind, Vec<i64>),
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Pair(Tensor, Tensor);

    impl Stateful for Pair {
        fn named_tensors(&self) -> NamedTensors {
            vec![
                ("first".into(), self.0.shallow_clone()),
                ("second".into(), self.1.shallow_clone()),
            ]
        }
    }

    fn pair(values: [f32; 2]) -> Pair {
        Pair(Tensor::from_slice(&values[..1]), Tensor::from_slice(&values[1..]))
    }

    #[test]
    fn a_state_is_taken_over_by_name() {
        let mut stored = pair([1.0, 2.0]).named_tensors();
        stored.reverse();
        let mut state = pair([0.0, 0.0]);
        state.load_named(&stored).unwrap();
        assert_eq!((state.0.double_value(&[0]), state.1.double_value(&[0])), (1.0, 2.0));
    }

    #[test]
    fn a_state_that_does_not_fit_changes_nothing() {
        let mut state = pair([0.0, 0.0]);
        let first = || ("first".to_owned(), Tensor::from_slice(&[1.0_f32]));
        let missing = state.load_named(&[first()]).unwrap_err();
        assert_eq!(missing, RestoreError::Missing { name: "second".into() });
        let misshapen = state
            .load_named(&[first(), ("second".into(), Tensor::from_slice(&[1.0_f64]))])
            .unwrap_err();
        assert!(misshapen.to_string().contains("second"), "{misshapen}");
        assert_eq!(state.0.double_value(&[0]), 0.0);
    }
}
