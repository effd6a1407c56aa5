//! Networks in `.onnx` files, run by `rten`. Without the feature `models` this file only reports that.

use splat4d::Result;
use std::path::Path;

/// Numbers and their axes.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    pub(super) shape: Vec<usize>,
    pub(super) data: Vec<f32>,
}

/// An input as a network declares it.
#[derive(Clone, Debug)]
pub(super) struct Declared {
    pub(super) name: String,
    /// Sizes of its axes, `None`: free. Empty: not stated.
    pub(super) shape: Vec<Option<usize>>,
}

#[cfg(feature = "models")]
pub(super) use real::Network;
#[cfg(not(feature = "models"))]
pub(super) use without::Network;

/// The mark of an attribute that requests cubic interpolation (protobuf: field 4, five bytes).
#[cfg(feature = "models")]
const CUBIC: &[u8] = b"\x22\x05cubic";

#[cfg(feature = "models")]
mod real {
    use super::{CUBIC, Declared, Path, Result, Tensor};
    use crate::files;
    use rten::{
        DataType, Dimension, LoadErrorKind, Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value, ValueType,
    };
    use rten_tensor::Tensor as Array;
    use rten_tensor::prelude::*;
    use splat4d::Error;
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::path::PathBuf;
    use std::sync::Arc;

    /// A loaded network.
    pub(in crate::models) struct Network {
        model: Model,
        path: PathBuf,
        inputs: Vec<(NodeId, Declared, DataType)>,
        outputs: Vec<NodeId>,
        pool: Arc<ThreadPool>,
        /// Whether it interpolates cubically, which is computed as linear interpolation.
        pub(in crate::models) cubic: bool,
    }

    impl Network {
        /// Loads a network. `inputs`, `outputs`: their names; empty: all, and the first `count` ones.
        ///
        /// Errors: no network; operators that the runtime lacks; inputs or outputs of other names.
        pub(in crate::models) fn load(
            path: &Path,
            inputs: &[String],
            outputs: &[String],
            count: usize,
        ) -> Result<Self> {
            let bytes = files::read(path)?;
            if bytes.is_empty() {
                return Err(Error::input("the network's file is empty").at(path.display()).remedy(AGAIN));
            }
            let cubic = bytes.windows(CUBIC.len()).any(|w| w == CUBIC);
            drop(bytes);
            let mut options = ModelOptions::with_all_ops();
            options.prepack_weights(true);
            let loaded = catch_unwind(AssertUnwindSafe(|| options.load_file(path)));
            let model = match loaded {
                Ok(Ok(model)) => model,
                Ok(Err(e)) => {
                    let remedy = match e.kind() {
                        LoadErrorKind::UnknownFileType => "Give an ONNX file whose name ends in .onnx",
                        LoadErrorKind::OperatorInvalid => OPERATORS,
                        LoadErrorKind::ExternalDataError => {
                            "Put the file of its weights (often NAME.onnx.data) next to it, or export it as one file"
                        }
                        _ => AGAIN,
                    };
                    return Err(Error::input(format!("the network cannot be loaded: {e}"))
                        .at(path.display())
                        .remedy(remedy));
                }
                Err(_) => return Err(Error::input("the network cannot be loaded").at(path.display()).remedy(AGAIN)),
            };
            let name = |id: NodeId| model.node_info(id).and_then(|n| n.name().map(str::to_owned)).unwrap_or_default();
            let list =
                |ids: &[NodeId]| ids.iter().map(|id| format!("\"{}\"", name(*id))).collect::<Vec<_>>().join(", ");
            let find = |wanted: &[String], ids: &[NodeId], what: &str| -> Result<Vec<NodeId>> {
                let of = |wanted: &String| {
                    ids.iter().copied().find(|id| name(*id) == *wanted).ok_or_else(|| {
                        Error::input(format!("the network has no {what} \"{wanted}\", but {}", list(ids)))
                            .at(path.display())
                            .remedy(format!("Correct {what}.names in its description"))
                    })
                };
                wanted.iter().map(of).collect()
            };
            let (all, results) = (model.input_ids(), model.output_ids());
            let ids = if inputs.is_empty() { all.to_vec() } else { find(inputs, all, "input")? };
            let mut found = if outputs.is_empty() { results.to_vec() } else { find(outputs, results, "output")? };
            if found.len() < count {
                let what = format!("expected {count} outputs of the network, found {}: {}", found.len(), list(results));
                return Err(Error::input(what).at(path.display()).remedy("Correct output.kind in its description"));
            }
            found.truncate(count);
            let declared = |id: NodeId| {
                let info = model.node_info(id);
                let shape = info.as_ref().and_then(|n| n.shape()).unwrap_or_default();
                let size = |d: Dimension| match d {
                    Dimension::Fixed(n) => Some(n),
                    Dimension::Symbolic(_) => None,
                };
                let kind = match info.and_then(|n| n.dtype()) {
                    Some(ValueType::Tensor(kind)) => kind,
                    _ => DataType::Float,
                };
                (id, Declared { name: name(id), shape: shape.into_iter().map(size).collect() }, kind)
            };
            let inputs = ids.into_iter().map(declared).collect();
            let pool = Arc::new(ThreadPool::with_num_threads(rayon::current_num_threads()));
            Ok(Self { path: path.to_owned(), inputs, outputs: found, pool, cubic, model })
        }

        /// Its inputs.
        pub(in crate::models) fn inputs(&self) -> impl Iterator<Item = &Declared> {
            self.inputs.iter().map(|(_, declared, _)| declared)
        }

        /// Its outputs for these inputs. Errors: shapes that do not fit; an operator fails.
        pub(in crate::models) fn run(&self, inputs: Vec<Tensor>) -> Result<Vec<Tensor>> {
            let failed = |what: String| {
                Error::input(format!("the network failed: {what}"))
                    .at(self.path.display())
                    .remedy("Check input.size, input.layout and input.channels of its description (docs/networks.md)")
            };
            let values = self.inputs.iter().zip(inputs).map(|((id, _, kind), tensor)| {
                let shape = tensor.shape.as_slice();
                let value = match kind {
                    DataType::Int32 => Value::from(Array::from_data(
                        shape,
                        tensor.data.iter().map(|v| v.round() as i32).collect::<Vec<_>>(),
                    )),
                    DataType::UInt8 => Value::from(Array::from_data(
                        shape,
                        tensor.data.iter().map(|v| v.round() as u8).collect::<Vec<_>>(),
                    )),
                    _ => Value::from(Array::from_data(shape, tensor.data)),
                };
                (*id, value.into())
            });
            let values = values.collect();
            let options = RunOptions::default().with_thread_pool(Some(self.pool.clone()));
            let run = catch_unwind(AssertUnwindSafe(|| self.model.run(values, &self.outputs, Some(options))));
            let results = match run {
                Ok(results) => results.map_err(|e| failed(e.to_string()))?,
                Err(_) => return Err(failed("an operator stopped".into())),
            };
            results
                .into_iter()
                .map(|value| taken(value).ok_or_else(|| failed("an output is not of numbers".into())))
                .collect()
        }
    }

    fn taken(value: Value) -> Option<Tensor> {
        fn of<T: Copy>(array: Array<T>, number: impl Fn(T) -> f32) -> Tensor {
            Tensor { shape: array.shape().to_vec(), data: array.iter().map(|v| number(*v)).collect() }
        }
        Some(match value {
            Value::FloatTensor(a) => of(a, |v| v),
            Value::Int32Tensor(a) => of(a, |v| v as f32),
            Value::Int8Tensor(a) => of(a, f32::from),
            Value::UInt8Tensor(a) => of(a, f32::from),
            _ => return None,
        })
    }

    /// Remedy of damaged files.
    const AGAIN: &str = "Download or export it again";
    /// Remedy of operators that are missing.
    const OPERATORS: &str = "The runtime (rten) has most operators of ONNX: export the network with opset 17 and without operators of \
                             other domains";
}

#[cfg(not(feature = "models"))]
mod without {
    use super::{Declared, Path, Result, Tensor};
    use crate::parts::left_out;

    /// In place of networks.
    pub(in crate::models) struct Network {
        pub(in crate::models) cubic: bool,
    }

    impl Network {
        pub(in crate::models) fn load(_: &Path, _: &[String], _: &[String], _: usize) -> Result<Self> {
            Err(left_out("running networks (`priors`)", "models"))
        }

        pub(in crate::models) fn inputs(&self) -> impl Iterator<Item = &Declared> {
            std::iter::empty()
        }

        pub(in crate::models) fn run(&self, _: Vec<Tensor>) -> Result<Vec<Tensor>> {
            Err(left_out("running networks (`priors`)", "models"))
        }
    }
}
