//! Builds a graph of ONNX, node by node in the order of evaluation.

use std::ops::Range;

use crate::messages::{
    AttributeProto, DimensionProto, FLOAT, GraphProto, INT, INT64, INTS, NodeProto, TensorProto,
    TensorShapeProto, TensorTypeProto, TypeProto, UINT8, ValueInfoProto,
};

/// A graph in the making.
#[derive(Debug, Default)]
pub(crate) struct Graph {
    graph: GraphProto,
}

/// Type of an input's or output's numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Number {
    U8,
    F32,
}

/// Length of an axis.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Length {
    /// Chosen by the caller.
    Batch,
    Fixed(usize),
}

/// Attribute of a node.
#[derive(Debug, Clone)]
pub(crate) enum Attribute {
    Int(&'static str, i64),
    Ints(&'static str, Vec<i64>),
}

impl Attribute {
    /// Target type of a `Cast`.
    pub(crate) fn to_f32() -> Self {
        Self::Int("to", FLOAT.into())
    }

    fn message(&self) -> AttributeProto {
        match self {
            Self::Int(name, value) => AttributeProto {
                name: (*name).into(),
                i: Some(*value),
                ints: Vec::new(),
                kind: INT,
            },
            Self::Ints(name, values) => AttributeProto {
                name: (*name).into(),
                i: None,
                ints: values.clone(),
                kind: INTS,
            },
        }
    }
}

impl Graph {
    /// Adds a node that writes one value.
    pub(crate) fn node(
        &mut self,
        operator: &str,
        inputs: &[&str],
        output: &str,
        attributes: &[Attribute],
    ) {
        self.graph.node.push(NodeProto {
            input: inputs.iter().map(ToString::to_string).collect(),
            output: vec![output.into()],
            name: output.into(),
            op_type: operator.into(),
            attribute: attributes.iter().map(Attribute::message).collect(),
        });
    }

    /// Adds numbers that the file holds. An empty shape is a scalar.
    pub(crate) fn constant(&mut self, name: &str, shape: &[usize], numbers: &[f32]) {
        let bytes = bytemuck::cast_slice(numbers).to_vec();
        self.tensor(name, shape, FLOAT, bytes);
    }

    /// Adds the index of a row, a scalar.
    pub(crate) fn index(&mut self, name: &str, index: i64) {
        self.tensor(name, &[], INT64, index.to_le_bytes().to_vec());
    }

    /// Adds a list of one axis.
    pub(crate) fn axes(&mut self, name: &str, axis: i64) {
        self.tensor(name, &[1], INT64, axis.to_le_bytes().to_vec());
    }

    /// Adds the part `range` of `input` along `axis`.
    pub(crate) fn slice(&mut self, input: &str, output: &str, axis: i64, range: Range<usize>) {
        let name = |what: &str| format!("{output}.{what}");
        let (start, end, along) = (name("start"), name("end"), name("axis"));
        self.axes(&start, range.start as i64);
        self.axes(&end, range.end as i64);
        self.axes(&along, axis);
        self.node("Slice", &[input, &start, &end, &along], output, &[]);
    }

    pub(crate) fn input(&mut self, name: &str, kind: Number, shape: &[Length], meaning: &str) {
        self.graph.input.push(value(name, kind, shape, meaning));
    }

    pub(crate) fn output(&mut self, name: &str, kind: Number, shape: &[Length], meaning: &str) {
        self.graph.output.push(value(name, kind, shape, meaning));
    }

    pub(crate) fn finish(mut self, name: &str) -> GraphProto {
        self.graph.name = name.into();
        self.graph
    }

    fn tensor(&mut self, name: &str, shape: &[usize], data_type: i32, raw_data: Vec<u8>) {
        self.graph.initializer.push(TensorProto {
            dims: shape.iter().map(|&length| length as i64).collect(),
            data_type,
            name: name.into(),
            raw_data,
        });
    }
}

fn value(name: &str, kind: Number, shape: &[Length], meaning: &str) -> ValueInfoProto {
    let dim = shape.iter().map(|length| match length {
        Length::Batch => DimensionProto {
            dim_value: None,
            dim_param: Some("batch".into()),
        },
        Length::Fixed(length) => DimensionProto {
            dim_value: Some(*length as i64),
            dim_param: None,
        },
    });
    let elem_type = match kind {
        Number::U8 => UINT8,
        Number::F32 => FLOAT,
    };
    let shape = Some(TensorShapeProto { dim: dim.collect() });
    ValueInfoProto {
        name: name.into(),
        kind: Some(TypeProto {
            tensor_type: Some(TensorTypeProto { elem_type, shape }),
        }),
        doc_string: meaning.into(),
    }
}
