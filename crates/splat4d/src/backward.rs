//! From the gradients to splats to those of a scene's tables: the last part of a differentiable render, for training
//! and for losses from outside.

use crate::layers::{Evaluation, Scene};
use crate::math::Real;
use crate::render::RenderGrads;
use crate::scene::{Color, Grads, Part, SH, Space, Splats, Table, Time};

/// By part, the gradient of the layer's own SH table, where that table is the colour: what a renderer's VJP adds to
/// directly.
pub fn sh_grads<'a, F: Real>(splats: &Splats<'_, F>, d: &'a mut [Grads<F>]) -> Vec<Option<&'a mut Table<F>>> {
    let own = |(d, part): (&'a mut Grads<F>, &Part<'_, F>)| match part.color {
        Color::Sh { base: true, .. } => {
            let [table] = d.of([SH]);
            Some(table)
        }
        _ => None,
    };
    d.iter_mut().zip(&splats.parts).map(own).collect()
}

impl<F: Real> RenderGrads<F> {
    /// Adds the gradients to the splats to the results of `evaluation` at the time `t`, and those to the weights of the
    /// head to `d`, one per layer. [`Evaluation::backward`] passes them to the tables. `parts` may be exchanged for
    /// other tables, whose numbers mean nothing.
    ///
    /// Panics: `evaluation` holds no result for every layer's Gaussians at `t`.
    pub fn add_to(&mut self, scene: &Scene<F>, t: Time, evaluation: &mut Evaluation<F>, d: &mut [Grads<F>]) {
        if let (Some((layer, keys)), Some(head)) = (scene.head_keys(), &self.head) {
            let [first, second] = d[layer].of([keys.first, keys.second]);
            first.data_mut().iter_mut().zip(&head.first).for_each(|(d, x)| *d += *x);
            second.data_mut().iter_mut().zip(&head.second).for_each(|(d, x)| *d += *x);
        }
        for (layer, part) in self.parts.iter_mut().enumerate() {
            let i = evaluation.find(layer, Space::Gaussians, t).expect("every layer was queried at this time");
            evaluation.add_gradient(i, &mut part.out, &mut part.color, &mut part.weights);
        }
    }
}
