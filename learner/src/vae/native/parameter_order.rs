//! The native engine's order of parameters, and its conversion from and to PyTorch's.
//!
//! Images are channels-last, hence weights too:
//! `[rows' channels, kernel row, kernel column, image's channels]` for both kinds of convolution.
//! Rows are the output of a convolution and the input of a transposed one. Initial values are
//! drawn, and snapshots published, in PyTorch's order, the contract with actors.

use std::ops::Range;

use crate::networks::Layout;

/// Ranges of a layer's two tensors in the parameter vector.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct LayerRanges {
    pub(super) weight: Range<usize>,
    pub(super) bias: Range<usize>,
}

/// A tensor of PyTorch's as four dimensions, with the permutation that leads to the native order.
#[derive(Debug, Clone, PartialEq, Eq)]
struct OrderedTensor {
    /// Tensor name, as in PyTorch.
    name: String,
    /// Shape in PyTorch's order.
    shape: [usize; 4],
    /// Dimensions of `shape` from the outermost to the innermost in native order.
    axes: [usize; 4],
    /// Index of the first element in the native vector.
    start: usize,
}

/// The order of the parameters.
#[derive(Debug, Clone)]
pub(super) struct ParameterOrder {
    /// Tensors, in PyTorch's order.
    entries: Vec<OrderedTensor>,
}

/// Returns the four dimensions of a tensor of this name and shape, and their native order.
fn arranged(name: &str, shape: &[usize]) -> ([usize; 4], [usize; 4]) {
    const AS_IT_IS: [usize; 4] = [0, 1, 2, 3];
    const CHANNELS_LAST: [usize; 4] = [0, 2, 3, 1];
    match (name, shape) {
        // The input has a single row, so each kernel row makes its own image row; therefore each is
        // a separate matrix.
        ("decoder.conv1.weight", &[inputs, outputs, height, width]) => {
            ([inputs, outputs, height, width], [2, 0, 3, 1])
        }
        (_, &[rows, channels, height, width]) => ([rows, channels, height, width], CHANNELS_LAST),
        ("encoder.mean.weight" | "encoder.log_variance.weight", &[outputs, features]) => (
            [outputs, FEATURE_CHANNELS, features / FEATURE_CHANNELS, 1],
            CHANNELS_LAST,
        ),
        ("decoder.linear.weight", &[features, inputs]) => (
            [UNFOLDED_CHANNELS, features / UNFOLDED_CHANNELS, 1, inputs],
            [1, 0, 2, 3],
        ),
        ("decoder.linear.bias", &[features]) => (
            [UNFOLDED_CHANNELS, features / UNFOLDED_CHANNELS, 1, 1],
            [1, 0, 2, 3],
        ),
        (_, &[len]) => ([len, 1, 1, 1], AS_IT_IS),
        _ => unreachable!("{name} has shape {shape:?}, which no layer of the VAE has"),
    }
}

/// Channels of the encoder's last feature map.
const FEATURE_CHANNELS: usize = 256;
/// Channels of the decoder's first feature map.
const UNFOLDED_CHANNELS: usize = 1024;

impl ParameterOrder {
    /// Returns the order for the tensors of `layout`, encoder and decoder.
    pub(super) fn of(layout: &Layout) -> Self {
        let mut entries: Vec<OrderedTensor> = layout
            .tensors()
            .iter()
            .map(|tensor| {
                let shape: Vec<usize> = tensor.shape.iter().map(|&size| size as usize).collect();
                let (shape, axes) = arranged(&tensor.name, &shape);
                let name = tensor.name.clone();
                OrderedTensor {
                    name,
                    shape,
                    axes,
                    start: 0,
                }
            })
            .collect();
        // Both heads are one layer here: their weights lie side by side, followed by their biases.
        let mut places: Vec<usize> = (0..entries.len()).collect();
        let place = |name: &str| entries.iter().position(|entry| entry.name == name);
        if let (Some(bias), Some(weight)) = (
            place("encoder.mean.bias"),
            place("encoder.log_variance.weight"),
        ) {
            places.swap(bias, weight);
        }
        let mut start = 0;
        for place in places {
            entries[place].start = start;
            start += entries[place].len();
        }
        Self { entries }
    }

    /// Ranges of the layer's tensors.
    ///
    /// # Panics
    /// When there is no such layer.
    pub(super) fn layer(&self, name: &str) -> LayerRanges {
        LayerRanges {
            weight: self.tensor(&format!("{name}.weight")),
            bias: self.tensor(&format!("{name}.bias")),
        }
    }

    /// Range of a tensor.
    ///
    /// # Panics
    /// When there is no tensor of this name.
    pub(super) fn tensor(&self, name: &str) -> Range<usize> {
        let found = self.entries.iter().find(|entry| entry.name == name);
        let entry = found.expect("the layout describes every layer of the VAE");
        entry.start..entry.start + entry.len()
    }

    /// Converts a vector from PyTorch's order.
    pub(super) fn arrange_from_pytorch(&self, values: &[f32]) -> Vec<f32> {
        let mut arranged = vec![0.0; values.len()];
        self.walk(|here, there| arranged[here] = values[there]);
        arranged
    }

    /// Converts a vector to PyTorch's order; writes as many leading elements as fit.
    pub(super) fn to_pytorch(&self, values: &[f32], into: &mut [f32]) {
        self.walk(|here, there| {
            if let Some(into) = into.get_mut(there) {
                *into = values[here];
            }
        });
    }

    /// Calls `pair` with the native and the PyTorch index of every number.
    fn walk(&self, mut pair: impl FnMut(usize, usize)) {
        let mut first = 0;
        for entry in &self.entries {
            let strides =
                [3, 2, 1, 0].map(|axis: usize| entry.shape[axis + 1..].iter().product::<usize>());
            let [d, c, b, a] = strides;
            let strides = entry.axes.map(|axis| [a, b, c, d][axis]);
            let sizes = entry.axes.map(|axis| entry.shape[axis]);
            let mut here = entry.start;
            for i in 0..sizes[0] {
                for j in 0..sizes[1] {
                    for k in 0..sizes[2] {
                        let there = first + i * strides[0] + j * strides[1] + k * strides[2];
                        for l in 0..sizes[3] {
                            pair(here, there + l * strides[3]);
                            here += 1;
                        }
                    }
                }
            }
            first += entry.len();
        }
    }
}

impl OrderedTensor {
    fn len(&self) -> usize {
        self.shape.iter().product()
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::config::DecoderName;

    use super::*;
    use crate::networks::{DecoderNetwork, EncoderNetwork};

    fn order(latent: usize) -> (ParameterOrder, usize) {
        let mut layout = Layout::default();
        let _ = (
            EncoderNetwork::describe(&mut layout, latent),
            DecoderNetwork::describe(&mut layout, latent, DecoderName::Plain),
        );
        (ParameterOrder::of(&layout), layout.len())
    }

    #[test]
    fn every_number_has_one_place_and_returns_to_its_own() {
        let (order, len) = order(8);
        // Exact in f32 up to 2^24.
        let numbers: Vec<f32> = (0..len).map(|number| number as f32).collect();
        let arranged = order.arrange_from_pytorch(&numbers);
        assert_ne!(arranged, numbers);
        let mut back = vec![f32::NAN; len];
        order.to_pytorch(&arranged, &mut back);
        assert_eq!(back, numbers);
    }

    #[test]
    fn a_weight_lies_where_its_formula_says() {
        let (order, len) = order(32);
        let numbers: Vec<f32> = (0..len).map(|number| number as f32).collect();
        let arranged = order.arrange_from_pytorch(&numbers);
        let first_of = |name: &str| {
            let entries = order.entries.iter();
            entries
                .take_while(|entry| entry.name != name)
                .map(OrderedTensor::len)
                .sum::<usize>()
        };
        // encoder.conv2 [64, 32, 4, 4]: output 5, input 7, kernel row 1, kernel column 2.
        let name = "encoder.conv2.weight";
        let there = first_of(name) + ((5 * 32 + 7) * 4 + 1) * 4 + 2;
        let here = order.tensor(name).start + ((5 * 4 + 1) * 4 + 2) * 32 + 7;
        assert_eq!(arranged[here], there as f32);
        // decoder.conv1 [1024, 128, 5, 7]: input 1000, output 100, kernel row 3, kernel column 4.
        let name = "decoder.conv1.weight";
        let there = first_of(name) + ((1000 * 128 + 100) * 5 + 3) * 7 + 4;
        let here = order.tensor(name).start + ((3 * 1024 + 1000) * 7 + 4) * 128 + 100;
        assert_eq!(arranged[here], there as f32);
        // decoder.linear [3072, 32]: channel 9 of 1024, pixel 2 of 3, code 11.
        let name = "decoder.linear.weight";
        let there = first_of(name) + (9 * 3 + 2) * 32 + 11;
        let here = order.tensor(name).start + (2 * 1024 + 9) * 32 + 11;
        assert_eq!(arranged[here], there as f32);
        // Heads [32, 3072]: output 3, channel 200 of 256, pixel 10 of 12; the second head follows
        // the first.
        let name = "encoder.log_variance.weight";
        let there = first_of(name) + 3 * 3072 + 200 * 12 + 10;
        let here = order.tensor("encoder.mean.weight").start + (32 + 3) * 3072 + 10 * 256 + 200;
        assert_eq!(arranged[here], there as f32);
    }
}
