//! Depth images that a run's decoder makes of latent codes. The decoder comes out of the newest
//! checkpoint: no actor needs it, so no snapshot has it.

use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use safetensors::Dtype;
use safetensors::tensor::Metadata;
use skein_inference::Decoder;
use skein_kernels::Isa;
use skein_protocol::MAX_LATENT;
use skein_protocol::config::Engine;
use skein_protocol::files::{self, TENSOR_BYTES};
use skein_run::RunDirectory;

use crate::catalogue::Catalogue;
use crate::settings;

/// Most steps of an episode that are reconstructed, 10 ms each: more than any run's.
const MOST_CODES: usize = 1024;
/// Most bytes of the header of a checkpoint's file.
const MOST_HEADER: u64 = 1 << 20;
/// Engines, by the name of the VAE's parameters in a checkpoint.
const ENGINES: [(&str, Engine); 2] = [
    ("vae.native.parameters", Engine::Native),
    ("vae.parameters", Engine::Libtorch),
];

/// Decoder of a run's checkpoint.
#[derive(Debug)]
pub(crate) struct RunDecoder {
    checkpoint: PathBuf,
    decoder: Decoder,
    latent: usize,
}

impl RunDecoder {
    /// Returns `kept` if it is still of the newest checkpoint of `run`, or the decoder of that one.
    ///
    /// # Errors
    /// Says why the run has no decoder, or names the file that cannot be read.
    pub(crate) fn newest(
        kept: Option<Self>,
        catalogue: &Catalogue,
        run: &RunDirectory,
    ) -> anyhow::Result<Self> {
        let episodes = run
            .newest_checkpoint()
            .context("no reconstruction: the run has no checkpoint yet")?;
        let file = format!("episode-{episodes}/tensors.safetensors");
        let checkpoint = catalogue
            .inside(&run.checkpoints().join(file))
            .context("the newest checkpoint cannot be read")?;
        match kept {
            Some(kept) if kept.checkpoint == checkpoint => Ok(kept),
            _ => Self::load(checkpoint, &catalogue.read_text(&run.config())?),
        }
    }

    fn load(checkpoint: PathBuf, config: &str) -> anyhow::Result<Self> {
        // Not as a configuration: another version of Skein may have other keys.
        let settings = settings::flat(config)?;
        if settings.contains_key("vae.start_from") {
            bail!("no reconstruction: the run's encoder was trained before it, without a decoder");
        }
        let decoder = settings
            .get("vae.decoder")
            .map_or("\"plain\"", String::as_str);
        if decoder != "\"plain\"" {
            bail!("no reconstruction: the decoder {decoder} needs more than the latent code");
        }
        let latent = settings.get("vae.latent");
        let latent = latent
            .and_then(|latent| latent.parse().ok())
            .filter(|&latent| (1..=MAX_LATENT).contains(&latent))
            .context("no reconstruction: config.toml has no valid vae.latent")?;
        let decoder = read(&checkpoint, latent)
            .with_context(|| format!("no decoder in {}", checkpoint.display()))?;
        Ok(Self {
            checkpoint,
            decoder,
            latent,
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

fn read(checkpoint: &Path, latent: usize) -> anyhow::Result<Decoder> {
    let mut file = files::open(checkpoint, TENSOR_BYTES)?.into_inner();
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let length = u64::from_le_bytes(length);
    if length > MOST_HEADER {
        bail!("its header is too long");
    }
    let mut header = vec![0; 8 + length as usize];
    file.rewind()?;
    file.read_exact(&mut header)?;
    // Not SafeTensors::read_metadata, which wants the whole file: with Adam's moments, 70 MB.
    let metadata: Metadata = serde_json::from_slice(&header[8..])?;
    let tensors = metadata.tensors();
    let found = ENGINES
        .into_iter()
        .find_map(|(name, engine)| Some((engine, *tensors.get(name)?)));
    let (engine, about) = found.context("it holds no VAE")?;
    let sizes = Decoder::tensors(latent);
    let numbers: usize = sizes.iter().map(|(_, len)| len).sum();
    let (begin, end) = about.data_offsets;
    // The decoder's parameters follow the encoder's.
    let first = end.checked_sub(4 * numbers);
    let first = first.filter(|&first| about.dtype == Dtype::F32 && begin <= first);
    let place = first.and_then(|first| first.checked_add(header.len()));
    let place = place.context("its VAE has another shape")?;
    file.seek(SeekFrom::Start(place as u64))?;
    let mut bytes = vec![0; 4 * numbers];
    file.read_exact(&mut bytes)?;
    let values: Vec<f32> = bytes
        .as_chunks::<4>()
        .0
        .iter()
        .map(|&bytes| f32::from_le_bytes(bytes))
        .collect();
    drop(bytes);
    let mut rest = values.as_slice();
    let mut arranged = Vec::new();
    for (tensor, len) in sizes {
        let (values, after) = rest.split_at(len);
        arranged.push((tensor, in_decoders_order(engine, tensor, values)));
        rest = after;
    }
    let tensor = |wanted: &str| {
        let found = arranged.iter().find(|(tensor, _)| *tensor == wanted);
        found.map_or(&[][..], |(_, values)| values.as_slice())
    };
    Ok(Decoder::new(Isa::best(), tensor))
}

/// Brings a tensor of a checkpoint into the order of [`Decoder::new`].
fn in_decoders_order(engine: Engine, tensor: &str, values: &[f32]) -> Vec<f32> {
    let len = values.len();
    match (engine, tensor) {
        (Engine::Native, "decoder.conv1.weight") => {
            permuted(values, [5, 1024, 7, 128], [1, 0, 2, 3])
        }
        (Engine::Native, _) => values.to_vec(),
        (Engine::Libtorch, "decoder.linear.weight" | "decoder.linear.bias") => {
            permuted(values, [1024, 3, len / 3072, 1], [1, 0, 2, 3])
        }
        (Engine::Libtorch, "decoder.conv1.weight") => {
            permuted(values, [1024, 128, 5, 7], [0, 2, 3, 1])
        }
        (Engine::Libtorch, "decoder.conv2.weight") => {
            permuted(values, [128, 64, 6, 8], [0, 2, 3, 1])
        }
        (Engine::Libtorch, "decoder.conv3.weight") => {
            permuted(values, [64, 32, 7, 8], [0, 2, 3, 1])
        }
        (Engine::Libtorch, _) => values.to_vec(),
    }
}

/// Returns a tensor of shape `sizes` with its axes in another order.
fn permuted(values: &[f32], sizes: [usize; 4], axes: [usize; 4]) -> Vec<f32> {
    let strides = [
        sizes[1] * sizes[2] * sizes[3],
        sizes[2] * sizes[3],
        sizes[3],
        1,
    ];
    let [a, b, c, d] = axes.map(|axis| (sizes[axis], strides[axis]));
    let mut arranged = Vec::with_capacity(values.len());
    for i in 0..a.0 {
        for j in 0..b.0 {
            for k in 0..c.0 {
                let first = i * a.1 + j * b.1 + k * c.1;
                arranged.extend((0..d.0).map(|l| values[first + l * d.1]));
            }
        }
    }
    arranged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_put_into_another_order() {
        let values: Vec<f32> = (0..6).map(|number| number as f32).collect();
        let turned = permuted(&values, [2, 3, 1, 1], [1, 0, 2, 3]);
        assert_eq!(turned, [0.0, 3.0, 1.0, 4.0, 2.0, 5.0]);
        assert_eq!(permuted(&values, [1, 2, 3, 1], [0, 1, 2, 3]), values);
    }

    #[test]
    fn a_run_without_a_decoder_says_why_and_damage_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path().join("run"));
        std::fs::create_dir_all(run.checkpoints().join("episode-7")).unwrap();
        let newest = |text: &str| {
            std::fs::write(run.config(), text).unwrap();
            let catalogue = Catalogue::open(folder.path()).unwrap();
            let error = RunDecoder::newest(None, &catalogue, &run).unwrap_err();
            format!("{error:#}")
        };
        assert!(newest("").contains("cannot be read"));
        let plain = "[vae]\nlatent = 32\n";
        let file = run.checkpoints().join("episode-7/tensors.safetensors");
        std::fs::write(&file, [0xff; 64]).unwrap();
        assert!(newest("").contains("vae.latent"));
        assert!(newest(plain).contains("no decoder in"));
        std::fs::write(&file, [&9u64.to_le_bytes()[..], b"{\"a\": 1}}"].concat()).unwrap();
        assert!(newest(plain).contains("no decoder in"));
        // Offsets beyond the file, and in the wrong order.
        for offsets in ["[0, 18446744073709551615]", "[99999999, 3]"] {
            let tensor = format!("{{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":{offsets}}}");
            let header = format!("{{\"vae.parameters\":{tensor}}}");
            let length = (header.len() as u64).to_le_bytes();
            std::fs::write(&file, [&length[..], header.as_bytes()].concat()).unwrap();
            assert!(newest(plain).contains("no decoder in"));
        }
        let frozen = newest("[vae]\nstart_from = \"encoder.safetensors\"\n");
        assert!(frozen.contains("trained before it"), "{frozen}");
        std::fs::remove_dir_all(run.checkpoints()).unwrap();
        assert!(newest("").contains("no checkpoint yet"));
    }
}
