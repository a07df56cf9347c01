//! CheckpointCost of fault tolerance: the same training with and without checkpoints, alternately,
//! and the processor time of the receiving thread.

use anyhow::{Context, Result};
use skein_protocol::config::Config;
use skein_protocol::stages::Stage;
use skein_protocol::summary::RunSummary;
use skein_run::show;

use crate::stage::Recipe;
use crate::statistics::median;

/// Tolerated loss of training speed.
const TOLERANCE: f64 = 0.03;

/// Trainings with and without checkpoints.
#[derive(Debug)]
pub(crate) struct CheckpointCost {
    every_episodes: u64,
    with: Vec<RunSummary>,
    without: Vec<RunSummary>,
}

impl CheckpointCost {
    /// Trains `recipe` this many times with and without checkpoints, alternately. `train` trains in
    /// the folder with the given name.
    ///
    /// # Errors
    /// Returns an error if a training fails or the configuration cannot be read.
    pub(crate) fn measure(
        recipe: &Recipe,
        times: u32,
        train: impl Fn(&str, &Recipe) -> Result<RunSummary>,
    ) -> Result<Self> {
        let config = Config::load(&recipe.config, &recipe.overrides)?;
        let mut bare = recipe.clone();
        // Beyond the last episode. A checkpoint at the end is written in both cases.
        bare.overrides.push(format!(
            "checkpoints.every_episodes={}",
            config.run.episodes + 1
        ));
        let mut cost = Self {
            every_episodes: config.checkpoints.every_episodes,
            with: Vec::new(),
            without: Vec::new(),
        };
        for time in 1..=times {
            let context = || format!("training number {time} failed");
            cost.with
                .push(train(&format!("with-{time}"), recipe).with_context(context)?);
            cost.without
                .push(train(&format!("without-{time}"), &bare).with_context(context)?);
        }
        Ok(cost)
    }

    /// Prints the costs. Returns `true` if they are within the tolerance.
    pub(crate) fn print(&self) -> bool {
        let wall = |summary: &RunSummary| summary.wall_secs;
        let (with, without) = (median_of(&self.with, wall), median_of(&self.without, wall));
        let slower = with / without - 1.0;
        let cpu = |name: &'static str| {
            median_of(&self.with, move |summary| {
                summary
                    .thread_cpu_secs
                    .get(name)
                    .copied()
                    .unwrap_or_default()
            })
        };
        let all: f64 = median_of(&self.with, |summary| summary.thread_cpu_secs.values().sum());
        let waits = median_of(&self.with, |summary| {
            summary.stages.of(Stage::Checkpoint).secs()
        });
        let receives = cpu("receiver") / all;
        show!(
            "CheckpointCost in seconds, medians of {} trainings each:",
            self.with.len()
        );
        show!(
            "  {:<44} {with:8.2}",
            format!("with a checkpoint every {} episodes", self.every_episodes)
        );
        show!("  {:<44} {without:8.2}", "without checkpoints");
        show!("  {:<44} {:7.2} %", "slowdown", slower * 100.0);
        show!("  {:<44} {waits:8.2}", "training waiting for checkpoints");
        show!(
            "  {:<44} {:8.2}",
            "processor time of writing checkpoints",
            cpu("checkpoints")
        );
        show!(
            "  {:<44} {:8.2}",
            "processor time of assembling episodes",
            cpu("receiver")
        );
        show!("  {:<44} {all:8.2}", "processor time of the learner");
        show!(
            "  {:<44} {:7.2} %",
            "share of assembling episodes",
            receives * 100.0
        );
        slower.max(0.0) + receives < TOLERANCE
    }
}

fn median_of(summaries: &[RunSummary], value: impl Fn(&RunSummary) -> f64) -> f64 {
    median(summaries.iter().map(value).collect())
}
