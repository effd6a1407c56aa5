//! Exports next to colours: channels as images and numbers, requested points, labels.

use crate::convert::moving;
use crate::sample::{Capture, splat4d};
use crate::{json_of, str, train};
use serde_json::json;
use splat4d::format::npy::Npy;
use splat4d::format::scene;
use splat4d::scene::labels;
use std::path::{Path, PathBuf};

/// The birds, half of which are labelled, and a camera before them.
fn birds(folder: &Path) -> [PathBuf; 2] {
    let mut birds = moving();
    let of: Vec<Option<usize>> = (0..40).map(|i| (i < 20).then_some(1)).collect();
    labels::state(&mut birds.layers[0].params, 2, &of);
    birds.labels = vec!["air".into(), "bird".into()];
    let [file, camera] = ["birds.safetensors", "camera.json"].map(|name| folder.join(name));
    let mut bytes = Vec::new();
    scene::write(&birds, &mut bytes).unwrap();
    std::fs::write(&file, bytes).unwrap();
    let pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]];
    let text = json!({"fx": 40, "fy": 40, "cx": 20, "cy": 15, "w": 40, "h": 30, "world_to_camera": pose});
    std::fs::write(&camera, text.to_string()).unwrap();
    [file, camera]
}

fn npy(path: &Path) -> Npy {
    Npy::read(&std::fs::read(path).unwrap()).unwrap()
}

#[test]
fn every_channel_is_an_image_and_numbers() {
    let work = tempfile::tempdir().unwrap();
    let [file, camera] = birds(work.path());
    let (png, raw) = (work.path().join("a.png"), work.path().join("a"));
    for (channel, planes) in
        [("flow", 2), ("velocity", 3), ("normal", 3), ("label", 1), ("life", 1), ("uncertainty", 1)]
    {
        let words = ["render", str(&file), "--camera", str(&camera), "--time", "0.5", "--channel", channel];
        splat4d(&words).args(&["-o", str(&png), "--raw", str(&raw)]).run().ok();
        let shown = image::open(&png).unwrap().to_rgb8();
        assert!((shown.width(), shown.height()) == (40, 30) && shown.pixels().any(|p| p.0 != [0; 3]), "{channel}");
        let array = npy(&work.path().join(format!("a.{channel}.npy")));
        let shape: &[usize] = if planes == 1 { &[30, 40] } else { &[30, 40, planes] };
        assert_eq!(array.shape, shape, "{channel}");
        let numbers = array.to_f32();
        let known: Vec<f32> = numbers.iter().copied().filter(|x| x.is_finite()).collect();
        assert!(!known.is_empty(), "{channel}");
        match channel {
            "label" => assert!(known.iter().all(|x| [-1.0, 0.0, 1.0].contains(x)) && known.contains(&1.0)),
            "life" => assert!(known.iter().all(|x| (0.0..=1.0).contains(x))),
            "normal" => assert!(known.chunks(3).all(|n| (n.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-3)),
            _ => {}
        }
    }
    let folder = work.path().join("film");
    let words = ["render", str(&file), "--size", "24x18", "--channel", "flow", "--fps", "2", "-o", str(&folder)];
    splat4d(&words).args(&["--raw", str(&work.path().join("flo")), "--raw-format", "flo"]).run().ok();
    assert!(std::fs::read(work.path().join("flo/00000.flo")).unwrap().starts_with(b"PIEH"));
    splat4d(&["render", str(&file), "--camera", str(&camera), "--channel", "depth", "--raw", str(&raw)])
        .args(&["--raw-format", "exr"])
        .run()
        .ok();
    assert!(std::fs::read(work.path().join("a.depth.exr")).unwrap().starts_with(&[0x76, 0x2f, 0x31, 0x01]));

    let refused = |more: &[&str]| {
        splat4d(&["render", str(&file), "--camera", str(&camera), "-o", str(&png)]).args(more).run().refused()
    };
    assert!(refused(&["--channel", "flavour"]).contains("uncertainty"));
    assert!(refused(&["--channel", "depth", "--raw", str(&raw), "--raw-format", "flo"]).contains("--channel flow"));
    let plain = work.path().join("plain.safetensors");
    let mut bytes = Vec::new();
    scene::write(&moving(), &mut bytes).unwrap();
    std::fs::write(&plain, bytes).unwrap();
    let none = splat4d(&["render", str(&plain), "--camera", str(&camera), "-o", str(&png), "--channel", "label"]);
    assert!(none.run().refused().contains("splat4d label"));
}

#[test]
fn films_for_compositing_have_shutter_lens_and_layers() {
    let work = tempfile::tempdir().unwrap();
    let [file, camera] = birds(work.path());
    let at = |name: &str| work.path().join(name);
    let render = |more: &[&str]| splat4d(&["render", str(&file)]).args(more).run();
    let film = ["--size", "24x18", "--fps", "2", "--shutter", "180", "--aperture", "0.2", "--focus", "2.5"];
    let pattern = at("comp/shot.%03d.exr");
    render(&[&film[..], &["-o", str(&pattern)]].concat()).ok();
    let bytes = std::fs::read(at("comp/shot.001.exr")).unwrap();
    let has = |name: &[u8]| bytes.windows(name.len()).any(|w| w == name);
    let names: [&[u8]; 5] = [b"A\0", b"Z\0", b"forward.u\0", b"label\0", b"1 bird"];
    assert!(bytes.starts_with(&[0x76, 0x2f, 0x31, 0x01]) && names.iter().all(|name| has(name)));
    // Frames of another film are not mixed with these.
    let other = render(&["--size", "24x18", "--freeze", "0.5", "--seconds", "0.5", "--fps", "2", "-o", str(&pattern)]);
    assert!(other.refused().contains("comp"));
    render(&["--camera", str(&camera), "--shutter", "90", "--transparent", "-o", str(&at("clear.png"))]).ok();
    assert!(image::open(at("clear.png")).unwrap().color().has_alpha());
    render(&["--camera", str(&camera), "-o", str(&at("one.exr"))]).ok();
    render(&["--camera", str(&camera), "--channel", "label", "-o", str(&at("label.exr"))]).ok();
    let sphere = ["--projection", "equirectangular", "--size", "32x16", "--freeze", "0.5", "--path", "orbit"];
    render(&[&sphere[..], &["--seconds", "0.1", "--fps", "10", "-o", str(&at("sphere"))]].concat()).ok();
    let shown = image::open(at("sphere/00000.png")).unwrap().to_rgb8();
    assert!((shown.width(), shown.height()) == (32, 16) && shown.pixels().any(|p| p.0 != shown.get_pixel(0, 0).0));
    let eyes = ["--stereo", "over-under", "--eye-distance", "0.1", "--size", "24x18", "--freeze", "0.5"];
    render(&[&eyes[..], &["--seconds", "0.1", "--fps", "10", "-o", str(&at("eyes"))]].concat()).ok();
    assert_eq!(image::image_dimensions(at("eyes/00000.png")).unwrap(), (24, 36));

    let out = ["-o", str(&at("x.png"))].map(str::to_owned);
    let refused = |more: &[&str]| render(&[&out.each_ref().map(String::as_str)[..], more].concat()).refused();
    for shutter in ["0", "720"] {
        assert!(refused(&["--shutter", shutter]).contains("up to 360"), "{shutter}");
    }
    assert!(refused(&["--aperture", "0.1", "--focus", "-2"]).contains("in front of the camera"));
    assert!(refused(&["--projection", "equirectangular", "--size", "30x16"]).contains("32x16"));
    assert!(refused(&["--stereo", "side-by-side"]).contains("--eye-distance"));
    assert!(refused(&["--transfer", "linear"]).contains(".exr"));
    let camera = ["render", str(&file), "--camera", str(&camera), "--projection", "equirectangular", "-o"];
    assert!(splat4d(&camera).args(&[str(&at("x.png"))]).run().refused().contains("40x30"));
}

#[test]
fn a_label_is_exported_alone() {
    let work = tempfile::tempdir().unwrap();
    let [file, _] = birds(work.path());
    let at = |name: &str| work.path().join(name);
    let said = splat4d(&["export", str(&file), "-o", str(&at("a.ply")), "--time", "0.5", "--label", "bird"]).run().ok();
    let all = splat4d(&["export", str(&file), "-o", str(&at("b.ply")), "--time", "0.5"]).run().ok();
    let count = |said: &str| said.split(" Gaussians").next().unwrap().rsplit(' ').next().unwrap().parse::<usize>();
    assert!(count(&said).unwrap() < count(&all).unwrap() && count(&said).unwrap() > 0, "{said} {all}");
    splat4d(&["export", str(&file), "--tracks", str(&at("t.csv")), "--label", "bird"]).run().ok();
    let rows = std::fs::read_to_string(at("t.csv")).unwrap();
    assert!(rows.lines().skip(1).all(|l| l.split(',').nth(1).unwrap().parse::<u32>().unwrap() < 20));
    splat4d(&["edit", str(&file), "--crop", "label(bird)", "-o", str(&at("bird.s4d"))]).run().ok();
    let baked = splat4d::open(&std::fs::read(at("bird.s4d")).unwrap()).unwrap();
    let of: Vec<Option<usize>> = baked.layers.iter().flat_map(|l| labels::of(&l.params)).collect();
    assert!(baked.labels == ["air", "bird"] && !of.is_empty() && of.iter().all(|l| *l == Some(1)), "{of:?}");
    let refused = |words: &[&str]| splat4d(words).run().refused();
    let message = refused(&["export", str(&file), "-o", str(&at("c.ply")), "--label", "fish"]);
    assert!(message.contains("`fish`") && message.contains("air, bird"), "{message}");
    assert!(refused(&["edit", str(&file), "--count", "label(fish)"]).contains("air, bird"));
}

#[test]
fn masks_label_a_run_and_points_are_tracked() {
    let work = tempfile::tempdir().unwrap();
    let root = Capture::new(work.path()).write();
    let mut about = json_of(&root.join("capture.json"));
    let cameras = about["cameras"].as_array_mut().unwrap();
    for camera in cameras.iter_mut() {
        let name = camera["name"].as_str().unwrap().to_owned();
        let (w, h) = (camera["width"].as_u64().unwrap() as u32, camera["height"].as_u64().unwrap() as u32);
        let mask = image::GrayImage::from_fn(w, h, |x, _| image::Luma([u8::from(x > w / 2)]));
        std::fs::create_dir_all(root.join("labels")).unwrap();
        mask.save(root.join(format!("labels/{name}.png"))).unwrap();
        let frames = camera["frames"].as_u64().unwrap() as usize;
        camera["labels"] = vec![format!("labels/{name}.png"); frames].into();
    }
    let (first, [width, height]) = (cameras[0].clone(), ["width", "height"].map(|k| cameras[0][k].as_u64().unwrap()));
    about["labels"] = json!(["left", "right"]);
    std::fs::write(root.join("capture.json"), about.to_string()).unwrap();
    let run = work.path().join("run");
    let said = train(&root, &run).ok();
    assert!(said.contains("labels of") && said.contains("mean IoU"), "{said}");
    let scene = scene::read(&std::fs::read(run.join("scene.safetensors")).unwrap()).unwrap();
    assert_eq!(scene.labels, ["left", "right"]);
    assert!(json_of(&run.join("run.json"))["labels"]["accuracy"].as_f64().unwrap() > 0.5);
    let playback = splat4d::open(&std::fs::read(run.join("scene.s4d")).unwrap()).unwrap();
    assert_eq!(playback.labels, scene.labels);
    splat4d(&["label", str(&run), "--rounds", "1"]).run().ok();
    splat4d(&["render", str(&run), "--channel", "uncertainty", "--path", "test"])
        .args(&["-o", str(&work.path().join("unsure")), "--raw", str(&work.path().join("raw"))])
        .run()
        .ok();
    assert!(npy(&work.path().join("raw/00000.npy")).to_f32().iter().any(|x| *x > 0.0));

    let points = work.path().join("points.csv");
    let name = first["name"].as_str().unwrap();
    std::fs::write(&points, format!("camera,x,y,time\n{name},{},{},0\n", width / 2, height / 2)).unwrap();
    let out = work.path().join("paths.csv");
    let ask = || splat4d(&["export", str(&run), "--tracks", str(&out), "--points", str(&points)]).run();
    ask().ok();
    let rows = std::fs::read_to_string(&out).unwrap();
    assert!(rows.starts_with("point,time,x,y,z,camera,u,v,visible\n"), "{rows}");
    std::fs::write(&points, format!("camera,x,y,time\n{name},{width},1,0\n")).unwrap();
    let message = ask().refused();
    assert!(
        message.contains("points.csv") && message.contains("line 2") && message.contains("outside the image"),
        "{message}"
    );
}
