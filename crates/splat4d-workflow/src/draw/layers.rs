//! Layers of an image for compositing: depth, motion and labels of what pixels show, sharp: of a pinhole at the frame's
//! time.

use super::{DEPTH_ALPHA, Painter, shoot};
use crate::paths::Shot as Frame;
use splat4d::channels;
use splat4d::flow;
use splat4d::render::Shot;
use splat4d::scene::{Planes, Space, Table};
use splat4d_train::labels::best;

/// Depth where nothing is: farther than everything, and still a number to compute with.
const FAR: f32 = 1e10;
/// The label of nothing.
const NO_LABEL: f32 = -1.0;

/// Planes of one image.
#[derive(Clone, Debug, Default)]
pub struct Layers {
    /// Expected depth, scene units: z in camera axes, of a sphere the distance; 10¹⁰ where nothing is. [1, h, w].
    pub depth: Planes<f32>,
    /// Motion to the next frame, pixels, x to the right and y down; 0 where nothing is. [2, h, w].
    pub motion: Planes<f32>,
    /// Number of the most probable label, −1 for none; no plane where the scene has no labels.
    pub label: Planes<f32>,
}

impl Painter<'_> {
    /// Renders a frame's layers. `next`: the frame to which motion is measured.
    pub fn layers(&mut self, frame: &Frame, next: &Frame) -> Layers {
        let (scene, camera) = (self.scene, &frame.camera);
        let (now, then) = (self.scene_time(frame.time), self.scene_time(next.time));
        scene.at(now, &mut self.instant);
        // Before motion adds queries of other times.
        let labels = channels::label_columns(scene, &self.instant);
        let motion = match &self.panorama {
            None => {
                let next = flow::Shot { t: then, camera: &next.camera };
                flow::flow_columns(scene, &self.instant, camera, next)
            }
            Some(_) => self.motion_around(frame, next),
        };
        let splats = self.instant.splats(scene, now);
        let shot = Shot { extra: Some(&motion), depth: true, ..Shot::new(&splats, camera, self.background) };
        shoot(&mut self.backend, self.listener, &mut self.panorama, &shot, &mut self.image);
        let (motion, weight) = flow::divided(&self.image.extra);
        let mut out = Layers { depth: self.image.depth.clone(), motion, label: Planes::default() };
        for (p, (depth, alpha)) in out.depth.data.iter_mut().zip(&self.image.alpha.data).enumerate() {
            *depth = if *alpha < DEPTH_ALPHA { FAR } else { *depth / alpha };
            if weight.data[p] < DEPTH_ALPHA {
                (0..2).for_each(|c| out.motion.plane_mut(c)[p] = 0.0);
            }
        }
        if let Some(columns) = labels {
            let shot = Shot { extra: Some(&columns), ..Shot::new(&splats, camera, self.background) };
            shoot(&mut self.backend, self.listener, &mut self.panorama, &shot, &mut self.image);
            out.label.reset(1, self.image.alpha.height, self.image.alpha.width);
            for (p, label) in out.label.data.iter_mut().enumerate() {
                *label = best(&self.image.extra, p).map_or(NO_LABEL, |l| l as f32);
            }
        }
        out
    }

    /// Motion of every splat over the sphere, as [`flow::flow_columns`]: by the shorter way around.
    fn motion_around(&mut self, frame: &Frame, next: &Frame) -> Table {
        let (scene, [now, then]) = (self.scene, [frame.time, next.time].map(|t| self.scene_time(t)));
        let mut queries = Vec::new();
        for layer in 0..scene.layers.len() {
            let i = self.instant.find(layer, Space::Gaussians, now).expect("every layer was queried");
            queries.push([i, self.instant.request_again(i, then)]);
        }
        self.instant.evaluate(&scene.layers);
        let panorama = self.panorama.as_ref().expect("the sphere is rendered");
        let width = panorama.size()[0] as f64;
        let mut out = Table::new(&[("flow", 2), ("valid", 1)], self.instant.splats(scene, now).len());
        let mut first = 0;
        for [a, b] in queries {
            let tables = [a, b].map(|query| self.instant.tape(query).out());
            for j in 0..tables[0].rows() {
                let [p, q] = [(tables[0], frame), (tables[1], next)].map(|(table, frame)| {
                    panorama.project(frame.camera.cam_from_world.apply(table.read::<3>(j, 0).map(f64::from)))
                });
                let across = (q[0] - p[0] + 0.5 * width).rem_euclid(width) - 0.5 * width;
                out.write(first + j, 0, [across as f32, (q[1] - p[1]) as f32, 1.0]);
            }
            first += tables[0].rows();
        }
        out
    }

    /// Distance (z in camera axes, scene units) of what an image shows at a pixel and around it; `None`: nothing.
    pub fn distance_at(&mut self, frame: &Frame, [x, y]: [f64; 2]) -> Option<f64> {
        /// Pixels around it of which the mean is taken.
        const REACH: usize = 2;
        let (scene, now) = (self.scene, self.scene_time(frame.time));
        scene.at(now, &mut self.instant);
        let splats = self.instant.splats(scene, now);
        let shot = Shot { depth: true, ..Shot::new(&splats, &frame.camera, self.background) };
        shoot(&mut self.backend, self.listener, &mut None, &shot, &mut self.image);
        let alpha = &self.image.alpha;
        let [x, y] = [(x, alpha.width), (y, alpha.height)].map(|(v, n)| (v.max(0.0) as usize).min(n - 1));
        let (mut depth, mut weight) = (0.0, 0.0);
        for row in y.saturating_sub(REACH)..=(y + REACH).min(alpha.height - 1) {
            for column in x.saturating_sub(REACH)..=(x + REACH).min(alpha.width - 1) {
                depth += f64::from(self.image.depth.get(0, row, column));
                weight += f64::from(alpha.get(0, row, column));
            }
        }
        (alpha.get(0, y, x) >= DEPTH_ALPHA && weight > 0.0).then(|| depth / weight)
    }
}
