//! Tiny ONNX files written by hand: test fixtures need no Python. Field numbers are those of `onnx.proto`.

/// A node: operator, inputs, outputs, attributes.
pub struct Node {
    pub op: &'static str,
    pub inputs: Vec<&'static str>,
    pub outputs: Vec<&'static str>,
    pub attributes: Vec<(&'static str, Attribute)>,
}

/// An attribute's value.
pub enum Attribute {
    Int(i64),
    Ints(Vec<i64>),
}

/// A dimension: fixed, or open under a name.
#[derive(Clone, Copy)]
pub enum Size {
    Fixed(i64),
    Open(&'static str),
}

/// A float tensor with its dimensions.
pub struct Constant {
    pub name: &'static str,
    pub dims: Vec<i64>,
    pub values: Vec<f32>,
}

/// Name and dimensions of an input or output.
pub type Value = (&'static str, Vec<Size>);

/// A model of opset 17.
pub fn model(nodes: &[Node], constants: &[Constant], inputs: &[Value], outputs: &[Value]) -> Vec<u8> {
    let mut graph = Vec::new();
    for node in nodes {
        bytes(&mut graph, 1, &node_proto(node));
    }
    bytes(&mut graph, 2, b"fixture");
    for constant in constants {
        bytes(&mut graph, 5, &tensor_proto(constant));
    }
    for (field, values) in [(11, inputs), (12, outputs)] {
        for value in values {
            bytes(&mut graph, field, &value_proto(value));
        }
    }
    let mut opset = Vec::new();
    bytes(&mut opset, 1, b"");
    number(&mut opset, 2, 17);
    let mut model = Vec::new();
    number(&mut model, 1, 8);
    bytes(&mut model, 7, &graph);
    bytes(&mut model, 8, &opset);
    model
}

fn node_proto(node: &Node) -> Vec<u8> {
    let mut out = Vec::new();
    node.inputs.iter().for_each(|name| bytes(&mut out, 1, name.as_bytes()));
    node.outputs.iter().for_each(|name| bytes(&mut out, 2, name.as_bytes()));
    bytes(&mut out, 4, node.op.as_bytes());
    for (name, attribute) in &node.attributes {
        let mut inner = Vec::new();
        bytes(&mut inner, 1, name.as_bytes());
        match attribute {
            Attribute::Int(value) => {
                number(&mut inner, 3, *value as u64);
                number(&mut inner, 20, 2);
            }
            Attribute::Ints(values) => {
                values.iter().for_each(|value| number(&mut inner, 8, *value as u64));
                number(&mut inner, 20, 7);
            }
        }
        bytes(&mut out, 5, &inner);
    }
    out
}

fn tensor_proto(constant: &Constant) -> Vec<u8> {
    let mut out = Vec::new();
    constant.dims.iter().for_each(|dim| number(&mut out, 1, *dim as u64));
    number(&mut out, 2, 1);
    bytes(&mut out, 8, constant.name.as_bytes());
    bytes(&mut out, 9, &constant.values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    out
}

fn value_proto((name, dims): &Value) -> Vec<u8> {
    let mut shape = Vec::new();
    for dim in dims {
        let mut inner = Vec::new();
        match dim {
            Size::Fixed(size) => number(&mut inner, 1, *size as u64),
            Size::Open(name) => bytes(&mut inner, 2, name.as_bytes()),
        }
        bytes(&mut shape, 1, &inner);
    }
    let mut tensor = Vec::new();
    number(&mut tensor, 1, 1);
    bytes(&mut tensor, 2, &shape);
    let mut kind = Vec::new();
    bytes(&mut kind, 1, &tensor);
    let mut out = Vec::new();
    bytes(&mut out, 1, name.as_bytes());
    bytes(&mut out, 2, &kind);
    out
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn number(out: &mut Vec<u8>, field: u64, value: u64) {
    varint(out, field << 3);
    varint(out, value);
}

fn bytes(out: &mut Vec<u8>, field: u64, value: &[u8]) {
    varint(out, field << 3 | 2);
    varint(out, value.len() as u64);
    out.extend_from_slice(value);
}
