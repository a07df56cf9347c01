//! The three kinds of layer, each described by its two tensors.
//!
//! Initial values follow PyTorch's defaults: weights and biases uniform in ±1/√fan_in (Kaiming
//! uniform with a = √5, He et al. 2015).

use tch::Tensor;

use super::{Layout, Parameters};

/// Indices of a layer's two tensors in its network's [`Parameters`].
#[derive(Debug, Clone, Copy)]
struct LayerTensors {
    weight: usize,
    bias: usize,
}

impl LayerTensors {
    fn describe(layout: &mut Layout, name: &str, weight_shape: &[i64], outputs: i64) -> Self {
        // PyTorch takes dimension 1 for the inputs, even where a transposed convolution's weight
        // has its outputs there.
        let fan_in: i64 = weight_shape[1..].iter().product();
        let bound = 1.0 / (fan_in as f32).sqrt();
        Self {
            weight: layout.push(format!("{name}.weight"), weight_shape, bound),
            bias: layout.push(format!("{name}.bias"), &[outputs], bound),
        }
    }
}

/// A fully connected layer.
#[derive(Debug, Clone, Copy)]
pub struct LinearLayer(LayerTensors);

impl LinearLayer {
    /// Describes a layer with weight `[outputs, inputs]`.
    pub fn describe(layout: &mut Layout, name: &str, inputs: i64, outputs: i64) -> Self {
        Self(LayerTensors::describe(
            layout,
            name,
            &[outputs, inputs],
            outputs,
        ))
    }

    /// Maps `[n, inputs]` to `[n, outputs]`.
    pub fn forward(&self, parameters: &Parameters, input: &Tensor) -> Tensor {
        input.linear(
            parameters.tensor(self.0.weight),
            Some(parameters.tensor(self.0.bias)),
        )
    }
}

/// A convolution with stride 2 and no padding.
#[derive(Debug, Clone, Copy)]
pub struct ConvolutionLayer(LayerTensors);

impl ConvolutionLayer {
    /// Describes a layer with weight `[outputs, inputs, height, width]`.
    pub fn describe(
        layout: &mut Layout,
        name: &str,
        inputs: i64,
        outputs: i64,
        [height, width]: [i64; 2],
    ) -> Self {
        Self(LayerTensors::describe(
            layout,
            name,
            &[outputs, inputs, height, width],
            outputs,
        ))
    }

    /// Maps `[n, inputs, h, w]` to `[n, outputs, (h - height) / 2 + 1, (w - width) / 2 + 1]`.
    pub fn forward(&self, parameters: &Parameters, input: &Tensor) -> Tensor {
        let (weight, bias) = (
            parameters.tensor(self.0.weight),
            parameters.tensor(self.0.bias),
        );
        input.conv2d(weight, Some(bias), [2, 2], [0, 0], [1, 1], 1)
    }
}

/// A transposed convolution with stride 2 and no padding.
#[derive(Debug, Clone, Copy)]
pub struct TransposedConvolutionLayer(LayerTensors);

impl TransposedConvolutionLayer {
    /// Describes a layer with weight `[inputs, outputs, height, width]`.
    pub fn describe(
        layout: &mut Layout,
        name: &str,
        inputs: i64,
        outputs: i64,
        [height, width]: [i64; 2],
    ) -> Self {
        Self(LayerTensors::describe(
            layout,
            name,
            &[inputs, outputs, height, width],
            outputs,
        ))
    }

    /// Maps `[n, inputs, h, w]` to `[n, outputs, 2 (h - 1) + height, 2 (w - 1) + width]`.
    pub fn forward(&self, parameters: &Parameters, input: &Tensor) -> Tensor {
        let (weight, bias) = (
            parameters.tensor(self.0.weight),
            parameters.tensor(self.0.bias),
        );
        input.conv_transpose2d(weight, Some(bias), [2, 2], [0, 0], [0, 0], 1, [1, 1])
    }
}
