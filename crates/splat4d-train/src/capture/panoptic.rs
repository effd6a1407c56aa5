//! PanopticSports captures (Luiten 2024): `train_meta.json`, `test_meta.json`, `ims/`, `seg/`; fixed cameras, OpenCV
//! axes, world to camera.

use super::account::{Account, Aspect, Severity};
use super::convention::Convention;
use super::json::{self, Node};
use super::lookup::{self, Lookup};
use super::points::read_cloud;
use super::{CaptureKind, CaptureOptions, PointCloud, RawCapture, RawFrame, Split, rig};
use splat4d::Result;
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Intrinsics, Lens};
use std::path::Path;

/// Upwards in the studio.
const UP: [f64; 3] = [0.0, -1.0, 0.0];

/// Reads both files; the cameras of `test_meta.json` are held out.
pub(super) fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let fps = options.fps.unwrap_or(DEFAULT_FPS);
    let lookup = Lookup::new(root, options)?;
    let mut found: Vec<(usize, RawFrame)> = Vec::new();
    let test = root.join("test_meta.json");
    for (path, split) in [(marker, Split::Train), (&test, Split::Held)] {
        if path.exists() {
            let value = json::read(path)?;
            read_meta(&lookup, &Node::root(&value), split, (fps, options), &mut found)
                .map_err(|e| e.at(path.display()))?;
        }
    }
    let mut ids: Vec<usize> = found.iter().map(|(id, _)| *id).collect();
    ids.sort_unstable();
    ids.dedup();
    for (id, frame) in &mut found {
        frame.camera = ids.partition_point(|i| i < id);
    }
    found.sort_by_key(|(_, f)| (f.camera, f.index));
    let mut warnings = Vec::new();
    let points = read_points(root, &mut warnings)?;
    let mut account = Account::default();
    lookup.report(&mut account);
    check_order(&found, fps, &mut account);
    Ok(RawCapture {
        cameras: ids.iter().map(ToString::to_string).collect(),
        frames: found.into_iter().map(|(_, f)| f).collect(),
        named: true,
        fps,
        points,
        up: Some(UP),
        warnings,
        account,
        ..RawCapture::new(root, CaptureKind::Panoptic, Convention::OPENCV)
    })
}

/// Reports image names whose numbers do not follow the lists, which give the times.
fn check_order(found: &[(usize, RawFrame)], fps: f64, account: &mut Account) {
    let number = |f: &RawFrame| rig::trailing_number(&f.image.file_name()?.to_string_lossy());
    // From one time to the next of the same camera: entries of the lists, and numbers of the names.
    let steps: Option<Vec<(usize, i128)>> = found
        .windows(2)
        .filter(|pair| pair[0].0 == pair[1].0)
        .map(|pair| {
            let [a, b] = [&pair[0].1, &pair[1].1];
            Some((b.index - a.index, number(b)? as i128 - number(a)? as i128))
        })
        .collect();
    let Some(steps) = steps.filter(|s| !s.is_empty()) else { return };
    if steps.iter().all(|&(entries, numbers)| entries as i128 == numbers) {
        return;
    }
    let back = steps.iter().filter(|(_, numbers)| *numbers <= 0).count();
    if back > 0 {
        let what = format!(
            "Times are the order of the lists, and {back} of {} image names have a lower or equal number than the one before: \
             sort the lists if the numbers count the frames.",
            steps.len()
        );
        account.add(Aspect::Assumed, Severity::Warning, what);
    } else {
        let what = format!(
            "Times are the order of the lists, {fps} entries a second; the numbers of image names leave some out. If all frames \
             count, set capture.fps to the rate of the frames that are listed."
        );
        account.add(Aspect::Assumed, Severity::Note, what);
    }
}

fn read_meta(
    lookup: &Lookup,
    top: &Node<'_>,
    split: Split,
    (fps, options): (f64, &CaptureOptions),
    out: &mut Vec<(usize, RawFrame)>,
) -> Result<()> {
    let (width, height) = (top.get("w")?.count()?, top.get("h")?.count()?);
    let columns = ["k", "w2c", "fn", "cam_id"].map(|key| top.get(key).and_then(|n| n.list()));
    let [k, w2c, names, ids] = columns;
    let (k, w2c, names, ids) = (k?, w2c?, names?, ids?);
    if [w2c.len(), names.len(), ids.len()].iter().any(|&n| n != k.len()) {
        return Err(top.error("the lists k, w2c, fn and cam_id are not equally long").remedy("Export the file again."));
    }
    let (images, masks) = ([lookup.folder("ims")], [lookup.root().join("seg")]);
    for t in 0..k.len() {
        let (k, w2c, names, ids) = (k[t].list()?, w2c[t].list()?, names[t].list()?, ids[t].list()?);
        if [w2c.len(), names.len(), ids.len()].iter().any(|&n| n != k.len()) {
            let what = format!("at time {t} the lists k, w2c, fn and cam_id are not equally long");
            return Err(top.error(what).remedy("Export the file again."));
        }
        for c in 0..k.len() {
            let m = k[c].matrix3()?;
            let name = names[c].text()?;
            let stated = Se3::from_rows(&w2c[c].pose4(options.poses)?);
            let source = Camera {
                cam_from_world: Convention::OPENCV.read_as(stated, options.poses)?,
                intrinsics: Intrinsics { fx: m[0][0], fy: m[1][1], cx: m[0][2], cy: m[1][2] },
                lens: Lens::Pinhole,
                width,
                height,
                near: Camera::NEAR,
            };
            let mask = lookup.image(&masks, &format!("{}.png", lookup::without_ending(name)))?;
            let image = lookup.image_or_place(&images, name)?;
            let raw = RawFrame::new((0, t, t as f64 / fps), source, image);
            out.push((ids[c].count()?, RawFrame { mask, split, ..raw }));
        }
    }
    Ok(())
}

/// The cloud: the one .ply next to the metadata, else [`ARCHIVE`].
fn read_points(root: &Path, warnings: &mut Vec<String>) -> Result<Option<PointCloud>> {
    let names = rig::file_names(root);
    let plys: Vec<&str> =
        names.iter().map(String::as_str).filter(|n| n.to_ascii_lowercase().ends_with(".ply")).collect();
    match plys[..] {
        [only] => read_cloud(&root.join(only)).map(Some),
        _ if names.iter().any(|n| n == ARCHIVE) => read_cloud(&root.join(ARCHIVE)).map(Some),
        [] => Ok(None),
        _ => {
            warnings.push(format!(
                "Which of {} is the initial cloud? None is used: leave one there, or name it with --set init=FILE.",
                plys.join(", ")
            ));
            Ok(None)
        }
    }
}

/// Luiten's own cloud: `data` of shape `[N, 7]`: position, sRGB from 0 to 1, foreground.
const ARCHIVE: &str = "init_pt_cld.npz";
