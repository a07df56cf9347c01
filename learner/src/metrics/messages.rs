//! Messages in TensorBoard event files, in Protobuf's encoding.
//!
//! The crates that write event files depend on superseded Protobuf libraries, so the few messages
//! needed are defined here. Field numbers are those of TensorFlow's `event.proto`, `summary.proto`
//! and `tensor.proto`, and of TensorBoard's `plugins/hparams/plugin_data.proto` and `api.proto`.

use std::collections::BTreeMap;

use prost::Message;

/// `tensorflow.Event`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    pub(super) wall_time: f64,
    #[prost(int64, tag = "2")]
    pub(super) step: i64,
    #[prost(oneof = "event::What", tags = "3, 5, 7")]
    pub(super) what: Option<event::What>,
}

pub(super) mod event {
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(in super::super) enum What {
        #[prost(string, tag = "3")]
        FileVersion(String),
        #[prost(message, tag = "5")]
        Summary(super::Summary),
        #[prost(message, tag = "7")]
        SessionLog(super::SessionLog),
    }
}

/// `tensorflow.Summary`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct Summary {
    #[prost(message, repeated, tag = "1")]
    pub(super) value: Vec<SummaryValue>,
}

/// `tensorflow.Summary.Value`: one of scalar, image, tensor; or only what a plugin reads.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SummaryValue {
    #[prost(string, tag = "1")]
    pub(super) tag: String,
    #[prost(float, optional, tag = "2")]
    pub(super) simple_value: Option<f32>,
    #[prost(message, optional, tag = "4")]
    image: Option<Image>,
    #[prost(message, optional, tag = "8")]
    tensor: Option<Tensor>,
    #[prost(message, optional, tag = "9")]
    metadata: Option<Metadata>,
}

impl SummaryValue {
    pub(super) fn scalar(tag: &str, value: f64) -> Self {
        Self {
            tag: tag.to_owned(),
            simple_value: Some(value as f32),
            ..Self::default()
        }
    }

    /// A grey picture of so many pixels, as PNG.
    pub(super) fn picture(tag: &str, [width, height]: [usize; 2], png: Vec<u8>) -> Self {
        Self {
            tag: tag.to_owned(),
            image: Some(Image {
                height: height as i32,
                width: width as i32,
                colorspace: GREY,
                encoded_image_string: png,
            }),
            ..Self::default()
        }
    }

    /// A text in Markdown.
    pub(super) fn text(tag: &str, markdown: String) -> Self {
        Self {
            tag: tag.to_owned(),
            tensor: Some(Tensor {
                dtype: STRING,
                tensor_shape: Some(TensorShape {}),
                string_val: vec![markdown.into_bytes()],
            }),
            metadata: Some(Metadata::of("text", Vec::new())),
            ..Self::default()
        }
    }

    /// Content of the tab of hyperparameters: the `settings` of a run, and the curves to compare.
    pub(super) fn hyperparameters(
        settings: &BTreeMap<String, String>,
        curves: &[&str],
        start_secs: f64,
    ) -> [Self; 2] {
        let hparams = settings
            .iter()
            .map(|(key, value)| (key.clone(), Setting::of(value)));
        let hparams: BTreeMap<_, _> = hparams.collect();
        let hparam_infos = hparams
            .iter()
            .map(|(key, value)| SettingInfo {
                name: key.clone(),
                kind: value.kind(),
            })
            .collect();
        let metric_infos = curves
            .iter()
            .map(|tag| CurveInfo {
                name: Some(CurveName {
                    tag: (*tag).to_owned(),
                }),
            })
            .collect();
        let value = |tag: &str, data: PluginData| Self {
            tag: format!("_hparams_/{tag}"),
            metadata: Some(Metadata::of("hparams", data.encode_to_vec())),
            ..Self::default()
        };
        let experiment = PluginData {
            experiment: Some(Experiment {
                hparam_infos,
                metric_infos,
            }),
            session_start_info: None,
        };
        let session = PluginData {
            experiment: None,
            session_start_info: Some(SessionStart {
                hparams,
                start_time_secs: start_secs,
            }),
        };
        [
            value("experiment", experiment),
            value("session_start_info", session),
        ]
    }
}

/// Value of `Image.colorspace` for one channel.
const GREY: i32 = 1;
/// Value of `DataType.DT_STRING`.
const STRING: i32 = 7;

/// `tensorflow.Summary.Image`.
#[derive(Clone, PartialEq, Message)]
struct Image {
    #[prost(int32, tag = "1")]
    height: i32,
    #[prost(int32, tag = "2")]
    width: i32,
    #[prost(int32, tag = "3")]
    colorspace: i32,
    #[prost(bytes = "vec", tag = "4")]
    encoded_image_string: Vec<u8>,
}

/// `tensorflow.TensorProto`.
#[derive(Clone, PartialEq, Message)]
struct Tensor {
    #[prost(int32, tag = "1")]
    dtype: i32,
    #[prost(message, optional, tag = "2")]
    tensor_shape: Option<TensorShape>,
    #[prost(bytes = "vec", repeated, tag = "8")]
    string_val: Vec<Vec<u8>>,
}

/// `tensorflow.TensorShapeProto`, of a scalar.
#[derive(Clone, PartialEq, Message)]
struct TensorShape {}

/// `tensorflow.SummaryMetadata`.
#[derive(Clone, PartialEq, Message)]
struct Metadata {
    #[prost(message, optional, tag = "1")]
    plugin_data: Option<Plugin>,
}

impl Metadata {
    fn of(plugin: &str, content: Vec<u8>) -> Self {
        Self {
            plugin_data: Some(Plugin {
                plugin_name: plugin.to_owned(),
                content,
            }),
        }
    }
}

/// `tensorflow.SummaryMetadata.PluginData`.
#[derive(Clone, PartialEq, Message)]
struct Plugin {
    #[prost(string, tag = "1")]
    plugin_name: String,
    #[prost(bytes = "vec", tag = "2")]
    content: Vec<u8>,
}

/// `tensorboard.hparams.HParamsPluginData`.
#[derive(Clone, PartialEq, Message)]
struct PluginData {
    #[prost(message, optional, tag = "2")]
    experiment: Option<Experiment>,
    #[prost(message, optional, tag = "3")]
    session_start_info: Option<SessionStart>,
}

/// `tensorboard.hparams.Experiment`.
#[derive(Clone, PartialEq, Message)]
struct Experiment {
    #[prost(message, repeated, tag = "4")]
    hparam_infos: Vec<SettingInfo>,
    #[prost(message, repeated, tag = "5")]
    metric_infos: Vec<CurveInfo>,
}

/// `tensorboard.hparams.HParamInfo`.
#[derive(Clone, PartialEq, Message)]
struct SettingInfo {
    #[prost(string, tag = "1")]
    name: String,
    /// `tensorboard.hparams.DataType`.
    #[prost(int32, tag = "4")]
    kind: i32,
}

/// `tensorboard.hparams.MetricInfo`.
#[derive(Clone, PartialEq, Message)]
struct CurveInfo {
    #[prost(message, optional, tag = "1")]
    name: Option<CurveName>,
}

/// `tensorboard.hparams.MetricName`.
#[derive(Clone, PartialEq, Message)]
struct CurveName {
    #[prost(string, tag = "2")]
    tag: String,
}

/// `tensorboard.hparams.SessionStartInfo`.
#[derive(Clone, PartialEq, Message)]
struct SessionStart {
    #[prost(btree_map = "string, message", tag = "1")]
    hparams: BTreeMap<String, Setting>,
    #[prost(double, tag = "5")]
    start_time_secs: f64,
}

/// `google.protobuf.Value`.
#[derive(Clone, PartialEq, Message)]
struct Setting {
    #[prost(oneof = "setting::Kind", tags = "2, 3, 4")]
    kind: Option<setting::Kind>,
}

mod setting {
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(super) enum Kind {
        #[prost(double, tag = "2")]
        Number(f64),
        #[prost(string, tag = "3")]
        Text(String),
        #[prost(bool, tag = "4")]
        Flag(bool),
    }
}

impl Setting {
    /// Reads a value in TOML's notation.
    fn of(value: &str) -> Self {
        let kind = match (value.parse(), value.parse()) {
            (Ok(number), _) => setting::Kind::Number(number),
            (_, Ok(flag)) => setting::Kind::Flag(flag),
            _ => setting::Kind::Text(value.trim_matches('"').to_owned()),
        };
        Self { kind: Some(kind) }
    }

    /// `tensorboard.hparams.DataType`.
    fn kind(&self) -> i32 {
        match self.kind {
            Some(setting::Kind::Text(_)) | None => 1,
            Some(setting::Kind::Flag(_)) => 2,
            Some(setting::Kind::Number(_)) => 3,
        }
    }
}

/// `tensorflow.SessionLog`.
#[derive(Clone, PartialEq, Message)]
pub(super) struct SessionLog {
    #[prost(int32, tag = "1")]
    pub(super) status: i32,
}

/// Value of `SessionLog.SessionStatus.START`.
pub(super) const SESSION_START: i32 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_has_the_kind_of_its_toml() {
        let kinds = ["0.5", "7", "true", "\"sac\"", "[1, 2]"].map(|value| Setting::of(value).kind);
        assert_eq!(
            kinds.map(Option::unwrap),
            [
                setting::Kind::Number(0.5),
                setting::Kind::Number(7.0),
                setting::Kind::Flag(true),
                setting::Kind::Text("sac".to_owned()),
                setting::Kind::Text("[1, 2]".to_owned()),
            ]
        );
    }
}
