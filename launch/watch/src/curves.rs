//! Curves of a run as the page draws them: few enough points, over episodes, steps or time.

use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;

use serde::Serialize;
use skein_run::RunDirectory;

use crate::catalogue::Catalogue;
use crate::episodes::{Episode, Episodes};
use crate::events::{Events, Point};

/// Most points of a curve on the page.
const MOST_POINTS: usize = 600;
/// Episodes that a point of a training curve is the mean of, as in the terminal.
const WINDOW: usize = 50;
/// Value of a curve in one episode.
type OfEpisode = fn(&Episode) -> f64;
/// Curves from `episodes.csv`.
const OF_EPISODES: [(&str, OfEpisode); 4] = [
    ("walls passed", |row| f64::from(row.walls_passed)),
    ("return", |row| f64::from(row.episode_return)),
    ("steps per episode", |row| f64::from(row.steps)),
    ("policy lag, epochs", |row| f64::from(row.lag)),
];

/// A run, as far as it has been read.
#[derive(Debug, Default)]
pub(crate) struct ReadRun {
    episodes: Episodes,
    events: Events,
}

/// A curve; all lists have the same length.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Curve {
    episodes: Vec<u64>,
    steps: Vec<u64>,
    /// Since the first point, where that is known.
    minutes: Vec<Option<f64>>,
    values: Vec<f64>,
}

/// Episodes of an actor.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Flown {
    episodes: u64,
    steps: u64,
    walls_passed: f64,
    /// The actor's last episode.
    last_episode: usize,
}

impl ReadRun {
    /// Reads what a run has added. A file that does not exist yet is empty.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub(crate) fn update(&mut self, catalogue: &Catalogue, run: &RunDirectory) -> io::Result<()> {
        let existing = |path: PathBuf| match catalogue.inside(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            found => found.map(Some),
        };
        if let Some(path) = existing(run.episodes_csv())? {
            self.episodes.update(&path)?;
        }
        if let Some(path) = existing(run.tensorboard())? {
            self.events.update(&path)?;
        }
        Ok(())
    }

    /// Returns the number of episodes read, to bound memory.
    pub(crate) fn size(&self) -> usize {
        self.episodes.rows().len()
    }

    /// Returns the names of all curves.
    pub(crate) fn names(&self) -> Vec<String> {
        let of_episodes = OF_EPISODES.iter().map(|(name, _)| (*name).to_owned());
        of_episodes
            .chain(self.events.tags().map(str::to_owned))
            .collect()
    }

    /// Returns the rows of `episodes.csv` that could not be read.
    pub(crate) fn damaged(&self) -> u64 {
        self.episodes.damaged
    }

    /// Returns the mean of the last [`WINDOW`] episodes: walls passed, return.
    pub(crate) fn latest(&self) -> Option<[f64; 2]> {
        let rows = self.episodes.rows();
        let last = &rows[rows.len().saturating_sub(WINDOW)..];
        let mean = |of: fn(&Episode) -> f64| last.iter().map(of).sum::<f64>() / last.len() as f64;
        (!last.is_empty()).then(|| [mean(OF_EPISODES[0].1), mean(OF_EPISODES[1].1)])
    }

    /// Returns what each actor has flown.
    pub(crate) fn actors(&self) -> BTreeMap<u16, Flown> {
        let mut actors = BTreeMap::<u16, Flown>::new();
        for (number, row) in self.episodes.rows().iter().enumerate() {
            let actor = actors.entry(row.actor).or_default();
            actor.episodes += 1;
            actor.steps += u64::from(row.steps);
            actor.walls_passed += f64::from(row.walls_passed);
            actor.last_episode = number;
        }
        for actor in actors.values_mut() {
            actor.walls_passed /= actor.episodes as f64;
        }
        actors
    }

    /// Returns the curve called `name`; an empty one if the run has none.
    pub(crate) fn curve(&self, name: &str) -> Curve {
        match OF_EPISODES.iter().find(|(known, _)| *known == name) {
            Some((_, value)) => self.of_episodes(*value),
            None => self.of_events(name),
        }
    }

    fn of_episodes(&self, value: fn(&Episode) -> f64) -> Curve {
        let rows = self.episodes.rows();
        let clock = self.clock();
        let stride = rows.len().div_ceil(MOST_POINTS).max(1);
        let mut curve = Curve::default();
        let (mut steps, mut sum) = (0, 0.0);
        for (number, row) in rows.iter().enumerate() {
            steps += u64::from(row.steps);
            sum += value(row);
            if let Some(left) = number.checked_sub(WINDOW) {
                sum -= value(&rows[left]);
            }
            let is_last = number + 1 == rows.len();
            if number % stride == stride - 1 || is_last {
                let episode = number as u64 + 1;
                let mean = sum / (number + 1).min(WINDOW) as f64;
                curve.push(episode, steps, clock.minutes_at(episode), mean);
            }
        }
        curve
    }

    fn of_events(&self, tag: &str) -> Curve {
        let points = self.events.points(tag);
        let clock = self.clock();
        let stride = points.len().div_ceil(MOST_POINTS).max(1);
        let mut curve = Curve::default();
        let mut steps = 0;
        let mut counted = 0;
        let rows = self.episodes.rows();
        for block in points.chunks(stride) {
            let Some(&Point { episode, .. }) = block.last() else {
                continue;
            };
            let upto = (episode as usize).min(rows.len()).max(counted);
            let new = rows[counted..upto].iter().map(|row| u64::from(row.steps));
            steps += new.sum::<u64>();
            counted = upto;
            let values = block.iter().map(|point| f64::from(point.value));
            let mean = values.sum::<f64>() / block.len() as f64;
            curve.push(episode, steps, clock.minutes_at(episode), mean);
        }
        curve
    }

    /// Returns when episodes ended, by the curve that has most points.
    fn clock(&self) -> Clock<'_> {
        let curves = self.events.tags().map(|tag| self.events.points(tag));
        Clock {
            points: curves.max_by_key(|points| points.len()).unwrap_or(&[]),
        }
    }
}

/// Times of some episodes.
struct Clock<'a> {
    points: &'a [Point],
}

impl Clock<'_> {
    /// Returns the minutes from the first known episode to `episode`.
    fn minutes_at(&self, episode: u64) -> Option<f64> {
        let next = self.points.partition_point(|point| point.episode < episode);
        let at = self.points.get(next).or(self.points.last())?;
        Some((at.unix_secs - self.points.first()?.unix_secs) / 60.0)
    }
}

impl Curve {
    fn push(&mut self, episode: u64, steps: u64, minutes: Option<f64>, value: f64) {
        self.episodes.push(episode);
        self.steps.push(steps);
        self.minutes.push(minutes);
        self.values.push(value);
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_long_run_has_few_points_which_are_means_of_fifty_episodes() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunDirectory::new(folder.path().join("run"));
        fs::create_dir(run.root()).unwrap();
        let mut rows =
            "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n"
                .to_owned();
        for number in 0..20_000 {
            let walls = number % 2;
            rows.push_str(&format!("{number},0,0,{walls},1,10,{walls},1,collided\n"));
        }
        fs::write(run.episodes_csv(), rows).unwrap();
        let catalogue = Catalogue::open(folder.path()).unwrap();
        let mut read = ReadRun::default();
        read.update(&catalogue, &run).unwrap();
        let curve = read.curve("walls passed");
        assert!(curve.values.len() <= MOST_POINTS + 1);
        assert!(
            curve.values[10..]
                .iter()
                .all(|mean| (mean - 0.5).abs() < 1e-9)
        );
        assert_eq!(curve.steps.last(), Some(&200_000));
        assert_eq!(read.actors()[&1].episodes, 10_000);
        assert!(read.curve("none").values.is_empty());
    }
}
