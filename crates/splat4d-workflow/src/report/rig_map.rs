//! A map of the cameras from above, as SVG.

use super::chart::escape;
use splat4d::math::se3::{cross, dot, norm, sub};
use splat4d_import::doctor::Grade;
use splat4d_train::capture::Capture;
use std::fmt::Write;

/// Width of the map and its margin, units of the SVG.
const WIDTH: f64 = 560.0;
const MARGIN: f64 = 64.0;
/// Most points that are plotted.
const POINTS: usize = 600;
/// Length of a viewing direction, of the map's width.
const ARROW: f64 = 0.09;
/// Most cameras with a name.
const NAMED: usize = 40;
/// Distance of a name from its camera, height of a line and mean width of a letter at the size of type on phones.
const NAME_GAP: f64 = 12.0;
const NAME_LINE: f64 = 17.0;
const LETTER: f64 = 8.5;
/// Lines by which a name gives way to others; one that still covers another is left to the tooltip.
const NAME_SHIFTS: usize = 3;

/// The map of fixed cameras; empty where there are fewer than two. `grade`: the worst finding of a camera.
pub(super) fn svg(capture: &Capture, grade: &dyn Fn(&str) -> Option<Grade>) -> String {
    let plan = Plan::new(capture.up);
    let mut cameras = Vec::new();
    for (k, rig) in capture.cameras.iter().enumerate().filter(|(_, rig)| rig.fixed) {
        if let Some(frame) = capture.frames.iter().find(|f| f.camera == k) {
            cameras.push((rig.name.as_str(), plan.of(frame.view.center()), plan.of(frame.view.forward())));
        }
    }
    if cameras.len() < 2 {
        return String::new();
    }
    let cloud = capture.points.as_ref().map_or(&[][..], |p| &p.points);
    let stride = cloud.len().div_ceil(POINTS).max(1);
    let mut points: Vec<[f64; 2]> = cloud.iter().step_by(stride).map(|x| plan.of(*x)).collect();
    // Far points would shrink the rig to a dot.
    let frame = Bounds::of(cameras.iter().map(|c| c.1)).grown(0.6);
    points.retain(|p| frame.holds(*p));
    let bounds = Bounds::of(cameras.iter().map(|c| c.1).chain(points.iter().copied()));
    draw(&cameras, &points, &bounds, grade)
}

fn draw(
    cameras: &[(&str, [f64; 2], [f64; 2])],
    points: &[[f64; 2]],
    bounds: &Bounds,
    grade: &dyn Fn(&str) -> Option<Grade>,
) -> String {
    let scale = (WIDTH - 2.0 * MARGIN) / bounds.side(0).max(bounds.side(1)).max(f64::MIN_POSITIVE);
    let height = bounds.side(1) * scale + 2.0 * MARGIN;
    // Downwards in the plan is away from the reader.
    let place =
        |p: [f64; 2]| [MARGIN + (p[0] - bounds.low[0]) * scale, height - MARGIN - (p[1] - bounds.low[1]) * scale];
    let mut out = format!("<svg viewBox=\"0 0 {WIDTH} {height:.0}\" role=\"img\" aria-label=\"Map of the cameras\">\n");
    for p in points {
        let [x, y] = place(*p);
        let _ = writeln!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"1\" fill=\"var(--soft)\" opacity=\"0.55\"/>");
    }
    let mut labels = Labels::default();
    for (name, at, forward) in cameras {
        let colour = match grade(name) {
            Some(Grade::Bad) => "#d4351c",
            Some(Grade::Warning) => "#e08a00",
            _ => "var(--c1)",
        };
        let [x, y] = place(*at);
        let length = forward[0].hypot(forward[1]);
        let step = if length > 0.0 { ARROW * WIDTH / length } else { 0.0 };
        let (tx, ty) = (x + step * forward[0], y - step * forward[1]);
        let (label, name) = (labels.place(name, [x, y], [tx - x, ty - y]), escape(name));
        let _ = writeln!(
            out,
            "<g stroke=\"{colour}\" fill=\"{colour}\"><title>{name}</title><line x1=\"{x:.1}\" y1=\"{y:.1}\" x2=\"{tx:.1}\" \
             y2=\"{ty:.1}\" stroke-width=\"1.6\"/><circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4.5\" stroke=\"none\"/></g>"
        );
        if let Some([nx, ny]) = label.filter(|_| cameras.len() <= NAMED) {
            let _ = writeln!(
                out,
                "<text class=\"tick\" x=\"{nx:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{name}</text>",
                ny + 4.0
            );
        }
    }
    out + "</svg>\n"
}

/// Names of cameras that cover neither each other nor their own camera: centre and half size of each.
#[derive(Default)]
struct Labels(Vec<([f64; 2], [f64; 2])>);

impl Labels {
    /// The centre of a camera's name, behind the camera; `None` if others are everywhere around.
    fn place(&mut self, name: &str, at: [f64; 2], forward: [f64; 2]) -> Option<[f64; 2]> {
        let length = forward[0].hypot(forward[1]);
        // A camera that looks straight down has its name below.
        let back = if length > 0.0 { forward.map(|v| -v / length) } else { [0.0, 1.0] };
        let half = [0.5 * LETTER * name.chars().count() as f64, 0.5 * NAME_LINE];
        for shift in 0..=NAME_SHIFTS {
            // The box's edge, not its centre, is `NAME_GAP` behind the camera.
            let reach = NAME_GAP + NAME_LINE * shift as f64;
            let center = [0, 1].map(|k| at[k] + back[k] * (reach + half[k] * back[k].abs()));
            let free = |(other, size): &([f64; 2], [f64; 2])| {
                (0..2).any(|k| (center[k] - other[k]).abs() >= half[k] + size[k])
            };
            if self.0.iter().all(free) {
                self.0.push((center, half));
                return Some(center);
            }
        }
        None
    }
}

/// Two directions on the ground.
struct Plan([[f64; 3]; 2]);

impl Plan {
    fn new(up: [f64; 3]) -> Self {
        // The axis that is farthest from upwards makes the other two.
        let axis = (0..3).min_by(|a, b| up[*a].abs().total_cmp(&up[*b].abs())).expect("there are three");
        let mut east = [0.0; 3];
        east[axis] = 1.0;
        let along = dot(east, up);
        let east = sub(east, up.map(|u| u * along));
        let east = east.map(|e| e / norm(east));
        Self([east, cross(up, east)])
    }

    fn of(&self, x: [f64; 3]) -> [f64; 2] {
        self.0.map(|axis| dot(axis, x))
    }
}

/// Least and greatest coordinates.
struct Bounds {
    low: [f64; 2],
    high: [f64; 2],
}

impl Bounds {
    fn of(points: impl Iterator<Item = [f64; 2]>) -> Self {
        let empty = Self { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };
        points.fold(empty, |b, p| Self {
            low: std::array::from_fn(|k| b.low[k].min(p[k])),
            high: std::array::from_fn(|k| b.high[k].max(p[k])),
        })
    }

    fn side(&self, k: usize) -> f64 {
        self.high[k] - self.low[k]
    }

    fn grown(&self, share: f64) -> Self {
        let by = share * self.side(0).max(self.side(1));
        Self { low: self.low.map(|v| v - by), high: self.high.map(|v| v + by) }
    }

    fn holds(&self, p: [f64; 2]) -> bool {
        (0..2).all(|k| (self.low[k]..=self.high[k]).contains(&p[k]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_close_cameras_do_not_cover_each_other() {
        let mut labels = Labels::default();
        let places: Vec<[f64; 2]> =
            (0..3).filter_map(|k| labels.place("cam00", [100.0 + 10.0 * k as f64, 50.0], [0.0, -1.0])).collect();
        assert_eq!(places.len(), 3);
        for (a, b) in [(0, 1), (0, 2), (1, 2)] {
            let apart = [0, 1].map(|k| (places[a][k] - places[b][k]).abs());
            assert!(apart[0] >= 5.0 * LETTER || apart[1] >= NAME_LINE, "{places:?}");
        }
        let crowd = (0..20).filter_map(|_| labels.place("cam00", [100.0, 50.0], [0.0, -1.0])).count();
        assert!(crowd <= NAME_SHIFTS, "names without room are left out: {crowd}");
        assert!(labels.place("cam00", [400.0, 50.0], [0.0; 2]).is_some_and(|p| p[1] > 50.0), "it looks straight down");
    }

    #[test]
    fn the_map_shows_cameras_from_above() {
        let plan = Plan::new([0.0, 1.0, 0.0]);
        let [a, b] = [plan.of([2.0, 5.0, 0.0]), plan.of([0.0, -3.0, 1.0])];
        assert!(
            (a[0].hypot(a[1]) - 2.0).abs() < 1e-12 && (b[0].hypot(b[1]) - 1.0).abs() < 1e-12,
            "height does not count"
        );
        let cameras = [("left<1>", [0.0, 0.0], [1.0, 0.0]), ("right", [4.0, 2.0], [0.0, -1.0])];
        let bounds = Bounds::of(cameras.iter().map(|c| c.1));
        let svg = draw(&cameras, &[[1.0, 1.0]], &bounds, &|name| (name == "right").then_some(Grade::Bad));
        assert!(svg.contains("left&lt;1&gt;") && !svg.contains("left<1>"));
        assert_eq!(svg.matches("#d4351c").count(), 2, "line and dot of the bad one");
        // The first is at the left and looks to the right; y goes downwards in SVG.
        assert!(svg.contains(&format!("x1=\"{MARGIN:.1}\"")), "{svg}");
    }
}
