//! A tiny capture that arrives frame by frame.

use super::arrival::END_MARKER;
use super::history::still;
use super::record::NEW;
use super::*;
use crate::run::tests::{Place, recipe};
use crate::step::tests::Made;
use splat4d::format::playback::Primitive;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::params::OPACITY;
use splat4d::scene::{GEOMETRY, Params};

/// A capture of which frames are copied as they are recorded.
struct Recorded {
    whole: Place,
    folder: tempfile::TempDir,
    recipe: Recipe,
}

impl Recorded {
    fn new(changes: &[&str]) -> Self {
        Self::of(Place::new(), changes)
    }

    fn of(whole: Place, changes: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::copy(whole.source().join("capture.json"), folder.path().join("capture.json")).unwrap();
        let short = ["follow.first_steps=30", "follow.frame_steps=8", "follow.changed=0.001", "follow.share=0.05"];
        let recipe = recipe(&[&short[..], changes].concat());
        Self { whole, folder, recipe }
    }

    /// The image of a frame in the folder that grows.
    fn image(&self, camera: usize, frame: usize) -> PathBuf {
        self.folder.path().join(format!("images/{camera}/{frame:04}.png"))
    }

    /// Copies a frame's images of some cameras, which are old when they are looked at.
    fn record(&self, frame: usize, cameras: Range<usize>) {
        for camera in cameras {
            let to = self.image(camera, frame);
            std::fs::create_dir_all(to.parent().unwrap()).unwrap();
            std::fs::copy(self.whole.source().join(format!("images/{camera}/{frame:04}.png")), &to).unwrap();
        }
    }

    fn begin(&self, run: &str) -> Following {
        Following::begin(self.folder.path(), &self.recipe, &self.whole.run(run), Device::Cpu).unwrap()
    }

    /// Looks until a frame is there, as a new file needs a second look.
    fn arrives(following: &mut Following, frame: usize) -> Arrival {
        following.look(frame).unwrap();
        following.look(frame).unwrap()
    }
}

fn fit(following: &mut Following) -> FollowedFrame {
    following.fit(&AtomicBool::new(false), &mut |_| {}).unwrap().expect("nothing stops it")
}

/// A row at x, opaque.
fn at(xs: &[f32]) -> Params<f32> {
    let mut params = Params::new(xs.len(), 1, &[]);
    for (row, &x) in xs.iter().enumerate() {
        params[GEOMETRY].write(row, 0, [x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -2.0, -2.0, -2.0, 3.0]);
    }
    params
}

fn replaced(frame: usize, active: &[u32], xs: &[f32], origin: &[u32]) -> Record {
    Record { frame, active: active.to_vec(), params: at(xs), origin: origin.to_vec(), ..Record::default() }
}

/// The x of everything that the nodes show at a time, rising.
fn shown(nodes: &[Node], t: f64) -> Vec<f64> {
    let x = |p: &Primitive| p.mean[0] + f64::from(p.velocity[0]) * (t - p.center);
    let mut all: Vec<f64> =
        nodes.iter().filter(|n| n.from <= t && t < n.to).flat_map(|n| n.primitives.iter().map(x)).collect();
    all.sort_by(f64::total_cmp);
    all
}

#[test]
fn unchanged_gaussians_are_written_once_and_others_move_from_frame_to_frame() {
    // Row 1 moves in frame 2 and again in frame 3, where it also has a copy; row 2 vanishes in frame 4.
    let mut history = History::new(at(&[0.0, 10.0, 20.0]), 0);
    history.apply(&replaced(1, &[], &[], &[]));
    history.apply(&replaced(2, &[1], &[11.0], &[0]));
    // Rows are now those at 0, 20 and 11.
    history.apply(&replaced(3, &[2], &[12.0, 13.0], &[0, 0]));
    history.apply(&replaced(4, &[1], &[], &[]));
    history.apply(&replaced(5, &[], &[30.0], &[NEW]));
    let nodes = history.nodes(0..8, &|frame| frame as f64);
    let close = |t: f64, expected: &[f64]| {
        let got = shown(&nodes, t);
        assert!(
            got.len() == expected.len() && got.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5),
            "{t}: {got:?}"
        );
    };
    close(0.0, &[0.0, 10.0, 20.0]);
    close(1.0, &[0.0, 10.0, 20.0]);
    close(1.5, &[0.0, 10.5, 20.0]);
    close(2.0, &[0.0, 11.0, 20.0]);
    close(2.25, &[0.0, 11.25, 20.0]);
    close(3.0, &[0.0, 12.0, 13.0, 20.0]);
    close(4.0, &[0.0, 12.0, 13.0]);
    close(6.9, &[0.0, 12.0, 13.0, 30.0]);
    let still = nodes.iter().flat_map(|n| &n.primitives).filter(|p| p.mean[0].abs() < 1e-6).count();
    assert_eq!(still, 1, "a Gaussian that never changes is one primitive of the whole span");
    assert!(nodes.iter().all(|n| n.primitives.iter().all(|p| p.half_width.is_infinite())));
    // Frames in parts show the same.
    let parts: Vec<Node> = [0..1, 1..4, 4..8].into_iter().flat_map(|part| history.nodes(part, &|f| f as f64)).collect();
    for t in [0.0, 1.5, 2.25, 3.0, 4.0, 7.5] {
        assert_eq!(shown(&parts, t), shown(&nodes, t), "{t}");
    }
    history.forget(4);
    assert_eq!(shown(&history.nodes(4..8, &|f| f as f64), 5.0), [0.0, 12.0, 13.0, 30.0]);
    assert_eq!(still_layer_rows(&history), 4);
}

fn still_layer_rows(history: &History) -> usize {
    let layer = still(history.layer.params.clone());
    assert_eq!(layer.params[GEOMETRY].get(0, OPACITY), 3.0);
    layer.params.len()
}

#[test]
fn motion_is_repeated_only_by_gaussians_that_moved_last() {
    let mut history = History::new(at(&[0.0, 10.0]), 0);
    history.apply(&replaced(1, &[1], &[11.0], &[0]));
    assert_eq!(history.extrapolated(1, 5.0).unwrap()[0], 12.0);
    assert_eq!(history.extrapolated(1, 0.5).unwrap()[0], 11.5, "no faster than the cap");
    assert!(history.extrapolated(0, 5.0).is_none());
    history.apply(&replaced(2, &[], &[], &[]));
    assert!(history.extrapolated(1, 5.0).is_none(), "it has come to rest");
}

#[test]
fn turning_gaussians_have_the_rotations_of_both_frames() {
    let mut history = History::new(at(&[0.0]), 0);
    let mut next = replaced(1, &[0], &[0.0], &[0]);
    let half = 0.4f32;
    next.params[GEOMETRY].write(0, 3, [half.cos(), 0.0, 0.0, half.sin()]);
    history.apply(&next);
    let nodes = history.nodes(0..2, &|f| 0.1 * f as f64);
    let p = &nodes.iter().find(|n| n.from == 0.0 && n.primitives[0].turn[2] != 0.0).unwrap().primitives[0];
    for (t, angle) in [(0.0, 0.0), (0.1, f64::from(half))] {
        // docs/format.md: q + ½Δ(0, ω)⊗q, normalised.
        let (q, by) = (p.quat.map(f64::from), 0.5 * (t - p.center) * f64::from(p.turn[2]));
        let turned = splat4d::math::quat::normalize([q[0] - by * q[3], 0.0, 0.0, q[3] + by * q[0]]).0;
        assert!((turned[3].atan2(turned[0]) - angle).abs() < 1e-6, "{t}: {turned:?}");
    }
}

#[test]
fn files_of_frames_are_read_as_written_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let record =
        Record { errors: vec![0.5, 0.25], facts: json!({"fps": 10.0}), ..replaced(3, &[4, 7], &[1.0, 2.0], &[1, NEW]) };
    record.write(folder.path()).unwrap();
    assert_eq!(record::list(folder.path()), [3]);
    assert_eq!(Record::read(folder.path(), 3).unwrap(), record);
    let bytes = record.bytes().unwrap();
    assert!(Record::parse(&bytes, 4).unwrap_err().to_string().contains("another frame"));
    let wrong = Record { origin: vec![2, 0], ..record };
    assert!(Record::parse(&wrong.bytes().unwrap(), 3).unwrap_err().to_string().contains("do not fit"));
    assert!(Record::parse(&bytes[..bytes.len() / 2], 3).is_err());
}

#[test]
fn a_frame_arrives_when_all_its_images_are_complete() {
    let capture = Recorded::new(&[]);
    let mut following = capture.begin("run");
    let what = |arrival: Arrival| match arrival {
        Arrival::Incomplete { what, .. } => what,
        other => panic!("{other:?}"),
    };
    assert!(what(following.look(0).unwrap()).contains("cam0"));
    capture.record(0, 0..3);
    assert!(what(Recorded::arrives(&mut following, 0)).contains("cam3"));
    capture.record(0, 3..4);
    // Cut short, as while it is written.
    let path = capture.image(3, 0);
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    assert!(what(Recorded::arrives(&mut following, 0)).contains("is not a complete image"));
    std::fs::write(&path, &whole).unwrap();
    assert_eq!(Recorded::arrives(&mut following, 0), Arrival::Complete);
    // Another size is refused at once.
    capture.record(1, 0..4);
    image::RgbImage::new(8, 8).save(capture.image(2, 1)).unwrap();
    following.look(1).unwrap();
    let error = following.look(1).unwrap_err().to_string();
    assert!(error.contains("8x8") && error.contains("24x24"), "{error}");
    capture.record(1, 0..4);
    assert_eq!(Recorded::arrives(&mut following, 1), Arrival::Complete);
    // The end, with and without a part of a frame.
    std::fs::write(capture.folder.path().join(END_MARKER), "").unwrap();
    assert_eq!(following.look(2).unwrap(), Arrival::Ended { left: None });
    capture.record(2, 0..1);
    assert!(matches!(following.look(2).unwrap(), Arrival::Ended { left: Some(_) }));
    // A stated number of frames that shrinks.
    let file = capture.folder.path().join("capture.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replacen('{', r#"{"frames": 1, "#, 1)).unwrap();
    assert_eq!(following.look(1).unwrap(), Arrival::Ended { left: None });
    assert!(matches!(following.look(2).unwrap(), Arrival::Ended { left: Some(_) }));
    std::fs::write(&file, &text[..text.len() / 2]).unwrap();
    assert!(what(following.look(1).unwrap()).contains("JSON"), "it may be replaced at this moment");
}

#[test]
fn frames_are_learnt_as_they_arrive_and_a_stopped_run_continues_bit_for_bit() {
    let capture = Recorded::new(&[]);
    let (mut once, mut again) = (capture.begin("once"), capture.begin("again"));
    let mut seen = Vec::new();
    for frame in 0..3 {
        capture.record(frame, 0..4);
        seen.push(fit(&mut once));
        // A stop leaves no frame behind.
        assert!(again.fit(&AtomicBool::new(true), &mut |_| {}).unwrap().is_none());
        let other = fit(&mut again);
        assert_eq!(FollowedFrame { seconds: 0.0, ..other }, FollowedFrame { seconds: 0.0, ..seen[frame].clone() });
        again = capture.begin("again");
        assert_eq!(again.next(), frame + 1);
    }
    assert_eq!(seen.iter().map(|f| f.frame).collect::<Vec<_>>(), [0, 1, 2]);
    assert!(seen[1..].iter().all(|f| f.changed > 0 && f.psnr.is_some_and(f64::is_finite)), "{seen:?}");
    let bytes =
        |run: &str, frame: usize| std::fs::read(capture.whole.run(run).join(format!("frames/{frame:06}.safetensors")));
    for frame in 0..3 {
        assert_eq!(bytes("once", frame).unwrap(), bytes("again", frame).unwrap(), "{frame}");
    }
    let nodes = again.nodes(0..3);
    assert_eq!((nodes, again.seconds(1)), (once.nodes(0..3), 0.1));
    again.write_info(1.0, true).unwrap();
    let (recipe, opened) = crate::run::open_run(&capture.whole.run("again")).unwrap();
    assert_eq!((recipe.capture.max_frames, opened.train.len()), (3, 9));
    assert_eq!(Following::request(&capture.whole.run("again")).unwrap().1, capture.recipe);
}

/// A ball of one colour that is not there in the first frame: the frame in which it appears, its Gaussians within the ball
/// by all new ones, and how many the scene has in the end. `empty`: no Gaussian is in the images before it.
fn ball_appears(empty: bool) -> (Record, [usize; 2], usize) {
    const BACKGROUND: image::Rgb<u8> = image::Rgb([60, 70, 140]);
    let capture = Recorded::of(Place::filmed(6, &[1, 1, 1]), &[]);
    for (camera, frame) in (0..6).flat_map(|camera| (0..3).map(move |frame| (camera, frame))) {
        let path = capture.whole.source().join(format!("images/{camera}/{frame:04}.png"));
        let mut image = image::open(&path).unwrap().to_rgb8();
        for y in 0..image.height() {
            let background = *image.get_pixel(0, y);
            for x in 0..image.width() {
                let pixel = image.get_pixel_mut(x, y);
                let ball = *pixel != background && pixel.0[2] < 100;
                *pixel = match (ball && frame > 0, empty) {
                    (true, _) => image::Rgb([255, 150, 20]),
                    (false, true) => BACKGROUND,
                    (false, false) => background,
                };
            }
        }
        image.save(&path).unwrap();
    }
    let mut following = capture.begin("run");
    let mut known = 0;
    for frame in 0..3 {
        capture.record(frame, 0..6);
        known = fit(&mut following).gaussians;
        if let Some(state) = following.state.as_mut().filter(|_| empty && frame == 0) {
            state.history = History::new(at(&[]), 0);
            state.errors.fill(0.0);
        }
    }
    let record = Record::read(&capture.whole.run("run").join(FOLDER), 1).unwrap();
    let rows = record.origin.iter().enumerate().filter(|(_, o)| **o == NEW).map(|(row, _)| row);
    let points: Vec<[f32; 3]> = rows.map(|row| record.params[GEOMETRY].read::<3>(row, 0)).collect();
    let made = Made::new(6, 3, 8);
    let center = made.object_at(made.time_of(1));
    let near = points.iter().filter(|x| norm(sub(x.map(f64::from), center)) < 1.6 * Made::RADIUS).count();
    let of = [near, points.len()];
    (record, of, known)
}

#[test]
fn what_appears_gets_gaussians_where_it_is() {
    let (_, [near, all], known) = ball_appears(false);
    // The hull of five cameras at 24x24 pixels is a little larger than the ball.
    assert!(near >= 30 && 10 * near >= 6 * all, "{near} of {all} are where it appeared");
    assert!(4 * known <= 5 * 130, "{known}: up to a quarter more than densify.max_cap");
}

#[test]
fn what_appears_gets_gaussians_although_none_is_active() {
    let (record, [near, all], _) = ball_appears(true);
    assert!(record.active.is_empty(), "{:?}", record.active);
    assert!(near >= 30 && 10 * near >= 6 * all, "{near} of {all} are where it appeared");
}

#[test]
fn a_run_needs_the_images_of_the_frames_that_it_took_alone() {
    let capture = Recorded::new(&[]);
    let file = capture.folder.path().join("capture.json");
    let text = std::fs::read_to_string(&file).unwrap();
    let mut following = capture.begin("run");
    capture.record(0, 0..4);
    fit(&mut following);
    // A camera misses a frame; the recording ends before the last one is complete.
    capture.record(1, 0..3);
    following.skip();
    capture.record(2, 0..4);
    fit(&mut following);
    std::fs::copy(capture.image(0, 2), capture.image(0, 3)).unwrap();
    following.write_info(1.0, true).unwrap();
    let run = capture.whole.run("run");
    let opened = || crate::run::open_run(&run);
    let listed = text.replace("images/2/%04d.png\"", "images/2/%04d.png\", \"frames\": 3");
    for text in [text.clone(), text.replacen('{', r#"{"frames": 1000, "#, 1), listed] {
        std::fs::write(&file, text).unwrap();
        let read = opened().unwrap().1;
        assert_eq!(read.times(), [0.0, 0.2]);
        assert_eq!((read.train.len(), read.held.len(), read.account), (6, 2, Vec::new()));
    }
    // Images of frames that it took are missed: one is reported, many are an error.
    std::fs::remove_file(capture.image(1, 2)).unwrap();
    let reported = opened().unwrap().1.account;
    assert!(reported.iter().any(|r| r.what.contains("1 of 8 images are missing: images/1/0002.png")), "{reported:?}");
    std::fs::remove_file(capture.image(2, 2)).unwrap();
    let error = opened().unwrap_err().to_string();
    assert!(error.contains("2 of 8 images are missing: images/1/0002.png, images/2/0002.png"), "{error}");
}

#[test]
fn static_frames_change_next_to_nothing() {
    // Nothing exceeds such an error.
    let capture = Recorded::new(&["follow.changed=2"]);
    let mut following = capture.begin("run");
    for frame in 0..2 {
        capture.record(frame, 0..4);
        fit(&mut following);
    }
    let nodes = following.nodes(0..2);
    assert_eq!((nodes.len(), nodes[0].from, nodes[0].to), (1, 0.0, 0.2), "one node of both frames");
    let frame = |n: usize| {
        std::fs::metadata(capture.whole.run("run").join(format!("frames/{n:06}.safetensors"))).unwrap().len()
    };
    assert!(frame(1) < frame(0) / 4, "{} of {}", frame(1), frame(0));
}

#[test]
fn what_cannot_be_followed_is_refused() {
    let capture = Recorded::new(&[]);
    let begin = |recipe: &Recipe, run: &str| {
        let begun = Following::begin(capture.folder.path(), recipe, &capture.whole.run(run), Device::Cpu);
        begun.err().map_or_else(String::new, |e| e.to_string())
    };
    let with = |change: &str| {
        let mut recipe = capture.recipe.clone();
        recipe.set(change).unwrap();
        recipe
    };
    assert!(begin(&with("motion=hexplane"), "a").contains("hexplane"));
    assert!(begin(&with("refine.poses=true"), "a").contains("refined"));
    assert_eq!(begin(&capture.recipe, "a"), "");
    assert!(begin(&with("seed=4"), "a").contains("another recipe"));
    let empty = tempfile::tempdir().unwrap();
    let error = Following::begin(empty.path(), &capture.recipe, &capture.whole.run("b"), Device::Cpu).err().unwrap();
    assert!(error.to_string().contains("capture.json"), "{error}");
    // Cameras that change.
    capture.record(0, 0..4);
    let mut following = capture.begin("c");
    fit(&mut following);
    capture.record(1, 0..4);
    let file = capture.folder.path().join("capture.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replace("\"cx\":12.0", "\"cx\":11.0")).unwrap();
    let error = following.fit(&AtomicBool::new(false), &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("cameras are not those"), "{error}");
    std::fs::write(&file, text).unwrap();
    fit(&mut following);
    // A file of a frame that is missing.
    std::fs::remove_file(capture.whole.run("c").join("frames/000000.safetensors")).unwrap();
    let begun = Following::begin(capture.folder.path(), &capture.recipe, &capture.whole.run("c"), Device::Cpu);
    assert!(begun.err().unwrap().to_string().contains("missing"));
}
