//! Depth images that a run's decoder makes of latent codes.

use std::fs;
use std::path::PathBuf;
use std::time::SystemTime;

use anyhow::{Context, bail};
use skein_inference::Decoder;
use skein_kernels::Isa;
use skein_protocol::decoder_file::TrainedDecoder;
use skein_run::RunDirectory;

use crate::catalogue::Catalogue;

/// Most steps of an episode that are reconstructed, 10 ms each: more than any run's.
const MOST_CODES: usize = 1024;

/// Decoder of a run.
#[derive(Debug)]
pub(crate) struct RunDecoder {
    /// Its file, and when that was written.
    source: (PathBuf, SystemTime),
    decoder: Decoder,
    latent: usize,
}

impl RunDecoder {
    /// Returns `kept` if `run` still has that one, or the decoder that it has now.
    ///
    /// # Errors
    /// Says that the run has no decoder, or names the file that cannot be read.
    pub(crate) fn newest(
        kept: Option<Self>,
        catalogue: &Catalogue,
        run: &RunDirectory,
    ) -> anyhow::Result<Self> {
        if !run.decoder().exists() {
            bail!(
                "no reconstruction: the run has no decoder (yet): a plain VAE writes one with \
                 each checkpoint, and an encoder from a file brings its own"
            );
        }
        let file = catalogue.inside(&run.decoder())?;
        let written = fs::metadata(&file).and_then(|about| about.modified());
        let written = written.with_context(|| file.display().to_string())?;
        let source = (file, written);
        if let Some(kept) = kept.filter(|kept| kept.source == source) {
            return Ok(kept);
        }
        let trained = TrainedDecoder::load(&source.0)?;
        Ok(Self {
            source,
            decoder: Decoder::new(Isa::best(), &trained),
            latent: trained.latent,
        })
    }

    /// Returns the depth images that the codes stand for, `[codes, 72, 128]`.
    ///
    /// # Errors
    /// If there are too many codes, or one has another length than the run's.
    pub(crate) fn decode(&self, codes: &[Vec<f32>]) -> anyhow::Result<Vec<u8>> {
        if codes.len() > MOST_CODES {
            bail!("no reconstruction: the episode has more than {MOST_CODES} steps");
        }
        if let Some(other) = codes.iter().find(|code| code.len() != self.latent) {
            let (found, expected) = (other.len(), self.latent);
            bail!("the recording's codes have {found} numbers, the run's {expected}");
        }
        Ok(codes
            .iter()
            .flat_map(|code| self.decoder.decode(code))
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use skein_protocol::IMAGE_PIXELS;

    use super::*;

    #[test]
    fn a_run_without_a_decoder_says_so_and_damage_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path().join("run"));
        std::fs::create_dir_all(run.root()).unwrap();
        let catalogue = Catalogue::open(folder.path()).unwrap();
        let newest = |kept| RunDecoder::newest(kept, &catalogue, &run);
        let error = newest(None).unwrap_err().to_string();
        assert!(error.contains("no decoder"), "{error}");
        std::fs::write(run.decoder(), [0xff; 64]).unwrap();
        let error = format!("{:#}", newest(None).unwrap_err());
        assert!(error.contains("decoder.safetensors"), "{error}");

        let latent = 3;
        let trained = TrainedDecoder {
            values: vec![0.0; TrainedDecoder::tensors(latent).last().unwrap().range.end],
            latent,
            encoder_sha256: String::new(),
        };
        std::fs::write(run.decoder(), trained.to_file()).unwrap();
        let decoder = newest(Some(newest(None).unwrap())).unwrap();
        let image = decoder.decode(&[vec![0.0; latent]]).unwrap();
        assert_eq!(image, vec![128; IMAGE_PIXELS], "the middle of the scale");
        assert!(decoder.decode(&[vec![0.0; 4]]).is_err());
        assert!(
            decoder
                .decode(&vec![vec![0.0; latent]; MOST_CODES + 1])
                .is_err()
        );
    }
}
