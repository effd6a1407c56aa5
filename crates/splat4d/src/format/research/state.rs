//! Tensors of a state dictionary by name and shape, and linear maps for the tables of our networks.

use super::super::torch::{Tensor, Torch, Value};
use super::unsupported;
use crate::scene::Params;
use crate::{Error, Result};

/// Names that are listed in errors.
const NAMED: usize = 6;

/// A state dictionary of `torch.save`.
pub(super) struct State<'a>(Torch<'a>);

/// A linear map, weights row-major [outputs, inputs].
#[derive(Clone, Debug)]
pub(super) struct Map {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
}

impl<'a> State<'a> {
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self> {
        Torch::open(bytes).map(Self)
    }

    /// Some names, for errors.
    pub(super) fn names(&self) -> String {
        let names = self.0.keys(self.0.root());
        if names.is_empty() { "no tensors".into() } else { names[..names.len().min(NAMED)].join(", ") }
    }

    fn tensor(&self, name: &str) -> Option<&Tensor> {
        match self.0.get(self.0.root(), name) {
            Some(Value::Tensor(tensor)) => Some(tensor),
            _ => None,
        }
    }

    /// Axes of a tensor. `None`: there is none of that name.
    pub(super) fn shape(&self, name: &str) -> Option<&[usize]> {
        self.tensor(name).map(|t| &t.shape[..])
    }

    /// Numbers of a tensor of this shape.
    pub(super) fn numbers(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
        let tensor = self.tensor(name).ok_or_else(|| missing(name))?;
        if tensor.shape != shape {
            return Err(Error::input(format!("tensor `{name}` has shape {:?}, expected {shape:?}", tensor.shape))
                .remedy("The network's file is damaged, or of a changed program; save it again."));
        }
        self.0.numbers(tensor)
    }

    /// The linear map `{name}.weight`, `{name}.bias`.
    pub(super) fn map(&self, name: &str) -> Result<Map> {
        let weight = format!("{name}.weight");
        let &[outputs, inputs] = self.shape(&weight).ok_or_else(|| missing(&weight))? else {
            return Err(Error::input(format!("tensor `{weight}` is not a matrix")).remedy("Save the network again."));
        };
        let bias = self.numbers(&format!("{name}.bias"), &[outputs])?;
        Ok(Map { inputs, outputs, weight: self.numbers(&weight, &[outputs, inputs])?, bias })
    }

    /// The maps `{prefix}{first}`, `{prefix}{first + step}` and so on, as many as there are.
    pub(super) fn maps(&self, prefix: &str, step: usize) -> Result<Vec<Map>> {
        let names = (0..).map(|i| format!("{prefix}{}", i * step));
        let there = |name: &String| self.shape(&format!("{name}.weight")).is_some();
        names.take_while(there).map(|name| self.map(&name)).collect()
    }
}

fn missing(name: &str) -> Error {
    Error::input(format!("the network has no tensor `{name}`"))
        .remedy("Its file is damaged, or of a changed program; save it again.")
}

impl Map {
    /// Times a factor.
    pub(super) fn scaled(mut self, factor: f64) -> Self {
        for x in self.weight.iter_mut().chain(&mut self.bias) {
            *x = (f64::from(*x) * factor) as f32;
        }
        self
    }

    /// With these inputs alone, in this order.
    pub(super) fn with_inputs(&self, order: impl Iterator<Item = usize> + Clone) -> Self {
        let rows = self.weight.chunks_exact(self.inputs.max(1));
        let weight: Vec<f32> = rows.flat_map(|row| order.clone().map(move |i| row[i])).collect();
        Self { inputs: order.count(), outputs: self.outputs, weight, bias: self.bias.clone() }
    }

    /// With zeros as bias: where another map has it.
    pub(super) fn without_bias(mut self) -> Self {
        self.bias.fill(0.0);
        self
    }

    /// Several maps of one input as one. Errors: their inputs differ.
    pub(super) fn stacked(maps: Vec<Self>) -> Result<Self> {
        let mut maps = maps.into_iter();
        let mut first = maps.next().expect("at least one map");
        for map in maps {
            if map.inputs != first.inputs {
                return Err(unsupported("the network's last maps differ in their inputs")
                    .remedy("Export a sequence of .ply files from the program that trained it."));
            }
            first.outputs += map.outputs;
            first.weight.extend(map.weight);
            first.bias.extend(map.bias);
        }
        Ok(first)
    }

    /// Writes it as map `i` of the perceptron `name`.
    pub(super) fn put(&self, params: &mut Params, name: &str, i: usize) -> Result<()> {
        put(params, &format!("{name}.{i}.weight"), &self.weight)?;
        put(params, &format!("{name}.{i}.bias"), &self.bias)
    }
}

/// Writes the numbers of a model's `Fixed` table. Errors: it has another number of them. Panics: no such table.
pub(super) fn put(params: &mut Params, name: &str, numbers: &[f32]) -> Result<()> {
    let key = params.find(name).unwrap_or_else(|| panic!("the model has a table `{name}`"));
    let table = &mut params[key];
    if table.rows() != numbers.len() {
        let what = format!("`{name}` has {} numbers in the network, expected {}", numbers.len(), table.rows());
        return Err(unsupported(what).remedy("Export a sequence of .ply files from the program that trained it."));
    }
    table.data_mut()[..numbers.len()].copy_from_slice(numbers);
    Ok(())
}
