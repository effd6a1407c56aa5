use super::*;
use crate::paths::{Clock, Route, shots};
use crate::source::Source;
use exr::prelude::{AnyChannels, FlatSamples, ReadChannels, ReadLayers};
use std::io::Cursor;

const SIZE: [usize; 2] = [96, 72];

/// The bundled scene.
fn knight() -> Source {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    Source::open(&root.join("examples/knight.s4d")).unwrap()
}

fn frames(source: &Source, route: &Route) -> Vec<Shot> {
    let views = source.views().unwrap();
    let [from, to] = source.scene.clip;
    let clock = Clock { from, to, freeze: None, slow_motion: None, seconds: None, fps: 30.0 };
    shots(route, &clock, &views, &source.stage(&views), Some(SIZE)).unwrap()
}

fn studio<'s>(source: &Source, photo: &'s Photo, shots: &'s [Shot]) -> Studio<'s> {
    let (clip, channel) = (source.scene.clip, Channel::Color);
    let focus = Cell::new(None);
    Studio { photo, channel, shots, views: false, clip, frame: 1.0 / 30.0, range: [0.0, 1.0], exr: false, focus }
}

fn painter(source: &Source) -> Painter<'_> {
    Painter::new(&source.scene, source.scene.background, false, false)
}

fn rgb(written: Written) -> Rgb {
    match written {
        Written::Rgb(rgb) => rgb,
        Written::File(_) => panic!("a file"),
    }
}

/// PSNR of what a display shows.
fn psnr(a: &Rgb, b: &Rgb) -> f64 {
    let square = |(a, b): (&u8, &u8)| (f64::from(*a) - f64::from(*b)).powi(2);
    let mse = a.data.iter().zip(&b.data).map(square).sum::<f64>() / a.data.len() as f64;
    10.0 * (255.0 * 255.0 / mse.max(1e-9)).log10()
}

/// PSNR of the default number of samples, and of a sharp image, against many samples.
fn against_many(source: &Source, photo: &Photo, shots: &[Shot], i: usize, many: usize) -> [f64; 2] {
    let mut painter = painter(source);
    let many = Photo { samples: Some(many), ..photo.clone() };
    let mut render = |photo: &Photo| rgb(studio(source, photo, shots).write(&mut painter, i).unwrap());
    let reference = render(&many);
    [render(photo), render(&Photo::default())].map(|image| psnr(&image, &reference))
}

#[test]
fn eight_samples_blur_motion_as_64_do() {
    let source = knight();
    let photo = Photo { shutter: Some(180.0), ..Photo::default() };
    // Of the characters alone, and of a camera that circles once in six seconds; the film's first frame too.
    for (route, frame) in [(Route::Camera("cam05".into()), 12), (Route::Orbit, 60), (Route::Orbit, 0)] {
        let [blurred, sharp] = against_many(&source, &photo, &frames(&source, &route), frame, 64);
        assert!(blurred > 40.0 && sharp < blurred - 10.0, "{route:?}: {blurred:.1} dB, sharp {sharp:.1} dB");
    }
}

#[test]
fn sixteen_samples_of_a_lens_are_like_many() {
    let source = knight();
    let photo = Photo { aperture: Some(0.3), ..Photo::default() };
    let [blurred, sharp] = against_many(&source, &photo, &frames(&source, &Route::Orbit)[..1], 0, 256);
    assert!(blurred > 40.0 && sharp < blurred - 10.0, "{blurred:.1} dB, sharp {sharp:.1} dB");
}

#[test]
fn the_course_follows_the_film_and_stays_in_the_clip() {
    let (source, photo) = (knight(), Photo::default());
    let orbit = frames(&source, &Route::Orbit);
    let of_film = studio(&source, &photo, &orbit);
    let near = |a: &Shot, b: &Shot| {
        let apart = splat4d::math::se3::sub(a.camera.center(), b.camera.center());
        norm(apart) < 1e-3 && (a.time - b.time).abs() < 1e-9
    };
    let last = orbit.len() - 1;
    for i in [0, 7, last] {
        assert!(near(&of_film.at(i, 0.0), &orbit[i]), "{i}");
    }
    assert!(near(&of_film.at(7, 1.0), &orbit[8]) && near(&of_film.at(7, -1.0), &orbit[6]));
    assert!(near(&of_film.at(7, 0.5), &of_film.at(8, -0.5)));
    let [first_second, last_second] = source.scene.clip;
    assert_eq!((of_film.at(0, -0.5).time, of_film.at(last, 0.5).time), (first_second, last_second));
    // Views of their own: the camera is static, and time continues.
    let views = Studio { views: true, ..studio(&source, &photo, &orbit) };
    let later = views.at(7, 0.5);
    assert_eq!(later.camera, orbit[7].camera);
    assert!((later.time - orbit[7].time - 0.5 / 30.0).abs() < 1e-12);
}

#[test]
fn transparent_images_over_the_background_are_the_opaque_ones() {
    let source = knight();
    let all = frames(&source, &Route::Orbit);
    let opaque = rgb(studio(&source, &Photo::default(), &all).write(&mut painter(&source), 9).unwrap());
    let photo = Photo { transparent: true, ..Photo::default() };
    let Written::File(png) = studio(&source, &photo, &all).write(&mut painter(&source), 9).unwrap() else {
        panic!("no file");
    };
    let image = image::load_from_memory(&png).unwrap().to_rgba8();
    let background = source.scene.background.map(|b| 255.0 * b);
    assert!(image.pixels().any(|p| p.0[3] < 250) && image.pixels().any(|p| p.0[3] > 250));
    for (pixel, expected) in image.pixels().zip(opaque.data.chunks(3)) {
        let alpha = f32::from(pixel.0[3]) / 255.0;
        for c in 0..3 {
            let over = alpha * f32::from(pixel.0[c]) + (1.0 - alpha) * background[c];
            assert!((over - f32::from(expected[c])).abs() < 2.5, "{pixel:?} {expected:?}");
        }
    }
}

/// Planes of an OpenEXR file.
fn planes(bytes: &[u8]) -> Vec<(String, Vec<f32>)> {
    let read = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let image = read.all_attributes().non_parallel().from_buffered(Cursor::new(bytes)).unwrap();
    let channels: AnyChannels<FlatSamples> = image.layer_data.channel_data;
    channels.list.iter().map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect())).collect()
}

#[test]
fn exr_files_hold_linear_colour_depth_and_motion() {
    let source = knight();
    let all = frames(&source, &Route::Camera("cam05".into()));
    let of = |transfer: Option<Transfer>| {
        let photo = Photo { transfer, ..Photo::default() };
        let studio = Studio { exr: true, ..studio(&source, &photo, &all) };
        match studio.write(&mut painter(&source), 12).unwrap() {
            Written::File(bytes) => planes(&bytes),
            Written::Rgb(_) => panic!("no file"),
        }
    };
    let (linear, srgb) = (of(None), of(Some(Transfer::Srgb)));
    let names: Vec<&str> = linear.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["A", "B", "G", "R", "Z", "forward.u", "forward.v"]);
    let plane = |planes: &[(String, Vec<f32>)], name: &str| planes.iter().find(|p| p.0 == name).unwrap().1.clone();
    let mut painter = painter(&source).of_channel(Channel::Depth).unwrap();
    painter.draw(&all[12].camera, all[12].time);
    let (depth, alpha) = (painter.raw(), painter.image.alpha.clone());
    let (a, r, s, z) = (plane(&linear, "A"), plane(&linear, "R"), plane(&srgb, "R"), plane(&linear, "Z"));
    for p in 0..a.len() {
        assert!((a[p] - alpha.data[p]).abs() < 1e-5);
        let expected = if depth.data[p].is_finite() { depth.data[p] } else { 1e10 };
        assert!((z[p] / expected - 1.0).abs() < 1e-4, "{} {expected}", z[p]);
        if a[p] > 0.5 {
            let (light, value) = (f64::from(r[p] / a[p]), f64::from(s[p] / a[p]));
            let curve = if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
            assert!((light - curve).abs() < 1e-4, "{light} {curve}");
        }
    }
    let mut flow = self::painter(&source).of_channel(Channel::Flow).unwrap();
    flow.draw(&all[12].camera, all[12].time);
    let (raw, u, v) = (flow.raw(), plane(&linear, "forward.u"), plane(&linear, "forward.v"));
    let mut moved = 0;
    for p in (0..a.len()).filter(|&p| raw.plane(0)[p].is_finite()) {
        // Frames of the film are a little closer than those of the scene.
        let [x, y] = [raw.plane(0)[p], raw.plane(1)[p]];
        assert!((u[p] - x).abs() < 0.05 + 0.1 * x.abs() && (v[p] + y).abs() < 0.05 + 0.1 * y.abs(), "{x} {y}");
        moved += usize::from(y.abs() > 0.2);
    }
    assert!(moved > 10, "something moves up or down: {moved}");
}

#[test]
fn two_eyes_are_two_cameras() {
    let source = knight();
    let all = frames(&source, &Route::Orbit);
    let photo = Photo { stereo: Some(Stereo::SideBySide), eye_distance: Some(0.2), ..Photo::default() };
    let both = rgb(studio(&source, &photo, &all).write(&mut painter(&source), 3).unwrap());
    assert_eq!([both.width, both.height], photo.written_size(SIZE));
    let mut left = all[3].clone();
    left.camera.cam_from_world =
        Se3 { translation: [0.1, 0.0, 0.0], ..Se3::IDENTITY }.after(&left.camera.cam_from_world);
    let alone = painter(&source).picture(&left.camera, left.time, Channel::Color, [0.0, 1.0]);
    let rows = both.data.chunks(6 * SIZE[0]).zip(alone.data.chunks(3 * SIZE[0]));
    assert!(rows.clone().all(|(both, left)| both[..3 * SIZE[0]] == *left));
    assert!(rows.clone().any(|(both, left)| both[3 * SIZE[0]..] != *left));
    let over = Photo { stereo: Some(Stereo::OverUnder), ..photo };
    let over = rgb(studio(&source, &over, &all).write(&mut painter(&source), 3).unwrap());
    assert!(over.data[..alone.data.len()] == alone.data && over.height == 2 * SIZE[1]);
}

#[test]
fn focus_is_found_or_refused() {
    let source = knight();
    let all = frames(&source, &Route::Orbit);
    let focus = |focus: Option<Focus>| {
        let photo = Photo { aperture: Some(0.1), focus, ..Photo::default() };
        studio(&source, &photo, &all).focus(&mut painter(&source), &all[0])
    };
    let middle = focus(None).unwrap();
    assert!((middle / focus(Some(Focus::Pixel([48.0, 36.0]))).unwrap() - 1.0).abs() < 1e-9 && middle > 1.0);
    assert_eq!(focus(Some(Focus::Distance(2.5))).unwrap(), 2.5);
    let refused = |at: Focus| focus(Some(at)).unwrap_err().to_string();
    assert!(refused(Focus::Distance(1e-9)).contains("near plane"));
    assert!(refused(Focus::Pixel([96.0, 3.0])).contains("96x72"));
}

#[test]
fn bad_options_are_explained() {
    let refused = |photo: Photo, more: &dyn Fn(&mut RenderOptions)| {
        let mut args = RenderOptions { output: Some("a.png".into()), photo, ..RenderOptions::default() };
        more(&mut args);
        args.photo.check(&args).unwrap_err().to_string()
    };
    let plain = |photo: Photo| refused(photo, &|_| ());
    for shutter in [0.0, -5.0, 720.0] {
        assert!(plain(Photo { shutter: Some(shutter), ..Photo::default() }).contains("up to 360"), "{shutter}");
    }
    let lens = |focus: f64| Photo { aperture: Some(0.1), focus: Some(Focus::Distance(focus)), ..Photo::default() };
    assert!(plain(lens(-1.0)).contains("in front of the camera") && plain(lens(0.0)).contains("option `focus`"));
    assert!(plain(Photo { focus: Some(Focus::Distance(1.0)), ..Photo::default() }).contains("option `aperture`"));
    assert!(plain(Photo { samples: Some(4), ..Photo::default() }).contains("option `shutter`"));
    assert!(plain(Photo { samples: Some(0), shutter: Some(90.0), ..Photo::default() }).contains("samples"));
    let sphere = Photo { projection: Projection::Equirectangular, ..Photo::default() };
    let message = refused(sphere.clone(), &|args| args.size = Some([640, 480]));
    assert!(message.contains("640x480") && message.contains("960x480"), "{message}");
    let eyes = Photo { stereo: Some(Stereo::OverUnder), eye_distance: Some(0.065), ..sphere.clone() };
    assert!(plain(eyes).contains("a centre of their own"));
    assert!(plain(Photo { aperture: Some(0.1), ..sphere.clone() }).contains("whole sphere"));
    assert!(refused(sphere, &|args| args.channel = Channel::Label).contains("label"));
    assert!(plain(Photo { stereo: Some(Stereo::OverUnder), ..Photo::default() }).contains("0.065"));
    let shutter = Photo { shutter: Some(180.0), ..Photo::default() };
    assert!(refused(shutter.clone(), &|args| args.channel = Channel::Depth).contains("depth"));
    assert!(refused(shutter, &|args| args.raw = Some("raw".into())).contains("option `raw`"));
    let clear = Photo { transparent: true, ..Photo::default() };
    assert!(refused(clear.clone(), &|args| args.output = Some("a.mp4".into())).contains(".png"));
    assert!(refused(clear, &|args| args.background = Some([1.0; 3])).contains("option `background`"));
    assert!(plain(Photo { transfer: Some(Transfer::Linear), ..Photo::default() }).contains(".exr"));
    let several = files_of(Path::new("a.exr"), false, 3).unwrap_err().to_string();
    assert!(several.contains("a.%04d.exr"), "{several}");
    assert_eq!(files_of(Path::new("f/a.%02d.exr"), false, 2).unwrap().unwrap()[1], Path::new("f/a.01.exr"));
    assert!(files_of(Path::new("a.png"), false, 3).unwrap().is_none());
}

#[test]
fn spheres_have_a_level_horizon() {
    let pose = Se3::look_at([1.0, 2.0, 5.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let camera = Camera::with_fov_y(pose, 0.8, 40, 20);
    let straight = level(&camera, [0.0, 2.0, 0.0]);
    assert!(straight.forward()[1].abs() < 1e-12 && straight.forward()[0] < 0.0 && straight.forward()[2] < 0.0);
    assert!(norm(splat4d::math::se3::sub(straight.center(), camera.center())) < 1e-12);
    assert_eq!(level(&camera, camera.forward()), camera);
}
