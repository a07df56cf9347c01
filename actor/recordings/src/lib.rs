//! Recordings of episodes as MCAP, with Foxglove's schemas, for Foxglove, Rerun and the page of
//! `skein watch`.
//!
//! Episodes follow each other on one time axis. Each step has the numbers of the `.npz` recording,
//! the depth image with its calibration, and the frames world, body and camera. Each episode begins
//! with its walls and the drone as a scene. File format: <https://mcap.dev/spec>.

mod messages;
mod read;
mod scene;
mod schemas;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::Path;

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions, Writer};
use prost::Message;
use skein_inference::Decoder;
use skein_protocol::evaluation::EpisodeScore;
use skein_protocol::transition::{Outcome, RecordLengths, TransitionRecord};
use skein_protocol::{ActionSpace, REWARD_TERM_NAMES};
use skein_rollout::recording::RecordingRow;
use skein_simulator::course::Course;
use skein_simulator::simulator::SimulatorSettings;

use messages::{CameraCalibration, FrameTransforms, Level, Log, RawImage, Timestamp};
use schemas::{Schema, encode_reward, encode_step};

pub use read::{MOST_STEPS, RecordedFlight, RecordedStep, RecordedWall, images, read};

/// Pause between two episodes on the time axis, seconds.
const PAUSE_SECS: f64 = 1.0;

/// Episode to record.
#[derive(Debug, Clone, Copy)]
pub struct Episode<'a> {
    /// Title, unique in the recording.
    pub title: &'a str,
    /// The course, and its number among the recording's courses.
    pub course: (&'a Course, i32),
    /// Number of the episode on that course.
    pub number: i32,
    /// Lengths of the latent codes and of the actions.
    pub lengths: RecordLengths,
    /// How it ended.
    pub score: EpisodeScore,
}

/// Topics of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Topic {
    /// State, action and reward: the arrays of the `.npz` recording but the image.
    Step,
    /// The reward's terms by name.
    Reward,
    /// The depth image's bytes, as the encoder sees them.
    Image,
    /// The same in millimetres.
    Depth,
    /// The depth image that the decoder makes of the latent code.
    Reconstruction,
    Calibration,
    Frames,
    Scene,
    Events,
}

impl Topic {
    const ALL: [Self; 9] = [
        Self::Step,
        Self::Reward,
        Self::Image,
        Self::Depth,
        Self::Reconstruction,
        Self::Calibration,
        Self::Frames,
        Self::Scene,
        Self::Events,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Step => "/drone/step",
            Self::Reward => "/drone/reward",
            Self::Image => "/camera/image",
            Self::Depth => "/camera/depth",
            Self::Reconstruction => "/camera/reconstruction",
            Self::Calibration => "/camera/calibration",
            Self::Frames => "/frames",
            Self::Scene => "/scene",
            Self::Events => "/events",
        }
    }

    fn schema(self) -> Schema {
        match self {
            Self::Step => schemas::step(),
            Self::Reward => schemas::reward(),
            Self::Image | Self::Depth | Self::Reconstruction => schemas::RAW_IMAGE,
            Self::Calibration => schemas::CAMERA_CALIBRATION,
            Self::Frames => schemas::FRAME_TRANSFORMS,
            Self::Scene => schemas::SCENE_UPDATE,
            Self::Events => schemas::LOG,
        }
    }
}

/// An MCAP file under way.
pub struct Recording<'a> {
    settings: &'a SimulatorSettings,
    decoder: Option<&'a Decoder>,
    writer: Writer<BufWriter<File>>,
    /// Number of each topic of [`Topic::ALL`] in the file.
    channels: Vec<u16>,
    /// Messages so far.
    sequence: u32,
    /// Beginning of the present episode on the time axis, seconds.
    begin_secs: f64,
    /// Time of the last step.
    now: Timestamp,
    walls_passed: u8,
    /// Previous position, for the trail.
    before_m: Option<[f32; 3]>,
}

impl<'a> Recording<'a> {
    /// Creates the file `path` of flights with `settings` and `action` through `courses`. With a
    /// `decoder`, every step has the image that it makes of the latent code.
    ///
    /// # Errors
    /// Of the file.
    pub fn create(
        path: &Path,
        settings: &'a SimulatorSettings,
        action: ActionSpace,
        courses: &[&str],
        decoder: Option<&'a Decoder>,
    ) -> io::Result<Self> {
        let options = WriteOptions::new()
            .library(concat!("skein ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Lz4));
        let file = BufWriter::new(File::create(path)?);
        let mut writer = options.create(file).map_err(io::Error::other)?;
        let mut channels = Vec::new();
        for topic in Topic::ALL {
            let schema = topic.schema();
            let schema = writer.add_schema(schema.name, "protobuf", &schema.descriptors);
            let schema = schema.map_err(io::Error::other)?;
            let channel = writer.add_channel(schema, topic.name(), "protobuf", &BTreeMap::new());
            channels.push(channel.map_err(io::Error::other)?);
        }
        let mut recording = Self {
            settings,
            decoder,
            writer,
            channels,
            sequence: 0,
            begin_secs: 0.0,
            now: Timestamp::default(),
            walls_passed: 0,
            before_m: None,
        };
        let axes: Vec<_> = action.axes().iter().map(|axis| axis.name()).collect();
        recording.write_names("action_names", &axes)?;
        recording.write_names("course_names", courses)?;
        recording.write_names("reward_term_names", &REWARD_TERM_NAMES)?;
        Ok(recording)
    }

    /// Adds an episode: its steps, then its closing record. The action of a teacher or oracle is
    /// left out if none was asked.
    ///
    /// # Errors
    /// Of the file.
    pub fn add<'r>(
        &mut self,
        episode: &Episode<'_>,
        records: impl Iterator<Item = &'r TransitionRecord> + Clone,
    ) -> io::Result<()> {
        let (course, number) = episode.course;
        self.begin_episode(episode.title, course)?;
        let is_asked =
            |record: &TransitionRecord| record.teacher_action.iter().any(|&it| it != 0.0);
        let missing = match records.clone().any(is_asked) {
            true => None,
            false => Some("oracle_action"),
        };
        for record in records {
            let row = RecordingRow {
                course: number,
                episode: episode.number,
                lengths: episode.lengths,
                record,
            };
            self.write_step(&row, missing)?;
            self.log_passing(record, course)?;
        }
        self.end_episode(&episode.score, course)
    }

    /// Writes what the numbers of a column in the steps stand for.
    fn write_names(&mut self, list: &str, names: &[&str]) -> io::Result<()> {
        let numbered = names.iter().enumerate();
        let metadata = Metadata {
            name: list.to_owned(),
            metadata: numbered
                .map(|(number, name)| (number.to_string(), (*name).to_owned()))
                .collect(),
        };
        let written = self.writer.write_metadata(&metadata);
        written.map_err(io::Error::other)
    }

    fn begin_episode(&mut self, title: &str, course: &Course) -> io::Result<()> {
        self.now = Timestamp::from_secs(self.begin_secs);
        self.walls_passed = 0;
        self.before_m = None;
        self.send(Topic::Scene, &scene::of_course(course, title, self.now))?;
        self.log(Level::Info, format!("{title} begins"))
    }

    fn write_step(&mut self, row: &RecordingRow<'_>, missing: Option<&str>) -> io::Result<()> {
        let record = row.record;
        let secs = f64::from(record.step) * f64::from(self.settings.vehicle.control_period_secs);
        self.now = Timestamp::from_secs(self.begin_secs + secs);
        let transforms = FrameTransforms {
            transforms: scene::frames(record, &self.settings.camera, self.now),
        };
        self.send(Topic::Frames, &transforms)?;
        let calibration = CameraCalibration::of(self.settings.camera.focal_px(), self.now);
        self.send(Topic::Calibration, &calibration)?;
        let image = RawImage::of_depth(&record.depth, self.now);
        self.send(Topic::Image, &image)?;
        let range_m = self.settings.camera.range_m;
        let depth = RawImage::in_millimetres(&record.depth, range_m, self.now);
        self.send(Topic::Depth, &depth)?;
        if let Some(decoder) = self.decoder {
            let image = decoder.decode(&record.latent[..row.lengths.latent]);
            let image = RawImage::of_depth(&image, self.now);
            self.send(Topic::Reconstruction, &image)?;
        }
        self.send_bytes(Topic::Step, &encode_step(row, missing))?;
        self.send_bytes(Topic::Reward, &encode_reward(record))?;
        let before_m = self.before_m.replace(record.position_m);
        if let Some(before_m) = before_m {
            let trail = scene::trail(record.step, before_m, record.position_m, self.now);
            self.send(Topic::Scene, &trail)?;
        }
        Ok(())
    }

    fn log_passing(&mut self, record: &TransitionRecord, course: &Course) -> io::Result<()> {
        if record.walls_passed <= self.walls_passed {
            return Ok(());
        }
        self.walls_passed = record.walls_passed;
        let what = match course.is_world() {
            true => "stage",
            false => "wall",
        };
        let event = format!("passed {what} {}", record.walls_passed);
        self.log(Level::Info, event)
    }

    fn end_episode(&mut self, score: &EpisodeScore, course: &Course) -> io::Result<()> {
        let (level, event) = match (score.outcome, score.hit_wall) {
            (Outcome::ReachedEnd, _) => (Level::Info, "reached the end".to_owned()),
            (Outcome::Collided, Some(_)) if course.is_world() => {
                (Level::Error, "hit an obstacle".to_owned())
            }
            (Outcome::Collided, Some(wall)) => (Level::Error, format!("hit wall {wall}")),
            (Outcome::Collided, None) => (Level::Error, "hit the corridor".to_owned()),
            (Outcome::TimedOut, _) => (Level::Warning, "timed out".to_owned()),
        };
        self.log(level, event)?;
        self.begin_secs = self.now.secs() + PAUSE_SECS;
        Ok(())
    }

    fn log(&mut self, level: Level, message: String) -> io::Result<()> {
        let log = Log::new(level, message, self.now);
        self.send(Topic::Events, &log)
    }

    fn send(&mut self, topic: Topic, message: &impl Message) -> io::Result<()> {
        self.send_bytes(topic, &message.encode_to_vec())
    }

    fn send_bytes(&mut self, topic: Topic, bytes: &[u8]) -> io::Result<()> {
        self.sequence = self.sequence.wrapping_add(1);
        let nanos = self.now.nanos();
        let header = MessageHeader {
            channel_id: self.channels[topic as usize],
            sequence: self.sequence,
            log_time: nanos,
            publish_time: nanos,
        };
        let written = self.writer.write_to_known_channel(&header, bytes);
        written.map_err(io::Error::other)
    }

    /// Completes the file and hands it to the disk.
    ///
    /// # Errors
    /// Of the file.
    pub fn finish(mut self) -> io::Result<()> {
        self.writer.finish().map_err(io::Error::other)?;
        self.writer.into_inner().into_inner()?.sync_all()
    }
}
