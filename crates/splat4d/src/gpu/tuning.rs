//! Performance constants of the kernels, which a sweep on a GPU varies. They do not change results, except for the last
//! bits where stated.

use super::limits::THREADS;

/// See the module's documentation. The defaults are the portable ones, chosen without a GPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tuning {
    /// Threads of a workgroup of the kernels over rows that stay on the GPU.
    pub row_threads: usize,
    /// Items that a thread of a sort, of a sum or of the search for tiles' lists handles.
    pub rounds: usize,
    /// Splats that a tile reads at a time, to blend them.
    pub batch: usize,
    /// Whether the backward pass of the blend uses subgroups, where the device has them: changes last bits.
    pub subgroups: bool,
    /// Whether the sorts' last dispatch uses them too: no bit depends on it.
    pub sort_subgroups: bool,
    /// Whether its backward pass with subgroups holds pixels in vectors (rasterize_back_vector.wgsl): changes last
    /// bits.
    pub back_vectors: bool,
    /// Whether its backward pass with subgroups has a lane per splat, from states that the forward pass writes
    /// (rasterize_back_lanes.wgsl): changes last bits, and takes 160 bytes per pair where subgroups have 32 threads.
    pub back_lanes: bool,
    /// Splats of a round of its backward pass without them.
    pub back_round: usize,
}

impl Default for Tuning {
    fn default() -> Self {
        Self {
            row_threads: THREADS,
            rounds: 8,
            batch: THREADS,
            subgroups: true,
            sort_subgroups: true,
            back_vectors: false,
            back_lanes: false,
            back_round: 4,
        }
    }
}

/// Values of a sweep. More splats a batch or a round need more than the 16 KiB of workgroup memory that every device
/// has.
const ROW_THREADS: [usize; 2] = [64, 128];
const ROUNDS: [usize; 3] = [2, 4, 16];
const BATCHES: [usize; 3] = [32, 64, 128];
const BACK_ROUNDS: [usize; 2] = [1, 2];

impl Tuning {
    /// The defaults, then each constant's other values.
    pub fn sweep() -> Vec<Self> {
        let with = |f: fn(&mut Self, usize), values: &[usize]| -> Vec<Self> {
            let one = |value: &usize| {
                let mut out = Self::default();
                f(&mut out, *value);
                out
            };
            values.iter().map(one).collect()
        };
        let mut out = vec![Self::default()];
        out.extend(with(|t, v| t.row_threads = v, &ROW_THREADS));
        out.extend(with(|t, v| t.rounds = v, &ROUNDS));
        out.extend(with(|t, v| t.batch = v, &BATCHES));
        out.push(Self { sort_subgroups: false, ..Self::default() });
        out.push(Self { back_vectors: true, ..Self::default() });
        out.push(Self { back_lanes: true, ..Self::default() });
        let portable = Self { subgroups: false, ..Self::default() };
        out.push(portable);
        out.extend(BACK_ROUNDS.map(|back_round| Self { back_round, ..portable }));
        out
    }

    /// Deviations from the default, `name=value`.
    pub fn changes(&self) -> Option<String> {
        let numbers = |t: &Self| {
            [
                ("row_threads", t.row_threads),
                ("rounds", t.rounds),
                ("batch", t.batch),
                ("subgroups", usize::from(t.subgroups)),
                ("sort_subgroups", usize::from(t.sort_subgroups)),
                ("back_vectors", usize::from(t.back_vectors)),
                ("back_lanes", usize::from(t.back_lanes)),
                ("back_round", t.back_round),
            ]
        };
        let changed = numbers(self).into_iter().zip(numbers(&Self::default())).filter(|(a, b)| a != b);
        let words: Vec<String> = changed.map(|((name, value), _)| format!("{name}={value}")).collect();
        (!words.is_empty()).then(|| words.join(" "))
    }

    /// Items in a block of a sum or of a sort (scan.wgsl, sort.wgsl).
    pub(super) fn block(&self) -> usize {
        THREADS * self.rounds
    }

    /// A shader's text with these constants in place of its own.
    pub(super) fn text(&self, shader: &str) -> String {
        let constants = [
            ("ROW_THREADS", self.row_threads),
            ("SORT_ROUNDS", self.rounds),
            ("SORT_BLOCK", self.block()),
            ("SCAN_RUN", self.rounds),
            ("SCAN_BLOCK", self.block()),
            ("RANGES_ROUNDS", self.rounds),
            ("BATCH", self.batch),
            ("ROUND", self.back_round),
        ];
        constants.iter().fold(shader.to_owned(), |text, (name, value)| with_constant(&text, name, *value))
    }
}

/// A shader's text with another value of an integer constant, where it has the constant.
pub(super) fn with_constant(text: &str, name: &str, value: usize) -> String {
    let before = format!("const {name}: u32 = ");
    let mut out = text.to_owned();
    if let Some(at) = out.find(&before).map(|at| at + before.len()) {
        let end = at + out[at..].find(';').expect("a constant ends");
        out.replace_range(at..end, &format!("{value}u"));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wgsl;

    #[test]
    fn every_shader_constant_exists_once_with_its_default() {
        let shaders =
            [wgsl::SORT, wgsl::SCAN, wgsl::RANGES, wgsl::RASTERIZE, wgsl::RASTERIZE_BACK, wgsl::LEARNT, wgsl::ADAM];
        for shader in shaders {
            assert_eq!(Tuning::default().text(shader), shader);
            let changed =
                Tuning { row_threads: 32, rounds: 1, batch: 16, back_round: 3, ..Tuning::default() }.text(shader);
            let others = shader.lines().zip(changed.lines()).filter(|(a, b)| a != b).count();
            // A sort and a sum have both rounds and blocks.
            let expected = if shader == wgsl::SORT || shader == wgsl::SCAN { 2 } else { 1 };
            assert_eq!(others, expected, "{}", &shader[..60]);
        }
        let sweep = Tuning::sweep();
        assert!(sweep[0].changes().is_none() && sweep[1..].iter().all(|t| t.changes().is_some()));
    }
}
