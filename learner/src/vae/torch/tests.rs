//! The whole step: exactness, determinism, and that it learns.

use skein_protocol::config::{DecoderName, Observation, ObservationLayout};
use skein_protocol::snapshot::SnapshotLayout;

use super::*;
use crate::vae::tests::synthetic_bytes;

fn synthetic_images(count: usize, seed: u64) -> Tensor {
    images_from_bytes(&synthetic_bytes(count, seed))
}

fn vae(seed: u64) -> TorchVae {
    crate::device::use_threads(1);
    TorchVae::new(&VaeSection::default(), seed, Device::Cpu)
}

fn bits(tensor: &Tensor) -> Vec<f32> {
    Vec::try_from(tensor.reshape([-1])).unwrap()
}

#[test]
fn squared_error_is_summed_over_pixels_and_averaged_over_images() {
    let seen = Tensor::from_slice(&[0.0_f32, 1.0, 0.5, 0.5]).view([2, 1, 1, 2]);
    let reconstructed = Tensor::from_slice(&[0.5_f32, 0.5, 0.5, 1.0]).view([2, 1, 1, 2]);
    // ((0.25 + 0.25) + (0 + 0.25)) / 2
    assert_eq!(
        squared_error(&reconstructed, &seen).double_value(&[]),
        0.375
    );
}

#[test]
fn divergence_matches_hand_calculation() {
    let mean = Tensor::from_slice(&[1.0_f32, 0.0, 0.0, 0.0]).view([2, 2]);
    let log_variance = Tensor::from_slice(&[0.0_f32, 2.0_f32.ln(), 0.0, 0.0]).view([2, 2]);
    // ½ (1 + (2 - ln 2 - 1)) for the first code, 0 for the second, which is the prior.
    let expected = 0.5 * (1.0 + 1.0 - std::f64::consts::LN_2) / 2.0;
    let found = divergence(&mean, &log_variance).double_value(&[]);
    assert!((found - expected).abs() < 1e-6, "{found} is not {expected}");
}

#[test]
fn the_published_part_is_the_snapshots_encoder() {
    let vae = vae(1);
    let layout = SnapshotLayout::new(&ObservationLayout::present(Observation::Latent, 32), 8);
    assert_eq!(layout.encoder(), 0..vae.published_len());
    let mut start = 0;
    for (ours, snapshots) in vae
        .parameters
        .layout()
        .tensors()
        .iter()
        .zip(layout.tensors())
    {
        if start == vae.published_len() {
            break;
        }
        let shape: Vec<usize> = ours.shape.iter().map(|&size| size as usize).collect();
        assert_eq!((&ours.name, &shape), (&snapshots.name, &snapshots.shape));
        assert_eq!(start..start + ours.len(), snapshots.range);
        start += ours.len();
    }
    assert_eq!(start, vae.published_len());
    let mut published = vec![0.0; vae.published_len()];
    vae.publish(&mut published);
    assert_eq!(published, bits(vae.parameters.flat())[..start]);
}

#[test]
fn the_decoder_gives_images_of_the_cameras_size() {
    let vae = vae(1);
    assert_eq!(
        vae.reconstruct(&synthetic_images(2, 1)).size(),
        [2, 72, 128]
    );
    assert_eq!(vae.encode(&images_from_bytes(&[])).size(), [0, 32]);
}

#[test]
fn images_are_encoded_alike_in_one_chunk_and_in_several() {
    let (vae, images) = (vae(1), synthetic_images(CHUNK as usize + 3, 1));
    let together = vae.encode(&images);
    assert_eq!(together.size(), [CHUNK + 3, 32]);
    let apart = vae.encode(&images.narrow(0, CHUNK, 3));
    assert!(
        together
            .narrow(0, CHUNK, 3)
            .allclose(&apart, 1e-4, 1e-5, false)
    );
}

#[test]
fn gradient_matches_finite_differences() {
    let mut vae = vae(1);
    vae.parameters = vae.parameters.to_double();
    let pixels = pixels(&synthetic_images(1, 1)).to_kind(Kind::Double);
    let code_noise = Noise::new(2).normal(&[1, 32], Device::Cpu);
    let loss = |vae: &TorchVae| vae.objective(&pixels, &code_noise).loss;
    let gradient = vae.parameters.gradient(&loss(&vae));

    // Along its own gradient, the loss rises by the gradient's norm. A tensor out of place in the
    // flat vector would show.
    let _guard = no_grad_guard();
    let mut start = 0;
    for tensor in vae.parameters.layout().clone().tensors() {
        let len = tensor.len() as i64;
        let direction = gradient.narrow(0, start, len);
        let slope = direction.norm().double_value(&[]);
        let mut loss_after_moving = |distance: f64| {
            let _ = vae
                .parameters
                .flat_mut()
                .narrow(0, start, len)
                .g_add_(&(&direction * (distance / slope)));
            loss(&vae).double_value(&[])
        };
        let (ahead, behind) = (loss_after_moving(1e-5), loss_after_moving(-2e-5));
        loss_after_moving(1e-5);
        let measured = (ahead - behind) / 2e-5;
        assert!(
            (measured - slope).abs() < 1e-3 * slope,
            "{}: {measured} is not {slope}",
            tensor.name
        );
        start += len;
    }
}

#[test]
fn a_vae_learns_to_reproduce_images_it_was_not_trained_on() {
    let mut vae = vae(3);
    let (seen, unseen) = (synthetic_images(64, 1), synthetic_images(16, 2));
    let code_noise = Noise::new(5).normal(&[16, 32], Device::Cpu);
    let error = |vae: &TorchVae| {
        let _guard = no_grad_guard();
        vae.objective(&pixels(&unseen), &code_noise)
            .error
            .double_value(&[])
            / IMAGE_PIXELS as f64
    };
    let untrained = error(&vae);
    let mut noise = Noise::new(4);
    for step in 0..24 {
        let metrics = vae
            .update(&seen.narrow(0, step % 8 * 8, 8), &mut noise)
            .unwrap();
        let parts = metrics.pixel_error * IMAGE_PIXELS as f32 + metrics.divergence;
        assert!(
            (metrics.loss - parts).abs() < 0.01 * metrics.loss,
            "{metrics:?}"
        );
    }
    assert!(
        error(&vae) < 0.4 * untrained,
        "{} after training, {untrained} before",
        error(&vae)
    );
    assert_eq!(vae.updates(), 24);
}

#[test]
fn a_restored_vae_continues_bit_for_bit() {
    let images = synthetic_images(8, 1);
    let mut vae = vae(1);
    vae.update(&images, &mut Noise::new(1)).unwrap();
    let stored = vae.named_tensors();
    let expected = vae.update(&images, &mut Noise::new(2)).unwrap();

    let mut resumed = self::vae(9);
    resumed.load_named(&stored).unwrap();
    assert_eq!(
        resumed.update(&images, &mut Noise::new(2)).unwrap(),
        expected
    );
    assert_eq!(bits(resumed.parameters.flat()), bits(vae.parameters.flat()));
}

#[test]
fn a_non_finite_loss_changes_nothing() {
    let mut vae = vae(1);
    vae.kl_weight = f64::INFINITY;
    let before = vae.parameters.flat().copy();
    let error = vae
        .update(&synthetic_images(2, 1), &mut Noise::new(1))
        .unwrap_err();
    assert_eq!(
        error,
        UpdateError::NonFinite {
            tensor: "vae loss",
            update: 1
        }
    );
    assert_eq!((vae.parameters.flat(), vae.updates()), (&before, 0));
}

#[test]
fn a_u_net_reproduces_more_than_a_plain_decoder_and_publishes_an_encoder_of_equal_layout() {
    let section = VaeSection {
        decoder: DecoderName::UNet,
        ..VaeSection::default()
    };
    crate::device::use_threads(1);
    let mut u_net = TorchVae::new(&section, 3, Device::Cpu);
    let mut plain = vae(3);
    assert_eq!(u_net.published_len(), plain.published_len());
    let published = |vae: &TorchVae| {
        let mut values = vec![0.0; vae.published_len()];
        vae.publish(&mut values);
        values
    };
    assert_eq!(published(&u_net), published(&plain), "both start alike");
    let images = synthetic_images(8, 1);
    assert_eq!(u_net.reconstruct(&images).size(), [8, 72, 128]);
    let mut noise = [Noise::new(4), Noise::new(4)];
    let mut errors = [0.0; 2];
    for _ in 0..24 {
        for ((vae, noise), error) in [&mut u_net, &mut plain]
            .into_iter()
            .zip(&mut noise)
            .zip(&mut errors)
        {
            *error = vae.update(&images, noise).unwrap().pixel_error;
        }
    }
    println!("pixel errors {errors:?}");
    assert!(errors[0] < errors[1], "{errors:?}");
    assert_ne!(published(&u_net), published(&plain));
}

#[test]
fn a_u_nets_decoder_sees_the_middle_of_every_map() {
    crate::device::use_threads(1);
    let section = VaeSection {
        decoder: DecoderName::UNet,
        ..VaeSection::default()
    };
    let sees = |section: &VaeSection| {
        let vae = TorchVae::new(section, 1, Device::Cpu);
        let _guard = no_grad_guard();
        let encoded = vae
            .encoder
            .encode(&vae.parameters, &pixels(&synthetic_images(1, 1)));
        let reconstruct =
            |maps: &[Tensor; 3]| vae.decoder.forward(&vae.parameters, &encoded.mean, maps);
        let whole = reconstruct(&encoded.maps);
        std::array::from_fn::<_, 3, _>(|changed| {
            let maps =
                std::array::from_fn(|map| &encoded.maps[map] + f64::from(u8::from(map == changed)));
            reconstruct(&maps) != whole
        })
    };
    assert_eq!(sees(&section), [true; 3]);
    assert_eq!(sees(&VaeSection::default()), [false; 3]);
}
