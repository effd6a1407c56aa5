//! From what the files specify to a checked capture: poses, sizes, files, duplicates, split, clock.

use super::account::Severity;
use super::account::{Aspect, Remark, first_names};
use super::options::Lenses;
use super::pose::{SAME_POSE, same_pose};
use super::{
    Capture, CaptureKind, CaptureOptions, Exif, Extent, FlowFile, Frame, HoldOut, PointCloud, RawCapture, RawFrame,
    Rig, Split, Timing,
};
use super::{
    borders, computed, evidence, lookup, masks, options, panorama, picture, plausible, pose, rig, shutter, vignetting,
};
use rayon::prelude::*;
use splat4d::math::se3::{norm, normalize};
use splat4d::scene::{Camera, Lens, Time};
use splat4d::{Error, Result};
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Every how many images one is held out where no rig and no convention states otherwise (LLFF's habit).
const HOLD_EVERY: usize = 8;
/// White: the default background of transparent pixels (the papers' choice for D-NeRF).
const WHITE: [f32; 3] = [1.0; 3];

/// Checks what a reader found and makes a capture of it.
pub(super) fn assemble(mut take: RawCapture, options: &CaptureOptions) -> Result<Capture> {
    let root = take.root.clone();
    let located = |e: Error| e.at(root.display());
    if take.frames.is_empty() {
        return Err(located(
            Error::input("the capture has no frames")
                .remedy("Check that the file lists images and that the images exist at the listed paths."),
        ));
    }
    options::check_rate("frame rate", take.fps).map_err(located)?;
    let used: BTreeSet<usize> = take.frames.iter().map(|f| f.camera).collect();
    skip_missing(&mut take, options).map_err(located)?;
    skip_repeated(&mut take);
    masks::fill(&mut take)?;
    computed::fill(&mut take)?;
    let in_part = take.take != Extent::default();
    if !in_part {
        drop_unused_cameras(&mut take, &used);
    }
    shared_images(&mut take);
    // The faces of a panorama are cameras of their own, and share its image.
    panorama::split(&mut take, options.hold_out.as_ref())?;
    for frame in &mut take.frames {
        check_frame(frame, &take.cameras[frame.camera], options)?;
    }
    if !in_part {
        let mut all = Extent::default();
        take.frames.iter().for_each(|f| all.add(f.index..f.index + 1));
        take.take = all;
    }
    let offset = super::offset::subtract(&mut take);
    let cameras = rigs(&take);
    check_poses(&mut take, &cameras)?;
    check_duplicates(&mut take, &cameras).map_err(located)?;
    if take.points.is_none() && take.geometry.is_none() && !in_part {
        unread_clouds(&mut take);
    }
    let (has_alpha, turned, unsure) = fit_pictures(&mut take, options)?;
    check_masks(&take, has_alpha)?;
    let background = options.background.or(take.background).or(has_alpha.then_some(WHITE)).filter(|_| has_alpha);
    let (train, held, validation) = split(&mut take, &cameras, options).map_err(located)?;
    let up = take.up.map(normalize).filter(|u| norm(*u) > 0.0).unwrap_or_else(|| estimate_up(&take.frames));
    let flows = flows(&mut take.frames);
    let firsts = std::mem::take(&mut take.firsts);
    let frames = take.frames.into_iter().zip(flows);
    let mut frames: Vec<Frame> = frames
        .zip(turned)
        .map(|((raw, flow), upright)| {
            let shutter = options.shutter(raw.shutter);
            let vignetting = raw.vignetting.or(options.vignetting).filter(|k| *k != [0.0; 3]);
            Frame { flow, upright, shutter, vignetting, ..finish(raw, options.downscale) }
        })
        .collect();
    shutter::find_motion(&mut frames, &cameras);
    take.notes.extend(shutter::notes(&frames));
    take.notes.extend(vignetting::notes(&frames));
    let name = take.name.unwrap_or_else(|| {
        let full = std::path::absolute(&take.root).unwrap_or_else(|_| take.root.clone());
        full.file_name().map_or_else(|| "capture".into(), |n| n.to_string_lossy().into_owned())
    });
    take.warnings.extend(take.points.as_ref().and_then(PointCloud::loss));
    let points = take.points.map(|p| p.voxel_downsample(options.max_points)).filter(|p| !p.points.is_empty());
    let mut capture = Capture {
        name,
        elsewhere: super::elsewhere::find(&take.root, &frames, &take.files),
        root: take.root,
        kind: take.kind,
        cameras,
        named: take.named || super::sequence::are_cameras(&take.cameras),
        frames,
        take: take.take,
        held,
        train,
        validation,
        future: Vec::new(),
        timing: take.timing,
        fps: take.fps,
        points,
        geometry: take.geometry.map(|g| Arc::new(g.relative_to(offset))),
        background,
        up,
        offset,
        labels: take.labels,
        downscale: options.downscale,
        convention: take.convention,
        poses: options.poses,
        lenses: Lenses::default(),
        account: take.account.remarks,
        warnings: take.warnings,
        notes: take.notes,
    };
    settle_orientation(&mut capture, &unsure);
    borders::find(&mut capture, options, &firsts);
    join_geometry(&mut capture, options)?;
    for remark in &capture.account {
        let list = if remark.severity == Severity::Warning { &mut capture.warnings } else { &mut capture.notes };
        list.push(remark.what.clone());
    }
    let near = near(&capture, options.near);
    capture.frames.iter_mut().for_each(|f| f.view.near = near);
    // Last: all else follows from the whole capture.
    let frames = &capture.frames;
    for all in [&mut capture.train, &mut capture.held, &mut capture.validation] {
        all.retain(|&i| options.lists(frames[i].index));
    }
    Ok(capture)
}

/// Adds points of measured geometry to the capture's own.
fn join_geometry(capture: &mut Capture, options: &CaptureOptions) -> Result<()> {
    let Some(geometry) = capture.geometry.clone() else { return Ok(()) };
    if options.max_points == 0 || capture.train.is_empty() {
        return Ok(());
    }
    let (cloud, note) = geometry.cloud(capture)?;
    capture.notes.push(note);
    let points = capture.points.get_or_insert_default();
    points.points.extend(cloud.points);
    points.colors.extend(cloud.colors);
    points.times.extend(cloud.times);
    Ok(())
}

/// Names point clouds next to the capture's files, where it has no points: nothing states that they are in its world.
fn unread_clouds(take: &mut RawCapture) {
    let clouds: Vec<String> =
        rig::file_names(&take.root).into_iter().filter(|n| n.to_ascii_lowercase().ends_with(".ply")).collect();
    if !clouds.is_empty() {
        let what = format!(
            "Point clouds in the folder that the capture does not name: {}. To begin with one, name it (ply_file_path in \
             transforms.json, points in capture.json).",
            first_names(&clouds)
        );
        take.account.add(Aspect::NotRead, Severity::Note, what);
    }
}

/// Points nearer than this share of all points of a training camera may be outliers.
const STRAY_POINTS: f64 = 0.01;
/// Of the distance of the nearest points: Gaussians in front of them are still rendered.
const BEFORE_POINTS: f64 = 0.5;

/// Some distance there must be, of the extent: the projection divides by it.
const SMALLEST_NEAR: f64 = 1e-3;

/// Of the requested share, where no points give the nearest distance.
const UNKNOWN_DEPTH: f64 = 0.25;

/// How near splats are rendered, scene units: this share of the extent, or half way to the nearest of the capture's
/// points.
pub(super) fn near(capture: &Capture, share: f64) -> f64 {
    let cloud = capture.points.as_ref().map_or(&[][..], |p| &p.points);
    let views: Vec<&Camera> = capture.places().collect();
    let of = |view: &&Camera| -> Vec<f64> {
        let (width, height) = (view.width as f64, view.height as f64);
        let inside = |&([u, v], _): &([f64; 2], f64)| (0.0..width).contains(&u) && (0.0..height).contains(&v);
        cloud.iter().filter_map(|&x| view.project(x)).filter(inside).map(|(_, z)| z).collect()
    };
    // Most of the time of opening a capture of thousands of images.
    let mut depths: Vec<f64> = views.par_iter().flat_map_iter(of).collect();
    let at = (STRAY_POINTS * depths.len() as f64) as usize;
    let extent = capture.center_and_radius().1;
    let farthest = match depths.is_empty() {
        true => UNKNOWN_DEPTH * share * extent,
        false => BEFORE_POINTS * *depths.select_nth_unstable_by(at, f64::total_cmp).1,
    };
    (share * extent).min(farthest).max(Camera::NEAR.min(SMALLEST_NEAR * extent))
}

/// The pinhole view of the image as it will be loaded.
fn finish(raw: RawFrame, downscale: usize) -> Frame {
    let view = Camera { lens: Lens::Pinhole, ..raw.source.downscaled(downscale) };
    Frame {
        camera: raw.camera,
        view,
        source: raw.source,
        time: Time(raw.time),
        index: raw.index,
        image: raw.image,
        upright: true,
        mask: raw.mask,
        depth: raw.depth,
        flow: None,
        labels: raw.labels,
        features: raw.features,
        tracks: raw.tracks,
        recorded: None,
        shutter: None,
        vignetting: None,
        residual: [0.0; 2],
    }
}

/// The flows of all frames, each with the next frame of its camera.
fn flows(frames: &mut [RawFrame]) -> Vec<Option<FlowFile>> {
    let numbers: BTreeMap<(usize, usize), usize> =
        frames.iter().enumerate().map(|(i, f)| ((f.camera, f.index), i)).collect();
    let next = |f: &RawFrame| numbers.get(&(f.camera, f.index + 1)).copied();
    frames.iter_mut().map(|f| Some(FlowFile { to: next(f)?, path: f.flow.take()?, of_view: false })).collect()
}

fn check_frame(frame: &mut RawFrame, camera: &str, options: &CaptureOptions) -> Result<()> {
    let place = |e: Error| e.at(format!("{} (camera {camera}, frame {})", frame.image.display(), frame.index));
    let source = &mut frame.source;
    pose::check_intrinsics(&source.intrinsics, source.width, source.height).map_err(place)?;
    source.cam_from_world = pose::checked(source.cam_from_world).map_err(place)?;
    if frame.time.is_nan() || frame.time.abs() > pose::LATEST {
        let what = format!("invalid time {} s", pose::short(frame.time));
        return Err(place(Error::input(what).remedy("Give its time in seconds from the start of the clip.")));
    }
    if source.width < options.downscale || source.height < options.downscale {
        let what =
            format!("nothing of a {}x{} image is left at downscale {}", source.width, source.height, options.downscale);
        return Err(place(Error::input(what).remedy("Choose a smaller downscale.")));
    }
    let files = [
        ("picture", Some(&frame.image)),
        ("mask", frame.mask.as_ref()),
        ("depth", frame.depth.as_ref().map(|d| &d.path)),
        ("flow", frame.flow.as_ref()),
        ("mask of labels", frame.labels.as_ref()),
        ("image of features", frame.features.as_ref()),
    ];
    for (what, file) in files.into_iter().filter_map(|(what, file)| Some((what, file?))) {
        if !file.is_file() {
            return Err(Error::input(format!("the {what} of camera {camera}, frame {} is missing", frame.index))
                .at(file.display())
                .remedy("Restore the file, or take the frame out of the capture."));
        }
    }
    Ok(())
}

/// Cameras without frames would be rows without meaning everywhere else. `listed` are those that had some before
/// missing images were skipped, which was reported.
fn drop_unused_cameras(take: &mut RawCapture, listed: &BTreeSet<usize>) {
    let used: BTreeSet<usize> = take.frames.iter().map(|f| f.camera).collect();
    let unused: Vec<&str> =
        take.cameras.iter().enumerate().filter(|(i, _)| !listed.contains(i)).map(|(_, n)| n.as_str()).collect();
    if !unused.is_empty() {
        take.warnings.push(format!("Cameras without any frame are left out: {}.", unused.join(", ")));
    }
    let renumbered: BTreeMap<usize, usize> = used.iter().enumerate().map(|(new, &old)| (old, new)).collect();
    take.frames.iter_mut().for_each(|f| f.camera = renumbered[&f.camera]);
    take.cameras = used.iter().map(|&i| std::mem::take(&mut take.cameras[i])).collect();
}

/// Which cameras keep one pose.
fn rigs(take: &RawCapture) -> Vec<Rig> {
    let mut first: Vec<Option<&RawFrame>> = vec![None; take.cameras.len()];
    let mut fixed = vec![true; take.cameras.len()];
    for frame in &take.frames {
        let reference = *first[frame.camera].get_or_insert(frame);
        fixed[frame.camera] &= same_pose(&reference.source, &frame.source);
    }
    take.cameras.iter().zip(fixed).map(|(name, fixed)| Rig { name: name.clone(), fixed }).collect()
}

/// Two fixed cameras with one pose are a mistake, such as a copied matrix. Photos may be taken twice from one place,
/// but what is measured then was learnt.
fn check_poses(take: &mut RawCapture, cameras: &[Rig]) -> Result<()> {
    let mut first: BTreeMap<usize, &RawFrame> = BTreeMap::new();
    for frame in take.frames.iter().filter(|f| cameras[f.camera].fixed) {
        first.entry(frame.camera).or_insert(frame);
    }
    let photos = take.timing == Timing::Moment && !take.named;
    let mut shared = 0;
    // Sorting by one coordinate leaves only neighbours to compare, so that huge rigs stay cheap.
    let mut sorted: Vec<&RawFrame> = first.into_values().collect();
    sorted.sort_by(|a, b| a.source.cam_from_world.translation[0].total_cmp(&b.source.cam_from_world.translation[0]));
    for (i, a) in sorted.iter().enumerate() {
        let x = a.source.cam_from_world.translation[0];
        let reach = 2.0 * SAME_POSE * (1.0 + norm(a.source.cam_from_world.translation));
        for b in sorted[i + 1..].iter().take_while(|b| b.source.cam_from_world.translation[0] - x <= reach) {
            if !same_pose(&a.source, &b.source) {
                continue;
            }
            if photos {
                shared += usize::from(a.split != b.split);
                continue;
            }
            let (a, b) = (a.camera.min(b.camera), a.camera.max(b.camera));
            let what = format!("cameras {} and {} have the same pose", cameras[a].name, cameras[b].name);
            return Err(Error::input(what).at(take.root.display()).remedy(
                "A matrix was probably copied from one to the other: correct it, or remove one of the cameras.",
            ));
        }
    }
    warn_of_shared(shared, &mut take.warnings);
    Ok(())
}

/// Images used for both training and evaluation are reported, not refused: published data sets do it.
fn warn_of_shared(shared: usize, warnings: &mut Vec<String>) {
    if shared > 0 {
        warnings.push(format!(
            "{shared} frames of the training, validation and test sets agree in camera and time: scores on them do not measure new views."
        ));
    }
}

/// One camera takes one image at a time. Where the data set names none, one "camera" may represent several, so that the
/// pose counts too.
fn check_duplicates(take: &mut RawCapture, cameras: &[Rig]) -> Result<()> {
    let mut groups: BTreeMap<(usize, u64), Vec<usize>> = BTreeMap::new();
    let mut shared = 0;
    for (i, frame) in take.frames.iter().enumerate() {
        // Adding 0.0 makes −0 and 0 one time.
        let earlier = groups.entry((frame.camera, (frame.time + 0.0).to_bits())).or_default();
        for &j in earlier.iter() {
            let other = &take.frames[j];
            if !take.named && !cameras[frame.camera].fixed && !same_pose(&other.source, &frame.source) {
                continue;
            }
            if other.split != frame.split {
                shared += 1;
                continue;
            }
            let what = format!(
                "camera {} has two images at {} s: {} and {}",
                cameras[frame.camera].name,
                frame.time,
                other.image.display(),
                frame.image.display()
            );
            return Err(Error::input(what).remedy("Remove one, or correct its time or frame number."));
        }
        earlier.push(i);
    }
    warn_of_shared(shared, &mut take.warnings);
    Ok(())
}

/// Takes out the frames whose image is missing. Errors: too many are.
fn skip_missing(take: &mut RawCapture, options: &CaptureOptions) -> Result<()> {
    let there: Vec<bool> = take.frames.iter().map(|f| f.image.is_file()).collect();
    let all = there.len();
    let shown = |f: &RawFrame| f.image.strip_prefix(&take.root).unwrap_or(&f.image).display().to_string();
    let missing: Vec<String> = take.frames.iter().zip(&there).filter(|(_, t)| !**t).map(|(f, _)| shown(f)).collect();
    let share = missing.len() as f64 / all as f64;
    if missing.is_empty() {
        return Ok(());
    }
    let mut what = format!("{} of {all} images are missing: {}", missing.len(), first_names(&missing));
    let gone = take.frames.iter().zip(&there).find(|(_, t)| !**t).map(|(f, _)| &f.image);
    let other = gone.and_then(|image| lookup::unreadable(image));
    if let Some(other) = &other {
        what += &format!("; {} is there instead", other.display());
    }
    if let (Some(other), true) = (other, share > options.max_missing) {
        let name = other.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let png = format!("{}.png", lookup::without_ending(&name));
        return Err(Error::input(what).remedy(format!(
            "Its format is not read: convert the images to PNG or JPEG under the same names (ffmpeg -i {name} {png})."
        )));
    }
    if missing.len() == all {
        let broken = |p: &&Path| p.is_symlink() && !p.exists();
        if let Some(link) = gone.and_then(|image| image.ancestors().find(broken)) {
            let target = std::fs::read_link(link).unwrap_or_default();
            what += &format!("; {} is a link to {}, which is not there", link.display(), target.display());
        }
        return Err(Error::input(what).remedy("Put them there, or name the folder of the images with --images NAME."));
    }
    if share > options.max_missing {
        let allowed = (100.0 * share).ceil() / 100.0;
        return Err(Error::input(what)
            .remedy(format!("Restore them, or train without them: --set capture.max_missing={allowed}.")));
    }
    take.account.add(Aspect::NotFound, Severity::Warning, format!("{what}. They are skipped."));
    let mut there = there.into_iter();
    take.frames.retain(|_| there.next().unwrap_or(true));
    Ok(())
}

/// Removes frames that are listed twice: with one image, pose, time and purpose.
fn skip_repeated(take: &mut RawCapture) {
    let mut earlier: BTreeMap<&Path, Vec<usize>> = BTreeMap::new();
    let mut repeated = BTreeSet::new();
    for (i, frame) in take.frames.iter().enumerate() {
        let same = |&j: &usize| {
            let other = &take.frames[j];
            other.split == frame.split && other.time == frame.time && same_pose(&other.source, &frame.source)
        };
        let others = earlier.entry(&frame.image).or_default();
        if others.iter().any(same) {
            repeated.insert(i);
        } else {
            others.push(i);
        }
    }
    if repeated.is_empty() {
        return;
    }
    let names: Vec<String> = repeated.iter().map(|&i| take.frames[i].image.display().to_string()).collect();
    let what = format!(
        "{} of {} frames are listed twice, with one image, pose and time: {}. They are read once.",
        names.len(),
        take.frames.len(),
        first_names(&names)
    );
    take.account.add(Aspect::Assumed, Severity::Warning, what);
    let mut kept = (0..take.frames.len()).map(|i| !repeated.contains(&i));
    take.frames.retain(|_| kept.next().unwrap_or(true));
}

/// Reports frames with one image and different poses, of which one must be wrong.
fn shared_images(take: &mut RawCapture) {
    let mut first: BTreeMap<&Path, usize> = BTreeMap::new();
    let mut twice = Vec::new();
    for (i, frame) in take.frames.iter().enumerate() {
        match first.entry(&frame.image) {
            Entry::Vacant(slot) => drop(slot.insert(i)),
            Entry::Occupied(slot) => {
                if !same_pose(&take.frames[*slot.get()].source, &frame.source) {
                    twice.push((*slot.get(), i));
                }
            }
        }
    }
    let Some((a, b)) = twice.first() else { return };
    let name = |i: usize| {
        let frame = &take.frames[i];
        format!("camera {}, frame {}", take.cameras[frame.camera], frame.index)
    };
    let what = format!(
        "{} frames have the image of another frame, but another pose: {} and {} both have {}.",
        twice.len(),
        name(*a),
        name(*b),
        take.frames[*a].image.display()
    );
    take.account.add(Aspect::Assumed, Severity::Warning, what);
}

/// Whether an image of `size` is, or was resized to, what a camera describes.
fn fits(size: (usize, usize), camera: &Camera) -> bool {
    size == (camera.width, camera.height) || picture::is_resized(size, camera)
}

/// Compares the sizes of the images with their intrinsics, and scales those where images were resized; returns whether
/// any image has an alpha channel, for each whether its EXIF orientation is applied, and those of which sizes do not
/// specify it.
fn fit_pictures(take: &mut RawCapture, options: &CaptureOptions) -> Result<(bool, Vec<bool>, Vec<usize>)> {
    let mut alpha = false;
    let mut resized = Vec::new();
    let mut upright = Vec::with_capacity(take.frames.len());
    // Turned images whose sizes specify which pixels are described, and those whose sizes do not.
    let (mut by_size, mut unsure) = ([0; 2], Vec::new());
    // COLMAP reads pixels as stored, and so do the scripts that write these layouts.
    let of_colmap = matches!(take.kind, CaptureKind::Colmap | CaptureKind::N3dv | CaptureKind::Llff);
    let mut as_stored = 0;
    for frame in &mut take.frames {
        let header = picture::header(&frame.image)?;
        picture::check_end(&frame.image)?;
        alpha |= header.alpha;
        let whole = panorama::stored(&frame.source);
        let turn = match options.exif {
            _ if !header.is_turned() => true,
            Exif::Stored => false,
            Exif::Upright => true,
            Exif::Auto if of_colmap => {
                as_stored += 1;
                false
            }
            Exif::Auto => {
                let (as_stored, turned) = (fits(header.stored, &whole), fits(header.upright(), &whole));
                match (as_stored, turned) {
                    (true, true) => unsure.push(upright.len()),
                    (true, false) => by_size[0] += 1,
                    _ => by_size[1] += 1,
                }
                turned || !as_stored
            }
        };
        upright.push(turn);
        let size = if turn { header.upright() } else { header.stored };
        let source = &mut frame.source;
        let stated = (whole.width, whole.height);
        if size != stated && panorama::resize(source, size) {
            resized.push((&frame.image, size, stated));
        } else if size != stated && picture::is_resized(size, source) {
            let (x, y) = (size.0 as f64 / stated.0 as f64, size.1 as f64 / stated.1 as f64);
            let k = &mut source.intrinsics;
            (k.fx, k.cx, k.fy, k.cy) = (k.fx * x, k.cx * x, k.fy * y, k.cy * y);
            (source.width, source.height) = size;
            resized.push((&frame.image, size, stated));
        }
        picture::check_size(&frame.image, size, &panorama::stored(source))
            .map_err(|e| e.at(format!("camera {}", take.cameras[frame.camera])))?;
    }
    if let Some((image, size, stated)) = resized.first() {
        let what = format!(
            "{} images are of another size than their intrinsics are for, which are scaled to them: {} is {}x{}, not \
             {}x{}.",
            resized.len(),
            image.display(),
            size.0,
            size.1,
            stated.0,
            stated.1
        );
        // Reduced copies are meant to be smaller, and so are images that are all reduced alike: were they others, points and
        // matches would not fit.
        let ratio = size.0 as f64 / stated.0 as f64;
        let alike = |own: (usize, usize), stated: (usize, usize)| {
            [(own.0, stated.0), (own.1, stated.1)].iter().all(|&(n, of)| (n as f64 - ratio * of as f64).abs() <= 1.0)
        };
        let all_alike = resized.len() == upright.len() && resized.iter().all(|&(_, own, of)| alike(own, of));
        let reduced = || resized.iter().all(|(image, ..)| image.ancestors().any(lookup::is_reduced));
        let meant = all_alike || options.images.is_some() || reduced();
        take.account.add(Aspect::Assumed, if meant { Severity::Note } else { Severity::Warning }, what);
    }
    report_orientation(take, as_stored, by_size);
    plausible::check(take);
    Ok((alpha, upright, unsure))
}

/// Reports how EXIF orientations were applied to COLMAP's images, and to those whose sizes decide.
fn report_orientation(take: &mut RawCapture, as_stored: usize, by_size: [usize; 2]) {
    let all = take.frames.len();
    let mut say = |n: usize, what: &str| {
        if n > 0 {
            let what = format!("{n} of {all} images have an EXIF orientation. {what}");
            take.account.add(Aspect::Assumed, Severity::Note, what);
        }
    };
    say(
        as_stored,
        "It is not applied: COLMAP's poses describe the pixels as stored. Otherwise use --set capture.exif=upright.",
    );
    say(by_size[0], "It is not applied: only the pixels as stored have the size of their intrinsics.");
    say(by_size[1], "It is applied: only the upright images have the size of their intrinsics.");
}

/// Decides by points and features whether EXIF orientations are applied where sizes do not specify it, and states it.
fn settle_orientation(capture: &mut Capture, unsure: &[usize]) {
    if unsure.is_empty() {
        return;
    }
    let upright = evidence::upright(capture, unsure);
    let (severity, what) = match upright {
        Some(true) => (Severity::Note, "It is applied: points and features agree with the upright images."),
        Some(false) => (Severity::Note, "It is not applied: points and features agree with the pixels as stored."),
        None => (
            Severity::Warning,
            "It is applied; neither sizes nor points nor features show whether poses describe the upright images or the pixels as stored. If results are bad, use --set capture.exif=stored.",
        ),
    };
    let what = format!("{} of {} images have an EXIF orientation. {what}", unsure.len(), capture.frames.len());
    unsure.iter().for_each(|&i| capture.frames[i].upright = upright.unwrap_or(true));
    capture.account.push(Remark { aspect: Aspect::Assumed, severity, what });
}

/// An error if masks exist and not one of them shows anything; stops at the first that does.
fn check_masks(take: &RawCapture, has_alpha: bool) -> Result<()> {
    check_mask_shapes(take)?;
    let masked: Vec<&RawFrame> = take.frames.iter().filter(|f| f.mask.is_some() || has_alpha).collect();
    let Some(first) = masked.first() else { return Ok(()) };
    for frame in &masked {
        if let Some(mask) = &frame.mask {
            // Its size is compared before its pixels are read: a small file may claim gigabytes of them.
            let header = picture::header(mask)?;
            let size = header.upright();
            let sane = picture::check_not_larger("mask", size, &frame.source);
            sane.map_err(|e| e.at(mask.display()))?;
        }
        match picture::any_foreground(frame.mask.as_deref().unwrap_or(&frame.image), frame.mask.is_none()) {
            Ok(true) => return Ok(()),
            Ok(false) => {}
            // A broken image has its own, more detailed error when it is loaded.
            Err(_) if frame.mask.is_none() => return Ok(()),
            Err(e) => return Err(e),
        }
    }
    let place = first.mask.as_ref().unwrap_or(&first.image);
    Err(Error::input("the masks exclude everything: no image has a foreground pixel")
        .at(place.display())
        .remedy("Masks are white where the image counts: invert them, or leave them out of the capture."))
}

/// Masks whose shape is compared with that of their image's before training loads all.
const SHAPES: usize = 50;

/// An error if a mask has another shape than its image.
fn check_mask_shapes(take: &RawCapture) -> Result<()> {
    let masked: Vec<(&RawFrame, &PathBuf)> = take.frames.iter().filter_map(|f| Some((f, f.mask.as_ref()?))).collect();
    for (frame, mask) in masked.iter().step_by(masked.len().div_ceil(SHAPES).max(1)) {
        let own = panorama::stored(&frame.source);
        let header = picture::header(mask)?;
        if ![header.stored, header.upright()].iter().any(|&size| fits(size, &own)) {
            picture::check_not_larger("mask", header.upright(), &own).map_err(|e| e.at(mask.display()))?;
            picture::check_companion(mask, "mask", header.stored, &own)?;
        }
    }
    Ok(())
}

type Indices = Vec<usize>;

/// The training, held-out and validation frames.
fn split(take: &mut RawCapture, cameras: &[Rig], options: &CaptureOptions) -> Result<(Indices, Indices, Indices)> {
    let stated = options.hold_out.clone().or_else(|| take.hold_out.clone());
    let of = |split: Split| -> Indices { (0..take.frames.len()).filter(|&i| take.frames[i].split == split).collect() };
    let validation = of(Split::Validation);
    let by_convention = of(Split::Held);
    let rule = match stated {
        Some(rule) => rule,
        None if !by_convention.is_empty() => {
            let train = of(Split::Train);
            return non_empty(train, by_convention, validation);
        }
        // Photos of one time are no rig: one of them is too few to measure on.
        None if take.timing == Timing::Moment && !take.named => HoldOut::Every(HOLD_EVERY),
        None if cameras.len() >= 2 && cameras.iter().all(|c| c.fixed) => {
            HoldOut::Cameras(vec![cameras[0].name.clone()])
        }
        None => HoldOut::Every(HOLD_EVERY),
    };
    let pool: Indices = (0..take.frames.len()).filter(|&i| take.frames[i].split != Split::Validation).collect();
    let held: Vec<bool> = match &rule {
        HoldOut::None => vec![false; pool.len()],
        HoldOut::Every(n) => (0..pool.len()).map(|i| pool.len() > 1 && i % n == 0).collect(),
        HoldOut::Cameras(names) => {
            let chosen: Vec<usize> = names.iter().map(|n| find_camera(n, cameras)).collect::<Result<_>>()?;
            pool.iter().map(|&i| chosen.contains(&take.frames[i].camera)).collect()
        }
    };
    let pick = |want: bool| pool.iter().zip(&held).filter(|&(_, &h)| h == want).map(|(&i, _)| i).collect();
    non_empty(pick(false), pick(true), validation)
}

fn non_empty(train: Indices, held: Indices, validation: Indices) -> Result<(Indices, Indices, Indices)> {
    if train.is_empty() {
        return Err(Error::input("every frame is held out, none is left to train on")
            .remedy("Hold out fewer cameras, or none (--hold-out none)."));
    }
    Ok((train, held, validation))
}

fn find_camera(name: &str, cameras: &[Rig]) -> Result<usize> {
    let by_name = cameras.iter().position(|c| c.name == name);
    let by_number = || name.parse::<usize>().ok().filter(|&i| i < cameras.len());
    by_name.or_else(by_number).ok_or_else(|| {
        let names: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).take(40).collect();
        Error::input(format!("the held-out camera {name} does not exist"))
            .remedy(format!("The capture's cameras are: {}.", names.join(", ")))
    })
}

/// People hold cameras upright: minus the mean of the images' y axes.
fn estimate_up(frames: &[RawFrame]) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for frame in frames {
        (0..3).for_each(|k| sum[k] -= frame.source.cam_from_world.rotation[1][k]);
    }
    // Cameras all round a scene that point straight down cancel out; then any axis will do.
    if norm(sum) > 1e-3 * frames.len() as f64 { normalize(sum) } else { [0.0, 0.0, 1.0] }
}
