//! Seeded random numbers for the learner's tensors.
//!
//! libtorch's own generator has a state that cannot be stored, and other streams on other devices.
//! So every number is drawn here, on the CPU, from a seed of [`skein_protocol::seeds`], and copied
//! to its device: the same numbers everywhere.

use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use tch::{Device, Tensor};

/// A seeded stream of random numbers.
#[derive(Debug, Clone)]
pub struct Noise {
    generator: Pcg64Mcg,
}

impl Noise {
    /// Starts the stream of this seed.
    pub fn new(seed: u64) -> Self {
        Self {
            generator: Pcg64Mcg::seed_from_u64(seed),
        }
    }

    /// Draws independent standard normal numbers, f32, of this shape.
    pub fn normal(&mut self, shape: &[i64], device: Device) -> Tensor {
        let mut numbers = vec![0.0; shape.iter().product::<i64>() as usize];
        self.fill_normal(&mut numbers);
        Tensor::from_slice(&numbers).view(shape).to_device(device)
    }

    /// Draws the same numbers as [`Noise::normal`]. For an odd count, the second number of the last
    /// pair is discarded.
    pub fn fill_normal(&mut self, numbers: &mut [f32]) {
        for pair in numbers.chunks_mut(2) {
            let drawn = self.normal_pair();
            pair.copy_from_slice(&drawn[..pair.len()]);
        }
    }

    /// Draws a number uniformly from `[-bound, bound)`, by exact arithmetic: equal on every
    /// machine.
    pub fn uniform(&mut self, bound: f32) -> f32 {
        let unit = (self.generator.next_u32() >> 8) as f32 / (1 << 24) as f32;
        bound * (2.0 * unit - 1.0)
    }

    /// Draws two independent standard normal numbers (Box and Muller 1958).
    fn normal_pair(&mut self) -> [f32; 2] {
        // 53 random bits each; the first is shifted off zero, whose logarithm is infinite.
        let scale = 1.0 / (1_u64 << 53) as f64;
        let radius_unit = ((self.generator.next_u64() >> 11) + 1) as f64 * scale;
        let angle_unit = (self.generator.next_u64() >> 11) as f64 * scale;
        let radius = (-2.0 * radius_unit.ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * angle_unit).sin_cos();
        [(radius * cosine) as f32, (radius * sine) as f32]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_have_the_moments_of_a_standard_normal() {
        let numbers = Noise::new(1).normal(&[200_000], Device::Cpu);
        let moment = |power: i64| {
            numbers
                .pow_tensor_scalar(power)
                .mean(None)
                .double_value(&[])
        };
        assert!(moment(1).abs() < 0.01, "mean {}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.02, "variance {}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.1, "fourth moment {}", moment(4));
        // Both numbers of a pair share a radius; that must not correlate them.
        let pairs = numbers.view([-1, 2]);
        let product = (pairs.select(1, 0) * pairs.select(1, 1))
            .mean(None)
            .double_value(&[]);
        assert!(product.abs() < 0.01, "correlation {product}");
    }

    #[test]
    fn a_seed_names_its_numbers() {
        let draw = |seed| Vec::<f32>::try_from(Noise::new(seed).normal(&[5], Device::Cpu)).unwrap();
        assert_eq!(draw(7), draw(7));
        assert_ne!(draw(7), draw(8));
    }

    #[test]
    fn uniform_numbers_fill_their_range_and_stay_inside() {
        let mut noise = Noise::new(3);
        let numbers: Vec<f32> = (0..100_000).map(|_| noise.uniform(0.25)).collect();
        assert!(numbers.iter().all(|number| (-0.25..0.25).contains(number)));
        assert!(
            numbers.iter().any(|&number| number < -0.2499)
                && numbers.iter().any(|&number| number > 0.2499)
        );
        let mean = numbers.iter().sum::<f32>() / numbers.len() as f32;
        assert!(mean.abs() < 0.002, "mean {mean}");
    }
}
