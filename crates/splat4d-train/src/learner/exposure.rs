//! [`Exposure`]: what learns of the cameras.

use crate::optim::Moments;
use splat4d::scene::{Grads, Key, Params, Planes, Space};

/// A gain exp(m) and an offset c a camera and channel: columns m 3, c 3. The cameras' mean is held at the identity, so that
/// the scene keeps the rig's mean exposure and held-out cameras are drawn with it.
/// Source: Luiten et al. 2024 (gain and offset a camera); the fixed mean is ours.
#[derive(Debug)]
pub struct Exposure {
    /// One table [cameras, 6].
    pub params: Params<f32>,
    /// Its moments.
    pub moments: Moments<f32>,
    key: Key,
    pub(crate) grads: Grads<f32>,
    trained: Vec<usize>,
}

impl Exposure {
    /// The identity for every camera; only the `trained` ones ever change.
    pub(crate) fn new(cameras: usize, trained: Vec<usize>) -> Self {
        let mut params = Params::new(0, 0, &[]);
        let key = params
            .entry("exposure", Space::Fixed, &[("exposure", 6)], cameras, |_| {})
            .expect("a new table fits itself");
        Self { moments: Moments::new(&params), grads: Grads::new(&params), params, key, trained }
    }

    /// The table's key.
    pub(crate) fn key(&self) -> Key {
        self.key
    }

    /// Forgets what the last views gave.
    pub(crate) fn rest(&mut self) {
        self.grads.clear(&self.params);
    }

    /// Applies the gain and offset of camera `rig` to `color`.
    pub(crate) fn respond(&self, rig: usize, color: &mut Planes<f32>) {
        let row = self.params[self.key].read::<6>(rig, 0);
        for c in 0..3 {
            let gain = row[c].exp();
            color.plane_mut(c).iter_mut().for_each(|x| *x = *x * gain + row[3 + c]);
        }
    }

    /// The VJP of [`respond`](Self::respond) at what was drawn: turns the gradient to the exposed colours into that to the
    /// drawn ones, and adds to the camera's.
    pub(crate) fn respond_backward(&mut self, rig: usize, drawn: &Planes<f32>, d_color: &mut Planes<f32>) {
        let row = self.params[self.key].read::<6>(rig, 0);
        let mut d_row = [0.0f32; 6];
        for c in 0..3 {
            let gain = row[c].exp();
            let (mut d_gain, mut d_offset) = (0.0f64, 0.0f64);
            for (g, x) in d_color.plane_mut(c).iter_mut().zip(drawn.plane(c)) {
                d_offset += f64::from(*g);
                d_gain += f64::from(*g * x * gain);
                *g *= gain;
            }
            (d_row[c], d_row[3 + c]) = (d_gain as f32, d_offset as f32);
        }
        self.grads.of([self.key])[0].add(rig, 0, d_row);
    }

    /// One Adam step with what the last views gave. Returns whether all was finite.
    pub(crate) fn step(&mut self, rate: f64) -> bool {
        let mut rates = vec![None; self.key.0 as usize];
        rates.push(Some(vec![rate; 6]));
        let finite = self.moments.step(&mut self.params, &mut self.grads, &rates, &[]).is_empty();
        self.grads.clear(&self.params);
        let table = &mut self.params[self.key];
        for col in 0..6 {
            let sum: f64 = self.trained.iter().map(|&c| f64::from(table.get(c, col))).sum();
            let mean = (sum / self.trained.len().max(1) as f64) as f32;
            self.trained.iter().for_each(|&c| *table.get_mut(c, col) -= mean);
        }
        finite
    }
}
