//! Assigns courses, levels and seeds to episodes: tickets are a function of configuration, seed and
//! episode number.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skein_protocol::Action;
use skein_protocol::config::{Config, ConfirmOn};
use skein_protocol::ids::{Attempt, EpisodeId, PolicyVersion, RunId};
use skein_protocol::seeds::{Purpose, derive};
use skein_protocol::segment::Segment;
use skein_protocol::ticket::{CourseChoice, Exploration, Ticket};

use crate::checkpoint::EpochOrder;

/// Number of epochs of the whole run; the last one may be shorter.
pub fn epochs(config: &Config) -> u64 {
    config
        .run
        .episodes
        .div_ceil(config.learning.episodes_per_epoch)
}

/// Tickets of the epoch that `order` asks for, in episode order. With episodes flown in segments,
/// an epoch is one episode, and `flown` holds the actions of its segments so far, from the reset
/// on.
pub fn training(config: &Config, run: RunId, order: &EpochOrder, flown: &[Action]) -> Vec<Ticket> {
    let first = order.epoch * config.learning.episodes_per_epoch;
    let end = (first + config.learning.episodes_per_epoch).min(config.run.episodes);
    let ticket = |episode| Ticket {
        run,
        episode: EpisodeId(episode),
        attempt: Attempt(0),
        policy_version: PolicyVersion(order.policy_version),
        course: training_course(config, episode),
        start_level: start_level(config, episode),
        exploration: order.exploration,
        seed: derive(config.run.seed, Purpose::Episode, episode),
        teacher_share: order.teacher_share,
        segment: config.learning.in_segments().then(|| Segment {
            steps: config.learning.segment_steps as u32,
            prior_actions: flown.into(),
        }),
    };
    (first..end).map(ticket).collect()
}

/// Tickets of `episodes` evaluation episodes on each of `courses`, course by course.
///
/// Episode i has the same seed on every course and in every evaluation, so that snapshots are
/// compared on the same starts. `evaluation` numbers the evaluations of a run.
pub fn evaluation(
    config: &Config,
    run: RunId,
    evaluation: u64,
    version: PolicyVersion,
    courses: std::ops::Range<u32>,
    episodes: u64,
) -> Vec<Ticket> {
    let first = EpisodeId::FIRST_EVALUATION.0 + evaluation * EpisodeId::EVALUATION_STRIDE;
    let ticket = |(number, (course, episode))| Ticket {
        run,
        episode: EpisodeId(first + number),
        attempt: Attempt(0),
        policy_version: version,
        course: CourseChoice::Evaluation(course),
        start_level: 1,
        exploration: Exploration::Mode,
        seed: derive(config.run.seed, Purpose::EvaluationEpisode, episode),
        teacher_share: None,
        segment: None,
    };
    let flown = courses.flat_map(|course| (0..episodes).map(move |episode| (course, episode)));
    (0..).zip(flown).map(ticket).collect()
}

/// Tickets of the confirmation episodes for a candidate. Generated courses are the same for every
/// candidate, and training never uses them.
pub fn confirmation(
    config: &Config,
    run: RunId,
    number: u64,
    version: PolicyVersion,
) -> Vec<Ticket> {
    let mut tickets = evaluation(
        config,
        run,
        number,
        version,
        0..1,
        config.evaluation.confirm_episodes,
    );
    if config.evaluation.confirm_on == ConfirmOn::Generated {
        for (episode, ticket) in (0..).zip(&mut tickets) {
            let course = derive(config.run.seed, Purpose::ConfirmationCourse, episode);
            ticket.course = CourseChoice::Generated(course);
        }
    }
    tickets
}

/// Start level of training episode `episode`: the next level every few episodes, then level 1 again
/// (the paper, section 4.2).
fn start_level(config: &Config, episode: u64) -> u8 {
    let step = episode / config.learning.episodes_per_level;
    (step % u64::from(config.learning.levels)) as u8 + 1
}

/// Course of training episode `episode`.
fn training_course(config: &Config, episode: u64) -> CourseChoice {
    let mut rng = Pcg64Mcg::seed_from_u64(derive(config.run.seed, Purpose::Course, episode));
    if rng.random::<f64>() < config.courses.generated_share {
        CourseChoice::Generated(rng.random())
    } else {
        CourseChoice::Training
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::episodes::assembly::KeptData;

    fn tickets(config: &Config) -> Vec<Ticket> {
        (0..epochs(config))
            .flat_map(|epoch| {
                let order = EpochOrder {
                    epoch,
                    policy_version: epoch,
                    exploration: Exploration::Sample,
                    teacher_share: None,
                    keep: KeptData::Latents,
                };
                training(config, RunId(1), &order, &[])
            })
            .collect()
    }

    #[test]
    fn every_episode_is_in_exactly_one_epoch() {
        let mut config = Config::default();
        (config.run.episodes, config.learning.episodes_per_epoch) = (23, 10);
        let episodes: Vec<u64> = tickets(&config)
            .iter()
            .map(|ticket| ticket.episode.0)
            .collect();
        assert_eq!(episodes, (0..23).collect::<Vec<_>>());
    }

    #[test]
    fn the_start_level_rises_every_ten_episodes_and_returns() {
        let mut config = Config::default();
        config.run.episodes = 60;
        let levels: Vec<u8> = tickets(&config)
            .iter()
            .map(|ticket| ticket.start_level)
            .collect();
        assert_eq!(
            levels.chunks(10).map(|chunk| chunk[0]).collect::<Vec<_>>(),
            [1, 2, 3, 4, 5, 1]
        );
        assert!(
            levels
                .chunks(10)
                .all(|chunk| chunk.iter().all(|level| *level == chunk[0]))
        );
    }

    #[test]
    fn the_generated_share_is_about_the_configured_one_and_courses_differ() {
        let mut config = Config::default();
        (config.run.episodes, config.courses.generated_share) = (1000, 0.25);
        let generated: std::collections::BTreeSet<u64> = tickets(&config)
            .iter()
            .filter_map(|ticket| match ticket.course {
                CourseChoice::Generated(seed) => Some(seed),
                _ => None,
            })
            .collect();
        assert!(
            (200..300).contains(&generated.len()),
            "{} distinct courses",
            generated.len()
        );
    }

    #[test]
    fn candidates_are_confirmed_on_the_same_generated_courses_which_are_not_trained_on() {
        let mut config = Config::default();
        (config.run.episodes, config.courses.generated_share) = (1000, 1.0);
        let courses = |tickets: &[Ticket]| {
            tickets
                .iter()
                .map(|ticket| ticket.course)
                .collect::<HashSet<_>>()
        };
        let confirmed =
            |config: &Config, number| confirmation(config, RunId(1), number, PolicyVersion(number));
        assert_eq!(
            courses(&confirmed(&config, 0)),
            HashSet::from([CourseChoice::Evaluation(0)])
        );
        config.evaluation.confirm_on = ConfirmOn::Generated;
        let (first, second) = (confirmed(&config, 0), confirmed(&config, 1));
        assert_eq!(courses(&first).len(), 20);
        assert_eq!(courses(&first), courses(&second));
        assert!(courses(&tickets(&config)).is_disjoint(&courses(&first)));
        let is_flown_to_be_judged =
            |ticket: &Ticket| ticket.exploration == Exploration::Mode && ticket.start_level == 1;
        assert!(first.iter().all(is_flown_to_be_judged));
    }

    #[test]
    fn evaluations_compare_snapshots_on_the_same_starts() {
        let config = Config::default();
        let first = evaluation(&config, RunId(1), 0, PolicyVersion(3), 0..2, 5);
        let second = evaluation(&config, RunId(1), 1, PolicyVersion(4), 0..1, 5);
        let seeds =
            |tickets: &[Ticket]| tickets.iter().map(|ticket| ticket.seed).collect::<Vec<_>>();
        assert_eq!(seeds(&first[..5]), seeds(&second));
        assert_eq!(seeds(&first[..5]), seeds(&first[5..]));
        assert!(
            first
                .iter()
                .all(|ticket| second.iter().all(|other| other.episode != ticket.episode))
        );
        assert!(
            first
                .iter()
                .all(|ticket| ticket.exploration == Exploration::Mode && ticket.start_level == 1)
        );
    }
}
