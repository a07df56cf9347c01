//! The native engine against libtorch's automatic gradients, and against itself with other
//! instructions and threads.

use skein_kernels::Isa;
use skein_protocol::IMAGE_PIXELS;
use skein_protocol::config::DecoderName;

use super::*;

/// Depth images of one wall each, with a square opening at a random place. They have only two
/// depths, near and far.
pub(super) fn synthetic_bytes(count: usize, seed: u64) -> Vec<u8> {
    const WIDTH: usize = skein_protocol::IMAGE_WIDTH;
    let mut noise = Noise::new(seed);
    let mut bytes = vec![60; count * IMAGE_PIXELS];
    for image in bytes.chunks_exact_mut(IMAGE_PIXELS) {
        let (top, left) = (26.0 + noise.uniform(20.0), 54.0 + noise.uniform(40.0));
        for row in top as usize..top as usize + 20 {
            image[row * WIDTH..][left as usize..left as usize + 20].fill(220);
        }
    }
    bytes
}

/// Default length of the latent code.
const LATENT: usize = 32;

fn with_latent(latent: usize) -> VaeSection {
    VaeSection {
        latent,
        ..VaeSection::default()
    }
}

/// Returns both engines, for codes of `latent` numbers.
fn both(latent: usize, seed: u64) -> (NativeVae, TorchVae) {
    crate::device::use_threads(1);
    let section = with_latent(latent);
    (
        NativeVae::new(&section, seed, 2),
        TorchVae::new(&section, seed, Device::Cpu),
    )
}

fn native(seed: u64) -> NativeVae {
    NativeVae::new(&with_latent(LATENT), seed, 2)
}

fn torch(seed: u64) -> TorchVae {
    both(LATENT, seed).1
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

fn flat(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.reshape([-1])).unwrap()
}

/// Distance of two vectors, relative to the length of `expected`.
fn relative_distance(found: &[f32], expected: &[f32]) -> f64 {
    let length = |values: &mut dyn Iterator<Item = f64>| {
        values.map(|value| value * value).sum::<f64>().sqrt()
    };
    let difference = found.iter().zip(expected);
    let difference = length(&mut difference.map(|(a, b)| f64::from(*a) - f64::from(*b)));
    difference / length(&mut expected.iter().map(|value| f64::from(*value)))
}

fn state(vae: &mut NativeVae) -> Vec<crate::state::NamedTensor> {
    vae.named_tensors()
}

#[test]
fn losses_and_every_gradient_are_those_of_automatic_differentiation_in_double_precision() {
    // Seeds for which no sum is so near zero that rounding changes its sign: a ReLU would then be
    // open in one engine and shut in the other.
    for (seed, count, latent) in [
        (1, 1, 32),
        (2, 3, 32),
        (4, 16, 32),
        (5, 16, 32),
        (1, 3, 8),
        (2, 3, 16),
        (1, 3, 64),
    ] {
        let images = synthetic_bytes(count, seed);
        let mut noise = vec![0.0; count * latent];
        Noise::new(seed).fill_normal(&mut noise);
        let (mut native, torch) = both(latent, seed);
        let (found, gradient) = native.loss_and_gradient(&images, &noise);

        let reference = torch.in_double();
        let (expected, expected_gradient) =
            reference.loss_and_gradient(&images_from_bytes(&images), &noise);
        for (found, expected) in found.iter().zip(expected) {
            // A divergence near zero is a sum of differences of numbers near one.
            let error = (f64::from(*found) - expected).abs() / (1.0 + expected);
            assert!(error < 1e-6, "{found} is not {expected}: off by {error}");
        }
        let mut start = 0;
        for tensor in reference.layout().tensors() {
            let range = start..start + tensor.len();
            let error = relative_distance(&gradient[range.clone()], &expected_gradient[range]);
            assert!(
                error < 5e-6,
                "{} of {count} images, {latent} numbers, is off by {error}",
                tensor.name
            );
            start += tensor.len();
        }
        assert_eq!(start, gradient.len());
    }
}

#[test]
fn both_engines_start_with_the_same_numbers() {
    for (seed, latent) in [(1, 32), (2, 8), (3, 64)] {
        let (native, torch) = both(latent, seed);
        assert_eq!(native.published_len(), torch.published_len());
        let [mut ours, mut theirs] = [0; 2].map(|_| vec![f32::NAN; native.published_len()]);
        native.publish(&mut ours);
        torch.publish(&mut theirs);
        assert_eq!(bits(&ours), bits(&theirs));
    }
}

#[test]
fn both_engines_encode_and_reconstruct_alike() {
    let images = synthetic_bytes(35, 4);
    for latent in [8, 32, 64] {
        let (mut native, torch) = both(latent, 5);
        let codes = native.encode(&images);
        assert_eq!(codes.len(), 35 * latent);
        let expected = flat(&torch.encode(&images_from_bytes(&images)));
        assert!(relative_distance(&codes, &expected) < 2e-6);
        let seen = native.reconstruct(&images);
        let expected = flat(&torch.reconstruct(&images_from_bytes(&images)));
        assert_eq!(seen.len(), expected.len());
        for (seen, expected) in seen.iter().zip(&expected) {
            assert!((seen - expected).abs() < 1e-6, "{seen} is not {expected}");
        }
        assert!(native.encode(&[]).is_empty() && native.reconstruct(&[]).is_empty());
    }
}

#[test]
fn twenty_steps_of_both_engines_lead_to_the_same_place() {
    let images = synthetic_bytes(16, 6);
    let (mut native, mut torch) = (native(7), torch(7));
    let [mut ours, mut theirs] = [0; 2].map(|_| Noise::new(8));
    for step in 0..20 {
        let batch = &images[step % 2 * 8 * IMAGE_PIXELS..][..8 * IMAGE_PIXELS];
        let found = native.update(batch, &mut ours).unwrap();
        let expected = torch
            .update(&images_from_bytes(batch), &mut theirs)
            .unwrap();
        let error = (found.loss - expected.loss).abs() / expected.loss;
        assert!(error < 1e-3, "step {step}: {found:?} is not {expected:?}");
    }
    let seen = native.reconstruct(&images);
    let expected = flat(&torch.reconstruct(&images_from_bytes(&images)));
    let distance = relative_distance(&seen, &expected);
    assert!(distance < 1e-3, "reconstructions differ by {distance}");
}

#[test]
fn neither_threads_nor_instructions_change_a_bit() {
    let images = synthetic_bytes(2, 9);
    let run = |latent: usize, isa: Isa, threads: usize| {
        let mut vae = NativeVae::with_isa(&with_latent(latent), 1, threads, isa);
        let metrics = [1, 2].map(|seed| vae.update(&images, &mut Noise::new(seed)).unwrap());
        (
            metrics,
            bits(&vae.encode(&images)),
            bits(&vae.reconstruct(&images)),
            state(&mut vae),
        )
    };
    for latent in [8, 64] {
        let expected = run(latent, Isa::best(), 1);
        assert!(
            run(latent, Isa::Portable, 2) == expected,
            "{latent} numbers"
        );
    }
    let expected = run(LATENT, Isa::best(), 1);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        // Portable instructions are slow: only once, with 3 threads, of which one has no image.
        for threads in (1..4).filter(|threads| isa != Isa::Portable || *threads == 3) {
            assert!(
                run(LATENT, isa, threads) == expected,
                "{isa}, {threads} threads"
            );
        }
    }
}

#[test]
fn an_image_is_encoded_and_reconstructed_the_same_in_any_batch() {
    let (mut vae, images) = (native(1), synthetic_bytes(35, 1));
    let (codes, seen) = (vae.encode(&images), vae.reconstruct(&images));
    for index in [0, 33] {
        let alone = &images[index * IMAGE_PIXELS..][..IMAGE_PIXELS];
        assert_eq!(vae.encode(alone), codes[index * LATENT..][..LATENT]);
        assert_eq!(
            vae.reconstruct(alone),
            seen[index * IMAGE_PIXELS..][..IMAGE_PIXELS]
        );
    }
}

#[test]
fn a_restored_native_vae_continues_bit_for_bit() {
    let images = synthetic_bytes(4, 1);
    let mut vae = native(1);
    vae.update(&images, &mut Noise::new(1)).unwrap();
    let stored = state(&mut vae);
    let expected = vae.update(&images, &mut Noise::new(2)).unwrap();

    let mut resumed = native(9);
    // What it has packed must not survive the restore.
    let _ = resumed.encode(&images);
    resumed.load_named(&stored).unwrap();
    assert_eq!(resumed.updates(), 1);
    assert_eq!(
        resumed.update(&images, &mut Noise::new(2)).unwrap(),
        expected
    );
    assert!(state(&mut resumed) == state(&mut vae));
    assert_eq!(resumed.encode(&images), vae.encode(&images));
}

#[test]
fn the_state_of_one_engine_is_refused_by_the_other() {
    let mut torch = torch(1);
    assert!(torch.load_named(&state(&mut native(1))).is_err());
    assert!(native(1).load_named(&torch.named_tensors()).is_err());
}

#[test]
fn a_native_vae_learns_to_reproduce_images_it_was_not_trained_on() {
    let (seen, unseen) = (synthetic_bytes(64, 1), synthetic_bytes(16, 2));
    let mut vae = native(3);
    let mut code_noise = vec![0.0; 16 * LATENT];
    Noise::new(5).fill_normal(&mut code_noise);
    // Uses codes sampled as in training: after so few steps, the decoder has hardly seen the mean
    // itself.
    let error = |vae: &mut NativeVae| {
        vae.loss_and_gradient(&unseen, &code_noise).0[1] / IMAGE_PIXELS as f32
    };
    let untrained = error(&mut vae);
    let mut noise = Noise::new(4);
    for step in 0..24 {
        let batch = &seen[step % 8 * 8 * IMAGE_PIXELS..][..8 * IMAGE_PIXELS];
        let metrics = vae.update(batch, &mut noise).unwrap();
        let parts = metrics.pixel_error * IMAGE_PIXELS as f32 + metrics.divergence;
        assert!(
            (metrics.loss - parts).abs() < 1e-4 * metrics.loss,
            "{metrics:?}"
        );
    }
    let trained = error(&mut vae);
    assert!(
        trained < 0.4 * untrained,
        "{trained} after training, {untrained} before"
    );
    assert_eq!(vae.updates(), 24);
}

#[test]
fn a_step_that_is_not_finite_changes_nothing() {
    let images = synthetic_bytes(2, 1);
    let infinite = VaeSection {
        kl_weight: f64::INFINITY,
        ..VaeSection::default()
    };
    let mut vae = NativeVae::new(&infinite, 1, 2);
    let before = state(&mut vae);
    let refused = vae.update(&images, &mut Noise::new(1)).unwrap_err();
    let tensor = "vae loss";
    assert_eq!(refused, UpdateError::NonFinite { tensor, update: 1 });
    assert!(state(&mut vae) == before);

    // Parameters that are NaN, in different layers.
    let broken = |name: &str, value: f32| {
        let mut vae = native(1);
        vae.spoil(name, value);
        let before = state(&mut vae);
        let refused = vae.update(&images, &mut Noise::new(1)).unwrap_err();
        // NaN is not equal to itself, so the text is compared.
        let bits_of = |state: Vec<crate::state::NamedTensor>| format!("{state:?}");
        assert_eq!(bits_of(state(&mut vae)), bits_of(before), "{name}");
        refused
    };
    for name in [
        "encoder.conv1.bias",
        "decoder.conv1.weight",
        "decoder.conv4.bias",
    ] {
        let UpdateError::NonFinite { update, .. } = broken(name, f32::NAN);
        assert_eq!(update, 1, "{name}");
    }
}

#[test]
fn a_configuration_gets_its_engine() {
    let mut run = RunSection::default();
    let section = VaeSection::default();
    assert!(matches!(
        Vae::new(&section, &run, Device::Cpu),
        Vae::Native(_)
    ));
    let u_net = VaeSection {
        decoder: DecoderName::UNet,
        ..section.clone()
    };
    assert!(matches!(
        Vae::new(&u_net, &run, Device::Cpu),
        Vae::Libtorch(_)
    ));
    run.engine = Some(Engine::Libtorch);
    assert!(matches!(
        Vae::new(&section, &run, Device::Cpu),
        Vae::Libtorch(_)
    ));
}

#[test]
fn engines_agree_behind_their_common_face() {
    let images = synthetic_bytes(3, 2);
    let of = |engine| {
        let run = RunSection {
            engine: Some(engine),
            ..RunSection::default()
        };
        let mut vae = Vae::new(&VaeSection::default(), &run, Device::Cpu);
        let metrics = vae.update(&images, &mut Noise::new(1)).unwrap();
        let mut published = vec![0.0; vae.published_len()];
        vae.publish(&mut published);
        (metrics, vae.reconstruct(&images), published, vae.updates())
    };
    let (native, torch) = (of(Engine::Native), of(Engine::Libtorch));
    assert!((native.0.loss - torch.0.loss).abs() < 1e-5 * torch.0.loss);
    assert!(relative_distance(&native.1, &torch.1) < 1e-3);
    assert!(relative_distance(&native.2, &torch.2) < 1e-3);
    assert_eq!((native.3, torch.3), (1, 1));
}

fn supervised(weight: f64) -> NativeVae {
    NativeVae::supervised(&with_latent(8), 1, 1, (2, weight))
}

#[test]
fn a_supervised_encoder_tells_images_apart_from_the_start() {
    let images = synthetic_bytes(2, 2);
    let difference = |vae: &mut NativeVae| {
        let codes = vae.encode(&images);
        let (one, other) = codes.split_at(8);
        let differences = one.iter().zip(other);
        differences.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    let plain = difference(&mut NativeVae::new(&with_latent(8), 1, 1));
    let wider = difference(&mut supervised(1.0));
    assert!(wider > 10.0 * plain, "{wider}, {plain}");
}

#[test]
fn the_second_head_learns_what_images_show() {
    let images = synthetic_bytes(16, 3);
    // Place of each opening.
    const WIDTH: usize = skein_protocol::IMAGE_WIDTH;
    let known: Vec<f32> = images
        .chunks(IMAGE_PIXELS)
        .flat_map(|image| {
            let first = image.iter().position(|depth| *depth == 220).unwrap();
            [first % WIDTH, first / WIDTH].map(|pixels| pixels as f32 / 30.0 - 1.0)
        })
        .collect();
    let mut vae = supervised(100.0);
    let targets = Targets {
        clean: None,
        geometry: &known,
    };
    let mut losses = (0..60).map(|step| {
        let updated = vae.update_supervised(&images, targets, &mut Noise::new(step));
        updated.unwrap().1
    });
    let first = losses.next().unwrap();
    let last = losses.last().unwrap();
    assert!(last < 0.25 * first, "from {first} to {last}");
}

#[test]
fn a_supervised_vae_reproduces_the_clean_images() {
    let (images, clean) = (synthetic_bytes(3, 2), synthetic_bytes(3, 7));
    let known = [f32::NAN; 6];
    let after = |clean| {
        let mut vae = supervised(0.0);
        let targets = Targets {
            clean,
            geometry: &known,
        };
        let updated = vae.update_supervised(&images, targets, &mut Noise::new(1));
        (updated.unwrap().0, state(&mut vae))
    };
    let own = after(None);
    assert!(after(Some(&images)) == own);
    assert!(after(Some(&clean)).0.pixel_error != own.0.pixel_error);
}

#[test]
fn images_that_are_not_reproduced_change_nothing_but_what_the_second_head_and_divergence_ask() {
    let images = synthetic_bytes(3, 2);
    let after = |images: &[u8], reproduced: usize, kl_weight, known: f32| {
        let section = VaeSection {
            kl_weight,
            ..with_latent(8)
        };
        let mut vae = NativeVae::supervised(&section, 1, 2, (2, 1.0));
        let known = vec![known; 2 * images.len() / IMAGE_PIXELS];
        let targets = Targets {
            clean: Some(&images[..reproduced * IMAGE_PIXELS]),
            geometry: &known,
        };
        let updated = vae.update_supervised(images, targets, &mut Noise::new(1));
        let mut encoder = vec![0.0; vae.published_len()];
        vae.publish(&mut encoder);
        (updated.unwrap().0.pixel_error, bits(&encoder))
    };
    let first = &images[..IMAGE_PIXELS];
    let alone = after(first, 1, 0.0, f32::NAN);
    assert_eq!(after(&images, 1, 0.0, f32::NAN), alone);
    assert_ne!(after(&images, 2, 0.0, f32::NAN), alone);
    // The others count there.
    for (kl_weight, known) in [(1.0, f32::NAN), (0.0, 0.5)] {
        let alone = after(first, 1, kl_weight, known);
        let beside = after(&images, 1, kl_weight, known);
        assert_eq!(beside.0, alone.0);
        assert_ne!(beside.1, alone.1);
    }
}
