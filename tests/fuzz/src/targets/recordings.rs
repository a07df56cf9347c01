//! Recordings of episodes, as the page reads them.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::LazyLock;

use bytemuck::Zeroable;
use mcap::records::MessageHeader;
use mcap::{MessageStream, WriteOptions};
use skein_protocol::ActionSpace;
use skein_protocol::evaluation::EpisodeScore;
use skein_protocol::transition::{Outcome, RecordLengths, TransitionRecord};
use skein_recordings::{Episode, Recording, images, read};
use skein_simulator::course::Course;
use skein_simulator::simulator::SimulatorSettings;

use super::{ReaderDecision, Target, USUAL};

pub(super) const FILE: Target = Target {
    name: "recording",
    reads: "recordings: a byte for the topic, two for the length and a message, again and again; \
            after a byte above 127 the whole file",
    longest_bytes: 1 << 16,
    weight: USUAL / 8,
    samples: || vec![as_messages(&SOUND), [&[0xff], SOUND.as_slice()].concat()],
    run: |bytes| {
        let file = match bytes.split_first() {
            Some((128.., file)) => file.to_vec(),
            _ => as_file(bytes),
        };
        let flights = read(&file);
        let _ = images(&file, 0);
        let has_flight = |flights: &Vec<_>| !flights.is_empty();
        ReaderDecision::of(flights.ok().filter(has_flight))
    },
};

const TOPICS: [&str; 4] = ["/scene", "/events", "/camera/image", "/drone/step"];

const LENGTHS: RecordLengths = RecordLengths {
    latent: 8,
    action: ActionSpace::Velocity,
};

/// A recording of two steps.
static SOUND: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sound.mcap");
    let settings = SimulatorSettings::default();
    let course = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../configs/courses/training.toml"
    );
    let course = Course::load(course).unwrap();
    let mut recording =
        Recording::create(&path, &settings, LENGTHS.action, &["a course"], None).unwrap();
    let episode = Episode {
        title: "an episode",
        course: (&course, 0),
        number: 0,
        lengths: LENGTHS,
        score: EpisodeScore {
            walls_passed: 0,
            walls: 1,
            episode_return: 0.0,
            outcome: Outcome::TimedOut,
            hit_wall: None,
        },
    };
    let record = Box::new(TransitionRecord::zeroed());
    recording.add(&episode, [&*record; 2].into_iter()).unwrap();
    recording.finish().unwrap();
    std::fs::read(path).unwrap()
});

/// Returns the messages of a recording that a page reads, as the target takes them.
fn as_messages(file: &[u8]) -> Vec<u8> {
    let mut messages = Vec::new();
    for message in MessageStream::new(file).unwrap() {
        let message = message.unwrap();
        let topic = TOPICS
            .iter()
            .position(|topic| *topic == message.channel.topic);
        if let Some(topic) = topic {
            messages.push(topic as u8);
            messages.extend((message.data.len() as u16).to_le_bytes());
            messages.extend_from_slice(&message.data);
        }
    }
    messages
}

/// Returns a valid file with these messages, whatever they are.
fn as_file(mut bytes: &[u8]) -> Vec<u8> {
    let mut writer = WriteOptions::new()
        .compression(None)
        .create(Cursor::new(Vec::new()))
        .unwrap();
    let channels = TOPICS.map(|topic| {
        let channel = writer.add_channel(0, topic, "protobuf", &BTreeMap::new());
        channel.unwrap()
    });
    while let Some((&[topic, low, high], rest)) = bytes.split_first_chunk::<3>() {
        let length = usize::from(u16::from_le_bytes([low, high])).min(rest.len());
        let (message, rest) = rest.split_at(length);
        let header = MessageHeader {
            channel_id: channels[usize::from(topic) % channels.len()],
            sequence: 0,
            log_time: rest.len() as u64,
            publish_time: 0,
        };
        writer.write_to_known_channel(&header, message).unwrap();
        bytes = rest;
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}
