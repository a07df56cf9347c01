use std::collections::HashSet;

use super::*;

fn sample() -> StageTimes {
    let mut times = StageTimes::default();
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
        .filter(|stage| stage.thread() == ThreadRole::Actors);
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
    let total = Duration::from_nanos(times.total_nanos(ThreadRole::Actors));
    assert!(total >= Duration::from_millis(6) && total <= begun.elapsed());
    assert_eq!(
        (
            times.of(Stage::Physics).count,
            times.of(Stage::Camera).count
        ),
        (2, 1)
    );
    assert!(times.of(Stage::Physics).nanos > 4_000_000);
    assert_eq!(times.total_nanos(ThreadRole::Training), 0);
}

#[test]
fn sums_and_differences_of_times_never_overflow_or_go_below_zero() {
    let (all, none) = (sample(), StageTimes::default());
    assert_eq!(all.plus(&all).since(&all), all);
    assert_eq!(none.since(&all), none);
    let endless = StageTimes(
        [StageTime {
            count: u64::MAX,
            nanos: u64::MAX,
        }; STAGES],
    );
    assert_eq!(endless.plus(&all), endless);
    assert_eq!(endless.total_nanos(ThreadRole::Training), u64::MAX);
}

#[test]
fn a_file_restores_the_times_and_omits_stages_that_did_not_occur() {
    let json = serde_json::to_string(&sample()).unwrap();
    assert_eq!(serde_json::from_str::<StageTimes>(&json).unwrap(), sample());
    assert_eq!(serde_json::to_string(&StageTimes::default()).unwrap(), "[]");
}

#[test]
fn any_number_in_a_file_becomes_a_time_and_unknown_stages_are_ignored() {
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
    let times: StageTimes = serde_json::from_str(&format!("[{}]", rows.join(","))).unwrap();
    assert_eq!(times.of(Stage::Physics), StageTime { count: 1, nanos: 0 });
    let most = StageTime {
        count: u64::MAX,
        nanos: u64::MAX,
    };
    assert_eq!(times.of(Stage::Camera), most);
    assert_eq!(times.occurred().count(), 2);
}
