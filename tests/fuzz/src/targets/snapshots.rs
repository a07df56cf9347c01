//! Snapshots, from a file and off the wire, and encoders. A valid one is 3 MB of parameters; inputs
//! change some of them, the header, and the length.

use std::cell::RefCell;
use std::path::Path;
use std::sync::LazyLock;

use bytemuck::{bytes_of, cast_slice};
use skein_protocol::config::Config;
use skein_protocol::decoder_file::TrainedDecoder;
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::ids::{PolicyVersion, RunId};
use skein_protocol::snapshot::{Snapshot, SnapshotHeader, SnapshotLayout};

use super::signals::pod;
use super::{ReaderDecision, Target, USUAL};
use crate::script::Script;

pub(super) const FILE: Target = Target {
    name: "snapshot_file",
    reads: "snapshot files: the safetensors header and metadata, before valid parameters",
    longest_bytes: 1 << 14,
    weight: USUAL,
    samples: || vec![SOUND.header.clone()],
    run: file,
};

pub(super) const ENCODER: Target = Target {
    name: "encoder_file",
    reads: "encoder files: the safetensors header and metadata, before valid parameters",
    longest_bytes: FILE.longest_bytes,
    weight: USUAL,
    samples: || vec![SOUND.encoder_header.clone(), SOUND.header.clone()],
    run: encoder,
};

pub(super) const DECODER: Target = Target {
    name: "decoder_file",
    reads: "decoder files: the safetensors header and metadata, before valid parameters",
    longest_bytes: FILE.longest_bytes,
    weight: USUAL / 4,
    samples: || vec![DECODER_HEADER.clone(), SOUND.header.clone()],
    run: decoder,
};

pub(super) const RECEIVED: Target = Target {
    name: "snapshot_received",
    reads: "snapshots off the wire: header, then changes to a valid one's bytes",
    longest_bytes: 256,
    weight: USUAL / 4,
    samples: received_samples,
    run: received,
};

const RUN: RunId = RunId(1);
/// Size of a number in half precision.
const HALF_BYTES: usize = 2;

/// The file of a small policy's snapshot, in two parts, and the header of its encoder's own file.
struct ValidSnapshot {
    layout: SnapshotLayout,
    snapshot: Snapshot,
    /// Header with its length before it.
    header: Vec<u8>,
    values: Vec<u8>,
    encoder_header: Vec<u8>,
}

static SOUND: LazyLock<ValidSnapshot> = LazyLock::new(|| {
    let mut config = Config::default();
    config.sac.hidden_width = 1;
    let layout = SnapshotLayout::of(&config);
    let snapshot = Snapshot {
        version: PolicyVersion(3),
        values: (0..layout.values())
            .map(|index| (index as f32).sin())
            .collect(),
    };
    let mut header = snapshot.to_file(&layout, &config);
    let values = header.split_off(header.len() - layout.values() * size_of::<f32>());
    let encoder = TrainedEncoder {
        values: snapshot.values[layout.encoder()].to_vec(),
        latent: config.vae.latent,
    };
    let mut encoder_header = encoder.to_file(&config, 7);
    encoder_header.truncate(encoder_header.len() - encoder.values.len() * size_of::<f32>());
    ValidSnapshot {
        layout,
        snapshot,
        header,
        values,
        encoder_header,
    }
});

/// The header of a decoder's file whose parameters are zero.
static DECODER_HEADER: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let parameters = TrainedDecoder::tensors(1)
        .last()
        .map_or(0, |last| last.range.end);
    let decoder = TrainedDecoder {
        values: vec![0.0; parameters],
        latent: 1,
        encoder_sha256: "0".repeat(64),
    };
    let mut header = decoder.to_file();
    header.truncate(header.len() - parameters * HALF_BYTES);
    header
});

thread_local! {
    /// Values of a valid snapshot after room for a header, so that 3 MB need not be copied per
    /// input.
    static BUFFER: RefCell<Vec<u8>> = RefCell::new(
        [vec![0; FILE.longest_bytes], SOUND.values.clone()].concat(),
    );
}

/// Parses a file. The input's first eight bytes are the length of the header; that of the valid one
/// is right if the rest has the same length.
fn file(bytes: &[u8]) -> ReaderDecision {
    BUFFER.with_borrow_mut(|buffer| {
        let start = put_header(buffer, bytes);
        let sound = [&buffer[start..], bytes].map(|file| {
            match Snapshot::parse(file, Path::new("fuzzed.safetensors")) {
                Ok((snapshot, config)) => {
                    check(&snapshot, &SnapshotLayout::of(&config));
                    Some(snapshot)
                }
                Err(error) => {
                    assert!(error.to_string().contains("fuzzed.safetensors"), "{error}");
                    None
                }
            }
        });
        ReaderDecision::of(sound.into_iter().flatten().next())
    })
}

/// Parses a decoder's file, before zeros for parameters and without any.
fn decoder(bytes: &[u8]) -> ReaderDecision {
    let parameters = TrainedDecoder::tensors(1)
        .last()
        .map_or(0, |last| last.range.end);
    let mut whole = bytes.to_vec();
    if let Some(length) = whole.first_chunk_mut::<8>() {
        *length = (bytes.len() as u64 - 8).to_le_bytes();
    }
    whole.resize(whole.len() + parameters * HALF_BYTES, 0);
    let sound = [&*whole, bytes].map(|file| TrainedDecoder::parse(file).ok());
    ReaderDecision::of(sound.into_iter().flatten().next())
}

/// Puts a header before the values. Returns its place.
fn put_header(buffer: &mut [u8], header: &[u8]) -> usize {
    let start = FILE.longest_bytes - header.len();
    buffer[start..FILE.longest_bytes].copy_from_slice(header);
    // Only a header with the stated length is read at all.
    if let Some(length) = buffer[start..FILE.longest_bytes].first_chunk_mut::<8>() {
        *length = (header.len() as u64 - 8).to_le_bytes();
    }
    start
}

/// Parses an encoder's file as [`file`] does, and as the file of a snapshot with the same header.
fn encoder(bytes: &[u8]) -> ReaderDecision {
    BUFFER.with_borrow_mut(|buffer| {
        let start = put_header(buffer, bytes);
        let encoder = SOUND.layout.encoder().len() * size_of::<f32>();
        let own = &buffer[start..FILE.longest_bytes + encoder];
        let sound = [own, &buffer[start..], bytes].map(|file| {
            match TrainedEncoder::parse(file, Path::new("fuzzed.safetensors")) {
                Ok(encoder) => {
                    assert!(encoder.values.iter().all(|value| value.is_finite()));
                    Some(encoder)
                }
                Err(error) => {
                    assert!(error.to_string().contains("fuzzed.safetensors"), "{error}");
                    None
                }
            }
        });
        ReaderDecision::of(sound.into_iter().flatten().next())
    })
}

fn check(snapshot: &Snapshot, layout: &SnapshotLayout) {
    assert_eq!(snapshot.values.len(), layout.values());
    assert!(snapshot.values.iter().all(|value| value.is_finite()));
}

/// Returns inputs: a header, a flag for a correct checksum, a number of bytes cut off, and changes
/// (position and value).
fn received_samples() -> Vec<Vec<u8>> {
    let header = SOUND.snapshot.header(RUN, &SOUND.layout);
    let sample = |script: &[u8]| [bytes_of(&header), script].concat();
    vec![
        sample(&[]),
        sample(&[1, 0, 7, 0, 0, 0, 0x80, 0x7f]),
        sample(&[0, 0, 7, 0, 0, 0, 1, 2]),
        sample(&[1, 3]),
    ]
}

fn received(bytes: &[u8]) -> ReaderDecision {
    let mut script = Script::new(bytes);
    let mut header: SnapshotHeader = pod(script.bytes(size_of::<SnapshotHeader>()));
    let checksum_is_made_right = script.u8() % 2 == 1;
    BUFFER.with_borrow_mut(|buffer| {
        let values = &mut buffer[FILE.longest_bytes..];
        let cut = usize::from(script.u8()).min(values.len());
        let mut changed = Vec::new();
        while !script.is_over() {
            let place = script.u32() as usize % values.len();
            changed.push((place, values[place]));
            values[place] = script.u8();
        }
        let sent = &values[..values.len() - cut];
        if checksum_is_made_right {
            header.checksum = xxhash_rust::xxh3::xxh3_64(sent);
        }
        let read = Snapshot::receive(&header, sent, RUN, &SOUND.layout).ok();
        if let Some(snapshot) = &read {
            check(snapshot, &SOUND.layout);
            assert_eq!(cast_slice::<f32, u8>(&snapshot.values), sent);
            assert_eq!(snapshot.version.0, header.policy_version);
        }
        // In reverse, so that a position that was changed twice gets its first value back.
        for (place, value) in changed.into_iter().rev() {
            values[place] = value;
        }
        ReaderDecision::of(read)
    })
}
