//! Loss and gradient of a minibatch, pass by pass.
//!
//! Work that concerns a single image is done image by image, so that one layer's output is still
//! cached when the next layer reads it. The members of the team share the images. Work on the whole
//! batch (linear layers, the decoder's first convolution, weight gradients) is shared by rows or
//! columns. No sum is ever split between members.

use skein_kernels::{Finish, Isa, Start, Team};
use skein_protocol::IMAGE_PIXELS;

use super::batch::BatchBuffers;
use super::buffer::Buffer;
use super::code;
use super::elementwise::{column_sums, gate, reconstruction_error, scale};
use super::geometry::GeometryHead;
use super::layer::ConvLayer;
use super::members::{MemberScratch, by_image, portions, share};
use super::network::{DECODER, HEADS, LINEAR, UNFOLD, VaeNetwork};
use super::parameter_order::LayerRanges;
use super::stopwatch::Pass;

/// Knowledge about a minibatch, beyond its images.
#[derive(Debug, Clone, Copy, Default)]
pub struct Targets<'a> {
    /// Images to reproduce from the first m codes, `[m, 72, 128]`; `None` for all images
    /// themselves. The decoder is most of a step's work.
    pub clean: Option<&'a [u8]>,
    /// Numbers to regress, `[n, outputs]`, NaN where one is unknown; empty for none.
    pub geometry: &'a [f32],
}

/// The loss and its parts; see [`super::super::VaeMetrics`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct LossParts {
    pub(super) loss: f32,
    pub(super) error: f32,
    pub(super) divergence: f32,
    pub(super) geometry: f32,
}

/// Images that the decoder is to reproduce.
#[derive(Clone, Copy)]
enum Reproduced {
    Input,
    Clean,
}

/// Everything that the passes of one step read and write.
pub(super) struct StepContext<'a> {
    pub(super) isa: Isa,
    pub(super) team: &'a mut Team,
    pub(super) members: &'a mut [MemberScratch],
    pub(super) network: &'a mut VaeNetwork,
    pub(super) batch: &'a mut BatchBuffers,
    pub(super) parameters: &'a [f32],
    pub(super) kl_weight: f64,
    pub(super) geometry: Option<&'a mut GeometryHead>,
}

impl StepContext<'_> {
    /// Computes the loss of depth images, `[n, 72, 128]`, and its gradient. For the weights of the
    /// decoder's first convolution, only the gradient with respect to its output is left in
    /// [`super::unfold::Unfold`]. `noise`: standard normal, `[n, latent]`.
    pub(super) fn objective(
        &mut self,
        depth: &[u8],
        targets: Targets<'_>,
        noise: &[f32],
        gradient: &mut [f32],
    ) -> LossParts {
        let count = depth.len() / IMAGE_PIXELS;
        let decoded = targets
            .clean
            .map_or(count, |clean| clean.len() / IMAGE_PIXELS);
        self.batch.resize(self.network, count, decoded);
        if let Some(clean) = targets.clean {
            scale(self.isa, clean, &mut self.batch.clean);
        }
        self.encode(depth);
        let divergence = self.sample_codes(noise) / count as f64;
        let towards = match targets.clean {
            None => Reproduced::Input,
            Some(_) => Reproduced::Clean,
        };
        self.decode_and_backward(towards, decoded);
        self.unfold_backward();
        let geometry = self.code_backward(targets.geometry, noise, self.kl_weight / count as f64);
        self.encoder_backward(count);
        self.gradients(gradient);

        let error = self.batch.errors.iter().sum::<f64>() / decoded as f64;
        LossParts {
            loss: (error + self.kl_weight * divergence + geometry) as f32,
            error: error as f32,
            divergence: divergence as f32,
            geometry: geometry as f32,
        }
    }

    /// Forward: the encoder's convolutions.
    fn encode(&mut self, depth: &[u8]) {
        let count = depth.len() / IMAGE_PIXELS;
        let (network, parameters) = (&*self.network, self.parameters);
        let mut images = by_image(
            self.batch
                .encoder_maps
                .each_mut()
                .map(|buffer| &mut **buffer),
            count,
        );
        share(
            self.team,
            self.members,
            &mut images,
            |index, images, member| {
                let depth = &depth[index * IMAGE_PIXELS..][..IMAGE_PIXELS];
                let images = images.each_mut().map(|image| &mut **image);
                network.encoder_forward(parameters, depth, images, &mut member.watch);
            },
        );
    }

    /// Forward: heads, sampled codes, and the decoder's linear layer and first convolution. Returns
    /// the sum of the divergences.
    fn sample_codes(&mut self, noise: &[f32]) -> f64 {
        let (network, parameters, batch) = (&mut *self.network, self.parameters, &mut *self.batch);
        let watch = &mut self.members[0].watch;
        watch.start();
        network.heads.forward(
            self.team,
            parameters,
            &batch.encoder_maps[4],
            Finish::Plain,
            &mut batch.heads,
        );
        watch.layer(HEADS, Pass::Forward);
        let divergence = code::sample(
            self.isa,
            network.latent(),
            &batch.heads,
            noise,
            &mut batch.codes,
        );
        watch.rest();
        network.linear.forward(
            self.team,
            parameters,
            &batch.codes[..batch.decoded_len(network.latent())],
            Finish::Rectified,
            &mut batch.unfolded,
        );
        watch.layer(LINEAR, Pass::Forward);
        network.unfold.multiply(self.team, &batch.unfolded);
        watch.layer(UNFOLD, Pass::Forward);
        divergence
    }

    /// Forward through the rest of the decoder, squared error, and backward to its first feature
    /// map. `count`: number of images decoded.
    fn decode_and_backward(&mut self, towards: Reproduced, count: usize) {
        let (isa, network, parameters) = (self.isa, &*self.network, self.parameters);
        let BatchBuffers {
            encoder_maps: [pixels, ..],
            clean,
            decoder_maps: [a, b, c, d],
            decoder_maps_grad: [e, f, g],
            decoder_bias_sums,
            errors,
            ..
        } = &mut *self.batch;
        let pixels = match towards {
            Reproduced::Input => pixels,
            Reproduced::Clean => clean,
        };
        let buffers: [&mut Buffer; 8] = [a, b, c, d, e, f, g, decoder_bias_sums];
        let images = by_image(buffers.map(|buffer| &mut **buffer), count);
        let mut items: Vec<_> = images.into_iter().zip(errors).collect();
        let weight = 2.0 / count as f32;
        share(
            self.team,
            self.members,
            &mut items,
            |index, (images, error), member| {
                let MemberScratch { columns, watch, .. } = member;
                let [a, b, c, d, e, f, g, sums] = images;
                network.decoder_forward(parameters, index, [a, b, c, d], columns, watch);
                let pixels = &pixels[index * IMAGE_PIXELS..][..IMAGE_PIXELS];
                **error = reconstruction_error(isa, d, pixels, weight);
                watch.rest();
                let mut sums = BiasSums::new(network.decoder_places(), sums);
                let ways = [(2, &*c, &mut *g), (1, &*b, f), (0, &*a, e)];
                let mut grad = &**d;
                for (index, output, into) in ways {
                    sums.add(isa, index + 1, grad);
                    watch.layer(DECODER + index, Pass::Gradient);
                    network.decoder[index].look(grad, Start::Zero, Finish::Gated(output), into);
                    watch.layer(DECODER + index, Pass::Backward);
                    grad = into;
                }
                sums.add(isa, 0, grad);
                watch.layer(UNFOLD, Pass::Gradient);
            },
        );
    }

    /// Backward through the decoder's first convolution.
    fn unfold_backward(&mut self) {
        let (parameters, batch) = (self.parameters, &mut *self.batch);
        let watch = &mut self.members[0].watch;
        watch.start();
        self.network.unfold.gather(&batch.decoder_maps_grad[0]);
        watch.layer(UNFOLD, Pass::Backward);
        let (unfold, gate) = (&self.network.unfold, &batch.unfolded);
        // Whole images, so that members have equal parts.
        let mut parts = portions(
            &mut batch.unfolded_grad,
            super::unfold::INPUT_LEN,
            self.members.len(),
        );
        share(
            self.team,
            self.members,
            &mut parts,
            |_, (first, input), member| {
                let gate = &gate[*first * super::unfold::INPUT_LEN..][..input.len()];
                unfold.backward(parameters, &mut member.unfold, *first, gate, input);
                member.watch.layer(UNFOLD, Pass::Backward);
            },
        );
    }

    /// Backward through linear layer, geometry head, codes and heads, to the features. Returns the
    /// geometry's part of the loss.
    fn code_backward(&mut self, known: &[f32], noise: &[f32], divergence_weight: f64) -> f64 {
        let (network, batch) = (&*self.network, &mut *self.batch);
        let watch = &mut self.members[0].watch;
        watch.start();
        let decoded = batch.decoded_len(network.latent());
        let (from_images, others) = batch.codes_grad.split_at_mut(decoded);
        network
            .linear
            .backward(self.team, &batch.unfolded_grad, Finish::Plain, from_images);
        others.fill(0.0);
        watch.layer(LINEAR, Pass::Backward);
        let geometry = match &mut self.geometry {
            Some(head) => head.add_gradient(self.team, &batch.codes, known, &mut batch.codes_grad),
            None => 0.0,
        };
        let weight = divergence_weight as f32;
        code::backward(
            self.isa,
            network.latent(),
            &batch.heads,
            noise,
            &batch.codes_grad,
            weight,
            &mut batch.heads_grad,
        );
        watch.rest();
        let (finish, into) = (
            Finish::Gated(&batch.encoder_maps[4]),
            &mut batch.encoder_maps_grad[3],
        );
        network
            .heads
            .backward(self.team, &batch.heads_grad, finish, into);
        watch.layer(HEADS, Pass::Backward);
        geometry
    }

    /// Backward through the encoder, to its first feature map.
    fn encoder_backward(&mut self, count: usize) {
        let (isa, network) = (self.isa, &*self.network);
        let BatchBuffers {
            encoder_maps,
            encoder_maps_grad: [a, b, c, d],
            encoder_bias_sums,
            ..
        } = &mut *self.batch;
        let buffers: [&mut Buffer; 5] = [a, b, c, d, encoder_bias_sums];
        let mut images = by_image(buffers.map(|buffer| &mut **buffer), count);
        share(
            self.team,
            self.members,
            &mut images,
            |index, images, member| {
                let MemberScratch { columns, watch, .. } = member;
                let [a, b, c, d, sums] = images;
                let mut sums = BiasSums::new(network.encoder_places(), sums);
                let mut grad = &**d;
                for (layer, into) in [(3, c), (2, b), (1, a)] {
                    sums.add(isa, layer, grad);
                    watch.layer(layer, Pass::Gradient);
                    into.fill(0.0);
                    network.encoder[layer].spread(grad, columns, into);
                    gate(
                        isa,
                        into,
                        &encoder_maps[layer][index * into.len()..][..into.len()],
                    );
                    watch.layer(layer, Pass::Backward);
                    grad = into;
                }
                sums.add(isa, 0, grad);
                watch.layer(0, Pass::Gradient);
            },
        );
    }

    /// Computes the gradients of all biases and of all weights except the decoder's first
    /// convolution's.
    fn gradients(&mut self, gradient: &mut [f32]) {
        let (isa, network, batch) = (self.isa, &*self.network, &*self.batch);
        let watch = &mut self.members[0].watch;
        watch.start();
        let mut of_layer = |index: usize,
                            layer: &ConvLayer,
                            rows: &[f32],
                            images: &[f32],
                            gradient: &mut [f32]| {
            layer.gradient(self.team, isa, rows, images, gradient);
            watch.layer(index, Pass::Gradient);
        };
        for (index, layer) in network.encoder.iter().enumerate() {
            of_layer(
                index,
                layer,
                &batch.encoder_maps_grad[index],
                &batch.encoder_maps[index],
                gradient,
            );
        }
        for (index, layer) in network.decoder.iter().enumerate() {
            let grad = batch
                .decoder_maps_grad
                .get(index + 1)
                .unwrap_or(&batch.decoder_maps[3]);
            of_layer(
                DECODER + index,
                layer,
                &batch.decoder_maps[index],
                grad,
                gradient,
            );
        }
        network.heads.gradient(
            self.team,
            isa,
            &batch.heads_grad,
            &batch.encoder_maps[4],
            gradient,
        );
        watch.layer(HEADS, Pass::Gradient);
        network.linear.gradient(
            self.team,
            isa,
            &batch.unfolded_grad,
            &batch.codes[..batch.decoded_len(network.latent())],
            gradient,
        );
        watch.layer(LINEAR, Pass::Gradient);
        total(
            isa,
            network.encoder_places(),
            &batch.encoder_bias_sums,
            gradient,
        );
        total(
            isa,
            network.decoder_places(),
            &batch.decoder_bias_sums,
            gradient,
        );
        watch.rest();
    }
}

/// Bias gradients of four layers from one image, one layer after the other.
struct BiasSums<'a> {
    parts: [&'a mut [f32]; 4],
}

impl<'a> BiasSums<'a> {
    fn new(places: [&LayerRanges; 4], sums: &'a mut [f32]) -> Self {
        let mut rest = sums;
        let parts = places.map(|place| {
            let (own, others) = std::mem::take(&mut rest).split_at_mut(place.bias.len());
            rest = others;
            own
        });
        Self { parts }
    }

    /// Adds for `layer`. `grad`: the gradient with respect to the layer's output, before its ReLU.
    fn add(&mut self, isa: Isa, layer: usize, grad: &[f32]) {
        column_sums(isa, grad, self.parts[layer]);
    }
}

/// Computes the biases' gradients from the sums of all images.
fn total(isa: Isa, places: [&LayerRanges; 4], sums: &[f32], gradient: &mut [f32]) {
    let mut total = [0.0; 512];
    let biases: usize = places.iter().map(|place| place.bias.len()).sum();
    let total = &mut total[..biases.next_multiple_of(16)];
    column_sums(isa, sums, total);
    let mut rest = &*total;
    for place in places {
        let (own, others) = rest.split_at(place.bias.len());
        gradient[place.bias.clone()].copy_from_slice(own);
        rest = others;
    }
}
