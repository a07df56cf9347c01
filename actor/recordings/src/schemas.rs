//! Schemas of a recording's messages: Foxglove's, from files, and our own, from the columns of the
//! `.npz` recording, so that both recordings hold the same values.

use std::borrow::Cow;
use std::collections::BTreeMap;

use prost::Message;
use prost::encoding::{WireType, decode_key, decode_varint, encode_key, encode_varint};
use skein_protocol::REWARD_TERM_NAMES;
use skein_protocol::transition::TransitionRecord;
use skein_rollout::recording::{COLUMNS, Column, RecordingRow};

/// A message's schema.
pub(crate) struct Schema {
    /// Name of the message.
    pub(crate) name: &'static str,
    /// `google.protobuf.FileDescriptorSet`.
    pub(crate) descriptors: Cow<'static, [u8]>,
}

macro_rules! foxglove {
    ($name:literal) => {
        Schema {
            name: concat!("foxglove.", $name),
            descriptors: Cow::Borrowed(include_bytes!(concat!(
                "../schemas/foxglove.",
                $name,
                ".bin"
            ))),
        }
    };
}

pub(crate) const SCENE_UPDATE: Schema = foxglove!("SceneUpdate");
pub(crate) const FRAME_TRANSFORMS: Schema = foxglove!("FrameTransforms");
pub(crate) const RAW_IMAGE: Schema = foxglove!("RawImage");
pub(crate) const CAMERA_CALIBRATION: Schema = foxglove!("CameraCalibration");
pub(crate) const LOG: Schema = foxglove!("Log");

/// Returns the schema of [`encode_step`].
pub(crate) fn step() -> Schema {
    let fields = (1..).zip(&COLUMNS).filter_map(|(number, column)| {
        let (kind, label) = match Encoding::of(column)? {
            Encoding::Floats => (TYPE_FLOAT, REPEATED),
            Encoding::Float => (TYPE_FLOAT, OPTIONAL),
            Encoding::Integer => (TYPE_INT32, OPTIONAL),
            Encoding::Byte => (TYPE_UINT32, OPTIONAL),
        };
        Some(field(column.name, number, label, kind))
    });
    own("skein.Step", "Step", fields.collect())
}

/// Returns the schema of [`encode_reward`].
pub(crate) fn reward() -> Schema {
    let names = REWARD_TERM_NAMES.iter().chain(&["total"]);
    let fields = (1..).zip(names);
    let fields = fields.map(|(number, name)| field(name, number, OPTIONAL, TYPE_FLOAT));
    own("skein.Reward", "Reward", fields.collect())
}

/// Returns an observation in Protobuf's encoding: a field for each column but the image and the one
/// that is `missing`.
pub(crate) fn encode_step(row: &RecordingRow<'_>, missing: Option<&str>) -> Vec<u8> {
    let mut message = Vec::new();
    let mut bytes = Vec::new();
    for (number, column) in (1..).zip(&COLUMNS) {
        let Some(encoding) = Encoding::of(column).filter(|_| missing != Some(column.name)) else {
            continue;
        };
        bytes.clear();
        column.write(row, &mut bytes);
        match encoding {
            Encoding::Floats => {
                encode_key(number, WireType::LengthDelimited, &mut message);
                encode_varint(bytes.len() as u64, &mut message);
                message.extend_from_slice(&bytes);
            }
            Encoding::Float => {
                encode_key(number, WireType::ThirtyTwoBit, &mut message);
                message.extend_from_slice(&bytes);
            }
            Encoding::Integer | Encoding::Byte => {
                encode_key(number, WireType::Varint, &mut message);
                encode_varint(little_endian(&bytes), &mut message);
            }
        }
    }
    message
}

/// Returns the numbers of a step by the names of their columns; `None` if it is damaged. Columns of
/// a later Skein are left out.
pub(crate) fn decode_step(mut message: &[u8]) -> Option<BTreeMap<&'static str, Vec<f32>>> {
    let mut numbers = BTreeMap::new();
    while !message.is_empty() {
        let (field, wire_type) = decode_key(&mut message).ok()?;
        let values = match wire_type {
            WireType::LengthDelimited => {
                let length = decode_varint(&mut message).ok()?;
                let (bytes, rest) = message.split_at_checked(usize::try_from(length).ok()?)?;
                message = rest;
                let floats = bytes.as_chunks::<4>().0.iter();
                floats.map(|&bytes| f32::from_le_bytes(bytes)).collect()
            }
            WireType::ThirtyTwoBit => {
                let (&bytes, rest) = message.split_first_chunk::<4>()?;
                message = rest;
                vec![f32::from_le_bytes(bytes)]
            }
            WireType::Varint => vec![decode_varint(&mut message).ok()? as f32],
            _ => return None,
        };
        if let Some(column) = COLUMNS.get(field as usize - 1) {
            numbers.insert(column.name, values);
        }
    }
    Some(numbers)
}

/// Returns the reward's terms and their sum in Protobuf's encoding.
pub(crate) fn encode_reward(record: &TransitionRecord) -> Vec<u8> {
    let mut message = Vec::new();
    let values = record.reward_terms.iter().chain([&record.reward]);
    for (number, value) in (1..).zip(values) {
        encode_key(number, WireType::ThirtyTwoBit, &mut message);
        message.extend_from_slice(&value.to_le_bytes());
    }
    message
}

/// Encoding of a column as a field. An array of bytes has none: it is an image, a message of its
/// own.
enum Encoding {
    Floats,
    Float,
    Integer,
    Byte,
}

impl Encoding {
    fn of(column: &Column) -> Option<Self> {
        match (column.kind, column.shape) {
            ("<f4", []) => Some(Self::Float),
            ("<f4", _) => Some(Self::Floats),
            ("<i4", []) => Some(Self::Integer),
            ("|u1", []) => Some(Self::Byte),
            _ => None,
        }
    }
}

/// Returns the whole number in `bytes`, which is not negative.
fn little_endian(bytes: &[u8]) -> u64 {
    let digits = bytes.iter().rev();
    digits.fold(0, |number, &digit| number << 8 | u64::from(digit))
}

/// Returns the schema of the only message of the package `skein`.
fn own(name: &'static str, message: &str, fields: Vec<FieldDescriptor>) -> Schema {
    let set = FileDescriptorSet {
        file: vec![FileDescriptor {
            name: format!("{name}.proto"),
            package: "skein".to_owned(),
            message_type: vec![MessageDescriptor {
                name: message.to_owned(),
                field: fields,
            }],
            syntax: "proto3".to_owned(),
        }],
    };
    Schema {
        name,
        descriptors: Cow::Owned(set.encode_to_vec()),
    }
}

fn field(name: &str, number: i32, label: i32, kind: i32) -> FieldDescriptor {
    FieldDescriptor {
        name: name.to_owned(),
        number,
        label,
        kind,
    }
}

// Numbers in `google/protobuf/descriptor.proto`.
const TYPE_FLOAT: i32 = 2;
const TYPE_INT32: i32 = 5;
const TYPE_UINT32: i32 = 13;
const OPTIONAL: i32 = 1;
const REPEATED: i32 = 3;

/// `google.protobuf.FileDescriptorSet`.
#[derive(Clone, PartialEq, Message)]
struct FileDescriptorSet {
    #[prost(message, repeated, tag = "1")]
    file: Vec<FileDescriptor>,
}

/// `google.protobuf.FileDescriptorProto`.
#[derive(Clone, PartialEq, Message)]
struct FileDescriptor {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(string, tag = "2")]
    package: String,
    #[prost(message, repeated, tag = "4")]
    message_type: Vec<MessageDescriptor>,
    #[prost(string, tag = "12")]
    syntax: String,
}

/// `google.protobuf.DescriptorProto`.
#[derive(Clone, PartialEq, Message)]
struct MessageDescriptor {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, repeated, tag = "2")]
    field: Vec<FieldDescriptor>,
}

/// `google.protobuf.FieldDescriptorProto`.
#[derive(Clone, PartialEq, Message)]
struct FieldDescriptor {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(int32, tag = "3")]
    number: i32,
    #[prost(int32, tag = "4")]
    label: i32,
    #[prost(int32, tag = "5")]
    kind: i32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_column_but_the_image_is_a_field() {
        let without: Vec<_> = COLUMNS
            .iter()
            .filter(|column| Encoding::of(column).is_none())
            .map(|column| column.name)
            .collect();
        assert_eq!(without, ["depth"]);
    }

    #[test]
    fn the_schemas_are_sets_that_hold_their_message_last() {
        for schema in [
            SCENE_UPDATE,
            FRAME_TRANSFORMS,
            RAW_IMAGE,
            LOG,
            step(),
            reward(),
        ] {
            let set = FileDescriptorSet::decode(&schema.descriptors[..]).unwrap();
            let last = set.file.last().unwrap();
            let name = format!("{}.{}", last.package, last.message_type[0].name);
            assert_eq!(name, schema.name);
        }
    }
}
