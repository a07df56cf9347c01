//! `skein-bench`: lists the benchmarks, and tabulates their results. `tests/bench.sh` runs the
//! benchmarks in between.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};
use serde::Serialize;
use skein_bench::catalogue::{
    Bench, BenchKind, BenchmarkRow, Catalogue, Growth, RunCondition, bench_of,
};
use skein_bench::faults::faults;
use skein_bench::figures::BenchmarkFigures;
use skein_bench::machine::{Core, Machine};
use skein_bench::table::{Judging, Table};
use skein_reports::growth::{GrowthLine, GrowthPicture};
use skein_run::failure::with_causes;
use skein_run::signals::survive_file_size_limit;
use skein_run::terminal::stdout_columns;
use skein_run::{note, show};

/// Lists the benchmarks and tabulates their results.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Print name and kind of each benchmark to run, one per line.
    List {
        /// Only this benchmark; may be repeated.
        #[arg(long, value_name = "NAME")]
        only: Vec<String>,
        /// Include benchmarks that only pictures of growth need.
        #[arg(long)]
        growth: bool,
    },
    /// Measure the peak performance of this core, and print it as a line of JSON.
    Core,
    /// Print the table of the results, and write it beside the figures.
    Table {
        /// Folder of the figures.
        directory: PathBuf,
        /// Only rows of this benchmark; may be repeated.
        #[arg(long, value_name = "NAME")]
        only: Vec<String>,
        /// Treat the results as a trial run: judge nothing.
        #[arg(long)]
        quick: bool,
        /// Draw pictures of how cost grows into this folder.
        #[arg(long, value_name = "DIR")]
        pictures: Option<PathBuf>,
    },
}

/// Contents of `table.json`.
#[derive(Serialize)]
struct Results<'a> {
    machine: &'a Machine,
    #[serde(flatten)]
    table: &'a Table,
}

fn main() -> ExitCode {
    survive_file_size_limit();
    let done = match Cli::parse().command {
        Command::List { only, growth } => list(
            &only,
            if growth {
                RunCondition::Growth
            } else {
                RunCondition::Always
            },
        ),
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
            tabulate(&directory, &only, judging, pictures.as_deref())
        }
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            note!("skein-bench: {}", with_causes(error.as_ref()));
            ExitCode::FAILURE
        }
    }
}

fn list(only: &[String], when: RunCondition) -> Result<()> {
    let benches = Catalogue::load().benches;
    if let Some(unknown) = only
        .iter()
        .find(|name| benches.iter().all(|bench| bench.name != **name))
    {
        let names: Vec<_> = benches.into_iter().map(|bench| bench.name).collect();
        bail!(
            "no benchmark is called {unknown}; the benchmarks are {}",
            names.join(", ")
        );
    }
    for bench in benches {
        let wanted = match only {
            [] => bench.when == RunCondition::Always || bench.when == when,
            only => only.contains(&bench.name),
        };
        if wanted {
            let kind = match bench.kind {
                BenchKind::OneCore => "one-core",
                BenchKind::Processes => "processes",
            };
            show!("{} {kind}", bench.name);
        }
    }
    Ok(())
}

fn core() -> Result<()> {
    show!("{}", serde_json::to_string(&Core::measure())?);
    Ok(())
}

fn tabulate(
    directory: &Path,
    only: &[String],
    judging: Judging,
    pictures: Option<&Path>,
) -> Result<()> {
    let Catalogue {
        benches,
        rows,
        growths,
    } = Catalogue::load();
    let is_named = |bench: &&Bench| bench.when == RunCondition::Named;
    let named: Vec<_> = benches.iter().filter(is_named).collect();
    let wanted = |figure: &str| {
        let of = bench_of(figure);
        match only {
            [] => named.iter().all(|bench| bench.name != of),
            only => only.iter().any(|name| name == of),
        }
    };
    let figures = BenchmarkFigures::read(directory)?;
    if figures.is_empty() {
        bail!(
            "{} holds no figures: run tests/bench.sh",
            directory.display()
        );
    }
    let machine = Machine::with(Core::best_of(&directory.join("machine.jsonl")));
    let rows: Vec<BenchmarkRow> = rows.into_iter().filter(|row| wanted(&row.figure)).collect();
    let table = Table::new(&rows, &figures, machine.core.f32_flops);
    let note = note(judging, &figures);
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
    let shown = table.to_terminal(judging, stdout_columns());
    show!("{machine}\n{shown}\n{note}");
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
            "the figures differ from what tests/bench/benchmarks.toml needs:\n  {}",
            faults.join("\n  ")
        ),
    }
}

/// Returns a note on the meaning of the table's times.
fn note(judging: Judging, figures: &BenchmarkFigures) -> String {
    match (judging, figures.most_disturbed()) {
        (Judging::Nothing, _) => "Trial run: these times mean nothing.".to_owned(),
        (Judging::Times, None) => {
            "BenchmarkFigures from processes are medians of 15 starts, or means over two seconds."
                .to_owned()
        }
        (Judging::Times, Some((name, times))) => format!(
            "A figure with a median beside it is the fastest of 60 samples and is judged by that; \
                the median was up to {times:.2} times as long, for {name}."
        ),
    }
}

fn draw(growths: &[Growth], figures: &BenchmarkFigures, folder: &Path) -> Result<()> {
    for growth in growths {
        let path = folder.join(&growth.picture).with_extension("png");
        if picture(growth, figures).draw(&path)? {
            show!("{}", path.display());
        }
    }
    Ok(())
}

fn picture<'a>(growth: &'a Growth, figures: &BenchmarkFigures) -> GrowthPicture<'a> {
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
