//! A VAE's decoder on disk: what makes depth images of latent codes again, for people to look at.
//!
//! The file is safetensors, in half precision, because its 5 million numbers are bytes of an image
//! in the end.

use std::collections::HashMap;
use std::path::Path;

use half::f16;
use half::slice::HalfFloatSliceExt;
use safetensors::Dtype;

use crate::MAX_LATENT;
use crate::files::{self, TENSOR_BYTES};
use crate::snapshot::{
    CHECKSUM_KEY, FORMAT_KEY, ParameterFile, SnapshotError, TensorSpec, checksum, write_tensors,
};

const FORMAT: &str = "decoder-1";
/// Metadata key of the length of the latent code.
const LATENT_KEY: &str = "skein.latent";
/// Metadata key of the SHA-256 of the encoder that it was trained with.
const ENCODER_KEY: &str = "skein.encoder_sha256";

/// Name of the file, in the directory of a run and beside a snapshot or an encoder.
pub const DECODER_FILE: &str = "decoder.safetensors";
/// Feature maps of the decoder, `[channels, height, width]`; the last one is the depth image.
pub const DECODER_MAPS: [[usize; 3]; 5] = [
    [1024, 1, 3],
    [128, 5, 11],
    [64, 14, 28],
    [32, 33, 62],
    [1, 72, 128],
];
/// Kernels between these maps, `[height, width]`; stride 2.
pub const DECODER_KERNELS: [[usize; 2]; 4] = [[5, 7], [6, 8], [7, 8], [8, 6]];

/// The parameters of a plain decoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainedDecoder {
    /// In the order and shapes of [`TrainedDecoder::tensors`].
    pub values: Vec<f32>,
    /// Length of the latent code.
    pub latent: usize,
    /// SHA-256 of the encoder whose codes it decodes,
    /// [`TrainedEncoder::sha256`](crate::encoder_file::TrainedEncoder::sha256).
    pub encoder_sha256: String,
}

impl TrainedDecoder {
    /// Returns the tensors of a decoder of codes of `latent` numbers, back to back, in PyTorch's
    /// shapes.
    pub fn tensors(latent: usize) -> Vec<TensorSpec> {
        let [channels, height, width] = DECODER_MAPS[0];
        let unfolded = channels * height * width;
        let mut shapes = vec![
            ("linear.weight".to_owned(), vec![unfolded, latent]),
            ("linear.bias".to_owned(), vec![unfolded]),
        ];
        for (layer, [height, width]) in DECODER_KERNELS.into_iter().enumerate() {
            let (inputs, outputs) = (DECODER_MAPS[layer][0], DECODER_MAPS[layer + 1][0]);
            let name = format!("conv{}", layer + 1);
            let kernels = vec![inputs, outputs, height, width];
            shapes.push((format!("{name}.weight"), kernels));
            shapes.push((format!("{name}.bias"), vec![outputs]));
        }
        let mut first = 0;
        let spec = |(name, shape): (String, Vec<usize>)| {
            let range = first..first + shape.iter().product::<usize>();
            first = range.end;
            let name = format!("decoder.{name}");
            TensorSpec { name, shape, range }
        };
        shapes.into_iter().map(spec).collect()
    }

    /// Reads a decoder's file.
    ///
    /// # Errors
    /// [`SnapshotError`] names the file and the problem.
    pub fn load(path: &Path) -> Result<Self, SnapshotError> {
        let bytes = files::read(path, TENSOR_BYTES).map_err(|source| SnapshotError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&bytes).map_err(|problem| SnapshotError::Format {
            path: path.to_owned(),
            problem,
        })
    }

    /// Reads the decoder's file `path`, if it is there and decodes the codes of the encoder with
    /// this SHA-256.
    ///
    /// # Errors
    /// As [`TrainedDecoder::load`], of a file that is there.
    pub fn of(encoder_sha256: &str, path: &Path) -> Result<Option<Self>, SnapshotError> {
        if !path.exists() {
            return Ok(None);
        }
        let decoder = Self::load(path)?;
        Ok((decoder.encoder_sha256 == encoder_sha256).then_some(decoder))
    }

    /// Reads a decoder from the bytes of its file.
    ///
    /// # Errors
    /// The problem alone.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let file = ParameterFile::parse(bytes)?;
        let format = file.text(FORMAT_KEY)?;
        if format != FORMAT {
            return Err(format!("its format is {format}, not {FORMAT}"));
        }
        let (latent, encoder_sha256) = (file.text(LATENT_KEY)?, file.text(ENCODER_KEY)?);
        let number = latent.parse().ok();
        let number = number.filter(|latent| (1..=MAX_LATENT).contains(latent));
        let number = number.ok_or_else(|| format!("its {LATENT_KEY} is {latent}"))?;
        let values = file.values(&Self::tensors(number), Dtype::F16)?;
        file.check(&[latent, encoder_sha256], &values)?;
        Ok(Self {
            values,
            latent: number,
            encoder_sha256: encoder_sha256.to_owned(),
        })
    }

    /// Returns the decoder as a safetensors file, its values rounded to half precision.
    ///
    /// # Panics
    /// If the number of values is not that of [`TrainedDecoder::tensors`].
    pub fn to_file(&self) -> Vec<u8> {
        let halves: Vec<f16> = self
            .values
            .iter()
            .map(|&value| f16::from_f32(value))
            .collect();
        let latent = self.latent.to_string();
        let digest = checksum(&[&latent, &self.encoder_sha256], &halves.to_f32_vec());
        let metadata = HashMap::from([
            (FORMAT_KEY.to_owned(), FORMAT.to_owned()),
            (CHECKSUM_KEY.to_owned(), digest),
            (LATENT_KEY.to_owned(), latent),
            (ENCODER_KEY.to_owned(), self.encoder_sha256.clone()),
        ]);
        write_tensors(&Self::tensors(self.latent), &halves, Dtype::F16, metadata)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoder() -> TrainedDecoder {
        let len = TrainedDecoder::tensors(2).last().unwrap().range.end;
        TrainedDecoder {
            values: (0..len).map(|index| (index % 512) as f32 / 256.0).collect(),
            latent: 2,
            encoder_sha256: "ab12".to_owned(),
        }
    }

    #[test]
    fn a_decoder_is_read_as_it_was_written_and_only_for_its_encoder() {
        let folder = tempfile::tempdir().unwrap();
        let (path, written) = (folder.path().join(DECODER_FILE), decoder());
        assert_eq!(TrainedDecoder::of("ab12", &path).unwrap(), None);
        std::fs::write(&path, written.to_file()).unwrap();
        assert_eq!(TrainedDecoder::of("ab12", &path).unwrap(), Some(written));
        assert_eq!(TrainedDecoder::of("cd34", &path).unwrap(), None);
    }

    #[test]
    fn a_damaged_or_foreign_file_is_refused_by_name() {
        let sound = decoder().to_file();
        let header = 8 + u64::from_le_bytes(*sound.first_chunk().unwrap()) as usize;
        let parameters = (header..sound.len()).step_by((sound.len() - header) / 20);
        for index in (0..header).step_by(7).chain(parameters) {
            let mut damaged = sound.clone();
            damaged[index] ^= 1 << (index % 8);
            assert!(TrainedDecoder::parse(&damaged).is_err(), "byte {index}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(DECODER_FILE);
        std::fs::write(&path, &sound[..header]).unwrap();
        let error = TrainedDecoder::of("ab12", &path).unwrap_err();
        assert!(error.to_string().contains(DECODER_FILE), "{error}");
    }
}
