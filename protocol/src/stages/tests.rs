use std::collections::HashSet;

use super::*;

fn sample() -> Times {
    let mut times = Times::default();
    for (nanos, stage) in (1_234_567_891..).step_by(1_111_111_111).zip(Stage::ALL) {
        times.add(*stage, 7, Duration::from_nanos(nanos));
    }
    times
}

#[test]
fn a_thread_names_each_of_its_stages_once_and_threads_do_not_mix() {
    let names: HashSet<_> = Stage::ALL
        .iter()
        .map(|stage| (stage.thread().name(), stage.name()))
        .collect();
    assert_eq!(names.len(), STAGES);
    let of_actors = Stage::ALL
        .iter()
        .filter(|stage| stage.thread() == Thread::Actors);
    assert_eq!(of_actors.count(), ACTOR_STAGES);
    for (index, stage) in Stage::ALL.iter().enumerate() {
        assert_eq!(*stage as usize, index);
    }
}

#[test]
fn laps_are_a_threads_whole_time() {
    let begun = Instant::now();
    let mut timer = LapTimer::start();
    for stage in [Stage::Physics, Stage::Camera, Stage::Physics] {
        std::thread::sleep(Duration::from_millis(2));
        timer.lap(stage, 1);
    }
    let times = timer.times();
    let total = Duration::from_nanos(times.total_nanos(Thread::Actors));
    assert!(total >= Duration::from_millis(6) && total <= begun.elapsed());
    assert_eq!(
        (
            times.of(Stage::Physics).count,
            times.of(Stage::Camera).count
        ),
        (2, 1)
    );
    assert!(times.of(Stage::Physics).nanos > 4_000_000);
    assert_eq!(times.total_nanos(Thread::Training), 0);
}

#[test]
fn what_was_is_taken_away_and_nothing_goes_below_nothing_or_overflows() {
    let (all, none) = (sample(), Times::default());
    assert_eq!(all.plus(&all).since(&all), all);
    assert_eq!(none.since(&all), none);
    let endless = Times(
        [Tally {
            count: u64::MAX,
            nanos: u64::MAX,
        }; STAGES],
    );
    assert_eq!(endless.plus(&all), endless);
    assert_eq!(endless.total_nanos(Thread::Training), u64::MAX);
}

#[test]
fn a_file_brings_back_what_was_spent_and_says_nothing_of_what_was_not() {
    let json = serde_json::to_string(&sample()).unwrap();
    assert_eq!(serde_json::from_str::<Times>(&json).unwrap(), sample());
    assert_eq!(serde_json::to_string(&Times::default()).unwrap(), "[]");
}

#[test]
fn whatever_a_file_says_is_a_time_and_stages_of_another_version_are_left_out() {
    let row = |thread: &str, stage: &str, count: u64, secs: &str| {
        format!(r#"{{"thread":"{thread}","stage":"{stage}","count":{count},"secs":{secs}}}"#)
    };
    let rows = [
        row("actors", "physics", 1, "-3.0"),
        row("actors", "camera", u64::MAX, "1e300"),
        row("actors", "camera", 5, "1e300"),
        row("actors", "telepathy", 5, "1.0"),
        row("ground staff", "idle", 5, "1.0"),
    ];
    let times: Times = serde_json::from_str(&format!("[{}]", rows.join(","))).unwrap();
    assert_eq!(times.of(Stage::Physics), Tally { count: 1, nanos: 0 });
    let most = Tally {
        count: u64::MAX,
        nanos: u64::MAX,
    };
    assert_eq!(times.of(Stage::Camera), most);
    assert_eq!(times.occurred().count(), 2);
}
