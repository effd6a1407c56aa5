//! Positions in images that networks return: matches of two images, and keypoints of people.

use super::describe::Form;
use super::network::Tensor;
use super::{Model, pixels};
use splat4d::Result;
use splat4d_train::capture::Rgb8;
use std::borrow::Cow;

/// Matches of two images: positions in the first and the second, pixels of the images (the first pixel's centre is 0.5).
pub type Matches = Vec<[[f32; 2]; 2]>;

/// Keypoints of a person: column and row, pixels of the image (the first pixel's centre is 0.5), and confidence.
pub type Person = Vec<[f32; 3]>;

/// Of a warp the best match of each block of the first image is used, of as many blocks along its longer side: one match
/// of each neighbourhood places a camera as well as all of them, and verification of all would take minutes.
const BLOCKS: usize = 48;

/// An image as a network takes it.
struct Fitted<'a> {
    image: Cow<'a, Rgb8>,
    /// Pixels of the image per pixel of this.
    by: [f32; 2],
}

impl Fitted<'_> {
    /// Whether a position is on the image, and not on what pads it.
    fn at(&self, of: &Rgb8, [x, y]: [f32; 2]) -> Option<[f32; 2]> {
        let at = [x * self.by[0], y * self.by[1]];
        let inside = (0.0..=of.width as f32).contains(&at[0]) && (0.0..=of.height as f32).contains(&at[1]);
        inside.then_some(at)
    }
}

impl Model {
    /// An image in the size of the network's input: stretched, or padded to the right and below.
    fn fitted<'a>(&self, image: &'a Rgb8, size: [usize; 2]) -> Fitted<'a> {
        let own = [image.width, image.height];
        let part = |own: [usize; 2], part: [usize; 2]| [0, 1].map(|k| own[k] as f32 / part[k] as f32);
        let Some(grey) = self.description.input.pad else {
            return Fitted { image: pixels::scaled(image, size), by: part(own, size) };
        };
        let factor = [0, 1].map(|k| size[k] as f64 / own[k] as f64).into_iter().fold(f64::INFINITY, f64::min);
        let inner = [0, 1].map(|k| ((own[k] as f64 * factor) as usize).clamp(1, size[k]));
        let scaled = pixels::scaled(image, inner);
        let mut data = vec![grey; 3 * size[0] * size[1]];
        for (row, from) in data.chunks_exact_mut(3 * size[0]).zip(scaled.data.chunks_exact(3 * inner[0])) {
            row[..3 * inner[0]].copy_from_slice(from);
        }
        Fitted { image: Cow::Owned(Rgb8 { width: size[0], height: size[1], data }), by: part(own, inner) }
    }

    /// Matches of two images. Errors: outputs of another shape than described.
    pub fn matches(&self, [a, b]: [&Rgb8; 2]) -> Result<Matches> {
        let size = self.input_size([a.width, a.height]);
        let fitted = [a, b].map(|image| self.fitted(image, size));
        let inputs = self.inputs(&[fitted.iter().map(|f| (&*f.image, [0, 0])).collect()], size)?;
        let outputs = self.network.run(inputs)?;
        let found = match self.description.output.form {
            Form::Numbered => self.numbered(&outputs),
            Form::Pairs => self.pairs(&outputs),
            Form::Warp => self.warp(&outputs, size),
        }?;
        let place = |[first, second]: [[f32; 2]; 2]| Some([fitted[0].at(a, first)?, fitted[1].at(b, second)?]);
        Ok(found.into_iter().filter_map(place).collect())
    }

    /// A coordinate of the network as one whose first pixel's centre is at 0.5.
    fn centred(&self, value: f32) -> f32 {
        value - self.description.output.pixel_centre + 0.5
    }

    /// Matches as numbers of key points.
    fn numbered(&self, outputs: &[Tensor]) -> Result<Matches> {
        let [points, pairs, scores] = outputs else { return Err(self.unlike("three outputs", "others")) };
        let (&[2, count, 2], &[found, 3]) = (&points.shape[..], &pairs.shape[..]) else {
            let shapes = format!("{:?} and {:?}", points.shape, pairs.shape);
            return Err(self.unlike("key points [2, points, 2] and matches [matches, 3]", &shapes));
        };
        if scores.data.len() != found {
            return Err(self.unlike(&format!("{found} scores"), &scores.data.len().to_string()));
        }
        let place = |image: usize, point: f32| {
            let at = 2 * (image * count + point as usize);
            [0, 1].map(|k| self.centred(points.data[at + k]))
        };
        let mut out = Matches::new();
        for (row, score) in pairs.data.chunks_exact(3).zip(&scores.data) {
            let inside = row[1..].iter().all(|v| (0.0..count as f32).contains(v));
            if row[0] == 0.0 && inside && *score >= self.description.output.threshold {
                out.push([place(0, row[1]), place(1, row[2])]);
            }
        }
        Ok(out)
    }

    /// Matches as positions in both images.
    fn pairs(&self, outputs: &[Tensor]) -> Result<Matches> {
        let [first, second, scores] = outputs else { return Err(self.unlike("three outputs", "others")) };
        let count = scores.data.len();
        let shaped = |t: &Tensor| t.data.len() == 2 * count && t.shape.last() == Some(&2);
        if count > 0 && !(shaped(first) && shaped(second)) {
            let shapes = format!("{:?}, {:?} and {:?}", first.shape, second.shape, scores.shape);
            return Err(self.unlike("positions [matches, 2] in both images and scores [matches]", &shapes));
        }
        let position = |of: &Tensor, k: usize| [0, 1].map(|axis| self.centred(of.data[2 * k + axis]));
        let sure = (0..count).filter(|k| scores.data[*k] >= self.description.output.threshold);
        Ok(sure.map(|k| [position(first, k), position(second, k)]).collect())
    }

    /// Matches of a warp: in each block of the first image that of the highest score.
    fn warp(&self, outputs: &[Tensor], size: [usize; 2]) -> Result<Matches> {
        let [warp, scores] = outputs else { return Err(self.unlike("two outputs", "others")) };
        let &[1, height, width, 2] = &warp.shape[..] else {
            return Err(self.unlike("a warp [1, h, w, 2]", &format!("{:?}", warp.shape)));
        };
        if scores.data.len() != width * height || width * height == 0 {
            return Err(self.unlike(&format!("scores [1, {height}, {width}]"), &format!("{:?}", scores.shape)));
        }
        let side = width.max(height).div_ceil(BLOCKS);
        let mut out = Matches::new();
        for (y0, x0) in (0..height).step_by(side).flat_map(|y| (0..width).step_by(side).map(move |x| (y, x))) {
            let rows = y0..(y0 + side).min(height);
            let inside = rows.flat_map(|y| (x0..(x0 + side).min(width)).map(move |x| y * width + x));
            let best = inside.max_by(|i, k| scores.data[*i].total_cmp(&scores.data[*k]).then(k.cmp(i)));
            let best = best.expect("a block has a pixel");
            if scores.data[best] >= self.description.output.threshold {
                let grid = [width, height];
                let here = [best % width, best / width];
                let first = [0, 1].map(|k| (here[k] as f32 + 0.5) * size[k] as f32 / grid[k] as f32);
                let second = [0, 1].map(|k| (warp.data[2 * best + k] + 1.0) / 2.0 * size[k] as f32);
                out.push([first, second]);
            }
        }
        Ok(out)
    }

    /// The people in an image, the most certain first. Errors: outputs of another shape than described.
    pub fn people(&self, image: &Rgb8) -> Result<Vec<Person>> {
        let size = self.input_size([image.width, image.height]);
        let fitted = self.fitted(image, size);
        let outputs = self.network.run(self.inputs(&[vec![(&*fitted.image, [0, 0])]], size)?)?;
        let points = &outputs[0];
        let (count, keypoints) = match points.shape[..] {
            [count, keypoints, 3] | [1, count, keypoints, 3] => (count, keypoints),
            _ => return Err(self.unlike("keypoints [people, keypoints, 3]", &format!("{:?}", points.shape))),
        };
        let person = |k: usize| &points.data[3 * keypoints * k..3 * keypoints * (k + 1)];
        let boxes: Vec<[f32; 5]> = match outputs.get(1) {
            Some(boxes) if boxes.data.len() == 5 * count && (count == 0 || boxes.shape.last() == Some(&5)) => {
                boxes.data.chunks_exact(5).map(|b| std::array::from_fn(|k| b[k])).collect()
            }
            Some(boxes) => return Err(self.unlike(&format!("boxes [{count}, 5]"), &format!("{:?}", boxes.shape))),
            None => (0..count).map(|k| around(person(k))).collect(),
        };
        let sure = |k: &usize| boxes[*k][4] >= self.description.output.threshold;
        let mut order: Vec<usize> = (0..count).filter(sure).collect();
        order.sort_by(|a, b| boxes[*b][4].total_cmp(&boxes[*a][4]).then(a.cmp(b)));
        let mut kept: Vec<usize> = Vec::new();
        for k in order {
            if kept.iter().all(|other| shared(boxes[*other], boxes[k]) <= self.description.output.overlap) {
                kept.push(k);
            }
        }
        let keypoint = |p: &[f32]| {
            let at = fitted.at(image, [self.centred(p[0]), self.centred(p[1])]);
            // Outside of the image, or no number: not seen.
            let sure = if at.is_some() && p[2].is_finite() { p[2].clamp(0.0, 1.0) } else { 0.0 };
            let [x, y] = at.unwrap_or_default();
            [x, y, sure]
        };
        Ok(kept.into_iter().map(|k| person(k).chunks_exact(3).map(keypoint).collect()).collect())
    }
}

/// The box around keypoints, and their mean confidence.
fn around(person: &[f32]) -> [f32; 5] {
    let edge = |axis: usize, of: fn(f32, f32) -> f32| person.chunks_exact(3).map(|p| p[axis]).reduce(of).unwrap_or(0.0);
    let sure = person.chunks_exact(3).map(|p| p[2]).sum::<f32>() / (person.len() / 3).max(1) as f32;
    [edge(0, f32::min), edge(1, f32::min), edge(0, f32::max), edge(1, f32::max), sure]
}

/// The share of two boxes' union that both cover.
fn shared(a: [f32; 5], b: [f32; 5]) -> f32 {
    let along = |k: usize| (a[k + 2].min(b[k + 2]) - a[k].max(b[k])).max(0.0);
    let area = |x: [f32; 5]| (x[2] - x[0]).max(0.0) * (x[3] - x[1]).max(0.0);
    let both = along(0) * along(1);
    let all = area(a) + area(b) - both;
    if all > 0.0 { both / all } else { 0.0 }
}
