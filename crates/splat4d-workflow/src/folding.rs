//! Scenes whose colours a network makes pixel by pixel, for files that contain Gaussians only.

use crate::deadline::Deadline;
use crate::draw::antialias;
use crate::events::Listener;
use crate::paths::View;
use crate::source::Source;
use splat4d::Result;
use splat4d::bake::{Likeness, Shown, compare, fold_head};
use splat4d::device;
use splat4d::layers::Head;
use splat4d::render::RenderConfig;
use splat4d::scene::Camera;

/// Degree of the spherical harmonics (studies/records/2026-11-28-pixel-head.md).
const DEGREE: usize = 3;
/// Training views that colours are fitted to, unless there are more times, and the longer side of their renders, pixels.
const VIEWS: usize = 64;
const SIDE: usize = 320;
/// Views that the result is compared in: held-out ones, where there are some.
const COMPARED: usize = 24;
/// Of the seconds that are left, what folding may take.
const SHARE: f64 = 0.3;

/// Replaces a network that makes the scene's colours (`features = full`) by spherical harmonics that look alike from the training
/// views, and reports how much alike. Other scenes are left as they are. `what` cannot hold the network.
///
/// Returns that; `None`: there is no network. Errors: a scene whose training cameras are unknown.
pub fn fold(source: &mut Source, what: &str, deadline: &Deadline, console: &dyn Listener) -> Result<Option<Likeness>> {
    if source.scene.head == Head::Identity {
        return Ok(None);
    }
    let views = source.views()?;
    if views.iter().all(|v| v.held) {
        return source.scene.without_head(what).map(|()| None);
    }
    let mode = antialias(source.antialias());
    let (held, seen): (Vec<&View>, Vec<&View>) = views.iter().partition(|v| v.held);
    // Every time is shown, so that no Gaussian with a short lifespan is missed.
    let mut times: Vec<f64> = seen.iter().map(|v| v.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let most = VIEWS.max(times.len());
    let mut shots = chosen(&seen, most);
    if deadline.is_set() {
        // The first round is a warm-up that is timed: one view in all passes.
        let began = deadline.now();
        fold_head(&source.scene, &shots[..1], DEGREE, mode, &mut |_, _| {})?;
        let each = (deadline.now() - began).max(f64::MIN_POSITIVE);
        let affordable = (SHARE * deadline.left().max(0.0) / each) as usize;
        shots = chosen(&seen, affordable.clamp(1, most));
    }
    let progress = &mut |done, total| console.phase("folding the network into spherical harmonics", done, total);
    let folded = fold_head(&source.scene, &shots, DEGREE, mode, progress)?;
    let other = if held.is_empty() { ("training", &seen) } else { ("held-out", &held) };
    let mut cpu = device::cpu(RenderConfig { antialias: mode, ..RenderConfig::default() });
    let alike =
        compare(&source.scene, Shown::File(&folded), &chosen(other.1, COMPARED), cpu.as_mut(), &mut |_, _| true)?;
    console.clear();
    if let Some(l) = &alike {
        console.result(&format!(
            "spherical harmonics of degree {DEGREE} replace the network that makes the colours (features = full): \
             {:.2} dB against the network over {} {} views, {:.2} dB in the worst ({:.2} s)",
            l.psnr, l.pictures, other.0, l.worst_psnr, l.worst_time
        ));
    }
    source.scene = folded;
    Ok(alike)
}

/// At most `most` of these views, evenly over time and from all cameras, at a size that is quick to render.
fn chosen(views: &[&View], most: usize) -> Vec<(f64, Camera)> {
    let mut seen = views.to_vec();
    seen.sort_by(|a, b| a.time.total_cmp(&b.time));
    let small = |v: &&View| (v.time, v.camera.downscaled(v.camera.width.max(v.camera.height).div_ceil(SIDE).max(1)));
    if seen.len() <= most {
        return seen.iter().map(small).collect();
    }
    // In the middle of equal parts, and of the views of that time the next camera but some.
    let pick = |i: usize| {
        let time = seen[(2 * i + 1) * seen.len() / (2 * most)].time;
        let first = seen.partition_point(|v| v.time < time);
        let count = seen.partition_point(|v| v.time <= time) - first;
        seen[first + i * stride(count) % count]
    };
    (0..most).map(|i| small(&pick(i))).collect()
}

/// A step through `count` cameras that visits all of them: near the golden section, so that neighbours in time differ.
fn stride(count: usize) -> usize {
    const GOLDEN: f64 = 0.382;
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let wanted = ((count as f64 * GOLDEN) as usize).max(1);
    (wanted..).find(|step| gcd(*step, count) == 1).unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;

    #[test]
    fn training_views_are_chosen_over_the_whole_clip() {
        let view = |i: usize| View {
            camera: Camera::with_fov_y(Se3::IDENTITY, 0.8, 200 + i % 7, 150),
            name: format!("cam{:02}", i % 7),
            time: (i / 7) as f64,
            held: false,
        };
        let views: Vec<View> = (0..210).map(view).collect();
        let views: Vec<&View> = views.iter().collect();
        let shots = chosen(&views, 60);
        assert_eq!(shots.len(), 60);
        assert!((0..30).all(|t| shots.iter().filter(|s| s.0 == f64::from(t)).count() == 2), "{shots:?}");
        let wide = View { camera: Camera::with_fov_y(Se3::IDENTITY, 0.8, 1352, 1014), ..views[0].clone() };
        assert!(chosen(&[&wide], 9)[0].1.width <= SIDE, "small images");
        // The widths tell cameras apart: also where there is one view per time, all of them take part.
        let few: std::collections::BTreeSet<usize> = chosen(&views, 30).iter().map(|s| s.1.width).collect();
        let one: std::collections::BTreeSet<u64> = chosen(&views, 30).iter().map(|s| s.0.to_bits()).collect();
        assert_eq!((few.len(), one.len()), (7, 30));
        assert_eq!(chosen(&views, 1000).len(), 210, "no view twice");
    }
}
