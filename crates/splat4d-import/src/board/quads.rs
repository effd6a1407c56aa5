//! Dark regions of an image whose outline is a square seen from somewhere.

use splat4d::scene::Planes;
use splat4d_train::vision::raster::sample;

/// Pixels of a tile whose brightest and darkest pixel, with those of its neighbours, give the threshold for dark:
/// AprilTag's.
const TILE: usize = 4;
/// The least difference of them: smaller differences are neither dark nor bright (AprilTag: 5 of 255).
const PLAIN: f32 = 0.04;
/// Pixels of a tag's shorter side at least: two for each bit and border of the smallest family.
const SMALLEST: f64 = 12.0;
/// How far the outline may be from the four edges, pixels and of the perimeter (OpenCV's polygons: 3 %).
const BENT: [f64; 2] = [1.5, 0.012];

/// Corners of all such regions, clockwise.
pub(super) fn quads(picture: &Planes<f32>) -> Vec<[[f64; 2]; 4]> {
    let (w, h) = (picture.width, picture.height);
    if w < 4 * TILE || h < 4 * TILE {
        return Vec::new();
    }
    let dark = dark(picture);
    let mut region = vec![0u32; w * h];
    let mut count = 0;
    let mut out = Vec::new();
    let (mut stack, mut members) = (Vec::new(), Vec::new());
    for start in 0..w * h {
        if !dark[start] || region[start] != 0 {
            continue;
        }
        count += 1;
        region[start] = count;
        stack.push(start);
        members.clear();
        while let Some(p) = stack.pop() {
            members.push(p);
            let (x, y) = (p % w, p / w);
            let near = [
                (x > 0).then(|| p - 1),
                (x + 1 < w).then(|| p + 1),
                (y > 0).then(|| p - w),
                (y + 1 < h).then(|| p + w),
            ];
            for q in near.into_iter().flatten() {
                if dark[q] && region[q] == 0 {
                    region[q] = count;
                    stack.push(q);
                }
            }
        }
        // A border of one of eight bits, or of six, is at least this part of a square.
        if (members.len() as f64) < 0.3 * SMALLEST * SMALLEST {
            continue;
        }
        if let Some(corners) = outline(&members, w).and_then(|o| corners(&o)).and_then(|c| laid(picture, &c)) {
            out.push(corners);
        }
    }
    out
}

/// Which pixels are dark next to what is around them.
fn dark(picture: &Planes<f32>) -> Vec<bool> {
    let (w, h) = (picture.width, picture.height);
    let (across, down) = (w.div_ceil(TILE), h.div_ceil(TILE));
    let mut ends = vec![[f32::INFINITY, f32::NEG_INFINITY]; across * down];
    for (p, v) in picture.data[..w * h].iter().enumerate() {
        let end = &mut ends[(p / w / TILE) * across + p % w / TILE];
        *end = [end[0].min(*v), end[1].max(*v)];
    }
    let wide = |tile: usize| {
        let (x, y) = (tile % across, tile / across);
        let mut all = [f32::INFINITY, f32::NEG_INFINITY];
        for v in y.saturating_sub(1)..(y + 2).min(down) {
            for u in x.saturating_sub(1)..(x + 2).min(across) {
                let end = ends[v * across + u];
                all = [all[0].min(end[0]), all[1].max(end[1])];
            }
        }
        all
    };
    // A tile without edges, such as one inside of a wide border, uses its neighbours until there is one.
    let mut limits: Vec<Option<f32>> = (0..across * down)
        .map(|t| {
            let [low, high] = wide(t);
            (high - low >= PLAIN).then_some(0.5 * (low + high))
        })
        .collect();
    filled(&mut limits, across);
    (0..w * h)
        .map(|p| limits[(p / w / TILE) * across + p % w / TILE].is_some_and(|limit| picture.data[p] < limit))
        .collect()
}

/// Gives limits to tiles that have none: the mean of their neighbours', ring after ring.
fn filled(limits: &mut [Option<f32>], across: usize) {
    /// Rings: tags with bits wider than twice this many tiles are not found.
    const RINGS: usize = 12;
    let down = limits.len() / across;
    for _ in 0..RINGS {
        let before = limits.to_vec();
        let mut changed = false;
        for (t, limit) in limits.iter_mut().enumerate().filter(|(_, l)| l.is_none()) {
            let (x, y) = (t % across, t / across);
            let (mut sum, mut count) = (0.0, 0.0);
            for v in y.saturating_sub(1)..(y + 2).min(down) {
                for u in x.saturating_sub(1)..(x + 2).min(across) {
                    if let Some(l) = before[v * across + u] {
                        sum += l;
                        count += 1.0;
                    }
                }
            }
            if count > 0.0 {
                *limit = Some(sum / count);
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
}

/// Pixel centres on the outside of a region: the first and last of each row and column.
fn outline(members: &[usize], w: usize) -> Option<Vec<[f64; 2]>> {
    let ends = |of: &dyn Fn(usize) -> [usize; 2]| {
        let (mut first, mut last) = (usize::MAX, 0);
        for &p in members {
            first = first.min(of(p)[0]);
            last = last.max(of(p)[0]);
        }
        let mut ends = vec![[usize::MAX, 0]; last - first + 1];
        for &p in members {
            let [line, at] = of(p);
            let end = &mut ends[line - first];
            *end = [end[0].min(at), end[1].max(at)];
        }
        (first, ends)
    };
    let (top, rows) = ends(&|p| [p / w, p % w]);
    let (left, columns) = ends(&|p| [p % w, p / w]);
    if (rows.len() as f64) < SMALLEST || (columns.len() as f64) < SMALLEST {
        return None;
    }
    let mut out: Vec<[f64; 2]> = Vec::with_capacity(2 * (rows.len() + columns.len()));
    let middle = |k: usize| k as f64 + 0.5;
    for (y, [a, b]) in rows.iter().enumerate() {
        out.extend([[middle(*a), middle(top + y)], [middle(*b), middle(top + y)]]);
    }
    for (x, [a, b]) in columns.iter().enumerate() {
        out.extend([[middle(left + x), middle(*a)], [middle(left + x), middle(*b)]]);
    }
    Some(out)
}

/// How far a point is to the right of the line from a to b, pixels (y down: for clockwise corners, outside is left).
fn beside(a: [f64; 2], b: [f64; 2], p: [f64; 2]) -> f64 {
    let d = [b[0] - a[0], b[1] - a[1]];
    (d[0] * (p[1] - a[1]) - d[1] * (p[0] - a[0])) / d[0].hypot(d[1]).max(1e-12)
}

/// The four corners of an outline, if it has four and runs straight between them.
fn corners(outline: &[[f64; 2]]) -> Option<[[f64; 2]; 4]> {
    let farthest = |of: &dyn Fn([f64; 2]) -> f64| {
        outline.iter().copied().max_by(|a, b| of(*a).total_cmp(&of(*b))).expect("an outline has points")
    };
    let n = outline.len() as f64;
    let middle: [f64; 2] = std::array::from_fn(|k| outline.iter().map(|p| p[k]).sum::<f64>() / n);
    let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let a = farthest(&|p| apart(p, middle));
    let b = farthest(&|p| apart(p, a));
    let c = farthest(&|p| beside(a, b, p).abs());
    // Like a clock.
    let [a, b, c] = if beside(a, b, c) > 0.0 { [a, b, c] } else { [b, a, c] };
    let outside = |p: [f64; 2]| -beside(a, b, p).min(beside(b, c, p)).min(beside(c, a, p));
    let d = farthest(&outside);
    let centre: [f64; 2] = std::array::from_fn(|k| (a[k] + b[k] + c[k] + d[k]) / 4.0);
    let mut quad = [a, b, c, d];
    let angle = |p: &[f64; 2]| (p[1] - centre[1]).atan2(p[0] - centre[0]);
    quad.sort_by(|p, q| angle(p).total_cmp(&angle(q)));
    let edges = [0, 1, 2, 3].map(|k| [quad[k], quad[(k + 1) % 4]]);
    let perimeter: f64 = edges.iter().map(|[p, q]| apart(*p, *q)).sum();
    let short = edges.iter().map(|[p, q]| apart(*p, *q)).fold(f64::INFINITY, f64::min);
    let convex = (0..4).all(|k| beside(quad[k], quad[(k + 1) % 4], quad[(k + 2) % 4]) > 0.25 * short);
    let bent = BENT[0].max(BENT[1] * perimeter);
    let straight = outline
        .iter()
        .all(|p| edges.iter().map(|[a, b]| beside(*a, *b, *p).abs()).fold(f64::INFINITY, f64::min) <= bent);
    (short >= SMALLEST && convex && straight).then_some(quad)
}

/// The same corners where lines meet that are laid through the steepest places about the edges.
fn laid(picture: &Planes<f32>, quad: &[[f64; 2]; 4]) -> Option<[[f64; 2]; 4]> {
    /// Of an edge, what is left out at either end: corners are round.
    const ENDS: f64 = 0.12;
    /// Pixels to either side that contain the edge, at most, and of its length: a border is an eighth of that.
    const REACH: [f64; 2] = [3.0, 0.08];
    /// Steps of a pixel.
    const STEPS: f64 = 4.0;
    let mut lines = [[0.0; 3]; 4];
    for (k, line) in lines.iter_mut().enumerate() {
        let (a, b) = (quad[k], quad[(k + 1) % 4]);
        let along = [b[0] - a[0], b[1] - a[1]];
        let length = along[0].hypot(along[1]);
        // Outwards, where it is bright.
        let out = [along[1] / length, -along[0] / length];
        let reach = REACH[0].min(REACH[1] * length).max(1.5);
        let count = (length as usize).clamp(8, 64);
        let value =
            |p: [f64; 2], r: f64| f64::from(sample(picture, (p[0] + r * out[0]) as f32, (p[1] + r * out[1]) as f32));
        let mut points: Vec<[f64; 2]> = Vec::with_capacity(count);
        for i in 0..count {
            let share = ENDS + (1.0 - 2.0 * ENDS) * (i as f64 + 0.5) / count as f64;
            let p = [a[0] + share * along[0], a[1] + share * along[1]];
            let steps = (reach * STEPS) as i32;
            let (mut sum, mut weight) = (0.0, 0.0);
            for s in -steps..=steps {
                let r = f64::from(s) / STEPS;
                let rise = value(p, r + 0.5) - value(p, r - 0.5);
                if rise > 0.0 {
                    sum += rise * rise * r;
                    weight += rise * rise;
                }
            }
            if weight > 0.0 {
                let r = sum / weight;
                points.push([p[0] + r * out[0], p[1] + r * out[1]]);
            }
        }
        if points.len() < count / 2 {
            return None;
        }
        *line = fitted(&points)?;
    }
    let mut corners = [[0.0; 2]; 4];
    for (k, corner) in corners.iter_mut().enumerate() {
        // Corner k is between the edge before it and its own.
        let (l, m) = (lines[(k + 3) % 4], lines[k]);
        let det = l[0] * m[1] - l[1] * m[0];
        if det.abs() < 1e-6 {
            return None;
        }
        *corner = [(l[2] * m[1] - l[1] * m[2]) / det, (l[0] * m[2] - l[2] * m[0]) / det];
        let moved = (corner[0] - quad[k][0]).hypot(corner[1] - quad[k][1]);
        // Outlines are of pixel centres, and cut corners.
        if moved > 2.0 * REACH[0] {
            return None;
        }
    }
    Some(corners)
}

/// The line `n·x = d` through points by total least squares, twice: points far off the first one are left out.
fn fitted(points: &[[f64; 2]]) -> Option<[f64; 3]> {
    let through = |points: &[[f64; 2]]| {
        let n = points.len() as f64;
        let mean: [f64; 2] = std::array::from_fn(|k| points.iter().map(|p| p[k]).sum::<f64>() / n);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in points {
            let d = [p[0] - mean[0], p[1] - mean[1]];
            xx += d[0] * d[0];
            xy += d[0] * d[1];
            yy += d[1] * d[1];
        }
        // At right angles to the direction of greatest spread.
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let normal = [-angle.sin(), angle.cos()];
        [normal[0], normal[1], normal[0] * mean[0] + normal[1] * mean[1]]
    };
    let first = through(points);
    let off = |p: &[f64; 2]| (first[0] * p[0] + first[1] * p[1] - first[2]).abs();
    let mut sorted: Vec<f64> = points.iter().map(off).collect();
    let half = sorted.len() / 2;
    let middle = *sorted.select_nth_unstable_by(half, f64::total_cmp).1;
    let kept: Vec<[f64; 2]> = points.iter().filter(|p| off(p) <= 3.0 * middle + 1e-9).copied().collect();
    (kept.len() >= 4).then(|| through(&kept))
}
