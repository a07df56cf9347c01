//! Evaluation from the command line: flies a trained snapshot, prints and writes how it fares.
//!
//! `skein-evaluate` and `skein evaluate` share what is here.

use std::fs::{self, File, OpenOptions};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::courses::Courses;
use crate::evaluation::{Evaluation, Keep, MAX_THREADS};
use crate::recording::{COLUMNS, check_recordable, write_recording};
use anyhow::{Context, bail};
use clap::{Args, Parser};
use skein_kernels::Isa;
use skein_protocol::config::Config;
use skein_protocol::snapshot::Snapshot;
use skein_run::RunDirectory;
use skein_run::tables::evaluation_table;
use skein_simulator::camera::InstructionSet;
use skein_simulator::suite::{EntryCourses, MOST_EPISODES, Suite, SuiteEntry};

/// Flies a trained snapshot through courses and prints how it fares.
///
/// Every episode takes off from the start of level 1 and follows the policy without noise. The
/// episodes are the same each time, whatever the number of threads: their seeds derive from the
/// seed of the run that trained the snapshot, whose configuration lies in the snapshot file.
///
/// R is the average rate of walls passed, (t_1 + … + t_n) / (n · episodes), where t_i counts the
/// episodes that passed wall i. Beside it stands what the other episodes failed by: which wall they
/// hit, or before which one they hit the corridor or ran out of steps. Walls are counted in the
/// order in which they are met.
#[derive(Debug, Parser)]
#[command(name = "skein-evaluate", version, after_long_help = columns_help())]
pub struct Arguments {
    #[command(flatten)]
    subject: Subject,
    /// A course file to fly, once for each course. By default the evaluation courses of the run
    /// that trained the snapshot.
    #[arg(long, value_name = "FILE")]
    course: Vec<PathBuf>,
    /// A suite file to fly instead: courses, all orders of a course's walls, generated courses,
    /// each with disturbances of its own; as configs/evaluations/generalist.toml.
    #[arg(long, value_name = "FILE", conflicts_with = "course")]
    suite: Option<PathBuf>,
    /// Episodes per course, or of each entry of the suite. By default evaluation.episodes of that
    /// run, or what the suite says.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=MOST_EPISODES))]
    episodes: Option<u64>,
    /// Also write the result to this file, as JSON.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Also write every step of every episode to this file, as .npz; takes 9.3 KiB of memory for
    /// each step, about 1 MiB for each whole episode.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    // Not a doc comment: those cannot name the constant.
    #[arg(long, value_name = "N", help = threads_help())]
    threads: Option<NonZeroUsize>,
}

/// What is flown.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct Subject {
    /// Directory of a run: its best snapshot is flown, or the latest where none has been confirmed
    /// as best.
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// A snapshot file (.safetensors).
    #[arg(long, value_name = "FILE")]
    snapshot: Option<PathBuf>,
}

/// Flies what `arguments` ask for, prints the table and writes the files.
///
/// # Errors
/// An error names the file or option at fault.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    if let Some(file) = &arguments.json {
        check_writable(file)?;
    }
    if let Some(file) = &arguments.record {
        check_folder(file)?;
        check_recordable(file)?;
    }
    let path = snapshot_path(&arguments.subject)?;
    let (snapshot, config) = Snapshot::load(&path)?;
    let courses = Arc::new(courses(arguments, &config, &path)?);
    let threads = arguments
        .threads
        .map_or_else(std::thread::available_parallelism, Ok)
        .unwrap_or(NonZeroUsize::MIN);
    let keep = if arguments.record.is_some() {
        Keep::Records
    } else {
        Keep::Scores
    };
    let evaluation = Evaluation {
        snapshot: &snapshot,
        config: &config,
        courses: Arc::clone(&courses),
        threads,
        keep,
    };
    eprintln!(
        "snapshot {} of {}: {}, {} threads",
        snapshot.version,
        path.display(),
        what_is_flown(
            &courses,
            arguments.suite.as_ref().map_or("courses", |_| "entries")
        ),
        evaluation.threads()
    );
    eprintln!(
        "networks are computed with {}; images are drawn with {}",
        Isa::best(),
        InstructionSet::best()
    );
    for note in shapes_trained_on(&config, &courses) {
        eprintln!("{note}");
    }
    let evaluated = evaluation.run()?;

    println!("{}", evaluation_table(&evaluated.report));
    if let Some(file) = &arguments.json {
        let json =
            serde_json::to_string_pretty(&evaluated.report).context("the result is no JSON")?;
        fs::write(file, json).with_context(|| format!("cannot write {}", file.display()))?;
    }
    if let Some(file) = &arguments.record {
        let names: Vec<_> = courses
            .evaluation()
            .map(|entry| entry.name.as_str())
            .collect();
        write_recording(file, &names, config.vae.latent, &evaluated.episodes)?;
    }
    Ok(())
}

/// Minutes of flying must not end in a file that cannot be written. Leaves nothing behind and an
/// existing file as it is.
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
            // The link that names it, if there is one, stays.
            .and_then(fs::remove_file)
            .with_context(cannot_write),
    }
}

/// The system's word for a missing folder is the one for a missing file.
fn check_folder(file: &Path) -> anyhow::Result<()> {
    let folder = match file.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        bail!(
            "cannot write {}: there is no folder {}; create it, or name another",
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
    // Of a run that has an identity, it can be told whether its courses are those that it was
    // trained and evaluated on.
    if directory.identity().is_file() {
        directory.open()?;
    }
    let candidates = [directory.best_snapshot(), directory.latest_snapshot()];
    let found = candidates.iter().find(|path| path.is_file()).cloned();
    found.with_context(|| {
        format!(
            "{} holds neither snapshots/best.safetensors nor snapshots/latest.safetensors: is it the directory of a run, and has its first epoch ended?",
            run.display()
        )
    })
}

/// What the arguments ask to be flown.
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

/// How many episodes of what, in words; `entries` is what there is a number of episodes for.
fn what_is_flown(courses: &Courses, entries: &str) -> String {
    let episodes: Vec<u64> = courses.evaluation().map(|entry| entry.episodes).collect();
    match episodes.as_slice() {
        [first, others @ ..] if others.iter().all(|episodes| episodes == first) => {
            format!("{first} episodes on each of {} {entries}", episodes.len())
        }
        _ => format!(
            "{} episodes in {} {entries}",
            episodes.iter().sum::<u64>(),
            episodes.len()
        ),
    }
}

/// A line for each entry that generates shapes which the snapshot was trained on: what it measures
/// is not what an agent makes of new shapes.
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

/// The evaluation courses of the run that trained the snapshot: in the run's directory, wherever
/// that has moved.
fn evaluation_courses(config: &Config, snapshot: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let snapshot =
        std::path::absolute(snapshot).with_context(|| format!("{}", snapshot.display()))?;
    // DIR/snapshots/best.safetensors, beside DIR/courses/.
    let folder = RunDirectory::new(snapshot.ancestors().nth(2).unwrap_or(Path::new("/"))).courses();
    let find = |path: &PathBuf| {
        let file = folder.join(path.file_name().unwrap_or_default());
        file.is_file().then(|| file.clone()).with_context(|| {
            format!(
                "{}, which the snapshot's run was evaluated on, is not there; name the course files to fly with --course",
                file.display()
            )
        })
    };
    config.courses.evaluation.iter().map(find).collect()
}

fn threads_help() -> String {
    format!(
        "Most threads to fly on, at most {MAX_THREADS} and one an episode. By default one a core"
    )
}

/// The arrays of a recording, for the long help.
fn columns_help() -> String {
    let rows = COLUMNS.iter().map(|column| {
        let shape: Vec<_> = std::iter::once("n".to_owned())
            .chain(column.shape.iter().map(ToString::to_string))
            .collect();
        format!(
            "  {:<13} {:<4} {:<14} {}\n",
            column.name,
            column.kind,
            format!("[{}]", shape.join(", ")),
            column.meaning
        )
    });
    format!(
        "Arrays in the file of --record, read by numpy.load(FILE); a row for each observation, episodes and courses in order:\n{}  {:<13} {:<4} {:<14} {}",
        rows.collect::<String>(),
        "course_names",
        "<U",
        "[courses]",
        "names of the courses"
    )
}
