//! Writes small networks: the few messages of ONNX (onnx.proto) that tests need, as protobuf.

/// Elements of tensors: FLOAT and INT64 of `TensorProto`.
const FLOAT: u64 = 1;
const INT64: u64 = 7;

fn varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 128 {
        out.push(value as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
}

/// A number of a field.
fn number(field: u64, value: u64, out: &mut Vec<u8>) {
    varint(field << 3, out);
    varint(value, out);
}

/// Bytes, a text or a message of a field.
fn bytes(field: u64, value: &[u8], out: &mut Vec<u8>) {
    varint(field << 3 | 2, out);
    varint(value.len() as u64, out);
    out.extend(value);
}

/// An attribute of a node.
pub(crate) enum Attribute<'a> {
    Int(&'a str, i64),
    Ints(&'a str, &'a [i64]),
    Text(&'a str, &'a str),
}

impl Attribute<'_> {
    fn encoded(&self) -> Vec<u8> {
        let mut out = Vec::new();
        match self {
            Attribute::Int(name, value) => {
                bytes(1, name.as_bytes(), &mut out);
                number(3, *value as u64, &mut out);
                number(20, 2, &mut out);
            }
            Attribute::Ints(name, values) => {
                bytes(1, name.as_bytes(), &mut out);
                values.iter().for_each(|v| number(8, *v as u64, &mut out));
                number(20, 7, &mut out);
            }
            Attribute::Text(name, value) => {
                bytes(1, name.as_bytes(), &mut out);
                bytes(4, value.as_bytes(), &mut out);
                number(20, 3, &mut out);
            }
        }
        out
    }
}

/// A network that is being written.
#[derive(Default)]
pub(crate) struct Graph {
    nodes: Vec<u8>,
    tensors: Vec<u8>,
    inputs: Vec<u8>,
    outputs: Vec<u8>,
    count: usize,
}

impl Graph {
    /// A node with one output, whose name is returned.
    pub(crate) fn node(&mut self, operator: &str, inputs: &[&str], attributes: &[Attribute<'_>]) -> String {
        self.count += 1;
        let name = format!("t{}", self.count);
        self.named(operator, inputs, &name, attributes);
        name
    }

    /// The same with a name.
    pub(crate) fn named(&mut self, operator: &str, inputs: &[&str], output: &str, attributes: &[Attribute<'_>]) {
        let mut node = Vec::new();
        inputs.iter().for_each(|i| bytes(1, i.as_bytes(), &mut node));
        bytes(2, output.as_bytes(), &mut node);
        bytes(3, format!("n{output}").as_bytes(), &mut node);
        bytes(4, operator.as_bytes(), &mut node);
        attributes.iter().for_each(|a| bytes(5, &a.encoded(), &mut node));
        bytes(1, &node, &mut self.nodes);
    }

    /// Constant numbers.
    pub(crate) fn floats(&mut self, shape: &[usize], values: &[f32]) -> String {
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(shape, FLOAT, &raw)
    }

    /// Constant whole numbers.
    pub(crate) fn ints(&mut self, shape: &[usize], values: &[i64]) -> String {
        let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(shape, INT64, &raw)
    }

    fn tensor(&mut self, shape: &[usize], kind: u64, raw: &[u8]) -> String {
        self.count += 1;
        let (name, mut tensor) = (format!("c{}", self.count), Vec::new());
        shape.iter().for_each(|n| number(1, *n as u64, &mut tensor));
        number(2, kind, &mut tensor);
        bytes(8, name.as_bytes(), &mut tensor);
        bytes(9, raw, &mut tensor);
        bytes(5, &tensor, &mut self.tensors);
        name
    }

    fn value(name: &str, shape: &[Option<usize>]) -> Vec<u8> {
        let mut axes = Vec::new();
        for (k, length) in shape.iter().enumerate() {
            let mut axis = Vec::new();
            match length {
                Some(n) => number(1, *n as u64, &mut axis),
                None => bytes(2, format!("axis{k}").as_bytes(), &mut axis),
            }
            bytes(1, &axis, &mut axes);
        }
        let (mut tensor, mut kind, mut value) = (Vec::new(), Vec::new(), Vec::new());
        number(1, FLOAT, &mut tensor);
        bytes(2, &axes, &mut tensor);
        bytes(1, &tensor, &mut kind);
        bytes(1, name.as_bytes(), &mut value);
        bytes(2, &kind, &mut value);
        value
    }

    /// Declares an input.
    pub(crate) fn input(&mut self, name: &str, shape: &[Option<usize>]) {
        bytes(11, &Self::value(name, shape), &mut self.inputs);
    }

    /// Declares an output.
    pub(crate) fn output(&mut self, name: &str, shape: &[Option<usize>]) {
        bytes(12, &Self::value(name, shape), &mut self.outputs);
    }

    /// The file.
    pub(crate) fn file(self) -> Vec<u8> {
        let mut graph = self.nodes;
        bytes(2, b"test", &mut graph);
        graph.extend(self.tensors);
        graph.extend(self.inputs);
        graph.extend(self.outputs);
        let (mut opset, mut model) = (Vec::new(), Vec::new());
        number(2, 17, &mut opset);
        number(1, 8, &mut model);
        bytes(7, &graph, &mut model);
        bytes(8, &opset, &mut model);
        model
    }
}

/// A channel of an input [1, 3, h, w] as [1, 1, h, w], times a number.
pub(crate) fn channel(graph: &mut Graph, input: &str, channel: i64, factor: f32) -> String {
    let at = graph.ints(&[1], &[channel]);
    let plane = graph.node("Gather", &[input, &at], &[Attribute::Int("axis", 1)]);
    let factor = graph.floats(&[], &[factor]);
    graph.node("Mul", &[&plane, &factor], &[])
}

/// Any size of three channels.
pub(crate) const IMAGES: [Option<usize>; 4] = [Some(1), Some(3), None, None];

/// A network whose value is a channel of its input, times a number.
pub(crate) fn of_channel(of: i64, factor: f32, shape: &[Option<usize>; 4]) -> Vec<u8> {
    let mut graph = Graph::default();
    graph.input("image", shape);
    let plane = channel(&mut graph, "image", of, factor);
    graph.named("Identity", &[&plane], "map", &[]);
    graph.output("map", &[shape[0], Some(1), shape[2], shape[3]]);
    graph.file()
}

/// Flow of two images: right by the difference of the means of their red channels, times a number; down by 0.
pub(crate) fn of_means(factor: f32) -> Vec<u8> {
    let mut graph = Graph::default();
    graph.input("a", &IMAGES);
    graph.input("b", &IMAGES);
    let [a, b] = ["a", "b"].map(|name| {
        let red = channel(&mut graph, name, 0, factor);
        (graph.node("ReduceMean", &[&red], &[Attribute::Ints("axes", &[1, 2, 3]), Attribute::Int("keepdims", 1)]), red)
    });
    let shift = graph.node("Sub", &[&b.0, &a.0], &[]);
    let zero = graph.node("Sub", &[&a.1, &a.1], &[]);
    let across = graph.node("Add", &[&zero, &shift], &[]);
    graph.named("Concat", &[&across, &zero], "flow", &[Attribute::Int("axis", 1)]);
    graph.output("flow", &[Some(1), Some(2), None, None]);
    graph.file()
}
