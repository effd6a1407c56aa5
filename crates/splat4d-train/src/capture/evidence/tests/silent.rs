//! Inputs that used to be read without a warning: masks of other images, premultiplied alpha, two zooms with one camera, lenses that
//! are slightly distorted.

use super::*;
use image::Luma;
use std::path::PathBuf;

/// A rectangle of an image, at another place in every one: the part of it that covers a pixel.
fn covered(i: usize, x: u32, y: u32) -> f32 {
    let left = 12.3 + 9.0 * i as f32;
    let top = 10.6 + 5.0 * ((i * 5) % 9) as f32;
    let along = |at: u32, from: f32, size: f32| {
        let at = at as f32;
        ((from + size).min(at + 1.0) - from.max(at)).clamp(0.0, 1.0)
    };
    along(x, left, 34.0) * along(y, top, 44.0)
}

fn textured(i: usize, x: u32, y: u32) -> f32 {
    noise([f64::from(x) / 7.0, f64::from(y) / 7.0, i as f64], 3) as f32
}

#[test]
fn masks_of_other_images_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: String| folder.path().join(name);
    for i in 0..CAMERAS {
        // Half as bright as what is around, with a texture.
        let color = |x, y| 90.0 + 60.0 * textured(i, x, y) + 70.0 * covered(i, x, y);
        ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Luma([color(x, y) as u8])).save(at(format!("{i}.png"))).unwrap();
        ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Luma([(255.0 * covered(i, x, y)) as u8]))
            .save(at(format!("{i}m.png")))
            .unwrap();
    }
    let found = |of: &dyn Fn(usize) -> usize| {
        let mut capture = photos(false);
        for (i, frame) in capture.frames.iter_mut().enumerate() {
            frame.image = at(format!("{i}.png"));
            frame.mask = Some(at(format!("{}m.png", of(i))));
        }
        let all: Vec<usize> = (0..CAMERAS).collect();
        outlines::check(&capture, &look::take(&capture, &all, look::COARSE)).map(|f| f.what)
    };
    assert_eq!(found(&|i| i), None);
    // One mask for all, such as of the camera's own mount.
    assert_eq!(found(&|_| 4), None);
    let next = found(&|i| (i + 1) % CAMERAS).unwrap();
    assert!(next.contains("Masks of 12 of 12 images"), "{next}");
    let exchanged = found(&|i| [i, 7, 2][usize::from(i == 2) + 2 * usize::from(i == 7)]).unwrap();
    assert!(exchanged.contains("Masks of 2 of 12 images") && exchanged.contains("2.png"), "{exchanged}");
    // A single wrong mask is no evidence: its outline may be on an edge by chance.
    assert_eq!(found(&|i| if i == 3 { 9 } else { i }), None);
}

#[test]
fn premultiplied_alpha_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let warned = |name: &str, multiplied: bool| {
        let mut capture = photos(false);
        for (i, frame) in capture.frames.iter_mut().enumerate() {
            frame.image = folder.path().join(format!("{name}{i}.png"));
            let pixel = |x: u32, y: u32| {
                let alpha = covered(i, x, y);
                let times = if multiplied { alpha } else { 1.0 };
                let color = ((120.0 + 60.0 * textured(i, x, y)) * times).round() as u8;
                Rgba([color, color, color / 2, (255.0 * alpha).round() as u8])
            };
            ImageBuffer::from_fn(WIDTH, HEIGHT, pixel).save(&frame.image).unwrap();
        }
        warned(&capture).into_iter().filter(|w| w.contains("premultiplied")).count()
    };
    assert_eq!([warned("straight", false), warned("multiplied", true)], [0, 1]);
}

#[test]
fn images_of_another_zoom_are_named() {
    let mut capture = photos(true);
    let zoomed = [capture.train[2], capture.train[5], capture.train[8]];
    for i in zoomed {
        let k = &mut capture.frames[i].source.intrinsics;
        (k.fx, k.fy) = (k.fx / 1.5, k.fy / 1.5);
    }
    let found = warned(&capture);
    let name = capture.frames[zoomed[1]].image.display().to_string();
    let said = |w: &&String| w.contains("another focal length than their camera") && w.contains(&name);
    assert!(
        found.iter().any(|w| said(&w) && w.contains("it is 1.4 times") || said(&w) && w.contains("it is 1.5 times")),
        "{found:?}"
    );
    assert!(!warned(&photos(true)).iter().any(|w| w.contains("another focal length")));
}

/// The photos as a lens with this first radial term takes them, with cameras that are pinholes.
fn distorted(k1: f64, points: bool, folder: &std::path::Path) -> Capture {
    let lens = look::bent(k1);
    let mut capture = photos(points);
    for (i, frame) in capture.frames.iter_mut().enumerate() {
        let back = pose(i).inverse();
        let color = |x: u32, y: u32| {
            let at = [(f64::from(x) + 0.5 - 80.0) / FOCAL, (f64::from(y) + 0.5 - 60.0) / FOCAL];
            let [x, y] = lens.undistort(at)?;
            let (p, _) = hit(back.translation, sub(back.apply([x, y, 1.0]), back.translation))?;
            Some(texture(p).map(|v| (v * 255.0).round() as u8))
        };
        frame.image = PathBuf::from(folder).join(format!("{k1}-{points}-{i}.png"));
        ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Rgb(color(x, y).unwrap_or([90, 120, 200])))
            .save(&frame.image)
            .unwrap();
    }
    capture
}

#[test]
fn distorted_images_of_pinhole_cameras_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let said = |k1: f64, points: bool| {
        let found = warned(&distorted(k1, points, folder.path()));
        found.into_iter().find(|w| w.contains("images are probably distorted"))
    };
    for points in [true, false] {
        assert_eq!(said(0.0, points), None);
    }
    // Without points so small images have too few matches.
    for k1 in [-0.3, -0.2] {
        let found = said(k1, true).unwrap_or_else(|| panic!("{k1}"));
        assert!(["k1 = -0.3", "k1 = -0.2"].iter().any(|k| found.contains(k)), "{found}");
    }
}
