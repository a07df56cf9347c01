//! A snapshot as an ONNX graph: encoder, policy and history in one, for programs that know nothing
//! of Skein.
//!
//! | name | type, shape | meaning |
//! |---|---|---|
//! | `depth` | u8 `[batch, 1, 72, 128]` | depth image; 255 is the range or farther |
//! | `velocity` | f32 `[batch, 3]` | forward, left, up in the heading frame, m/s |
//! | `history` | f32 `[batch, rows, width]` | zeros at a reset, else the last `next_history` |
//! | `goal` | f32 `[batch, 3]` | goal in the heading frame, m, if the policy sees it |
//! | `action` | f32 `[batch, action]` | numbers of `simulator.vehicle.action`, in [-1, 1] |
//! | `next_history` | as `history` | for the next call |
//!
//! The history holds a row for each of the last steps, the newest first: what the policy saw of it,
//! the action, and a 1 that tells a row from the zeros of a reset. Steps before the reset count as
//! the reset, as in training.

mod graph;
mod messages;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use prost::Message;
use skein_protocol::config::{Config, GOAL_SCALE, LEAST_GOAL_M, Observation};
use skein_protocol::files::destination;
use skein_protocol::snapshot::{
    POLICY_LAYERS, PolicyHead, Snapshot, SnapshotError, SnapshotLayout,
};
use skein_protocol::{ActionSpace, IMAGE_HEIGHT, IMAGE_WIDTH};

use graph::{Attribute, Graph, Length, Number};
use messages::{ModelProto, OperatorSetIdProto, StringStringEntryProto};

/// Version of the operators: every runtime of the last years has it.
const OPSET: i64 = 17;
/// Version of the format that belongs to it.
const IR_VERSION: i64 = 8;
/// Convolutions of the encoder.
const CONVOLUTIONS: usize = 4;

/// Reason why a snapshot was not exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The snapshot cannot be read.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The graph would replace the snapshot.
    #[error("--onnx {} is the snapshot itself: name another file", path.display())]
    SameFile {
        /// The file.
        path: PathBuf,
    },
    /// The graph cannot be written.
    #[error(
        "cannot write the graph to {}: {source}; name a file in a folder that exists",
        path.display()
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// Cause.
        #[source]
        source: io::Error,
    },
}

/// Writes the snapshot in the file `snapshot` as an ONNX graph to `onnx_path`.
///
/// # Errors
/// [`ExportError`] names the file and the problem.
pub fn export(snapshot: &Path, onnx_path: &Path) -> Result<(), ExportError> {
    let (loaded, config) = Snapshot::load(snapshot)?;
    let target = destination(onnx_path);
    if target.is_some() && target == destination(snapshot) {
        let path = onnx_path.to_owned();
        return Err(ExportError::SameFile { path });
    }
    fs::write(onnx_path, onnx(&loaded, &config)).map_err(|source| ExportError::Write {
        path: onnx_path.to_owned(),
        source,
    })
}

/// Returns the ONNX model of a snapshot, as the bytes of a file.
///
/// # Panics
/// If the snapshot is not one of this configuration; [`Snapshot::load`] returns only such pairs.
pub fn onnx(snapshot: &Snapshot, config: &Config) -> Vec<u8> {
    let layout = SnapshotLayout::of(config);
    let mut graph = Graph::default();
    for tensor in layout.tensors() {
        graph.constant(
            &tensor.name,
            &tensor.shape,
            &snapshot.values[tensor.range.clone()],
        );
    }
    let view = History::of(config);
    inputs(&mut graph, &view);
    encode(&mut graph);
    remember(&mut graph, config, &view);
    act(&mut graph, layout.head(), view.action);
    pass_on(&mut graph, &view);
    outputs(&mut graph, &view);
    let model = ModelProto {
        ir_version: IR_VERSION,
        producer_name: "skein".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        doc_string: "Depth image to velocity command; see docs/python.md of Skein".into(),
        graph: Some(graph.finish("skein policy")),
        opset_import: vec![OperatorSetIdProto {
            domain: String::new(),
            version: OPSET,
        }],
        metadata_props: metadata(snapshot, config, &view),
    };
    model.encode_to_vec()
}

/// Shape of the history.
struct History {
    rows: usize,
    /// Input of a step, without action and mark.
    step_len: usize,
    /// Numbers of an action.
    action: ActionSpace,
    per_step: Observation,
}

impl History {
    fn of(config: &Config) -> Self {
        let layout = config.observation_layout();
        Self {
            // At least the previous action, so that every graph is used in the same way.
            rows: layout.history_steps.last().copied().unwrap_or(1),
            step_len: layout.step_len(),
            action: layout.action,
            per_step: layout.per_step,
        }
    }

    fn width(&self) -> usize {
        self.step_len + self.action.numbers() + 1
    }

    fn shape(&self) -> [Length; 3] {
        [
            Length::Batch,
            Length::Fixed(self.rows),
            Length::Fixed(self.width()),
        ]
    }
}

fn inputs(graph: &mut Graph, history: &History) {
    let image = [
        Length::Batch,
        Length::Fixed(1),
        Length::Fixed(IMAGE_HEIGHT),
        Length::Fixed(IMAGE_WIDTH),
    ];
    graph.input(
        "depth",
        Number::U8,
        &image,
        "planar depth, top row first; 255 is the camera's range or farther, 0 is no reading",
    );
    graph.input(
        "velocity",
        Number::F32,
        &[Length::Batch, Length::Fixed(3)],
        "forward, left, up in the heading frame, m/s",
    );
    graph.input(
        "history",
        Number::F32,
        &history.shape(),
        "zeros at the start of an episode, then next_history of the last call",
    );
    if history.per_step.has_goal() {
        graph.input(
            "goal",
            Number::F32,
            &[Length::Batch, Length::Fixed(3)],
            "the goal from the drone: forward, left, up in the heading frame, m",
        );
    }
}

fn outputs(graph: &mut Graph, history: &History) {
    graph.output(
        "action",
        Number::F32,
        &[Length::Batch, Length::Fixed(history.action.numbers())],
        &format!(
            "{}, each in [-1, 1]: skein.action_limits",
            history.action.axis_names()
        ),
    );
    graph.output(
        "next_history",
        Number::F32,
        &history.shape(),
        "history of the next call",
    );
}

/// `depth` to `latent`, `[batch, latent]`.
fn encode(graph: &mut Graph) {
    graph.constant("scale", &[], &[1.0 / 255.0]);
    graph.node("Cast", &["depth"], "pixels", &[Attribute::to_f32()]);
    graph.node("Mul", &["pixels", "scale"], "features0", &[]);
    for layer in 1..=CONVOLUTIONS {
        let (input, output) = (format!("features{}", layer - 1), format!("features{layer}"));
        let weighted = format!("convolved{layer}");
        let weight = format!("encoder.conv{layer}.weight");
        let bias = format!("encoder.conv{layer}.bias");
        let strides = Attribute::Ints("strides", vec![2, 2]);
        graph.node("Conv", &[&input, &weight, &bias], &weighted, &[strides]);
        graph.node("Relu", &[&weighted], &output, &[]);
    }
    let last = format!("features{CONVOLUTIONS}");
    graph.node("Flatten", &[&last], "flat", &[]);
    linear(graph, "flat", "encoder.mean", "latent");
}

/// `latent`, `velocity` and `history` to `present` and `observation`.
fn remember(graph: &mut Graph, config: &Config, history: &History) {
    let (step_len, action) = (history.step_len, history.action.numbers());
    graph.index("newest_row", 0);
    graph.node(
        "Gather",
        &["history", "newest_row"],
        "newest",
        &[Attribute::Int("axis", 1)],
    );
    graph.slice("newest", "mark", 1, step_len + action..history.width());
    graph.constant("half", &[], &[0.5]);
    graph.node("Less", &["mark", "half"], "is_reset", &[]);
    graph.axes("second", 1);
    graph.node("Unsqueeze", &["is_reset", "second"], "rows_reset", &[]);

    let mut parts = vec!["latent"];
    if history.per_step.has_velocity() {
        let seen = config.observation_layout().velocity_len();
        graph.slice("velocity", "own_velocity", 1, 3 - seen..3);
        parts.push("own_velocity");
    }
    if history.per_step.has_action() {
        graph.slice("newest", "previous_action", 1, step_len..step_len + action);
        parts.push("previous_action");
    }
    if history.per_step.has_goal() {
        see_goal(graph);
        parts.extend(["goal_direction", "goal_distance"]);
    }
    graph.node("Concat", &parts, "present", &[Attribute::Int("axis", 1)]);

    graph.node("Unsqueeze", &["present", "second"], "present_row", &[]);
    graph.slice("history", "past", 2, 0..step_len);
    graph.node("Where", &["rows_reset", "present_row", "past"], "seen", &[]);
    let mut moments = vec!["present".to_owned()];
    for back in &config.learning.history_steps {
        let (row, moment) = (format!("row{back}"), format!("moment{back}"));
        graph.index(&row, *back as i64 - 1);
        graph.node(
            "Gather",
            &["seen", &row],
            &moment,
            &[Attribute::Int("axis", 1)],
        );
        moments.push(moment);
    }
    let moments: Vec<_> = moments.iter().map(String::as_str).collect();
    graph.node(
        "Concat",
        &moments,
        "observation",
        &[Attribute::Int("axis", 1)],
    );
}

/// `goal` to its direction and its scaled distance.
fn see_goal(graph: &mut Graph) {
    let along = || Attribute::Ints("axes", vec![1]);
    graph.node("ReduceL2", &["goal"], "goal_m", &[along()]);
    graph.constant("least_goal_m", &[], &[LEAST_GOAL_M]);
    graph.node("Max", &["goal_m", "least_goal_m"], "goal_length", &[]);
    graph.node("Div", &["goal", "goal_length"], "goal_direction", &[]);
    graph.constant("goal_scale", &[], &[GOAL_SCALE]);
    graph.node("Mul", &["goal_m", "goal_scale"], "goal_distance", &[]);
}

/// `observation` to `action`, without exploration.
fn act(graph: &mut Graph, head: PolicyHead, action: ActionSpace) {
    let mut input = "observation".to_owned();
    for layer in 1..POLICY_LAYERS {
        let (weighted, output) = (format!("weighted{layer}"), format!("hidden{layer}"));
        linear(graph, &input, &format!("policy.layer{layer}"), &weighted);
        graph.node("Relu", &[&weighted], &output, &[]);
        input = output;
    }
    let name = format!("policy.layer{POLICY_LAYERS}");
    match head {
        PolicyHead::SquashedGaussian => {
            linear(graph, &input, &name, "distribution");
            graph.slice("distribution", "mean", 1, 0..action.numbers());
        }
        PolicyHead::Noisy(_) => linear(graph, &input, &name, "mean"),
    }
    graph.node("Tanh", &["mean"], "action", &[]);
}

/// `present` and `action` to `next_history`.
fn pass_on(graph: &mut Graph, history: &History) {
    graph.constant("one", &[], &[1.0]);
    graph.node("Where", &["is_reset", "one", "one"], "marked", &[]);
    graph.node(
        "Concat",
        &["present", "action", "marked"],
        "step",
        &[Attribute::Int("axis", 1)],
    );
    graph.node("Unsqueeze", &["step", "second"], "step_row", &[]);
    if history.rows == 1 {
        graph.node("Identity", &["step_row"], "next_history", &[]);
        return;
    }
    graph.node(
        "Where",
        &["rows_reset", "step_row", "history"],
        "known",
        &[],
    );
    graph.slice("known", "kept", 1, 0..history.rows - 1);
    graph.node(
        "Concat",
        &["step_row", "kept"],
        "next_history",
        &[Attribute::Int("axis", 1)],
    );
}

fn linear(graph: &mut Graph, input: &str, layer: &str, output: &str) {
    let (weight, bias) = (format!("{layer}.weight"), format!("{layer}.bias"));
    let transposed = Attribute::Int("transB", 1);
    graph.node("Gemm", &[input, &weight, &bias], output, &[transposed]);
}

fn metadata(
    snapshot: &Snapshot,
    config: &Config,
    history: &History,
) -> Vec<StringStringEntryProto> {
    let setting = |section: &str, key: &str| {
        let found = config.simulator.get(section)?.get(key)?;
        Some(found.to_string())
    };
    let or = |found: Option<String>, default: &str| found.unwrap_or_else(|| default.to_owned());
    let entries = [
        ("skein.config", config.portable()),
        ("skein.policy_version", snapshot.version.to_string()),
        ("skein.policy_sha256", snapshot.sha256()),
        ("skein.observation", layout_text(config)),
        (
            "skein.history",
            format!("[batch, {}, {}]", history.rows, history.width()),
        ),
        ("skein.action", history.action.name().to_owned()),
        ("skein.action_limits", action_limits(config)),
        (
            "skein.camera_range_m",
            or(setting("camera", "range_m"), "20.0"),
        ),
        (
            "skein.control_period_secs",
            or(setting("vehicle", "control_period_secs"), "0.5"),
        ),
        (
            "skein.forward_speed_mps",
            or(setting("vehicle", "forward_speed_mps"), "1.0"),
        ),
    ];
    let entry = |(key, value): (&str, String)| StringStringEntryProto {
        key: key.into(),
        value,
    };
    entries.into_iter().map(entry).collect()
}

/// Returns what the numbers of an action command at -1, 0 and 1: `forward: -1 to 0 to 3 m/s, …`.
fn action_limits(config: &Config) -> String {
    let max_speed = || config.simulator.get("vehicle")?.get("max_speed_mps");
    let max_speed = max_speed().and_then(|speed| {
        let whole = || speed.as_integer().map(|whole| whole as f64);
        speed.as_float().or_else(whole)
    });
    let max_speed = max_speed.unwrap_or(1.0);
    let axes = config.action_space().axes().iter().map(|axis| {
        let [least, most] = axis.limits(max_speed as f32);
        format!("{}: {least} to 0 to {most} {}", axis.name(), axis.unit())
    });
    axes.collect::<Vec<_>>().join(", ")
}

fn layout_text(config: &Config) -> String {
    let per_step = config.learning.observation.name();
    format!(
        "{per_step}, of now and {:?} steps ago",
        config.learning.history_steps
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use skein_protocol::config::AlgorithmName;
    use skein_protocol::ids::PolicyVersion;

    fn model(set: impl Fn(&mut Config)) -> ModelProto {
        let mut config = Config::default();
        config.sac.hidden_width = 16;
        set(&mut config);
        let snapshot = Snapshot {
            version: PolicyVersion(7),
            values: vec![0.5; SnapshotLayout::of(&config).values()],
        };
        ModelProto::decode(onnx(&snapshot, &config).as_slice()).unwrap()
    }

    #[test]
    fn every_name_that_a_node_reads_was_written_before_it() {
        for observation in Observation::ALL {
            for history in [vec![], vec![1], vec![2, 4]] {
                let model = model(|config| {
                    config.learning.observation = observation;
                    config.learning.history_steps.clone_from(&history);
                });
                let graph = model.graph.unwrap();
                let mut known: Vec<_> = graph.initializer.iter().map(|it| &it.name).collect();
                known.extend(graph.input.iter().map(|it| &it.name));
                for node in &graph.node {
                    for read in &node.input {
                        assert!(
                            known.contains(&read),
                            "{read} in {observation:?} {history:?}"
                        );
                    }
                    known.extend(&node.output);
                }
                for output in &graph.output {
                    assert!(known.contains(&&output.name), "{}", output.name);
                }
            }
        }
    }

    #[test]
    fn the_history_reaches_back_as_far_as_the_policy_looks() {
        let rows = |history: &[usize]| {
            let model = model(|config| config.learning.history_steps = history.to_vec());
            let found = model.metadata_props.into_iter();
            let mut found = found.filter(|entry| entry.key == "skein.history");
            found.next().unwrap().value
        };
        assert_eq!(rows(&[]), "[batch, 1, 35]");
        assert_eq!(rows(&[2, 4]), "[batch, 4, 35]");
    }

    #[test]
    fn a_file_that_cannot_be_written_or_is_the_snapshot_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let mut config = Config::default();
        config.sac.hidden_width = 16;
        let layout = SnapshotLayout::of(&config);
        let snapshot = Snapshot {
            version: PolicyVersion(7),
            values: vec![0.5; layout.values()],
        };
        let bytes = snapshot.to_file(&layout, &config);
        fs::write(at("best.safetensors"), &bytes).unwrap();
        let refused = |onnx: &str| {
            let error = export(&at("best.safetensors"), &at(onnx)).unwrap_err();
            error.to_string()
        };
        assert!(refused("best.safetensors").contains("is the snapshot itself"));
        assert!(refused("none/graph.onnx").contains("none/graph.onnx"));
        assert_eq!(fs::read(at("best.safetensors")).unwrap(), bytes);
        export(&at("best.safetensors"), &at("graph.onnx")).unwrap();
        assert_eq!(
            fs::read(at("graph.onnx")).unwrap(),
            onnx(&snapshot, &config)
        );
    }

    #[test]
    fn a_head_without_deviations_is_not_cut() {
        let model = model(|config| config.learning.algorithm = AlgorithmName::Td3);
        let graph = model.graph.unwrap();
        let writes = |name: &str| graph.node.iter().any(|node| node.output[0] == name);
        assert!(writes("mean") && !writes("distribution"));
    }
}
