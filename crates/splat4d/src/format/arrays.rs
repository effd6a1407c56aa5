//! Between a layer's tables and the plain arrays of a scene file: one row-major unpadded f32 array per column group.

use super::safetensors::{Dtype, SafeTensors, Tensor};
use crate::scene::params::{LoadedArray, Params};
use crate::{Error, Result};

/// The column group whose columns are coefficient-major colours: its array is [N, K, 3].
const SH_GROUP: &str = "sh";

/// A column group of a layer as the array that a file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// The layer's prefix and the column group's name, e.g. `layers.0.means`.
    pub name: String,
    /// `[rows]` where a row is one number, `[N, K, 3]` for `sh`, `[rows, width]` otherwise.
    pub shape: Vec<usize>,
    /// Row-major.
    pub data: Vec<f32>,
}

impl Array {
    /// The same array, borrowed, as the safetensors writer takes it.
    pub(crate) fn tensor(&self) -> Tensor<'_> {
        Tensor::f32(self.name.clone(), &self.shape, &self.data)
    }
}

/// All column groups of all tables, in table order, named `prefix` + group (give `layers.0.`). Groups without columns
/// are left out, and so are arrays that no table has claimed.
pub(crate) fn params_to_arrays(prefix: &str, params: &Params) -> Vec<Array> {
    let mut out = Vec::new();
    for key in params.keys() {
        let table = &params[key];
        let mut first = 0;
        for column in table.columns() {
            let (rows, width) = (table.rows(), column.width);
            if width > 0 {
                let shape = match width {
                    _ if column.name == SH_GROUP && width.is_multiple_of(3) => vec![rows, width / 3, 3],
                    1 => vec![rows],
                    _ => vec![rows, width],
                };
                let name = format!("{prefix}{}", column.name);
                out.push(Array { name, shape, data: table.column_to_rows(first, width) });
            }
            first += width;
        }
    }
    out
}

/// Name of the array of masks in a layer: bits, no numbers of a table.
pub(super) const MASKS: &str = "masks";

/// The arrays of a file whose names begin with `prefix`, without it, as [`Params::build`] and [`Params::entry`] take
/// them: the first axis is the rows, the others are one row. A layer's masks (u32) are left out.
///
/// Errors: an array is not of f32, or is a single number without rows.
pub(crate) fn tensors_to_loaded(prefix: &str, file: &SafeTensors<'_>) -> Result<Vec<LoadedArray>> {
    let mut out = Vec::new();
    for tensor in file.tensors() {
        let Some(name) = tensor.name().strip_prefix(prefix) else { continue };
        if name == MASKS && tensor.dtype() == Dtype::U32 {
            continue;
        }
        if tensor.dtype() != Dtype::F32 || tensor.shape().is_empty() {
            return Err(Error::input(format!(
                "array `{}` is {} of shape {:?}, but f32 with a row per Gaussian is needed",
                tensor.name(),
                tensor.dtype().name(),
                tensor.shape()
            ))
            .remedy("The file was not written as a scene; export it again"));
        }
        let (rows, row) = (tensor.shape()[0], &tensor.shape()[1..]);
        // Axes next to an empty one are not bounded by the data: without this check a caller could believe 2^60 rows of
        // no numbers.
        let Some(width) = row.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).filter(|&w| w > 0) else {
            return Err(Error::input(format!("array `{}` has an impossible shape", tensor.name()))
                .remedy("The file is damaged; export it again"));
        };
        out.push(LoadedArray { name: name.to_owned(), rows, width, data: tensor.as_f32()? });
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::safetensors;
    use crate::math::Rng;
    use crate::scene::params::Space;
    use std::collections::BTreeMap;

    /// Random bits in every number, infinity and (quiet) NaN included.
    fn random(rng: Rng, rows: usize, sh: usize, life: &[(&'static str, usize)]) -> Params {
        let mut p = Params::new(rows, sh, life);
        p.entry("motion", Space::Gaussians, &[("velocity", 3), ("spin", 1)], rows, |_| {}).unwrap();
        p.entry("net", Space::Fixed, &[("weights", 5)], 7, |_| {}).unwrap();
        let keys: Vec<_> = p.keys().collect();
        for (k, key) in keys.into_iter().enumerate() {
            let table = &mut p[key];
            for row in 0..table.rows() {
                for col in 0..table.width() {
                    let x = f32::from_bits(rng.fork(k as u64).fork(row as u64).bits(col as u64) as u32);
                    // A detour through f64 makes a signalling NaN a quiet one.
                    table.set(row, col, if x.is_nan() { f32::from_bits(x.to_bits() | 1 << 22) } else { x });
                }
            }
        }
        p
    }

    fn bits(arrays: &[Array]) -> Vec<(String, Vec<usize>, Vec<u32>)> {
        let of = |a: &Array| (a.name.clone(), a.shape.clone(), a.data.iter().map(|x| x.to_bits()).collect());
        arrays.iter().map(of).collect()
    }

    #[test]
    fn any_layer_round_trips_bit_for_bit() {
        for (i, rows) in [0, 1, 15, 16, 17, 33, 100].into_iter().enumerate() {
            let rng = Rng::new(7, "arrays", i as u64);
            let sh = [1, 4, 9, 16][rng.below(0, 4)];
            let life: &[(&'static str, usize)] = if rng.below(1, 2) == 0 { &[] } else { &[("life", 2)] };
            let p = random(rng, rows, sh, life);
            let arrays = params_to_arrays("layers.0.", &p);
            let find = |n: &str| &arrays.iter().find(|a| a.name == n).unwrap().shape;
            assert_eq!(find("layers.0.means"), &[rows, 3]);
            assert_eq!(find("layers.0.opacity_logits"), &[rows]);
            assert_eq!(find("layers.0.sh"), &[rows, sh, 3]);

            let tensors: Vec<_> = arrays.iter().map(Array::tensor).collect();
            let mut file = Vec::new();
            safetensors::write(&tensors, &BTreeMap::new(), &mut file).unwrap();
            let loaded = tensors_to_loaded("layers.0.", &SafeTensors::read(&file).unwrap()).unwrap();
            let mut back = Params::build(loaded, rows, sh, life).unwrap();
            let made = |_: &mut _| panic!("the table must come from the file");
            back.entry("motion", Space::Gaussians, &[("velocity", 3), ("spin", 1)], rows, made).unwrap();
            back.entry("net", Space::Fixed, &[("weights", 5)], 7, made).unwrap();
            assert!(back.unclaimed().is_empty());
            assert_eq!(bits(&params_to_arrays("layers.0.", &back)), bits(&arrays));
        }
    }

    #[test]
    fn arrays_of_another_type_are_refused_by_name() {
        let mut file = Vec::new();
        safetensors::write(&[Tensor::u32("layers.1.means", &[1], &[1])], &BTreeMap::new(), &mut file).unwrap();
        let file = SafeTensors::read(&file).unwrap();
        assert!(tensors_to_loaded("layers.1.", &file).unwrap_err().to_string().contains("layers.1.means"));
        assert!(tensors_to_loaded("layers.0.", &file).unwrap().is_empty());
        let mut hollow = Vec::new();
        safetensors::write(&[Tensor::f32("means", &[1 << 40, 0], &[])], &BTreeMap::new(), &mut hollow).unwrap();
        assert!(tensors_to_loaded("", &SafeTensors::read(&hollow).unwrap()).is_err());
    }
}
