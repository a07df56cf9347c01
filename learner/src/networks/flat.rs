//! All parameters of a network in one flat tensor; the layers' tensors are views of it.
//!
//! One vector simplifies everything around a network. The optimizer's state is two more vectors, a
//! target network follows by one operation, a snapshot is one copy, and a checkpoint cannot miss a
//! tensor.

use std::ops::Range;

use tch::{Device, Tensor, no_grad_guard};

use crate::noise::Noise;

/// Factor by which an encoder's initial weights may exceed PyTorch's defaults. It keeps the
/// variance of activations constant through layers with ReLU (He et al. 2015, arXiv:1502.01852,
/// eq. 10). With the defaults, four layers shrink the difference between two images thirtyfold.
pub(crate) const WIDER: f32 = 2.449_489_7; // √6

/// Name, shape and initial range of one tensor of a network.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterSpec {
    /// Name, such as `encoder.conv1.weight`.
    pub name: String,
    /// Shape, in PyTorch's conventions.
    pub shape: Vec<i64>,
    /// Initial elements are uniform in `[-bound, bound)`.
    pub initial_bound: f32,
}

impl ParameterSpec {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product::<i64>() as usize
    }

    /// `true` if the tensor has no element.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The tensors of a network in the order of its flat vector, appended as the layers are described.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Layout {
    tensors: Vec<ParameterSpec>,
}

impl Layout {
    /// Appends a tensor; returns its index.
    pub(super) fn push(&mut self, name: String, shape: &[i64], initial_bound: f32) -> usize {
        self.tensors.push(ParameterSpec {
            name,
            shape: shape.to_vec(),
            initial_bound,
        });
        self.tensors.len() - 1
    }

    /// The tensors, in order.
    pub fn tensors(&self) -> &[ParameterSpec] {
        &self.tensors
    }

    /// Number of elements described so far.
    pub fn len(&self) -> usize {
        self.tensors.iter().map(ParameterSpec::len).sum()
    }

    /// Returns initial values, drawn tensor by tensor in order. They depend on the seed alone.
    pub fn initial_values(&self, seed: u64) -> Vec<f32> {
        let mut noise = Noise::new(seed);
        let mut values = Vec::with_capacity(self.len());
        for tensor in &self.tensors {
            values.extend((0..tensor.len()).map(|_| noise.uniform(tensor.initial_bound)));
        }
        values
    }

    /// Widens the initial range of the weights described so far by `factor`; biases keep theirs.
    pub(crate) fn widen_weights(&mut self, factor: f32) {
        for tensor in self
            .tensors
            .iter_mut()
            .filter(|tensor| tensor.shape.len() > 1)
        {
            tensor.initial_bound *= factor;
        }
    }

    /// `true` if no tensor was described yet.
    pub fn is_empty(&self) -> bool {
        self.tensors.is_empty()
    }
}

/// The parameters of a network: one flat f32 vector, and the layers' tensors as views of it.
#[derive(Debug)]
pub struct Parameters {
    layout: Layout,
    flat: Tensor,
    /// Leaves of the gradient graph; they share `flat`'s storage.
    views: Vec<Tensor>,
}

impl Parameters {
    /// Creates the layout's initial values, equal on every device.
    pub fn initialise(layout: Layout, seed: u64, device: Device) -> Self {
        let values = Tensor::from_slice(&layout.initial_values(seed));
        Self::of(layout, values.to_device(device))
    }

    /// Copies the parameters into storage of their own.
    pub fn duplicate(&self) -> Self {
        Self::of(self.layout.clone(), self.flat.copy())
    }

    fn of(layout: Layout, flat: Tensor) -> Self {
        let _guard = no_grad_guard();
        let mut start = 0;
        let views = layout
            .tensors()
            .iter()
            .map(|tensor| {
                let len = tensor.len() as i64;
                let view = flat.narrow(0, start, len).view(tensor.shape.as_slice());
                start += len;
                view.set_requires_grad(true)
            })
            .collect();
        Self {
            layout,
            flat,
            views,
        }
    }

    /// Copies the parameters in double precision, for checks against finite differences.
    #[cfg(test)]
    pub(crate) fn to_double(&self) -> Self {
        Self::of(self.layout.clone(), self.flat.to_kind(tch::Kind::Double))
    }

    /// Names and shapes of the tensors.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// All parameters, `[layout().len()]`.
    pub fn flat(&self) -> &Tensor {
        &self.flat
    }

    /// All parameters, to change in place; every view changes with them. Use only with gradients
    /// switched off.
    pub fn flat_mut(&mut self) -> &mut Tensor {
        &mut self.flat
    }

    /// The tensor at this index of the layout.
    pub(super) fn tensor(&self, place: usize) -> &Tensor {
        &self.views[place]
    }

    /// Gradient of the scalar `loss` with respect to all parameters, flat. Consumes the graph
    /// behind `loss`.
    pub fn gradient(&self, loss: &Tensor) -> Tensor {
        let gradients = Tensor::run_backward(&[loss], &self.views, false, false);
        let flattened: Vec<Tensor> = gradients
            .iter()
            .map(|gradient| gradient.reshape([-1]))
            .collect();
        Tensor::cat(&flattened, 0)
    }

    /// Moves every parameter towards the one in `leader`, by the fraction `rate` of their
    /// difference.
    pub fn follow(&mut self, leader: &Self, rate: f64) {
        let _guard = no_grad_guard();
        let _ = self.flat.lerp_(&leader.flat, rate);
    }

    /// Replaces all values.
    ///
    /// # Panics
    /// When `values` has another length.
    pub fn replace(&mut self, values: &[f32]) {
        let _guard = no_grad_guard();
        self.flat.copy_(&Tensor::from_slice(values));
    }

    /// Copies a range of the parameters.
    ///
    /// # Panics
    /// When the range is outside the vector, or `into` has another length.
    pub fn copy_range(&self, range: Range<usize>, into: &mut [f32]) {
        assert_eq!(into.len(), range.len(), "as many places as parameters");
        let part = self.flat.narrow(0, range.start as i64, range.len() as i64);
        part.to_device(Device::Cpu).copy_data(into, range.len());
    }
}

#[cfg(test)]
mod tests {
    use tch::Kind;

    use super::*;

    fn two_tensors() -> Layout {
        let mut layout = Layout::default();
        layout.push("a".into(), &[2, 3], 0.5);
        layout.push("b".into(), &[4], 2.0);
        layout
    }

    #[test]
    fn views_share_the_flat_vectors_storage() {
        let mut parameters = Parameters::initialise(two_tensors(), 1, Device::Cpu);
        let _guard = no_grad_guard();
        parameters
            .flat_mut()
            .copy_(&Tensor::arange(10, (Kind::Float, Device::Cpu)));
        assert_eq!(parameters.tensor(0).double_value(&[1, 2]), 5.0);
        assert_eq!(parameters.tensor(1).double_value(&[0]), 6.0);
    }

    #[test]
    fn initial_values_stay_within_their_tensors_bound() {
        let parameters = Parameters::initialise(two_tensors(), 1, Device::Cpu);
        let largest = |place: usize| parameters.tensor(place).abs().max().double_value(&[]);
        assert!(largest(0) <= 0.5 && largest(0) > 0.05);
        assert!(largest(1) <= 2.0 && largest(1) > 0.2);
    }

    #[test]
    fn the_gradient_lies_in_the_order_of_the_vector() {
        let parameters = Parameters::initialise(two_tensors(), 1, Device::Cpu);
        // d/da of the sum of squares of a is 2a; d/db of three times the sum of b is 3.
        let loss = parameters.tensor(0).square().sum(None) + 3.0 * parameters.tensor(1).sum(None);
        let gradient = parameters.gradient(&loss);
        assert_eq!(
            gradient.narrow(0, 0, 6),
            2.0 * parameters.flat().narrow(0, 0, 6)
        );
        assert_eq!(
            Vec::<f32>::try_from(gradient.narrow(0, 6, 4)).unwrap(),
            [3.0; 4]
        );
    }

    #[test]
    fn a_follower_moves_by_the_rate_and_leaves_its_leader_alone() {
        let leader = Parameters::initialise(two_tensors(), 1, Device::Cpu);
        let mut follower = Parameters::initialise(two_tensors(), 2, Device::Cpu);
        let (was, goal) = (follower.flat().copy(), leader.flat().copy());
        follower.follow(&leader, 0.25);
        assert!(
            follower
                .flat()
                .allclose(&(&was * 0.75 + &goal * 0.25), 0.0, 1e-6, false)
        );
        assert_eq!(leader.flat(), &goal);
    }

    #[test]
    fn a_copied_range_holds_the_numbers_from_there() {
        let parameters = Parameters::initialise(two_tensors(), 1, Device::Cpu);
        let mut copy = [0.0; 3];
        parameters.copy_range(5..8, &mut copy);
        let expected: [f32; 3] =
            std::array::from_fn(|place| parameters.flat().double_value(&[5 + place as i64]) as f32);
        assert_eq!(copy, expected);
    }
}
