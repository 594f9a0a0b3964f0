//! One ONNX graph in one session.

use super::Runtime;
use ort::session::{Session, SessionInputValue};
use ort::value::{TensorElementType, TensorRef};
use std::borrow::Cow;

/// Elements an output may have: 1 GiB of f32.
const MAX_OUTPUT_ELEMENTS: usize = 1 << 28;

/// An f32 tensor, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Its dimensions.
    pub shape: Vec<usize>,
    /// Its values; as many as the product of `shape`.
    pub data: Vec<f32>,
}

impl Tensor {
    /// Zeros.
    pub fn zeros(shape: &[usize]) -> Self {
        Self { shape: shape.to_vec(), data: vec![0.0; shape.iter().product()] }
    }
    /// A tensor, if the number of values fits the shape.
    pub fn new(shape: Vec<usize>, data: Vec<f32>) -> Option<Self> {
        let elements = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))?;
        (elements == data.len()).then_some(Self { shape, data })
    }
}

/// What can be wrong with a graph or a run of it.
#[derive(Debug, thiserror::Error)]
pub enum GraphError {
    /// ONNX Runtime refused.
    #[error("graph `{graph}`: {why}")]
    Runtime {
        /// Which graph: `coarse_map`, `coarse`, `refine_map` or `refine`.
        graph: &'static str,
        /// Its words.
        why: String,
    },
    /// An input or output is not what it must be.
    #[error("graph `{graph}`: {port}: expected {expected}, found {found}")]
    Port {
        /// Which graph.
        graph: &'static str,
        /// Input or output name.
        port: String,
        /// What it must be.
        expected: String,
        /// What it is.
        found: String,
    },
}

/// A dimension as it must be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dim {
    /// This size, or one that the graph leaves open.
    Exact(usize),
    /// Left open by the graph, or 1: only one item is ever passed.
    One,
    /// Left open by the graph.
    Open,
    /// Any.
    Any,
}

/// An input or output as it must be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Port {
    /// Name.
    pub name: &'static str,
    /// Dimensions.
    pub dims: Vec<Dim>,
}

/// A graph in a session of its own.
pub struct Graph {
    name: &'static str,
    session: Session,
    outputs: Vec<String>,
}

impl std::fmt::Debug for Graph {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Graph").field("name", &self.name).field("outputs", &self.outputs).finish_non_exhaustive()
    }
}

impl Graph {
    /// Makes a session of a graph's bytes and checks its inputs (exactly these) and outputs (at least these).
    pub fn new(
        name: &'static str,
        onnx: &[u8],
        runtime: &Runtime,
        inputs: &[Port],
        outputs: &[Port],
    ) -> Result<Self, GraphError> {
        let session = runtime.session(onnx).map_err(|e| GraphError::Runtime { graph: name, why: e.to_string() })?;
        let wrong =
            |port: &str, expected: String, found: String| GraphError::Port { graph: name, port: port.into(), expected, found };
        for outlet in session.inputs() {
            if !inputs.iter().any(|port| port.name == outlet.name()) {
                let names: Vec<_> = inputs.iter().map(|port| port.name).collect();
                return Err(wrong("inputs", format!("{names:?}"), format!("`{}`", outlet.name())));
            }
        }
        for (ports, outlets, what) in [(inputs, session.inputs(), "input"), (outputs, session.outputs(), "output")] {
            for port in ports {
                let outlet = outlets.iter().find(|outlet| outlet.name() == port.name);
                let outlet = outlet.ok_or_else(|| wrong(port.name, format!("an {what} of that name"), "none".into()))?;
                let dims: Option<&[i64]> = outlet.dtype().tensor_shape().map(|shape| &shape[..]);
                let float = outlet.dtype().tensor_type() == Some(TensorElementType::Float32);
                let fits = dims
                    .is_some_and(|dims| dims.len() == port.dims.len() && dims.iter().zip(&port.dims).all(|(d, p)| p.fits(*d)));
                if !float || !fits {
                    return Err(wrong(port.name, format!("f32 {}", show(&port.dims)), format!("{:?}", outlet.dtype())));
                }
            }
        }
        let outputs = session.outputs().iter().map(|outlet| outlet.name().to_owned()).collect();
        Ok(Self { name, session, outputs })
    }

    /// Which graph this is.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The names of its outputs.
    pub fn outputs(&self) -> &[String] {
        &self.outputs
    }

    /// Runs the graph; every output comes back, in the graph's order.
    pub fn run(&mut self, inputs: &[(&str, &Tensor)]) -> Result<Outputs, GraphError> {
        let name = self.name;
        let failed = |e: ort::Error| GraphError::Runtime { graph: name, why: e.to_string() };
        let mut values: Vec<(Cow<'_, str>, SessionInputValue<'_>)> = Vec::with_capacity(inputs.len());
        for (port, tensor) in inputs {
            // A fresh view for every run: cloning or binding a borrowed tensor never returns in ort 2.0.0-rc.15.
            let view = TensorRef::from_array_view((tensor.shape.clone(), tensor.data.as_slice())).map_err(failed)?;
            values.push((Cow::Borrowed(*port), view.into()));
        }
        let results = self.session.run(values).map_err(failed)?;
        let mut named = Vec::with_capacity(results.len());
        for (port, value) in results.iter() {
            let (shape, data) = value.try_extract_tensor::<f32>().map_err(failed)?;
            if data.len() > MAX_OUTPUT_ELEMENTS {
                let expected = format!("at most {MAX_OUTPUT_ELEMENTS} values");
                return Err(GraphError::Port { graph: name, port: port.into(), expected, found: data.len().to_string() });
            }
            let shape = shape.iter().map(|&d| usize::try_from(d).unwrap_or(0)).collect();
            named.push((port.to_owned(), Tensor { shape, data: data.to_vec() }));
        }
        Ok(Outputs { graph: name, named })
    }
}

impl Dim {
    fn fits(self, dim: i64) -> bool {
        match self {
            Self::Exact(size) => dim < 0 || usize::try_from(dim) == Ok(size),
            Self::One => dim < 0 || dim == 1,
            Self::Open => dim < 0,
            Self::Any => true,
        }
    }
}

fn show(dims: &[Dim]) -> String {
    let dims = dims.iter().map(|dim| match dim {
        Dim::Exact(size) => size.to_string(),
        Dim::One => "1 or open".into(),
        Dim::Open => "open".into(),
        Dim::Any => "any".into(),
    });
    format!("[{}]", dims.collect::<Vec<_>>().join(", "))
}

/// What a graph gave.
#[derive(Debug, Clone, PartialEq)]
pub struct Outputs {
    graph: &'static str,
    /// Outputs by name, in the graph's order.
    pub named: Vec<(String, Tensor)>,
}

impl Outputs {
    /// An output, if the graph has it.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.named.iter().find(|(port, _)| port == name).map(|(_, tensor)| tensor)
    }

    /// Takes an output out, with this shape: what a graph declares and what it gives may differ.
    pub fn take(&mut self, name: &str, dims: &[Dim]) -> Result<Tensor, GraphError> {
        let wrong = |found: String| GraphError::Port {
            graph: self.graph,
            port: name.into(),
            expected: format!("f32 {}", show(dims)),
            found,
        };
        let at = self.named.iter().position(|(port, _)| port == name).ok_or_else(|| wrong("none".into()))?;
        let shape = &self.named[at].1.shape;
        let fits = shape.len() == dims.len()
            && shape.iter().zip(dims).all(|(&size, dim)| match dim {
                Dim::Exact(expected) => size == *expected,
                Dim::One => size == 1,
                Dim::Open | Dim::Any => true,
            });
        if !fits {
            return Err(wrong(format!("{shape:?}")));
        }
        Ok(self.named.swap_remove(at).1)
    }
}
