//! Labels and features as further channels of the renderer ([`Shot::extra`](crate::render::Shot::extra)) with a last
//! column that is 1 where a splat has a value, so that [`divided`](crate::flow::divided) gives the mean over what a pixel
//! shows. Velocity and flow are in [`flow`](crate::flow).

use crate::layers::{Evaluation, Scene};
use crate::math::Real;
use crate::scene::{Table, features, labels};

/// Probabilities of the scene's labels: [splats, labels + 1], the last 1, or zeros in layers without labels. `None`:
/// the scene has no labels.
///
/// Panics: `instant` is not this scene's.
pub fn label_columns<F: Real>(scene: &Scene<F>, instant: &Evaluation<F>) -> Option<Table<F>> {
    let count = scene.labels.len();
    if count == 0 {
        return None;
    }
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut out = Table::new(&[("labels", count), ("valid", 1)], rows);
    let (mut first, mut p) = (0, vec![F::ZERO; count]);
    for (layer, tape) in scene.layers.iter().zip(instant.tapes()) {
        let own = tape.out().rows();
        if let Some(key) = labels::key(&layer.params) {
            for j in 0..own {
                labels::probabilities(&layer.params, key, tape.rows().id(j), &mut p);
                (0..count).for_each(|k| out.set(first + j, k, p[k]));
                out.set(first + j, count, F::ONE);
            }
        }
        first += own;
    }
    Some(out)
}

/// The scene's feature channels: [splats, channels + 1], the last 1, or zeros in layers without features. `None`: the
/// scene has none.
///
/// Panics: `instant` is not this scene's.
pub fn feature_columns<F: Real>(scene: &Scene<F>, instant: &Evaluation<F>) -> Option<Table<F>> {
    let count = scene.feature_channels();
    if count == 0 {
        return None;
    }
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut out = Table::new(&[("features", count), ("valid", 1)], rows);
    let mut first = 0;
    for (layer, tape) in scene.layers.iter().zip(instant.tapes()) {
        let own = tape.out().rows();
        if let Some(key) = features::key(&layer.params) {
            for j in 0..own {
                let row = tape.rows().id(j);
                (0..count).for_each(|k| out.set(first + j, k, layer.params[key].get(row, k)));
                out.set(first + j, count, F::ONE);
            }
        }
        first += own;
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::divided;
    use crate::layers::Layer;
    use crate::math::Se3;
    use crate::motion::{Spec, build};
    use crate::render::{Image, RenderConfig, Renderer, Shot};
    use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use crate::scene::{Camera, GEOMETRY, LIFE, LifeKind, Params, Time};

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::look_at([0.0, 0.0, 4.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.7, 48, 32)
    }

    /// Two discs that face the camera: one to the left of the image, one to the right and farther.
    fn scene() -> Scene<f32> {
        let mut p = Params::new(2, 1, LifeKind::GaussHalf.columns());
        for (r, x) in [(0, -0.6), (1, 0.6)] {
            p[GEOMETRY].write(r, 0, [x, 0.0, -0.5 * r as f32]);
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.6, -1.6, -5.0]);
            p[GEOMETRY].set(r, OPACITY, 6.0);
            p[LIFE].write(r, 0, [0.5, if r == 0 { 4.0 } else { -3.0 }]);
        }
        labels::state(&mut p, 2, &[Some(1), None]);
        let motion = build(&Spec::Still, &mut p).unwrap();
        let layers = vec![Layer::new("a", p, motion, LifeKind::GaussHalf)];
        let labels = vec!["floor".to_owned(), "hand".to_owned()];
        Scene { layers, labels, clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
    }

    /// The channel's value in the middle of both discs.
    fn shown(columns: &Table<f32>) -> [Vec<f32>; 2] {
        let (scene, mut instant, mut image) = (scene(), Evaluation::default(), Image::default());
        scene.at(Time(0.5), &mut instant);
        let splats = scene.splats(&instant);
        let camera = camera();
        let shot = Shot { extra: Some(columns), ..Shot::new(&splats, &camera, [0.0; 3]) };
        Renderer::new(RenderConfig::default()).render(&shot, &mut image);
        let (values, weight) = divided(&image.extra);
        [[-0.6, 0.0, 0.0], [0.6, 0.0, -0.5]].map(|x| {
            let ([u, v], _) = camera.project(x).unwrap();
            assert!(weight.get(0, v as usize, u as usize) > 0.3);
            (0..values.channels).map(|c| values.get(c, v as usize, u as usize)).collect()
        })
    }

    #[test]
    fn labels_are_those_of_visible_surfaces() {
        let (scene, mut instant) = (scene(), Evaluation::default());
        scene.at(Time(0.5), &mut instant);
        let [hand, nobody] = shown(&label_columns(&scene, &instant).unwrap());
        assert!(hand[1] > 0.99 && (nobody[0] - 0.5).abs() < 1e-5, "{hand:?} {nobody:?}");
        assert!(label_columns(&Scene { labels: Vec::new(), ..scene }, &instant).is_none());
    }
}
