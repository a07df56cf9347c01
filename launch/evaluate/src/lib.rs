//! Evaluation from the command line: flies a trained snapshot, prints and stores the results.
//!
//! `skein-evaluate` and `skein evaluate` share this module.

mod failures;
mod film;
mod mcap;
mod memory;
mod plot;
mod progress;
mod settings;

use std::fs::{self, File, OpenOptions};
use std::num::NonZeroUsize;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::memory::{check_recording, free_memory};
use crate::progress::Progress;
use crate::settings::{Flown, with_overrides};
use anyhow::{Context, bail};
use clap::{Args, Parser};
use serde::Serialize;
use skein_inference::Decoder;
use skein_kernels::Isa;
use skein_protocol::config::{Config, failing_override};
use skein_protocol::decoder_file::{DECODER_FILE, TrainedDecoder};
use skein_protocol::encoder_file::TrainedEncoder;
use skein_protocol::evaluation::EvaluationReport;
use skein_protocol::files::destination;
use skein_protocol::snapshot::Snapshot;
use skein_protocol::transition::RecordLengths;
use skein_reports::{MOST_DRAWN, unfinished_picture};
use skein_rollout::courses::Courses;
use skein_rollout::evaluation::{EvaluatedEpisode, Evaluation, Keep, MAX_THREADS};
use skein_rollout::recording::{
    COLUMNS, NAME_LISTS, RecordingError, check_recordable, temporary_path, write_atomically,
    write_recording,
};
use skein_run::RunDirectory;
use skein_run::tables::evaluation_table;
use skein_run::terminal::stdout_columns;
use skein_run::{note, show};
use skein_simulator::camera::InstructionSet;
use skein_simulator::suite::{EntryCourses, MOST_EPISODES, Suite, SuiteEntry};

/// Flies a trained snapshot through courses and prints its results.
///
/// Every episode begins at the start of level 1 and follows the policy without noise. The episodes
/// are the same each time, whatever the number of threads: their seeds derive from the seed of the
/// run that trained the snapshot. The snapshot file holds that run's configuration.
///
/// R is the mean rate of walls passed, (t_1 + … + t_n) / (n · episodes), where t_i counts the
/// episodes that passed wall i. The table also shows how the other episodes failed: the wall they
/// hit, or the wall before which they hit the corridor or ran out of steps. Walls are numbered in
/// the order in which the drone meets them.
#[derive(Debug, Parser)]
#[command(name = "skein-evaluate", version, after_long_help = columns_help())]
pub struct Arguments {
    #[command(flatten)]
    subject: Subject,
    /// A course file to fly; may be repeated. By default the evaluation courses of the run that
    /// trained the snapshot.
    #[arg(long, value_name = "FILE")]
    course: Vec<PathBuf>,
    /// A suite file to fly instead: courses, all orders of a course's walls, or generated courses,
    /// each with its own disturbances. Example: configs/evaluations/generalist.toml.
    #[arg(long, value_name = "FILE", conflicts_with = "course")]
    suite: Option<PathBuf>,
    /// Episodes per course or per entry of the suite. By default evaluation.episodes of that run,
    /// or the suite's number.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=MOST_EPISODES))]
    episodes: Option<u64>,
    /// Change one setting that the snapshot was trained with, for example
    /// --set simulator.vehicle.preset=hummingbird; may be repeated.
    ///
    /// Keys in [simulator] can be changed, and run.seed, from which the episodes' seeds derive.
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    overrides: Vec<String>,
    /// Also write the result to this file, as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Also write every step of every episode to this file. Needs 9.3 KiB of memory per step, about
    /// 1 MiB per whole episode.
    ///
    /// A file FILE.mcap is one that Foxglove and Rerun open; any other is an .npz, for NumPy.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Also draw the trajectories to this file, as PNG: each course from above and from the side,
    /// and its walls from the front. Of an entry with several courses, the first is drawn.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    #[command(flatten)]
    pictures: Pictures,
    // Not a doc comment, which cannot contain the constant.
    #[arg(long, value_name = "N", help = threads_help())]
    threads: Option<NonZeroUsize>,
}

/// Pictures of single episodes.
#[derive(Debug, Clone, Args)]
pub struct Pictures {
    /// Draw the episodes that failed to this file, as PNG, and print how the approaches to the
    /// walls ended: by shape of the opening, its clearance and its offset.
    ///
    /// The picture shows the wall with its opening, the last two metres, and the depth image a
    /// second before the end. What happened most often comes first.
    #[arg(long, value_name = "FILE")]
    pub failures: Option<PathBuf>,
    /// Draw the first episode to this file as it flies, as GIF: from above, from the side,
    /// its depth image, and what the latent code keeps of it. Five times as fast as flown.
    #[arg(long, value_name = "FILE")]
    pub gif: Option<PathBuf>,
}

/// Snapshot to fly.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct Subject {
    /// Directory of a run: flies its best snapshot, or its latest if none has been confirmed as
    /// best.
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// A snapshot file (.safetensors).
    #[arg(long, value_name = "FILE")]
    snapshot: Option<PathBuf>,
}

/// Flies the final evaluation of a run again, or `suite`, and draws `pictures` of it. For a moving
/// picture alone, one episode of each course is flown.
///
/// # Errors
/// As for [`run`].
pub fn draw(run: &Path, suite: Option<&Path>, pictures: &Pictures) -> anyhow::Result<()> {
    self::run(&Arguments {
        subject: Subject {
            run: Some(run.to_owned()),
            snapshot: None,
        },
        course: Vec::new(),
        suite: suite.map(Path::to_owned),
        episodes: pictures.failures.is_none().then_some(1),
        overrides: Vec::new(),
        json: None,
        record: None,
        plot: None,
        pictures: pictures.clone(),
        threads: None,
    })
}

/// Flies what `arguments` ask for, prints the table and writes the files.
///
/// # Errors
/// An error names the file or option at fault.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let path = snapshot_path(&arguments.subject)?;
    check_distinct_files(arguments, &path)?;
    if let Some(file) = &arguments.json {
        check_writable(file)?;
    }
    if let Some(file) = &arguments.record {
        check_folder(file)?;
        check_recordable(file)?;
    }
    let Pictures { failures, gif } = &arguments.pictures;
    let pictures = [
        ("--plot", "png", &arguments.plot),
        ("--failures", "png", failures),
        ("--gif", "gif", gif),
    ];
    for (option, ending, file) in pictures {
        if let Some(file) = file {
            check_plottable(file)?;
            check_ending(option, ending, file)?;
        }
    }
    let (snapshot, trained) = Snapshot::load(&path)?;
    let flown = match arguments.suite {
        Some(_) => Flown::Suite,
        None => Flown::Courses,
    };
    let planned = |overrides: &[String]| {
        let config = with_overrides(&trained, &path, overrides, flown)?;
        let courses = courses(arguments, &config, &path)?;
        courses.check()?;
        anyhow::Ok((config, courses))
    };
    let (config, courses) = planned(&arguments.overrides).map_err(|error| {
        let message = |overrides: &[String]| Some(planned(overrides).err()?.to_string());
        match failing_override(&arguments.overrides, message) {
            Some(text) if !error.to_string().contains("--set") => {
                error.context(format!("with --set {text}"))
            }
            _ => error,
        }
    })?;
    if arguments.record.is_some() {
        let episodes = courses.evaluation().map(|entry| entry.episodes).sum();
        check_recording(episodes, courses.most_records(), free_memory())?;
    }
    let recording = arguments.record.as_deref();
    let decoder = match recording.is_some_and(is_mcap) || gif.is_some() {
        true => decoder(&arguments.subject, &path, &snapshot, &config)?,
        false => None,
    };
    let decoder = decoder.as_ref();
    let courses = Arc::new(courses);
    let threads = arguments
        .threads
        .map_or_else(std::thread::available_parallelism, Ok)
        .unwrap_or(NonZeroUsize::MIN);
    let keep = match arguments {
        Arguments {
            record: Some(_), ..
        } => Keep::Records,
        _ if failures.is_some() => failures::to_keep(courses.settings()),
        Arguments { plot: Some(_), .. } => Keep::Positions(MOST_DRAWN as u64),
        _ => Keep::Scores,
    };
    let evaluation = Evaluation {
        snapshot: &snapshot,
        config: &config,
        courses: Arc::clone(&courses),
        threads,
        keep,
    };
    note!(
        "snapshot {} of {}: {}, {}",
        snapshot.version,
        path.display(),
        describe_episodes(
            &courses
                .evaluation()
                .map(|entry| entry.episodes)
                .collect::<Vec<_>>(),
            match arguments.suite {
                Some(_) => ["entry", "entries"],
                None => ["course", "courses"],
            }
        ),
        plural(evaluation.threads() as u64, ["thread", "threads"])
    );
    note!(
        "networks are computed with {}; images are drawn with {}",
        Isa::best(),
        InstructionSet::best()
    );
    if !arguments.overrides.is_empty() {
        note!("changed settings: {}", arguments.overrides.join(", "));
    }
    for note in shapes_trained_on(&config, &courses) {
        note!("{note}");
    }
    let progress = Progress::new("episode", evaluation.total());
    let evaluated = evaluation.run_and_tell(&|flown| progress.tell(flown));
    progress.finish();
    let evaluated = evaluated?;

    // Files first: the terminal may be gone. A file that cannot be written costs no other result.
    let json = arguments.json.as_deref();
    let written = json.map_or(Ok(()), |file| {
        let report = WrittenReport {
            report: &evaluated.report,
            changed_settings: &arguments.overrides,
        };
        write_json(file, &report)
    });
    let recorded = arguments.record.as_ref().map_or(Ok(()), |file| {
        let lengths = config.record_lengths();
        note!("recording: {}", file.display());
        record(file, &courses, lengths, decoder, &evaluated.episodes)
    });
    let drawn = arguments.plot.as_ref().map_or(Ok(()), |file| {
        plot::draw(&courses, &evaluated.episodes, file)
    });
    let failures = failures
        .as_ref()
        .map(|file| failures::draw(&courses, &evaluated.episodes, file, stdout_columns()));
    let filmed = gif.as_ref().map_or(Ok(()), |file| {
        let again = self::courses(arguments, &config, &path)?.with_episodes(1);
        film::draw(&snapshot, &config, again, decoder, file)
    });
    show!("{}", evaluation_table(&evaluated.report, stdout_columns()));
    written?;
    recorded?;
    drawn?;
    filmed?;
    if let Some(approaches) = failures {
        show!("{}", approaches?);
    }
    for (option, _, file) in pictures {
        if let Some(file) = file {
            note!("{}: {}", option.trim_start_matches('-'), file.display());
        }
    }
    Ok(())
}

/// Returns the decoder of the snapshot's latent codes, if a run or the folder of the snapshot has
/// it.
fn decoder(
    subject: &Subject,
    path: &Path,
    snapshot: &Snapshot,
    config: &Config,
) -> anyhow::Result<Option<Decoder>> {
    let file = match &subject.run {
        Some(run) => RunDirectory::new(run).decoder(),
        None => path.with_file_name(DECODER_FILE),
    };
    let encoder = TrainedEncoder::of_snapshot(snapshot, config);
    let trained = TrainedDecoder::of(&encoder.sha256(), &file)
        .context("this file is only for what latent codes hold: remove it to do without")?;
    Ok(trained.map(|trained| Decoder::new(Isa::best(), &trained)))
}

fn is_mcap(file: &Path) -> bool {
    file.extension()
        .is_some_and(|extension| extension == "mcap")
}

/// Writes a recording in the format that the file's name asks for.
fn record(
    file: &Path,
    courses: &Courses,
    lengths: RecordLengths,
    decoder: Option<&Decoder>,
    episodes: &[Vec<EvaluatedEpisode>],
) -> Result<(), RecordingError> {
    match is_mcap(file) {
        true => write_atomically(file, |file| {
            mcap::write(file, courses, lengths, decoder, episodes)
        }),
        false => {
            let entries = courses.evaluation();
            let names: Vec<_> = entries.map(|entry| entry.name.as_str()).collect();
            write_recording(file, &names, lengths, episodes)
        }
    }
}

fn write_json(file: &Path, report: &WrittenReport<'_>) -> anyhow::Result<()> {
    let json = serde_json::to_string_pretty(report).context("cannot write the result as JSON")?;
    fs::write(file, json).with_context(|| format!("cannot write {}", file.display()))
}

/// Checks that the file of a picture says what it is; so no file of a run is replaced by mistake.
fn check_ending(option: &str, ending: &str, file: &Path) -> anyhow::Result<()> {
    if file.extension().is_some_and(|there| there != ending) {
        bail!(
            "{option} {}: the picture is a {} file; give it a name that ends in .{ending}",
            file.display(),
            ending.to_uppercase()
        );
    }
    Ok(())
}

/// Checks that a picture can be written to `file`. A picture replaces the file, so nothing but a
/// regular file may be there.
fn check_plottable(file: &Path) -> anyhow::Result<()> {
    if fs::metadata(file).is_ok_and(|there| !there.is_file()) {
        bail!(
            "cannot write {}: it is not a regular file, so a picture cannot replace it; \
             name another",
            file.display()
        );
    }
    check_writable(file)
}

/// Result as JSON, with the settings in which it differs from the training.
#[derive(Serialize)]
struct WrittenReport<'a> {
    #[serde(flatten)]
    report: &'a EvaluationReport,
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    changed_settings: &'a [String],
}

/// Refuses an output file that is also another output or an input: one would be lost.
fn check_distinct_files(arguments: &Arguments, snapshot: &Path) -> anyhow::Result<()> {
    let outputs = [
        ("--json", arguments.json.clone()),
        ("--record", arguments.record.clone()),
        ("--plot", arguments.plot.clone()),
        ("--failures", arguments.pictures.failures.clone()),
        ("--gif", arguments.pictures.gif.clone()),
        (
            "the unfinished file of --record",
            arguments.record.as_deref().map(temporary_path),
        ),
        (
            "the unfinished file of --plot",
            arguments.plot.as_deref().map(unfinished_picture),
        ),
        (
            "the unfinished file of --failures",
            arguments
                .pictures
                .failures
                .as_deref()
                .map(unfinished_picture),
        ),
        (
            "the unfinished file of --gif",
            arguments.pictures.gif.as_deref().map(unfinished_picture),
        ),
    ];
    let outputs: Vec<_> = outputs
        .into_iter()
        .filter_map(|(option, file)| Some((option, file?)))
        .collect();
    let run = arguments.subject.run.as_ref().map(RunDirectory::new);
    let of_run = run.iter().flat_map(|run| {
        [
            run.config(),
            run.identity(),
            run.summary_json(),
            run.episodes_csv(),
            run.decoder(),
        ]
        .map(|file| ("a file of the run", file))
    });
    let inputs = [("the snapshot", snapshot.to_owned())]
        .into_iter()
        .chain(of_run)
        .chain(
            arguments
                .course
                .iter()
                .map(|file| ("--course", file.clone())),
        )
        .chain(arguments.suite.iter().map(|file| ("--suite", file.clone())));
    let all: Vec<_> = outputs.iter().cloned().chain(inputs).collect();
    for (number, (option, file)) in outputs.iter().enumerate() {
        let same = all[number + 1..]
            .iter()
            .find(|(_, other)| is_same_file(file, other));
        if let Some((other, _)) = same {
            bail!(
                "{option} and {other} are the same file, {}, of which one would be lost; name \
                another",
                file.display()
            );
        }
    }
    Ok(())
}

/// `true` if both paths lead to one regular file, or to one that does not exist yet.
fn is_same_file(one: &Path, other: &Path) -> bool {
    match (fs::metadata(one), fs::metadata(other)) {
        (Ok(one), Ok(other)) => {
            one.is_file() && (one.dev(), one.ino()) == (other.dev(), other.ino())
        }
        (Err(_), Err(_)) => {
            let place = destination(one);
            place.is_some() && place == destination(other)
        }
        _ => false,
    }
}

/// Checks that `file` can be written, so that a long evaluation is not lost. Leaves no file behind
/// and does not change an existing one.
fn check_writable(file: &Path) -> anyhow::Result<()> {
    check_folder(file)?;
    let cannot_write = || format!("cannot write {}", file.display());
    match fs::metadata(file) {
        // Opening a pipe would wait for its reader.
        Ok(there) if !there.is_file() && !there.is_dir() => Ok(()),
        Ok(_) => OpenOptions::new()
            .write(true)
            .open(file)
            .map(drop)
            .with_context(cannot_write),
        Err(_) => File::create(file)
            .and_then(|_| fs::canonicalize(file))
            // If a link names it, the link stays.
            .and_then(fs::remove_file)
            .with_context(cannot_write),
    }
}

/// Checks that the folder of `file` exists: the system reports a missing folder like a missing
/// file.
fn check_folder(file: &Path) -> anyhow::Result<()> {
    let folder = match file.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        bail!(
            "cannot write {}: folder {} does not exist; create it, or name another",
            file.display(),
            folder.display()
        );
    }
    Ok(())
}

fn snapshot_path(subject: &Subject) -> anyhow::Result<PathBuf> {
    let Some(run) = &subject.run else {
        return subject
            .snapshot
            .clone()
            .context("neither --run nor --snapshot is given");
    };
    let directory = RunDirectory::new(run);
    // For a run with an identity, this checks that its courses are those it was trained and
    // evaluated on.
    let identity = directory.identity();
    match identity.try_exists() {
        Ok(true) => drop(directory.open()?),
        Ok(false) => {}
        Err(error) => return Err(error).with_context(|| identity.display().to_string()),
    }
    // A best snapshot that cannot be read is an error: the latest is another policy.
    let is_there = |path: &PathBuf| fs::symlink_metadata(path).is_ok();
    let mut candidates = [directory.best_snapshot(), directory.latest_snapshot()].into_iter();
    candidates.find(is_there).with_context(|| {
        format!(
            "{} holds neither snapshots/best.safetensors nor snapshots/latest.safetensors: is it \
            the directory of a run whose first epoch has ended?",
            run.display()
        )
    })
}

/// Loads the courses that the arguments name.
fn courses(arguments: &Arguments, config: &Config, snapshot: &Path) -> anyhow::Result<Courses> {
    let courses = match (&arguments.suite, arguments.course.as_slice()) {
        (Some(file), _) => Courses::of_suite(config, Suite::load(file)?)
            .with_context(|| format!("{} cannot be flown", file.display()))?,
        (None, []) => Courses::of_files(config, &evaluation_courses(config, snapshot)?)?,
        (None, files) => Courses::of_files(config, files)?,
    };
    Ok(match arguments.episodes {
        Some(episodes) => courses.with_episodes(episodes),
        None => courses,
    })
}

/// Returns `count` with the word for one or for more.
fn plural(count: u64, [one, more]: [&str; 2]) -> String {
    format!("{count} {}", if count == 1 { one } else { more })
}

/// Describes episodes by their number per course or entry of a suite; `entries` is the word for one
/// of these and for more.
fn describe_episodes(episodes: &[u64], entries: [&str; 2]) -> String {
    match episodes {
        [first, others @ ..] if others.iter().all(|episodes| episodes == first) => {
            let flown = plural(*first, ["episode", "episodes"]);
            match episodes.len() {
                1 => format!("{flown} on 1 {}", entries[0]),
                count => format!("{flown} on each of {count} {}", entries[1]),
            }
        }
        _ => format!(
            "{} in {}",
            plural(episodes.iter().sum(), ["episode", "episodes"]),
            plural(episodes.len() as u64, entries)
        ),
    }
}

/// Returns a note for each entry with generated shapes that the snapshot was trained on: its result
/// does not measure performance on new shapes.
fn shapes_trained_on(config: &Config, courses: &Courses) -> Vec<String> {
    let trained = &courses.settings().generator.shapes;
    let known = |entry: &SuiteEntry| match &entry.courses {
        EntryCourses::Generated { ranges, .. } if config.courses.generated_share > 0.0 => {
            let shapes = ranges.shapes.iter().filter(|shape| trained.contains(shape));
            shapes.map(|shape| shape.name()).collect::<Vec<_>>()
        }
        _ => Vec::new(),
    };
    courses
        .evaluation()
        .map(|entry| (entry, known(entry)))
        .filter(|(_, known)| !known.is_empty())
        .map(|(entry, known)| {
            let shapes = known.join(", ");
            format!(
                "note: \"{}\" flies shapes that this snapshot was trained on: {shapes}",
                entry.name
            )
        })
        .collect()
}

/// Returns the evaluation courses of the run that trained the snapshot, from the run's directory,
/// which may have moved.
fn evaluation_courses(config: &Config, snapshot: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let snapshot =
        std::path::absolute(snapshot).with_context(|| format!("{}", snapshot.display()))?;
    // The snapshot is DIR/snapshots/best.safetensors; courses lie in DIR/courses/.
    let folder = RunDirectory::new(snapshot.ancestors().nth(2).unwrap_or(Path::new("/"))).courses();
    let find = |path: &PathBuf| {
        let file = folder.join(path.file_name().unwrap_or_default());
        file.is_file().then(|| file.clone()).with_context(|| {
            format!(
                "{}, an evaluation course of the snapshot's run, does not exist; name course \
                files with --course",
                file.display()
            )
        })
    };
    config.courses.evaluation.iter().map(find).collect()
}

fn threads_help() -> String {
    format!(
        "Most threads to fly on; at most {MAX_THREADS}, and one per episode. By default one per \
        core"
    )
}

/// Returns the description of a recording's arrays, for the long help.
fn columns_help() -> String {
    let rows = COLUMNS.iter().map(|column| {
        let shape: Vec<_> = std::iter::once("n".to_owned())
            .chain(column.shape.iter().map(ToString::to_string))
            .collect();
        let shape = format!("[{}]", shape.join(", "));
        (column.name, column.kind, shape, column.meaning)
    });
    let names = NAME_LISTS.iter();
    let lists = names.map(|&(name, shape, meaning)| (name, "<U", shape.to_owned(), meaning));
    let lines: Vec<_> = rows
        .chain(lists)
        .map(|(name, kind, shape, meaning)| format!("  {name:<17} {kind:<4} {shape:<14} {meaning}"))
        .collect();
    format!(
        "Arrays in the .npz file of --record, read by numpy.load(FILE); one row per observation, \
        episodes and courses in order:\n{}\n\n\
        Exit status: 0 flown, 1 failed, 2 wrong arguments.",
        lines.join("\n")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_flown_is_described_in_singular_and_plural() {
        let described = |episodes: &[u64]| describe_episodes(episodes, ["entry", "entries"]);
        assert_eq!(described(&[1]), "1 episode on 1 entry");
        assert_eq!(described(&[20]), "20 episodes on 1 entry");
        assert_eq!(described(&[1, 1]), "1 episode on each of 2 entries");
        assert_eq!(described(&[20, 1]), "21 episodes in 2 entries");
    }
}
