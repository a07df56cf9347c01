//! The networks' state in a checkpoint, as named tensors.
//!
//! [`Stateful::parts`] lists everything that an update changes, once. Storing and restoring both
//! use that list, so neither can miss what the other has. The stored state does not depend on the
//! engine that computed it.

use std::collections::HashMap;

use tch::{Device, Kind, Tensor, no_grad_guard};

/// A named tensor in main memory.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedTensor {
    /// Name, unique in a checkpoint.
    pub name: String,
    /// Shape, outermost dimension first.
    pub shape: Vec<usize>,
    /// Values in row-major order, as many as the shape says.
    pub values: TensorValues,
}

/// A tensor's values.
#[derive(Debug, Clone, PartialEq)]
pub enum TensorValues {
    /// Parameters and moments.
    F32(Vec<f32>),
    /// Sums that must be exact in double precision.
    F64(Vec<f64>),
    /// Counters.
    I64(Vec<i64>),
}

impl TensorValues {
    fn len(&self) -> usize {
        match self {
            Self::F32(values) => values.len(),
            Self::F64(values) => values.len(),
            Self::I64(values) => values.len(),
        }
    }

    fn kind(&self) -> &'static str {
        match self {
            Self::F32(_) => "f32",
            Self::F64(_) => "f64",
            Self::I64(_) => "i64",
        }
    }
}

/// Access to one part of a state.
#[derive(Debug)]
pub enum StatePart<'a> {
    /// A libtorch tensor on any device: f32, f64 or i64. Shares its storage with the state.
    Tensor(Tensor),
    /// A flat vector, `[len]`.
    Numbers(&'a mut [f32]),
    /// A counter, `[1]`.
    Count(&'a mut u64),
}

impl StatePart<'_> {
    /// Copies the shape and the values.
    fn read(&self) -> (Vec<usize>, TensorValues) {
        match self {
            Self::Tensor(tensor) => (shape(tensor), values(tensor)),
            Self::Numbers(numbers) => (vec![numbers.len()], TensorValues::F32(numbers.to_vec())),
            Self::Count(count) => (vec![1], TensorValues::I64(vec![count.cast_signed()])),
        }
    }

    fn kind(&self) -> &'static str {
        match self {
            Self::Tensor(tensor) => match tensor.kind() {
                Kind::Int64 => "i64",
                Kind::Double => "f64",
                _ => "f32",
            },
            Self::Numbers(_) => "f32",
            Self::Count(_) => "i64",
        }
    }

    fn shape(&self) -> Vec<usize> {
        match self {
            Self::Tensor(tensor) => shape(tensor),
            Self::Numbers(numbers) => vec![numbers.len()],
            Self::Count(_) => vec![1],
        }
    }

    /// Replaces the values by those of a tensor of the same kind and shape.
    fn write(self, values: &TensorValues) {
        match (self, values) {
            (Self::Tensor(mut own), values) => {
                let flat = match values {
                    TensorValues::F32(values) => Tensor::from_slice(values),
                    TensorValues::F64(values) => Tensor::from_slice(values),
                    TensorValues::I64(values) => Tensor::from_slice(values),
                };
                own.copy_(&flat.view(own.size().as_slice()));
            }
            (Self::Numbers(own), TensorValues::F32(values)) => own.copy_from_slice(values),
            (Self::Count(own), TensorValues::I64(values)) => *own = values[0].cast_unsigned(),
            (part, values) => unreachable!("{} was compared with {}", values.kind(), part.kind()),
        }
    }
}

fn shape(tensor: &Tensor) -> Vec<usize> {
    tensor
        .size()
        .into_iter()
        .map(|size| size as usize)
        .collect()
}

fn values(tensor: &Tensor) -> TensorValues {
    let tensor = tensor.detach().to_device(Device::Cpu).contiguous();
    let count = tensor.numel();
    macro_rules! values {
        ($variant:ident, $zero:expr) => {{
            let mut values = vec![$zero; count];
            tensor.copy_data(&mut values, count);
            TensorValues::$variant(values)
        }};
    }
    match tensor.kind() {
        Kind::Int64 => values!(I64, 0_i64),
        Kind::Double => values!(F64, 0.0_f64),
        _ => values!(F32, 0.0_f32),
    }
}

/// An object whose whole state is a list of named parts.
pub trait Stateful {
    /// Lists every part of the state, under a name that is unique in the learner. The parts can be
    /// changed in place: one list serves storing and restoring.
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)>;

    /// Copies the whole state.
    fn named_tensors(&mut self) -> Vec<NamedTensor> {
        let parts = self.parts().into_iter();
        parts
            .map(|(name, part)| {
                let (shape, values) = part.read();
                NamedTensor {
                    name,
                    shape,
                    values,
                }
            })
            .collect()
    }

    /// Restores the state from `stored`, which may hold other tensors too. The next update is then
    /// bit for bit the one that would have followed.
    ///
    /// # Errors
    /// [`TensorRestoreError`] names the first tensor that does not fit; the state is unchanged
    /// then.
    fn load_named(&mut self, stored: &[NamedTensor]) -> Result<(), TensorRestoreError> {
        let stored: HashMap<&str, &NamedTensor> = stored
            .iter()
            .map(|tensor| (tensor.name.as_str(), tensor))
            .collect();
        let mut pairs = Vec::new();
        for (name, own) in self.parts() {
            let NamedTensor { shape, values, .. } = *stored
                .get(name.as_str())
                .ok_or_else(|| TensorRestoreError::Missing { name: name.clone() })?;
            let expected = own.shape();
            let len: usize = expected.iter().product();
            if (shape, values.kind(), values.len()) != (&expected, own.kind(), len) {
                return Err(TensorRestoreError::Shape {
                    name,
                    expected: format!("{} {expected:?}", own.kind()),
                    found: format!("{} {shape:?} with {} values", values.kind(), values.len()),
                });
            }
            pairs.push((own, values));
        }
        let _guard = no_grad_guard();
        for (own, values) in pairs {
            own.write(values);
        }
        Ok(())
    }
}

/// Reason why a stored state cannot be restored.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TensorRestoreError {
    /// A tensor is missing.
    #[error(
        "the stored state lacks the tensor {name}: it comes from another version or is damaged"
    )]
    Missing {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor has another shape or kind of number.
    #[error(
        "the stored tensor {name} is {found}, not {expected}: \
         it was stored under another configuration of the networks"
    )]
    Shape {
        /// Name of the tensor.
        name: String,
        /// Kind and shape that this configuration needs.
        expected: String,
        /// Kind, shape and number of values found.
        found: String,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A state with one part of each kind.
    struct Three(Tensor, Vec<f32>, u64);

    impl Stateful for Three {
        fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
            vec![
                ("first".into(), StatePart::Tensor(self.0.shallow_clone())),
                ("second".into(), StatePart::Numbers(&mut self.1)),
                ("third".into(), StatePart::Count(&mut self.2)),
            ]
        }
    }

    fn three(values: [f32; 2], count: u64) -> Three {
        let first = Tensor::from_slice(&[values[0] as f64, -1.5]).view([1, 2]);
        Three(first, vec![values[1]; 3], count)
    }

    #[test]
    fn a_state_is_restored_by_name() {
        let mut stored = three([1.0, 2.0], 7).named_tensors();
        assert_eq!(
            stored[0],
            NamedTensor {
                name: "first".into(),
                shape: vec![1, 2],
                values: TensorValues::F64(vec![1.0, -1.5])
            }
        );
        let mut state = three([0.0, 0.0], 0);
        stored.reverse();
        state.load_named(&stored).unwrap();
        stored.reverse();
        assert_eq!(state.named_tensors(), stored);
        assert_eq!(
            (state.0.double_value(&[0, 0]), &state.1[..], state.2),
            (1.0, &[2.0; 3][..], 7)
        );
    }

    #[test]
    fn a_state_that_does_not_fit_changes_nothing() {
        let stored = three([1.0, 2.0], 7).named_tensors();
        let mut state = three([0.0, 0.0], 0);
        let before = state.named_tensors();
        let missing = state.load_named(&stored[..2]).unwrap_err();
        assert_eq!(
            missing,
            TensorRestoreError::Missing {
                name: "third".into()
            }
        );
        let misfits: [(usize, &[usize], TensorValues); 4] = [
            (0, &[1, 2], TensorValues::F32(vec![1.0; 2])),
            (1, &[1, 3], TensorValues::F32(vec![1.0; 3])),
            (1, &[3], TensorValues::F32(vec![1.0; 2])),
            (2, &[0], TensorValues::I64(vec![])),
        ];
        for (place, shape, values) in misfits {
            let mut stored = stored.clone();
            (stored[place].shape, stored[place].values) = (shape.to_vec(), values);
            let error = state.load_named(&stored).unwrap_err().to_string();
            assert!(error.contains(&stored[place].name), "{error}");
        }
        assert_eq!(state.named_tensors(), before);
    }
}
