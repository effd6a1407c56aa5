//! Adam, sparse over the active set: rows that took no part in a step, and untouched tables, do not change (no decay,
//! no update), and the bias correction uses the row's own step count.
//!
//! A step reads the gradient of every active value once and zeroes it, so no other pass has to.

mod adam;
mod noise;

pub(crate) use adam::{GAUSSIANS, corrections, step_row};
pub(crate) use noise::{MCMC_EXTENT, Noise};

use splat4d::math::Real;
use splat4d::scene::table::{Column, par_split};
use splat4d::scene::{Born, Grads, Key, Params, RowEdit, Space, Table};
use splat4d::simd::{Simd, dispatch};

/// First and second moments and step counts: for a table of width W one of width 2W + 1 and as many rows.
///
/// A page of one frame that has not learnt has none yet: its table has no rows before its first step.
#[derive(Clone, Debug, Default)]
pub struct Moments<F = f32> {
    tables: Vec<Table<F>>,
    /// Rows of every table, those included that have none yet.
    rows: Vec<usize>,
    /// By step count, of Gaussians and of everything else; made by the first step.
    corrections: [Vec<[F; 2]>; 2],
    /// Whether all tables have the decays of Gaussians.
    alike: bool,
}

impl<F: PartialEq> PartialEq for Moments<F> {
    /// Equality of the tables: caches are no state.
    fn eq(&self, other: &Self) -> bool {
        self.tables == other.tables
    }
}

/// A lower bound of one column; its active rows are lifted to it after the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// The table.
    pub key: Key,
    /// The column.
    pub column: usize,
    /// The bound.
    pub least: f64,
}

impl<F: Real> Moments<F> {
    /// All zero, in the shape of `p`.
    pub fn new(p: &Params<F>) -> Self {
        let table = |key: Key| {
            let columns = [("first", p[key].width()), ("second", p[key].width()), ("steps", 1)];
            let columns = columns.map(|(name, width)| Column { name: name.into(), width });
            Table::with_columns(columns.to_vec(), if p.info(key).page.is_some() { 0 } else { p[key].rows() })
        };
        let rows = p.keys().map(|k| p[k].rows()).collect();
        Self { tables: p.keys().map(table).collect(), rows, corrections: Default::default(), alike: false }
    }

    /// The same with the decays of Gaussians for all tables: for what is used as rarely as a Gaussian is visible.
    pub(crate) fn rarely_used(self) -> Self {
        Self { alike: true, ..self }
    }

    /// The moments of one table, [rows, 2W + 1]; no rows for a page that has not learnt.
    pub(crate) fn table(&self, key: Key) -> &Table<F> {
        &self.tables[key.0 as usize]
    }

    /// The same with all its rows, to load a checkpoint or to reset.
    pub(crate) fn table_mut(&mut self, key: Key) -> &mut Table<F> {
        let (table, rows) = (&mut self.tables[key.0 as usize], self.rows[key.0 as usize]);
        if table.rows() < rows {
            table.resize(rows);
        }
        table
    }

    /// Root mean square of the gradients of one value over about a hundred of its row's last steps; 0 before the first.
    pub(crate) fn rms(&self, key: Key, row: usize, column: usize) -> f64 {
        let table = self.table(key);
        let width = table.width() / 2;
        let steps = if table.rows() == 0 { 0.0 } else { table.get(row, 2 * width).f64() };
        if steps == 0.0 {
            return 0.0;
        }
        (table.get(row, width + column).f64() / (1.0 - GAUSSIANS[1].powf(steps))).sqrt()
    }

    /// Resets the moments of pages for which `learns` (of one of their column groups) does not hold: a frame that was
    /// tracked does not learn again.
    pub(crate) fn forget_pages(&mut self, p: &Params<F>, learns: impl Fn(&str) -> bool) {
        for key in p.keys().filter(|&k| p.info(k).page.is_some()) {
            let table = &mut self.tables[key.0 as usize];
            if table.rows() > 0 && !p[key].columns().iter().any(|c| learns(&c.name)) {
                *table = Table::with_columns(table.columns().to_vec(), 0);
            }
        }
    }

    /// Bytes of all tables.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        self.tables.iter().map(|t| size_of_val(t.data())).sum()
    }

    /// Takes over the tables of `old` that have the same shape and the same key; the rest stays new.
    pub(crate) fn adopt(&mut self, old: Self) {
        for ((table, &rows), old) in self.tables.iter_mut().zip(&self.rows).zip(old.tables) {
            // A page without history has nothing to give, whatever its rows.
            if (old.rows(), old.width()) == (rows, table.width()) {
                *table = old;
            }
        }
    }

    /// Follows a row edit of `p` (which may be before or after its own gather): rows that are not `Kept` start again.
    pub(crate) fn edit(&mut self, p: &Params<F>, edit: &RowEdit) {
        for key in p.keys().filter(|&k| p.info(k).space == edit.space) {
            let table = &mut self.tables[key.0 as usize];
            self.rows[key.0 as usize] = edit.len();
            if table.rows() == 0 {
                continue;
            }
            *table = table.gather(&edit.parent);
            for (row, born) in edit.born.iter().enumerate() {
                if *born != Born::Kept {
                    table.clear_row(row);
                }
            }
        }
    }

    /// One step. `rates[key]` holds a rate a column (0: frozen); a key without an entry rests.
    ///
    /// Gradients of the tables that learn are zero afterwards; frozen ones are left to [`Grads::clear`]. Returns the
    /// tables in which a number was not finite: their parameters are then not to be used, and the gradient of the rows
    /// to blame is kept.
    pub fn step(
        &mut self,
        p: &mut Params<F>,
        d: &mut Grads<F>,
        rates: &[Option<Vec<f64>>],
        floors: &[Floor],
    ) -> Vec<Key> {
        const BETAS: [[f64; 2]; 2] = [GAUSSIANS, adam::OTHERS];
        if self.corrections[0].is_empty() {
            self.corrections = BETAS.map(corrections);
        }
        let (mut bad, simd) = (Vec::new(), Simd::detect());
        for key in p.keys() {
            let Some(rates) = rates.get(key.0 as usize).and_then(Option::as_ref) else { continue };
            let width = p[key].width();
            if !p.info(key).trainable || width == 0 || rates.iter().all(|&r| r == 0.0) {
                continue;
            }
            assert_eq!(rates.len(), width, "a rate a column is needed");
            let space = p.info(key).space;
            let Some((gradient, active)) = d.drain(key, space) else { continue };
            let kind = usize::from(space != Space::Gaussians && !self.alike);
            let rule = adam::Rule {
                rates,
                floors,
                key,
                active: (space != Space::Fixed).then_some(active),
                corrections: &self.corrections[kind],
                betas: BETAS[kind].map(F::of),
            };
            let rows = self.rows[key.0 as usize];
            if self.tables[key.0 as usize].rows() < rows {
                self.tables[key.0 as usize].resize(rows);
            }
            let [table] = p.get_mut([key]);
            let views = [table.view_mut(), self.tables[key.0 as usize].view_mut(), gradient.view_mut()];
            let faults = par_split(views, &|views| dispatch(simd, adam::Step { rule: &rule, views }));
            if faults > 0.0 {
                // The caller inspects the gradient.
                let _ = d.of([key]);
                bad.push(key);
            }
        }
        bad
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::scene::{GEOMETRY, LIFE, Rows, SH};

    #[test]
    fn adam_equals_the_definition_and_skips_inactive_rows() {
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
            assert!(m.step(&mut p, &mut d, &rates, &[]).is_empty());
            a = 0.8 * a + 0.2 * g;
            b = 0.99 * b + 0.01 * g * g;
            x -= 0.1 * (a / (1.0 - 0.8f64.powi(step))) / ((b / (1.0 - 0.99f64.powi(step))).sqrt() + 1e-15);
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
        assert_eq!(m.step(&mut p, &mut d, &[None, Some(vec![0.1; 3])], &[]), [SH]);
        assert!(d.touched(SH) && d.table(SH).get(1, 0).is_nan(), "the gradient to blame is kept");
    }

    /// The same arithmetic, number by number.
    fn slow(p: &mut Table<f32>, m: &mut Table<f32>, d: &Table<f32>, active: &[bool], rates: &[f64], least: f32) {
        let width = p.width();
        for row in (0..p.rows()).filter(|&r| active[r]) {
            *m.get_mut(row, 2 * width) += 1.0;
            let n = m.get(row, 2 * width) as i32;
            let [c1, c2] = [0.8f64, 0.99].map(|beta| (1.0 / (1.0 - beta.powi(n))) as f32);
            for c in (0..width).filter(|&c| rates[c] != 0.0) {
                let g = d.get(row, c);
                let a = 0.8 * m.get(row, c) + (1.0 - 0.8) * g;
                let b = 0.99 * m.get(row, width + c) + (1.0 - 0.99) * g * g;
                let x = p.get(row, c) - rates[c] as f32 * (a * c1) / ((b * c2).sqrt() + 1e-15);
                m.set(row, c, a);
                m.set(row, width + c, b);
                p.set(row, c, if c == 1 { x.max(least) } else { x });
            }
        }
    }

    #[test]
    fn lanes_equal_number_by_number_and_leave_no_gradient() {
        let rows = 2500;
        let mut p = Params::<f32>::new(rows, 1, &[("a", 1), ("b", 1)]);
        let (mut m, mut d) = (Moments::new(&p), Grads::new(&p));
        let (mut expected, mut moments) = (p[LIFE].clone(), m.table(LIFE).clone());
        let rng = splat4d::math::Rng::new(2, "adam", 0);
        let rates = vec![None, None, Some(vec![0.0, 0.02])];
        let floor = Floor { key: LIFE, column: 1, least: -0.01 };
        for step in 0..40u64 {
            // Blocks that are full, empty and mixed; late steps meet rows of very different counts.
            let active: Vec<bool> =
                (0..rows).map(|r| r % 64 < 16 || (r % 64 < 40 && rng.fork(step).uniform(r as u64) < 0.4)).collect();
            let ids: Vec<u32> = (0..rows as u32).filter(|&r| active[r as usize]).collect();
            d.activate(Space::Gaussians, Rows::Some(&ids));
            let [g] = d.of([LIFE]);
            for &r in &ids {
                let x = rng.fork(1000 + step).normal(u64::from(r)) as f32;
                g.write(r as usize, 0, [x, 1e-3 * x * x - 2e-4]);
            }
            slow(&mut expected, &mut moments, &d.table(LIFE).clone(), &active, rates[2].as_ref().unwrap(), -0.01);
            assert!(m.step(&mut p, &mut d, &rates, &[floor]).is_empty());
            assert!(!d.touched(LIFE) && d.table(LIFE).data().iter().all(|&x| x == 0.0));
            d.clear(&p);
        }
        assert_eq!(p[LIFE].column_to_rows(0, 2), expected.column_to_rows(0, 2));
        assert_eq!(m.table(LIFE).column_to_rows(0, 5), moments.column_to_rows(0, 5));
        assert!(expected.column_to_rows(1, 1).contains(&-0.01), "the floor was met");
        assert_eq!(d, Grads::new(&p));
    }

    #[test]
    fn moments_exist_only_while_a_page_trains() {
        let (rows, frames) = (100, 5);
        let mut p = Params::<f32>::new(rows, 1, &[]);
        let mut m = Moments::new(&p);
        let alone = (m.bytes(), Grads::new(&p).bytes());
        let mut sizes = Vec::new();
        for frame in 1..=frames {
            let key = p.page("poses", frame, Space::Gaussians, &[("means", 3), ("quats", 4)], rows, |_| {}).unwrap();
            let old = std::mem::replace(&mut m, Moments::new(&p));
            m.adopt(old);
            m.forget_pages(&p, |column| column == format!("means@{frame}"));
            let mut d = Grads::new(&p);
            assert_eq!(d.bytes(), alone.1);
            for _ in 0..2 {
                d.activate(Space::Gaussians, Rows::All);
                d.of([key])[0].fill(1.0);
                let mut rates = vec![None; key.0 as usize];
                rates.push(Some(vec![0.1; 7]));
                assert!(m.step(&mut p, &mut d, &rates, &[]).is_empty());
                d.clear(&p);
            }
            assert_eq!(m.table(key).get(3, 14), 2.0, "steps are counted");
            sizes.push((m.bytes(), d.bytes()));
        }
        assert!(sizes.iter().all(|&s| s == sizes[0]), "moments and gradients do not grow with frames: {sizes:?}");
        m.forget_pages(&p, |_| false);
        assert_eq!(m.bytes(), alone.0);
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
