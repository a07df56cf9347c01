//! Inputs of plots: `episodes.csv`, `evaluation_trajectories.csv`, and images with their
//! reconstructions.

use std::sync::LazyLock;

use skein_chaos::read_curves;
use skein_reports::{NamedCourse, RunMaterial, draw_all};
use skein_run::{RunDirectory, write_event_record};
use skein_simulator::course::{Course, CourseLayout};

use super::courses::layout;
use super::{ReaderDecision, Target, USUAL, shipped, tagged};
use crate::scratch::with_files;
use crate::script::Script;

pub(super) const FILES: Target = Target {
    name: "report_files",
    reads: "episodes.csv (after a 0), evaluation_trajectories.csv (after a 1), \
            reconstructions.safetensors (after a 2)",
    longest_bytes: 4096,
    weight: USUAL / 2,
    samples,
    run: |bytes| {
        with_run(bytes, |run| match RunMaterial::read(run).1.first() {
            None => ReaderDecision::Accepted,
            Some(error) => {
                let folder = run.root().display().to_string();
                assert!(error.to_string().contains(&folder), "{error}");
                ReaderDecision::Refused
            }
        })
    },
};

pub(super) const CURVES: Target = Target {
    name: "curves",
    reads: "TensorBoard event files: messages, one per line, in valid frames; \
            after a byte above 127 the whole file",
    longest_bytes: 1024,
    weight: USUAL / 2,
    samples: curve_samples,
    run: |bytes| {
        let file = match bytes.split_first() {
            Some((128.., file)) => file.to_vec(),
            _ => bytes
                .split(|byte| *byte == b'\n')
                .flat_map(framed)
                .collect(),
        };
        with_files(&[("events.out.tfevents.1", &file)], |folder| {
            if let Err(error) = read_curves(folder) {
                assert!(
                    error.to_string().contains("events.out.tfevents.1"),
                    "{error}"
                );
                return ReaderDecision::Refused;
            }
            ReaderDecision::Accepted
        })
    },
};

/// Returns a message as one record of an event file.
fn framed(message: &[u8]) -> Vec<u8> {
    let mut record = Vec::new();
    write_event_record(&mut record, message).expect("a vector takes all bytes");
    record
}

/// Returns a step with two values, bare and as a complete file with its frame.
fn curve_samples() -> Vec<Vec<u8>> {
    let value = |tag: &[u8]| {
        [
            &[0x0a, 6 + tag.len() as u8 + 1, 0x0a, tag.len() as u8],
            tag,
            &[0x15, 0, 0, 0xc0, 0x3f],
        ]
        .concat()
    };
    let values = [value(b"return"), value(b"steps")].concat();
    let message = [&[0x10, 7, 0x2a, values.len() as u8], &values[..]].concat();
    let read = with_files(&[("events.out.tfevents.1", &framed(&message))], |folder| {
        read_curves(folder).unwrap()
    });
    assert_eq!(
        read["return"][&7],
        [1.5],
        "the sample is an event of another version"
    );
    vec![message.clone(), tagged(128, &framed(&message))]
}

pub(super) const PICTURES: Target = Target {
    name: "report_pictures",
    reads: "the same files; draws what is accepted, with courses of any geometry",
    longest_bytes: 2048,
    weight: 1,
    samples,
    run: |bytes| {
        // The bytes after a zero byte describe a course.
        let (files, course) = bytes.split_at(
            bytes
                .iter()
                .skip(1)
                .position(|byte| *byte == 0)
                .map_or(bytes.len(), |at| at + 1),
        );
        let mut courses = vec![TRAINING.clone()];
        courses.extend(fuzzed_course(course));
        with_run(files, |run| {
            let plots = draw_all(run, &courses, 50, Some(3.0));
            assert!(plots.pictures.iter().all(|picture| picture.exists()));
            ReaderDecision::of(plots.failures.is_empty().then_some(()))
        })
    },
};

static TRAINING: LazyLock<NamedCourse> = LazyLock::new(|| {
    let text = String::from_utf8(shipped("configs/courses/training.toml")).unwrap();
    NamedCourse {
        name: "training".to_owned(),
        course: Course::parse(&text, "training.toml").unwrap(),
    }
});

fn fuzzed_course(script: &[u8]) -> Option<NamedCourse> {
    let layout: CourseLayout = layout(&mut Script::new(script.get(1..)?));
    Some(NamedCourse {
        name: "fuzzed".to_owned(),
        course: Course::new(layout).ok()?,
    })
}

/// Creates a run that left one file, of the kind selected by the first byte.
fn with_run(bytes: &[u8], read: impl FnOnce(&RunDirectory) -> ReaderDecision) -> ReaderDecision {
    const NAMES: [&str; 3] = [
        "episodes.csv",
        "evaluation_trajectories.csv",
        "reconstructions.safetensors",
    ];
    let Some((&kind, content)) = bytes.split_first() else {
        return ReaderDecision::Refused;
    };
    let name = NAMES[usize::from(kind) % NAMES.len()];
    with_files(&[(name, content)], |folder| {
        read(&RunDirectory::new(folder))
    })
}

fn samples() -> Vec<Vec<u8>> {
    let episodes = "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n\
                   0,0,0,0,1,12,0,-0.9,collided\n1,0,0,1,1,33,1,0.2,timed_out\n";
    let paths = "course,episode,step,x_m,y_m,z_m,outcome\ntraining,0,0,1.5,0,3,collided\n\
                 training,0,1,9.7,1,3,collided\nfuzzed,1,0,1.5,0.5,3.5,reached_end\n";
    // Empty images: only the header can be damaged.
    let images = concat!(
        r#"{"depth":{"dtype":"U8","shape":[0,72,128],"data_offsets":[0,0]},"#,
        r#""reconstruction":{"dtype":"U8","shape":[0,72,128],"data_offsets":[0,0]}}"#
    );
    let images = [&(images.len() as u64).to_le_bytes()[..], images.as_bytes()].concat();
    vec![
        tagged(0, episodes.as_bytes()),
        tagged(1, paths.as_bytes()),
        tagged(2, &images),
        [&tagged(1, paths.as_bytes())[..], &[0], &[128; 60]].concat(),
    ]
}
