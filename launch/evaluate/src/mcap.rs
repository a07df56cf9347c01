//! Recordings of evaluation episodes as MCAP: entry by entry, episode by episode.

use std::io;
use std::path::Path;

use skein_inference::Decoder;
use skein_protocol::transition::RecordLengths;
use skein_recordings::{Episode, Recording};
use skein_rollout::courses::Courses;
use skein_rollout::evaluation::EvaluatedEpisode;

use crate::progress::Progress;

/// Writes `episodes`, entry by entry, to `path`, and says how far it is: with a decoder, a step
/// takes longer than it was flown in.
///
/// # Errors
/// Of the file, or if a course cannot be generated again.
pub(crate) fn write(
    path: &Path,
    courses: &Courses,
    lengths: RecordLengths,
    decoder: Option<&Decoder>,
    episodes: &[Vec<EvaluatedEpisode>],
) -> io::Result<()> {
    let entries = courses.evaluation();
    let names: Vec<_> = entries.map(|entry| entry.name.as_str()).collect();
    let progress = Progress::new(
        "recording episode",
        episodes.iter().flatten().count() as u64,
    );
    let mut written = 0;
    let mut recording =
        Recording::create(path, courses.settings(), lengths.action, &names, decoder)?;
    for (entry_number, (entry, episodes)) in (0..).zip(courses.evaluation().zip(episodes)) {
        for (number, episode) in (0..).zip(episodes) {
            let course = entry.courses.of_episode(number);
            let course = course.map_err(io::Error::other)?;
            let header = Episode {
                title: &format!("{}, episode {number}", entry.name),
                course: (&course, entry_number),
                number: number as i32,
                lengths,
                score: episode.score,
            };
            let records = episode.records.iter().map(|record| &**record);
            recording.add(&header, records)?;
            written += 1;
            progress.tell(written);
        }
    }
    progress.finish();
    recording.finish()
}
