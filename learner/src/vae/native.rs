//! The native engine: forward, backward and Adam on [`skein_kernels`].
//!
//! One step computes the loss of arXiv:1312.6114 with a squared reconstruction error, and its
//! gradient, in the order of `step.rs`. Images are stored channels-last throughout, so that kernels
//! read contiguous runs of memory in place. Gradients are written out by hand, layer by layer, and
//! tested against autograd. All results are the same bits with every instruction set and for any
//! number of threads; equality across types of processor is not promised (docs/reliability.md).

mod batch;
mod buffer;
mod code;
mod elementwise;
mod geometry;
mod layer;
mod members;
mod network;
mod parameter_order;
mod step;
mod stopwatch;
mod unfold;

use skein_kernels::{AdamStep, Isa, Team};
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::{DecoderName, VaeSection};
use skein_protocol::seeds::{Purpose, derive};

use self::batch::BatchBuffers;
use self::buffer::Buffer;
use self::elementwise::{sigmoids, squares};
use self::geometry::GeometryHead;
use self::members::{MemberScratch, by_image, share};
use self::network::VaeNetwork;
use self::parameter_order::ParameterOrder;
use self::step::{LossParts, StepContext};
use super::VaeMetrics;
use crate::error::UpdateError;
use crate::networks::{DecoderNetwork, EncoderNetwork, Layout, WIDER};
use crate::noise::Noise;
use crate::state::{StatePart, Stateful};

pub use step::Targets;
pub use stopwatch::{LAYERS, LayerTimes, Pass};

/// Images reconstructed at once: bounds memory, and reads the weights once for all of them.
const CHUNK: usize = 32;

/// Encoder, decoder and Adam's state, arranged by [`ParameterOrder`].
#[derive(Debug)]
pub struct NativeVae {
    isa: Isa,
    team: Team,
    members: Vec<MemberScratch>,
    order: ParameterOrder,
    /// Length of the prefix of PyTorch's order that actors need.
    published_len: usize,
    /// Where the decoder begins, in PyTorch's order and in the native one.
    decoder_start: usize,
    /// Number of leading parameters that steps leave as they are.
    frozen: usize,
    network: VaeNetwork,
    /// `true` if `network` has packed the present parameters.
    packed: bool,
    parameters: Buffer,
    moments: [Buffer; 2],
    /// Gradient, except for the weights of the decoder's first convolution, which exists only block
    /// by block.
    gradient: Buffer,
    batch: BatchBuffers,
    noise: Vec<f32>,
    /// Second head on the code; `None` where the caller knows no geometry.
    geometry: Option<GeometryHead>,
    steps: u64,
    learning_rate: f64,
    kl_weight: f64,
}

impl NativeVae {
    /// Returns an untrained VAE; its parameters depend on the run's seed alone and equal
    /// [`super::TorchVae`]'s.
    pub fn new(section: &VaeSection, run_seed: u64, threads: usize) -> Self {
        Self::with_isa(section, run_seed, threads, Isa::best())
    }

    /// Returns an untrained VAE with a second head, which regresses `outputs` numbers from the
    /// code. `weight`: factor of its squared error in the loss.
    ///
    /// The encoder's initial weights are wider than the defaults: with those, the head learns
    /// nothing in the first hundreds of steps.
    pub fn supervised(
        section: &VaeSection,
        run_seed: u64,
        threads: usize,
        (outputs, weight): (usize, f64),
    ) -> Self {
        let isa = Isa::best();
        let seed = derive(run_seed, Purpose::VaeParameters, 1);
        let head = GeometryHead::new(isa, section.latent, outputs, weight, seed);
        Self {
            geometry: Some(head),
            ..Self::initialised(section, run_seed, threads, isa, WIDER)
        }
    }

    pub(crate) fn with_isa(section: &VaeSection, run_seed: u64, threads: usize, isa: Isa) -> Self {
        Self::initialised(section, run_seed, threads, isa, 1.0)
    }

    /// Returns an untrained VAE without a second head. `wider`: factor of the encoder's initial
    /// weights.
    fn initialised(
        section: &VaeSection,
        run_seed: u64,
        threads: usize,
        isa: Isa,
        wider: f32,
    ) -> Self {
        let mut layout = Layout::default();
        let published_len = EncoderNetwork::describe(&mut layout, section.latent).published_len();
        layout.widen_weights(wider);
        let decoder_start = layout.len();
        let _ = DecoderNetwork::describe(&mut layout, section.latent, DecoderName::Plain);
        let order = ParameterOrder::of(&layout);
        let initial = layout.initial_values(derive(run_seed, Purpose::VaeParameters, 0));
        let len = initial.len();
        let team = Team::new(threads);
        let mut vae = Self {
            isa,
            members: (0..team.size()).map(|_| MemberScratch::new(isa)).collect(),
            team,
            published_len,
            decoder_start,
            frozen: 0,
            network: VaeNetwork::new(isa, section.latent, &order),
            packed: false,
            parameters: Buffer::zeroed(len),
            moments: [len, len].map(Buffer::zeroed),
            gradient: Buffer::zeroed(len),
            batch: BatchBuffers::default(),
            noise: Vec::new(),
            geometry: None,
            steps: 0,
            learning_rate: section.learning_rate,
            kl_weight: section.kl_weight,
            order,
        };
        vae.parameters
            .copy_from_slice(&vae.order.arrange_from_pytorch(&initial));
        vae
    }

    /// Takes over an encoder, [`NativeVae::publish`]'s values. From now on steps train the decoder
    /// alone, on the codes' means.
    ///
    /// # Panics
    /// When there are not [`NativeVae::published_len`] values.
    pub fn freeze_encoder(&mut self, encoder: &[f32]) {
        /// Logarithm of a variance that moves no code.
        const SURE: f32 = -20.0;
        let mut values = vec![0.0; self.parameters.len()];
        self.order.to_pytorch(&self.parameters, &mut values);
        let (published, rest) = values.split_at_mut(self.published_len);
        published.copy_from_slice(encoder);
        let log_variance = &mut rest[..self.decoder_start - self.published_len];
        let (weights, biases) =
            log_variance.split_at_mut(log_variance.len() - self.network.latent());
        weights.fill(0.0);
        biases.fill(SURE);
        let arranged = self.order.arrange_from_pytorch(&values);
        self.parameters.copy_from_slice(&arranged);
        (self.frozen, self.packed) = (self.decoder_start, false);
    }

    /// Sets Adam's step size from the next step on.
    pub fn set_learning_rate(&mut self, learning_rate: f64) {
        self.learning_rate = learning_rate;
    }

    /// Makes one step of Adam on a minibatch of depth images, `[n, 72, 128]`.
    ///
    /// # Errors
    /// [`UpdateError::NonFinite`] names the value that was not finite and the step's number;
    /// nothing has changed then.
    pub fn update(&mut self, images: &[u8], noise: &mut Noise) -> Result<VaeMetrics, UpdateError> {
        let objective = self.update_towards(images, Targets::default(), noise)?;
        Ok(metrics(&objective))
    }

    /// Makes one step of Adam on depth images whose `targets` are known. Returns the metrics, and
    /// the geometry's part of the loss.
    ///
    /// # Errors
    /// As [`NativeVae::update`].
    ///
    /// # Panics
    /// When the targets do not belong to as many images, or the geometry has no head.
    pub fn update_supervised(
        &mut self,
        images: &[u8],
        targets: Targets<'_>,
        noise: &mut Noise,
    ) -> Result<(VaeMetrics, f32), UpdateError> {
        let objective = self.update_towards(images, targets, noise)?;
        Ok((metrics(&objective), objective.geometry))
    }

    fn update_towards(
        &mut self,
        images: &[u8],
        targets: Targets<'_>,
        noise: &mut Noise,
    ) -> Result<LossParts, UpdateError> {
        let count = images.len() / IMAGE_PIXELS;
        self.noise.resize(count * self.network.latent(), 0.0);
        noise.fill_normal(&mut self.noise);

        let objective = self.objective(images, targets);
        self.check(&objective)?;
        self.step();
        Ok(objective)
    }

    /// Computes loss and gradient for these images and `self.noise`.
    fn objective(&mut self, images: &[u8], targets: Targets<'_>) -> LossParts {
        self.pack();
        let mut step = StepContext {
            isa: self.isa,
            team: &mut self.team,
            members: &mut self.members,
            network: &mut self.network,
            batch: &mut self.batch,
            parameters: &self.parameters,
            kl_weight: self.kl_weight,
            geometry: self.geometry.as_mut(),
        };
        step.objective(images, targets, &self.noise, &mut self.gradient)
    }

    /// Checks that everything a step would use is finite. For the gradient, its squared norm must
    /// not overflow; for the decoder's first convolution, a bound of it.
    fn check(&mut self, objective: &LossParts) -> Result<(), UpdateError> {
        let watch = &mut self.members[0].watch;
        watch.start();
        let blocks = self.network.unfold.place.weight.clone();
        let norm = squares(self.isa, &self.gradient[..blocks.start])
            + squares(self.isa, &self.gradient[blocks.end..])
            + self
                .network
                .unfold
                .gradient_bound(self.isa, &self.batch.unfolded)
            + self.geometry.as_ref().map_or(0.0, GeometryHead::squares);
        watch.rest();
        for (tensor, value) in [
            ("vae loss", objective.loss),
            ("vae squared error", objective.error),
            ("vae divergence", objective.divergence),
            ("vae gradient", norm as f32),
        ] {
            if !value.is_finite() {
                let update = self.steps + 1;
                return Err(UpdateError::NonFinite { tensor, update });
            }
        }
        Ok(())
    }

    /// Applies Adam, and packs the weights for the next step.
    fn step(&mut self) {
        self.steps += 1;
        let (isa, learning_rate, number) = (self.isa, self.learning_rate, self.steps);
        let adam = AdamStep {
            learning_rate,
            number,
        };
        let [first, second] = &mut self.moments;
        let input = &*self.batch.unfolded;
        let mut blocks = self
            .network
            .unfold
            .blocks(&mut self.parameters, [&mut *first, &mut *second]);
        share(
            &mut self.team,
            &mut self.members,
            &mut blocks,
            |_, block, member| {
                let _ = block.gradient(isa, input, &mut member.unfold);
                member.watch.layer(network::UNFOLD, Pass::Gradient);
                block.step(isa, adam, &mut member.unfold);
                member.watch.adam_and_packing();
            },
        );
        drop(blocks);
        let watch = &mut self.members[0].watch;
        watch.start();
        let blocks = self.network.unfold.place.weight.clone();
        for part in [self.frozen..blocks.start, blocks.end..self.parameters.len()] {
            let moments = [&mut first[part.clone()], &mut second[part.clone()]];
            let (parameters, gradient) = (&mut self.parameters[part.clone()], &self.gradient[part]);
            adam.apply(&mut self.team, isa, parameters, gradient, moments);
        }
        self.network.pack(&mut self.team, &self.parameters);
        if let Some(head) = &mut self.geometry {
            head.step(&mut self.team, learning_rate);
        }
        watch.adam_and_packing();
    }

    /// Packs the weights if they changed other than by a step.
    fn pack(&mut self) {
        if !self.packed {
            self.network.pack(&mut self.team, &self.parameters);
            self.network.unfold.pack(&self.parameters);
            self.packed = true;
        }
    }

    /// Returns the latent mean of each image, `[n, latent]`. `images`: `[n, 72, 128]`, any number
    /// of them.
    pub fn encode(&mut self, images: &[u8]) -> Vec<f32> {
        self.pack();
        let (network, parameters) = (&self.network, &*self.parameters);
        let mut codes = vec![0.0; images.len() / IMAGE_PIXELS * network.latent()];
        let mut parts: Vec<_> = codes.chunks_exact_mut(network.latent()).collect();
        share(
            &mut self.team,
            &mut self.members,
            &mut parts,
            |index, code, member| {
                let depth = &images[index * IMAGE_PIXELS..][..IMAGE_PIXELS];
                for (image, len) in member.images.iter_mut().zip(network.encoder_lens()) {
                    image.resize(len);
                }
                let images = member.images.each_mut().map(|image| &mut **image);
                network.encoder_forward(parameters, depth, images, &mut member.watch);
                network.mean(parameters, &member.images[4], code);
            },
        );
        codes
    }

    /// Reconstructs each image from its code's mean: `[n, 72, 128]` u8 to `[n, 72, 128]`, depth in
    /// [0, 1].
    pub fn reconstruct(&mut self, images: &[u8]) -> Vec<f32> {
        let mut seen = Vec::with_capacity(images.len());
        for images in images.chunks(CHUNK * IMAGE_PIXELS) {
            let codes = self.encode(images);
            let (isa, count) = (self.isa, images.len() / IMAGE_PIXELS);
            let (network, parameters, batch) =
                (&mut self.network, &*self.parameters, &mut self.batch);
            batch.resize(network, count, count);
            let finish = skein_kernels::Finish::Rectified;
            network.linear.forward(
                &mut self.team,
                parameters,
                &codes,
                finish,
                &mut batch.unfolded,
            );
            network.unfold.multiply(&mut self.team, &batch.unfolded);
            let network = &*network;
            let mut drawn = by_image(
                batch.decoder_maps.each_mut().map(|buffer| &mut **buffer),
                count,
            );
            share(
                &mut self.team,
                &mut self.members,
                &mut drawn,
                |index, images, member| {
                    let images = images.each_mut().map(|image| &mut **image);
                    network.decoder_forward(
                        parameters,
                        index,
                        images,
                        &mut member.columns,
                        &mut member.watch,
                    );
                },
            );
            drop(drawn);
            sigmoids(isa, &mut batch.decoder_maps[3]);
            seen.extend_from_slice(&batch.decoder_maps[3]);
        }
        seen
    }

    /// Length of the part of the parameters that actors need.
    pub fn published_len(&self) -> usize {
        self.published_len
    }

    /// Copies the encoder's part of a snapshot: convolutions and mean head, in the snapshot
    /// layout's order.
    ///
    /// # Panics
    /// When `into` is not [`NativeVae::published_len`] long.
    pub fn publish(&self, into: &mut [f32]) {
        assert_eq!(
            into.len(),
            self.published_len,
            "as many places as parameters"
        );
        self.order.to_pytorch(&self.parameters, into);
    }

    /// Returns the decoder's parameters, the tensors of a
    /// [`TrainedDecoder`](skein_protocol::decoder_file::TrainedDecoder).
    pub fn decoder_values(&self) -> Vec<f32> {
        let mut values = vec![0.0; self.parameters.len()];
        self.order.to_pytorch(&self.parameters, &mut values);
        values.split_off(self.decoder_start)
    }

    /// Number of VAE steps done so far.
    pub fn updates(&self) -> u64 {
        self.steps
    }

    /// Returns the time per layer and pass since the last call.
    pub fn take_times(&mut self) -> LayerTimes {
        let mut times = LayerTimes::default();
        for member in &mut self.members {
            times.add(&std::mem::take(&mut member.watch.times));
        }
        times
    }

    /// Floating-point operations per image of each layer's passes, in the order of [`LAYERS`] and
    /// [`Pass::ALL`]. The first layer has no backward pass: pixels need no gradient.
    pub fn operations(&self) -> [[f64; 3]; 10] {
        let mut operations = self.network.operations().map(|pass| [pass; 3]);
        operations[0][Pass::Backward as usize] = 0.0;
        operations
    }
}

fn metrics(objective: &LossParts) -> VaeMetrics {
    VaeMetrics {
        loss: objective.loss,
        pixel_error: objective.error / IMAGE_PIXELS as f32,
        divergence: objective.divergence,
    }
}

#[cfg(test)]
impl NativeVae {
    /// Sets the first number of a tensor to `value`.
    pub(super) fn spoil(&mut self, tensor: &str, value: f32) {
        let place = self.order.tensor(tensor).start;
        self.parameters[place] = value;
        self.packed = false;
    }

    /// Returns [loss, squared error, divergence], and the whole gradient in PyTorch's order.
    /// `noise`: standard normal, `[n, latent]`.
    pub(super) fn loss_and_gradient(
        &mut self,
        images: &[u8],
        noise: &[f32],
    ) -> ([f32; 3], Vec<f32>) {
        self.noise = noise.to_vec();
        let LossParts {
            loss,
            error,
            divergence,
            ..
        } = self.objective(images, Targets::default());
        let (mut whole, place) = (
            self.gradient.to_vec(),
            self.network.unfold.place.weight.clone(),
        );
        let [first, second] = &mut self.moments;
        let blocks = self
            .network
            .unfold
            .blocks(&mut self.parameters, [first, second]);
        let len = place.len() / blocks.len();
        for (block, into) in blocks.iter().zip(whole[place].chunks_exact_mut(len)) {
            let scratch = &mut self.members[0].unfold;
            into.copy_from_slice(block.gradient(self.isa, &self.batch.unfolded, scratch));
        }
        let mut gradient = vec![0.0; whole.len()];
        self.order.to_pytorch(&whole, &mut gradient);
        ([loss, error, divergence], gradient)
    }
}

impl Stateful for NativeVae {
    fn parts(&mut self) -> Vec<(String, StatePart<'_>)> {
        // The caller may change the parameters.
        self.packed = false;
        let [first, second] = &mut self.moments;
        // Names differ from the other engine's, because the numbers are in another order.
        let parts = [
            ("parameters", StatePart::Numbers(&mut self.parameters)),
            ("adam.first_moment", StatePart::Numbers(first)),
            ("adam.second_moment", StatePart::Numbers(second)),
            ("adam.steps", StatePart::Count(&mut self.steps)),
        ];
        let named = |(name, part)| (format!("vae.native.{name}"), part);
        let head = self.geometry.iter_mut().flat_map(GeometryHead::parts);
        parts.into_iter().map(named).chain(head).collect()
    }
}
