//! Adam, sparse over the active set: rows that took no part in a step, and tables that nothing touched, rest (no decay,
//! no update), and the bias correction uses the row's own step count.

use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::scene::table::Column;
use splat4d::scene::{BLOCK, Born, Grads, Key, Params, RowEdit, Space, Table};

/// Decay of the first moment (Kingma and Ba 2015).
const BETA1: f64 = 0.9;
/// Decay of the second moment.
const BETA2: f64 = 0.999;
/// Added to the root of the second moment (Kerbl et al. 2023 use 1e-15: gradients of single Gaussians are tiny).
const EPSILON: f64 = 1e-15;
/// Blocks a task takes.
const TASK_BLOCKS: usize = 32;

/// First and second moments and step counts: for a table of width W one of width 2W + 1 and as many rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Moments<F = f32> {
    tables: Vec<Table<F>>,
}

impl<F: Real> Moments<F> {
    /// All zero, in the shape of `p`.
    pub fn new(p: &Params<F>) -> Self {
        let table = |key: Key| {
            let columns = [("first", p[key].width()), ("second", p[key].width()), ("steps", 1)];
            let columns = columns.map(|(name, width)| Column { name: name.into(), width });
            Table::with_columns(columns.to_vec(), p[key].rows())
        };
        Self { tables: p.keys().map(table).collect() }
    }

    /// The moments of one table, [rows, 2W + 1].
    pub fn table(&self, key: Key) -> &Table<F> {
        &self.tables[key.0 as usize]
    }

    /// The same, to load a checkpoint or to reset.
    pub fn table_mut(&mut self, key: Key) -> &mut Table<F> {
        &mut self.tables[key.0 as usize]
    }

    /// Takes over the tables of `old` that have the same shape and stand at the same key; the rest stays new.
    pub fn adopt(&mut self, old: Self) {
        for (table, old) in self.tables.iter_mut().zip(old.tables) {
            if (old.rows(), old.width()) == (table.rows(), table.width()) {
                *table = old;
            }
        }
    }

    /// Follows a row edit of `p` (which may stand before or after its own gather): rows that are not `Kept` start anew.
    pub fn edit(&mut self, p: &Params<F>, edit: &RowEdit) {
        for key in p.keys().filter(|&k| p.info(k).space == edit.space) {
            let table = &mut self.tables[key.0 as usize];
            *table = table.gather(&edit.parent);
            for (row, born) in edit.born.iter().enumerate() {
                if *born != Born::Kept {
                    table.clear_row(row);
                }
            }
        }
    }

    /// One step. `rates[key]` holds a rate a column (0: frozen); a key without an entry rests.
    /// Returns the tables in which a number was not finite; their parameters are then not to be used.
    pub fn step(&mut self, p: &mut Params<F>, d: &Grads<F>, rates: &[Option<Vec<f64>>]) -> Vec<Key> {
        let mut bad = Vec::new();
        for key in p.keys().collect::<Vec<_>>() {
            let Some(rates) = rates.get(key.0 as usize).and_then(Option::as_ref) else { continue };
            if !d.touched(key) || !p.info(key).trainable || p[key].width() == 0 || rates.iter().all(|&r| r == 0.0) {
                continue;
            }
            let space = p.info(key).space;
            let flags = d.active(space);
            let [table] = p.get_mut([key]);
            if !step_table(table, d.table(key), &mut self.tables[key.0 as usize], flags, space, rates) {
                bad.push(key);
            }
        }
        bad
    }
}

fn step_table<F: Real>(
    p: &mut Table<F>,
    d: &Table<F>,
    m: &mut Table<F>,
    active: &[bool],
    space: Space,
    rates: &[f64],
) -> bool {
    let (width, rows) = (p.width(), p.rows());
    assert_eq!(rates.len(), width, "a rate a column is needed");
    let rates: Vec<F> = rates.iter().map(|&r| F::of(r)).collect();
    let tasks: Vec<_> = p
        .chunks_mut(TASK_BLOCKS)
        .zip(m.chunks_mut(TASK_BLOCKS))
        .zip(d.data().chunks(TASK_BLOCKS * width * BLOCK))
        .collect();
    tasks
        .into_par_iter()
        .map(|((p, m), d)| {
            let mut finite = true;
            let blocks = p.data.chunks_exact_mut(width * BLOCK).zip(m.data.chunks_exact_mut((2 * width + 1) * BLOCK));
            for (b, ((p_block, m_block), d_block)) in blocks.zip(d.chunks_exact(width * BLOCK)).enumerate() {
                let first = p.first + b * BLOCK;
                let lanes: [bool; BLOCK] =
                    std::array::from_fn(|lane| first + lane < rows && (space == Space::Fixed || active[first + lane]));
                if lanes.contains(&true) {
                    finite &= step_block(p_block, d_block, m_block, &lanes, &rates);
                }
            }
            finite
        })
        .reduce(|| true, |a, b| a & b)
}

/// Sixteen rows: p and d are [W][16], m is [2W + 1][16].
fn step_block<F: Real>(p: &mut [F], d: &[F], m: &mut [F], active: &[bool; BLOCK], rates: &[F]) -> bool {
    let width = rates.len();
    let (beta1, beta2) = (F::of(BETA1), F::of(BETA2));
    let (first, rest) = m.split_at_mut(width * BLOCK);
    let (second, steps) = rest.split_at_mut(width * BLOCK);
    let mut correct1 = [F::ONE; BLOCK];
    let mut correct2 = [F::ONE; BLOCK];
    for l in 0..BLOCK {
        if active[l] {
            steps[l] += F::ONE;
        }
        let n = steps[l].f64().max(1.0) as i32;
        correct1[l] = F::of(1.0 / (1.0 - BETA1.powi(n)));
        correct2[l] = F::of(1.0 / (1.0 - BETA2.powi(n)));
    }
    let mut checked = [F::ZERO; BLOCK];
    for c in 0..width {
        if rates[c] == F::ZERO {
            continue;
        }
        let at = c * BLOCK..(c + 1) * BLOCK;
        let (p, d) = (&mut p[at.clone()], &d[at.clone()]);
        let (m1, m2) = (&mut first[at.clone()], &mut second[at]);
        for l in 0..BLOCK {
            let a = beta1 * m1[l] + (F::ONE - beta1) * d[l];
            let b = beta2 * m2[l] + (F::ONE - beta2) * d[l] * d[l];
            let next = p[l] - rates[c] * (a * correct1[l]) / ((b * correct2[l]).sqrt() + F::of(EPSILON));
            m1[l] = if active[l] { a } else { m1[l] };
            m2[l] = if active[l] { b } else { m2[l] };
            p[l] = if active[l] { next } else { p[l] };
            // 0·x is 0 for finite x and NaN otherwise; padding lanes are finite zeros.
            checked[l] += F::ZERO * p[l];
        }
    }
    checked.iter().all(|x| *x == F::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::scene::{GEOMETRY, Rows, SH};

    #[test]
    fn equals_the_textbook_and_rests_where_nothing_is_active() {
        let mut p = Params::<f64>::new(40, 1, &[]);
        let mut m = Moments::new(&p);
        let mut d = Grads::new(&p);
        let rates = vec![Some(vec![0.1; 11]), None, None];
        let (mut x, mut a, mut b) = (0.0f64, 0.0f64, 0.0f64);
        for step in 1..=5 {
            d.activate(Space::Gaussians, Rows::Some(&[3, 20]));
            let g = 0.3 * step as f64 - 0.8;
            let [t] = d.of([GEOMETRY]);
            t.set(3, 1, g);
            t.set(4, 1, 9.0); // not active
            assert!(m.step(&mut p, &d, &rates).is_empty());
            a = 0.9 * a + 0.1 * g;
            b = 0.999 * b + 0.001 * g * g;
            x -= 0.1 * (a / (1.0 - 0.9f64.powi(step))) / ((b / (1.0 - 0.999f64.powi(step))).sqrt() + 1e-15);
            assert!((p[GEOMETRY].get(3, 1) - x).abs() < 1e-12);
            d.clear(&p);
        }
        assert_eq!(p[GEOMETRY].get(4, 1), 0.0);
        assert_eq!(m.table(GEOMETRY).get(4, 22), 0.0, "a resting row counts no steps");
        assert_eq!(m.table(GEOMETRY).get(20, 22), 5.0);
        assert!(p[SH].data().iter().all(|&x| x == 0.0));
    }

    #[test]
    fn a_nan_gradient_names_its_table() {
        let mut p = Params::<f32>::new(3, 1, &[]);
        let (mut m, mut d) = (Moments::new(&p), Grads::new(&p));
        d.activate(Space::Gaussians, Rows::All);
        d.of([SH])[0].set(1, 0, f32::NAN);
        assert_eq!(m.step(&mut p, &d, &[None, Some(vec![0.1; 3])]), [SH]);
    }

    #[test]
    fn new_rows_start_without_history() {
        let mut p = Params::<f32>::new(2, 1, &[]);
        let mut m = Moments::new(&p);
        m.table_mut(GEOMETRY).fill(2.0);
        let mut edit = RowEdit::identity(Space::Gaussians, 2);
        edit.push(1, Born::Clone);
        m.edit(&p, &edit);
        p.apply(&edit);
        assert_eq!(m.table(GEOMETRY).rows(), 3);
        assert_eq!([1, 2].map(|r| m.table(GEOMETRY).get(r, 5)), [2.0, 0.0]);
    }
}
