//! `skein-bench`: tells which benchmarks there are, and sets what they measured in a table.
//! `tests/bench.sh` runs them in between.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};
use serde::Serialize;
use skein_bench::catalogue::{BenchKind, Catalogue, Growth, Row, When, bench_of};
use skein_bench::faults::faults;
use skein_bench::figures::Figures;
use skein_bench::machine::{Core, Machine};
use skein_bench::table::{Judging, Table};
use skein_reports::growth::{GrowthLine, GrowthPicture};
use skein_run::failure::with_causes;

/// Lists the benchmarks, and tells what they measured.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Print name and kind of each benchmark that is to be run, one a line.
    List {
        /// This one alone; may be repeated.
        #[arg(long, value_name = "NAME")]
        only: Vec<String>,
        /// Those too that only pictures of growth need.
        #[arg(long)]
        growth: bool,
    },
    /// Measure what this core can do at best, and print it as a line of JSON.
    Core,
    /// Print the table of what was measured, and write it beside the figures.
    Table {
        /// Where the figures are.
        directory: PathBuf,
        /// Rows of this benchmark alone; may be repeated.
        #[arg(long, value_name = "NAME")]
        only: Vec<String>,
        /// The benchmarks were run to see that they work: judge nothing.
        #[arg(long)]
        quick: bool,
        /// Draw how cost grows into this folder.
        #[arg(long, value_name = "DIR")]
        pictures: Option<PathBuf>,
    },
}

/// `table.json`.
#[derive(Serialize)]
struct Results<'a> {
    machine: &'a Machine,
    #[serde(flatten)]
    table: &'a Table,
}

fn main() -> ExitCode {
    let done = match Cli::parse().command {
        Command::List { only, growth } => {
            list(&only, if growth { When::Growth } else { When::Always })
        }
        Command::Core => core(),
        Command::Table {
            directory,
            only,
            quick,
            pictures,
        } => {
            let judging = if quick {
                Judging::Nothing
            } else {
                Judging::Times
            };
            tell(&directory, &only, judging, pictures.as_deref())
        }
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("skein-bench: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn list(only: &[String], when: When) -> Result<()> {
    let benches = Catalogue::load().benches;
    if let Some(unknown) = only
        .iter()
        .find(|name| benches.iter().all(|bench| bench.name != **name))
    {
        let names: Vec<_> = benches.into_iter().map(|bench| bench.name).collect();
        bail!(
            "no benchmark is called {unknown}; there are {}",
            names.join(", ")
        );
    }
    for bench in benches {
        let wanted = match only {
            [] => bench.when == When::Always || when == When::Growth,
            only => only.contains(&bench.name),
        };
        if wanted {
            let kind = match bench.kind {
                BenchKind::OneCore => "one-core",
                BenchKind::Processes => "processes",
            };
            println!("{} {kind}", bench.name);
        }
    }
    Ok(())
}

fn core() -> Result<()> {
    println!("{}", serde_json::to_string(&Core::measure())?);
    Ok(())
}

fn tell(
    directory: &Path,
    only: &[String],
    judging: Judging,
    pictures: Option<&Path>,
) -> Result<()> {
    let wanted = |figure: &str| only.is_empty() || only.iter().any(|name| name == bench_of(figure));
    let Catalogue { rows, growths, .. } = Catalogue::load();
    let figures = Figures::read(directory)?;
    if figures.is_empty() {
        bail!(
            "{} holds no figures: run tests/bench.sh",
            directory.display()
        );
    }
    let machine = Machine::with(Core::best_of(&directory.join("machine.jsonl")));
    let rows: Vec<Row> = rows.into_iter().filter(|row| wanted(&row.figure)).collect();
    let table = Table::new(&rows, &figures, machine.core.f32_flops);
    let note = note(judging, &figures);
    println!("{machine}\n{}\n{note}", table.to_terminal(judging));

    let write = |name: &str, text: String| {
        let path = directory.join(name);
        fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    };
    write(
        "table.md",
        format!("{machine}\n\n{}\n\n{note}\n", table.to_markdown(judging)),
    )?;
    let results = Results {
        machine: &machine,
        table: &table,
    };
    write("table.json", serde_json::to_string_pretty(&results)?)?;
    let growths: Vec<Growth> = growths
        .into_iter()
        .filter(|growth| {
            pictures.is_some() && growth.series.iter().all(|series| wanted(&series.of))
        })
        .collect();
    if let Some(folder) = pictures {
        draw(&growths, &figures, folder)?;
    }
    match faults(&rows, &growths, &figures) {
        faults if faults.is_empty() => Ok(()),
        faults => bail!(
            "the benchmarks told something else than tests/bench/benchmarks.toml asks for:\n  {}",
            faults.join("\n  ")
        ),
    }
}

/// What is to be known of the table's times.
fn note(judging: Judging, figures: &Figures) -> String {
    match (judging, figures.most_disturbed()) {
        (Judging::Nothing, _) => {
            "Run to see that the benchmarks work: these times mean nothing.".to_owned()
        }
        (Judging::Times, None) => {
            "What needs processes is a median of 15 starts, or a mean over two seconds.".to_owned()
        }
        (Judging::Times, Some((name, times))) => format!(
            "A figure that has a median beside it is the fastest of 60 samples, and judged by that; the median took up to {times:.2} times as long, at {name}."
        ),
    }
}

fn draw(growths: &[Growth], figures: &Figures, folder: &Path) -> Result<()> {
    for growth in growths {
        let path = folder.join(&growth.picture).with_extension("png");
        if picture(growth, figures).draw(&path)? {
            println!("{}", path.display());
        }
    }
    Ok(())
}

fn picture<'a>(growth: &'a Growth, figures: &Figures) -> GrowthPicture<'a> {
    let lines = growth.series.iter().map(|series| GrowthLine {
        label: &series.label,
        points: figures
            .series(&series.of)
            .into_iter()
            .filter_map(|(x, figure)| {
                let shown = figure.shown(series.show, &series.unit, series.scale);
                Some((x, shown.ok()?))
            })
            .collect(),
    });
    GrowthPicture {
        title: &growth.title,
        x: &growth.x,
        y: &growth.y,
        lines: lines.collect(),
    }
}
