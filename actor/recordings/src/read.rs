//! Reads recordings back: what a page shows of them.

use std::collections::BTreeMap;
use std::io;

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use prost::Message;
use serde::Serialize;
use skein_protocol::IMAGE_PIXELS;

use crate::Topic;
use crate::messages::{Log, RawImage, SceneEntity, SceneUpdate};
use crate::scene::{CORRIDOR, OBSTACLES, WALL};
use crate::schemas::decode_step;

/// Most steps of a recording that are read: about 1 KB of memory each.
pub const MOST_STEPS: usize = 20_000;
/// Most bytes of a record: many times an image's or a course's.
const MOST_RECORD_BYTES: usize = 8 << 20;
/// Most points of an outline, or corners of the triangles of a wall or of all obstacles.
const MOST_POINTS: usize = 300_000;
const NANOS: f64 = 1e9;

/// An episode of a recording, without images: [`images`].
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct RecordedFlight {
    /// Title.
    pub title: String,
    /// Length, width, height of the corridor.
    pub corridor_m: [f32; 3],
    /// Walls in the order along the corridor.
    pub walls: Vec<RecordedWall>,
    /// Triangles of the obstacles that stand still.
    pub obstacles_m: Vec<[[f32; 3]; 3]>,
    /// Observations in order, the closing one last.
    pub steps: Vec<RecordedStep>,
    /// Events, each with the second in the episode.
    pub events: Vec<(f64, String)>,
    #[serde(skip)]
    begin_nanos: u64,
}

/// A wall as it is drawn.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct RecordedWall {
    /// Place of its front along the corridor.
    pub x_m: f32,
    /// Corners `[y, z]` of the opening.
    pub outline_m: Vec<[f32; 2]>,
    /// Triangles of its surface.
    pub triangles_m: Vec<[[f32; 3]; 3]>,
}

/// An observation.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct RecordedStep {
    /// Seconds since the episode's beginning.
    pub secs: f64,
    /// The values of each column of a recording, by its name.
    pub numbers: BTreeMap<&'static str, Vec<f32>>,
}

/// Reads all episodes of a recording.
///
/// # Errors
/// If `file` is no recording, is damaged, or has more than [`MOST_STEPS`] steps.
pub fn read(file: &[u8]) -> io::Result<Vec<RecordedFlight>> {
    let mut flights: Vec<RecordedFlight> = Vec::new();
    let mut steps = 0;
    each_message(file, |topic, nanos, message| {
        if topic == Topic::Scene {
            let scene = SceneUpdate::decode(message).map_err(damaged)?;
            // A scene that deletes what is there begins an episode; others are pieces of the trail.
            if !scene.deletions.is_empty() {
                flights.push(begin(scene, nanos));
            }
            return Ok(());
        }
        let Some(flight) = flights.last_mut() else {
            return Ok(());
        };
        let secs = nanos.saturating_sub(flight.begin_nanos) as f64 / NANOS;
        match topic {
            Topic::Step => {
                steps += 1;
                if steps > MOST_STEPS {
                    let text =
                        format!("it has more than {MOST_STEPS} steps: record fewer episodes");
                    return Err(io::Error::other(text));
                }
                let numbers = decode_step(message).ok_or_else(|| damaged("a step"))?;
                flight.steps.push(RecordedStep { secs, numbers });
            }
            Topic::Events => {
                let event = Log::decode(message).map_err(damaged)?;
                flight.events.push((secs, event.message));
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(flights)
}

/// Returns the depth images of episode `number` of a recording, from 0: `[steps, 72, 128]`.
///
/// # Errors
/// As for [`read`]; also if an image has another size.
pub fn images(file: &[u8], number: usize) -> io::Result<Vec<u8>> {
    let mut begun = 0;
    let mut images = Vec::new();
    each_message(file, |topic, _, message| {
        match topic {
            Topic::Scene => {
                let scene = SceneUpdate::decode(message).map_err(damaged)?;
                begun += usize::from(!scene.deletions.is_empty());
            }
            Topic::Image if begun == number + 1 => {
                let image = RawImage::decode(message).map_err(damaged)?;
                if image.data.len() != IMAGE_PIXELS {
                    return Err(damaged("an image of another size"));
                }
                images.extend_from_slice(&image.data);
            }
            _ => {}
        }
        match images.len() > MOST_STEPS * IMAGE_PIXELS {
            true => Err(io::Error::other("it has too many images")),
            false => Ok(()),
        }
    })?;
    match begun > number {
        true => Ok(images),
        false => Err(io::Error::other(format!("it has no episode {number}"))),
    }
}

/// Calls `take` with topic, time in nanoseconds and content of each message that Skein knows.
fn each_message(
    file: &[u8],
    mut take: impl FnMut(Topic, u64, &[u8]) -> io::Result<()>,
) -> io::Result<()> {
    // Not MessageStream, which allocates whatever length a record states.
    let options = LinearReaderOptions::default().with_record_length_limit(MOST_RECORD_BYTES);
    let mut reader = LinearReader::new_with_options(options);
    let mut rest = file;
    let mut topics = BTreeMap::new();
    while let Some(event) = reader.next_event() {
        let (opcode, data) = match event.map_err(damaged)? {
            LinearReadEvent::ReadRequest(wanted) => {
                let (bytes, after) = rest.split_at(wanted.min(rest.len()));
                reader.insert(bytes.len()).copy_from_slice(bytes);
                reader.notify_read(bytes.len());
                rest = after;
                continue;
            }
            LinearReadEvent::Record { opcode, data } => (opcode, data),
        };
        match opcode {
            op::CHANNEL => {
                let (id, topic) = channel(data).ok_or_else(|| damaged("a channel"))?;
                let mut known = Topic::ALL.into_iter();
                topics.insert(id, known.find(|known| known.name().as_bytes() == topic));
            }
            op::MESSAGE => {
                let record = mcap::parse_record(opcode, data).map_err(damaged)?;
                if let Record::Message { header, data } = record
                    && let Some(Some(topic)) = topics.get(&header.channel_id)
                {
                    take(*topic, header.log_time, &data)?;
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// Returns number and topic of a channel's record; `None` if it is cut off. `mcap::parse_record`
/// allocates whatever length its texts state.
fn channel(data: &[u8]) -> Option<(u16, &[u8])> {
    let (id, rest) = data.split_first_chunk::<2>()?;
    let (_schema_id, rest) = rest.split_first_chunk::<2>()?;
    let (length, rest) = rest.split_first_chunk::<4>()?;
    let topic = rest.get(..u32::from_le_bytes(*length) as usize)?;
    Some((u16::from_le_bytes(*id), topic))
}

fn damaged(what: impl std::fmt::Display) -> io::Error {
    io::Error::other(format!("the recording is damaged: {what}"))
}

fn begin(scene: SceneUpdate, begin_nanos: u64) -> RecordedFlight {
    let mut flight = RecordedFlight {
        begin_nanos,
        ..RecordedFlight::default()
    };
    for entity in &scene.entities {
        if let Some(title) = entity.id.strip_prefix(CORRIDOR) {
            flight.title = title.trim_start_matches([':', ' ']).to_owned();
            flight.corridor_m = corridor_m(entity);
        } else if entity.id.starts_with(WALL) {
            flight.walls.push(wall(entity));
        } else if entity.id == OBSTACLES {
            flight.obstacles_m = triangles_m(entity);
        }
    }
    flight
}

/// Returns length, width and height of the corridor that an entity's lines draw.
fn corridor_m(entity: &SceneEntity) -> [f32; 3] {
    let points = entity.lines.iter().flat_map(|line| &line.points);
    let mut corridor_m = [0f32; 3];
    for point in points.take(MOST_POINTS) {
        let [x_m, y_m, z_m]: [f32; 3] = (*point).into();
        for (size_m, reach_m) in corridor_m.iter_mut().zip([x_m, 2.0 * y_m, z_m]) {
            *size_m = size_m.max(reach_m);
        }
    }
    corridor_m
}

fn wall(entity: &SceneEntity) -> RecordedWall {
    let outline = entity.lines.iter().flat_map(|line| &line.points);
    let outline: Vec<[f32; 3]> = outline
        .take(MOST_POINTS)
        .map(|&point| point.into())
        .collect();
    RecordedWall {
        x_m: outline.first().map_or(0.0, |&[x_m, ..]| x_m),
        outline_m: outline.iter().map(|&[_, y_m, z_m]| [y_m, z_m]).collect(),
        triangles_m: triangles_m(entity),
    }
}

fn triangles_m(entity: &SceneEntity) -> Vec<[[f32; 3]; 3]> {
    let corners = entity.triangles.iter().flat_map(|list| &list.points);
    let corners: Vec<[f32; 3]> = corners
        .take(MOST_POINTS)
        .map(|&point| point.into())
        .collect();
    corners.as_chunks::<3>().0.to_vec()
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;
    use skein_protocol::ActionSpace;
    use skein_protocol::evaluation::EpisodeScore;
    use skein_protocol::transition::{Outcome, RecordLengths, TransitionRecord};
    use skein_simulator::course::Course;
    use skein_simulator::simulator::SimulatorSettings;

    use super::*;
    use crate::{Episode, Recording};

    const LENGTHS: RecordLengths = RecordLengths {
        latent: 8,
        action: ActionSpace::Velocity,
    };

    /// Returns a recording of two episodes of three records each.
    fn recording(course: &Course) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("two.mcap");
        let settings = SimulatorSettings::default();
        let mut recording =
            Recording::create(&path, &settings, LENGTHS.action, &["a course"], None).unwrap();
        for number in 0..2u8 {
            let records = (0..3u8).map(|step| {
                let mut record = Box::new(TransitionRecord::zeroed());
                record.step = step.into();
                record.position_m = [f32::from(step), f32::from(number), 3.0];
                record.depth.fill(10 * number + step);
                record.reward = 0.25;
                record.teacher_action[2] = f32::from(number);
                record
            });
            let records: Vec<_> = records.collect();
            let episode = Episode {
                title: &format!("episode {number}"),
                course: (course, 0),
                number: number.into(),
                lengths: LENGTHS,
                score: EpisodeScore {
                    walls_passed: 0,
                    walls: 2,
                    episode_return: 0.5,
                    outcome: Outcome::Collided,
                    hit_wall: Some(1),
                },
            };
            let records = records.iter().map(|record| &**record);
            recording.add(&episode, records).unwrap();
        }
        recording.finish().unwrap();
        std::fs::read(path).unwrap()
    }

    fn course() -> Course {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../configs/courses/training.toml"
        );
        Course::load(path).unwrap()
    }

    #[test]
    fn what_was_recorded_is_read_back() {
        let course = course();
        let file = recording(&course);
        let flights = read(&file).unwrap();
        let titles: Vec<_> = flights.iter().map(|flight| flight.title.as_str()).collect();
        assert_eq!(titles, ["episode 0", "episode 1"]);
        let second = &flights[1];
        let corridor = course.corridor();
        assert_eq!(
            second.corridor_m,
            [corridor.length_m, corridor.width_m, corridor.height_m]
        );
        assert_eq!(second.walls.len(), course.walls().len());
        let (read, made) = (&second.walls[1], &course.walls()[1]);
        assert_eq!(
            (read.x_m, read.outline_m.as_slice()),
            (made.x_m(), made.outline())
        );
        assert_eq!(read.triangles_m, course.wall_triangles()[1]);
        let numbers = &second.steps[2].numbers;
        assert_eq!(numbers["position_m"], [2.0, 1.0, 3.0]);
        assert_eq!(numbers["reward"], [0.25]);
        assert_eq!(numbers["latent"].len(), 8);
        assert_eq!(numbers["step"], [2.0]);
        assert_eq!(numbers["oracle_action"], [0.0, 0.0, 1.0]);
        // No oracle was asked there.
        assert!(!flights[0].steps[2].numbers.contains_key("oracle_action"));
        assert!(second.steps[0].secs == 0.0 && second.steps[2].secs > second.steps[1].secs);
        let (_, last) = second.events.last().unwrap();
        assert_eq!(last, "hit wall 1");
        let images = images(&file, 1).unwrap();
        let shades: Vec<_> = images.iter().step_by(IMAGE_PIXELS).copied().collect();
        assert_eq!(shades, [10, 11, 12]);
    }

    #[test]
    fn damage_is_an_error_and_never_a_panic() {
        let file = recording(&course());
        assert!(read(b"").is_err() && read(b"\x89MCAP0\r\n").is_err());
        assert!(images(&file[..file.len() / 2], 0).is_err());
        // Every kind of record begins somewhere in these.
        for place in (0..file.len()).step_by(97) {
            for byte in [0x00, 0xff] {
                let mut changed = file.clone();
                changed[place] = byte;
                let _ = (read(&changed), images(&changed, 1));
            }
        }
    }
}
