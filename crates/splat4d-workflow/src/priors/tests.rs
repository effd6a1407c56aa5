use super::*;
use crate::events::{Event, ignore};
use crate::models::Map;
use crate::models::tests::onnx::{IMAGES, of_channel, of_means, of_points};
use splat4d_train::capture::{DepthKind, ImageStore};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::Ordering;

const WIDTH: usize = 40;
const HEIGHT: usize = 30;
const FRAMES: usize = 4;

/// A fixed camera before a slanted wall; red is the inverse depth, and images become brighter.
fn capture(folder: &Path) {
    let inverse = |x: usize| 0.2 + 0.01 * x as f64;
    for k in 0..FRAMES {
        let pixel = |x: u32, _: u32| {
            image::Rgb([(200.0 * inverse(x as usize)).round() as u8 + k as u8, 10, if x < 10 { 200 } else { 0 }])
        };
        image::RgbImage::from_fn(WIDTH as u32, HEIGHT as u32, pixel).save(folder.join(format!("{k}.png"))).unwrap();
    }
    let images: Vec<String> = (0..FRAMES).map(|k| format!("\"{k}.png\"")).collect();
    let text = format!(
        r#"{{"version": 1, "hold_out": "none", "points": "points.ply", "cameras": [{{"name": "c", "width": {WIDTH}, "height": {HEIGHT},
        "fx": 40, "fy": 40, "cx": 20, "cy": 15, "images": [{}],
        "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}]}}"#,
        images.join(", ")
    );
    std::fs::write(folder.join("capture.json"), text).unwrap();
    let mut points = String::new();
    for k in 0..200 {
        let (x, y) = ((k * 7) % WIDTH, (k * 11) % HEIGHT);
        let z = 1.0 / inverse(x);
        let [u, v] = [(x as f64 + 0.5 - 20.0) / 40.0, (y as f64 + 0.5 - 15.0) / 40.0];
        points += &format!("{} {} {} 90 90 90\n", u * z, v * z, z);
    }
    let header = "ply\nformat ascii 1.0\nelement vertex 200\nproperty float x\nproperty float y\nproperty float z\nproperty uchar \
                  red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    std::fs::write(folder.join("points.ply"), format!("{header}{points}")).unwrap();
}

struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        std::fs::create_dir(place.take()).unwrap();
        capture(&place.take());
        place.network("depth", &of_channel(0, 1.0, &IMAGES), "kind = \"inverse-depth\"");
        place.network("far", &of_channel(0, -1.0, &IMAGES), "kind = \"inverse-depth\"");
        place.network("mask", &of_channel(2, 1.0, &IMAGES), "kind = \"mask\"\nthreshold = 0.5");
        place.network("flat", &of_channel(1, 1.0, &IMAGES), "kind = \"inverse-depth\"");
        place.network("flow", &of_means(255.0), "kind = \"flow\"");
        place
    }

    fn take(&self) -> PathBuf {
        self.0.path().join("take")
    }

    fn network(&self, name: &str, network: &[u8], output: &str) {
        std::fs::write(self.0.path().join(format!("{name}.onnx")), network).unwrap();
        let text = format!("version = 1\n[input]\nrange = 1\n[output]\n{output}\n");
        std::fs::write(self.0.path().join(format!("{name}.toml")), text).unwrap();
    }

    fn request(&self, networks: &[(Part, &str)]) -> Priors {
        let path = |name: &str| self.0.path().join(format!("{name}.onnx"));
        let networks = networks.iter().map(|(part, name)| (*part, path(name))).collect();
        Priors { capture: self.take(), networks, ..Priors::default() }
    }

    fn run(&self, networks: &[(Part, &str)]) -> Result<Made> {
        priors(&self.request(networks), &AtomicBool::new(false), &ignore)
    }

    fn opened(&self) -> Arc<Capture> {
        Arc::new(Capture::open(&self.take(), &CaptureOptions::default()).unwrap())
    }
}

#[test]
fn training_finds_what_networks_wrote() {
    let place = Place::new();
    let made = place.run(&[(Part::Depth, "depth"), (Part::Masks, "mask"), (Part::Flow, "flow")]).unwrap();
    let capture = place.opened();
    assert!(capture.frames.iter().all(|f| f.depth.as_ref().is_some_and(|d| d.kind == DepthKind::Inverse)));
    assert_eq!(capture.frames.iter().filter(|f| f.flow.is_some()).count(), FRAMES - 1);
    let picture = ImageStore::new(capture, 0).load(0).unwrap().to_picture();
    let mask = picture.mask.unwrap();
    assert!((0..WIDTH).all(|x| mask.get(0, 3, x) == f32::from(u8::from(x < 10))));
    let flow = picture.flow.unwrap();
    // One grey value brighter from frame to frame; what leaves the image is not known.
    assert!((flow.get(0, 5, 5) - 1.0).abs() < 0.02 && flow.get(1, 5, 5) == 0.0 && flow.get(2, 5, 5) == 1.0);
    assert_eq!(flow.get(2, 5, WIDTH - 1), 0.0);
    let depth = picture.depth.unwrap().0;
    assert!(depth.get(0, 0, 30) > depth.get(0, 0, 3));
    let figure = |part: Part, name: &str| made.rows.iter().find(|r| r.part == part).unwrap().figures[name];
    assert!(figure(Part::Depth, "correlation") > 0.99 && figure(Part::Depth, "error %") < 1.0);
    assert!(figure(Part::Depth, "change over time") < 0.01);
    assert!(
        (figure(Part::Masks, "share of the image %") - 25.0).abs() < 0.1
            && figure(Part::Masks, "overlap over time") == 1.0
    );
    assert!(figure(Part::Flow, "both directions agree %") > 90.0);
    assert!(made.rows.iter().all(|r| r.part == Part::Flow || r.warnings.is_empty()), "{:?}", made.rows);
    let text = made.text();
    assert!(text.lines().count() == 4 && text.contains("correlation 1.00"), "{text}");
    assert_eq!(made.json()["rows"].as_array().map(Vec::len), Some(3));
}

#[test]
fn matches_become_tracks() {
    let place = Place::new();
    let network = of_points(&[4.0, 3.0, 20.0, 10.0, 4.0, 3.0, 20.0, 10.0], &[0, 0, 0, 0, 1, 1], &[0.9, 0.8]);
    place.network("points", &network, "kind = \"matches\"");
    let text = "version = 1\n[input]\nchannels = \"grey\"\npair = \"batch\"\n[output]\nkind = \"matches\"\n";
    std::fs::write(place.0.path().join("points.toml"), text).unwrap();
    let made = place.run(&[(Part::Tracks, "points")]).unwrap();
    let table = std::fs::read_to_string(place.take().join("priors/tracks/c.csv")).unwrap();
    assert!(table.lines().count() == 1 + 2 * FRAMES && table.contains("\n0,0,4.500,3.500\n"), "{table}");
    assert!(place.opened().frames.iter().all(|f| f.tracks.is_some()));
    assert_eq!((made.rows.len(), made.rows[0].images), (1, FRAMES));
}

#[test]
fn the_same_request_continues_and_another_network_is_refused() {
    let place = Place::new();
    place.run(&[(Part::Depth, "depth")]).unwrap();
    let file = |k: usize| place.take().join(format!("priors/depth/{k}.png.png"));
    let before = std::fs::read(file(1)).unwrap();
    std::fs::remove_file(file(2)).unwrap();
    let stamp = std::fs::metadata(file(1)).unwrap().modified().unwrap();
    place.run(&[(Part::Depth, "depth")]).unwrap();
    assert!(file(2).is_file());
    assert_eq!(std::fs::metadata(file(1)).unwrap().modified().unwrap(), stamp, "finished images are skipped");
    let text = place.run(&[(Part::Depth, "far")]).unwrap_err().to_string();
    assert!(text.contains("another network") && text.contains("--force"), "{text}");
    assert_eq!(std::fs::read(file(1)).unwrap(), before);
    let forced = Priors { force: true, ..place.request(&[(Part::Depth, "far")]) };
    let made = priors(&forced, &AtomicBool::new(false), &ignore).unwrap();
    assert_ne!(std::fs::read(file(1)).unwrap(), before);
    assert!(
        made.rows[0].warnings[0].contains("camera c: the maps are the opposite of what the points show"),
        "{:?}",
        made.rows
    );
    // A lost file is made again, although the list names it.
    std::fs::remove_file(file(3)).unwrap();
    assert!(Capture::open(&place.take(), &CaptureOptions::default()).is_err());
    place.run(&[(Part::Depth, "far")]).unwrap();
    assert!(file(3).is_file());
    // Other parts of the list stay.
    place.run(&[(Part::Masks, "mask")]).unwrap();
    assert!(place.opened().frames.iter().all(|f| f.depth.is_some() && f.mask.is_some()));
}

#[test]
fn an_interrupted_request_leaves_whole_files_and_no_list() {
    let place = Place::new();
    let stop = AtomicBool::new(false);
    let listen = |event: &Event<'_>| {
        if let Event::Phase { name: "depth", done: 2, .. } = event {
            stop.store(true, Ordering::SeqCst);
        }
    };
    let error = priors(&place.request(&[(Part::Depth, "depth")]), &stop, &listen).unwrap_err();
    assert!(error.to_string().contains("Run the same command again"), "{error}");
    assert!(place.take().join("priors/depth/1.png.png").is_file() && !place.take().join("priors/priors.json").exists());
    assert!(place.opened().frames.iter().all(|f| f.depth.is_none()));
    place.run(&[(Part::Depth, "depth")]).unwrap();
    assert!(place.opened().frames.iter().all(|f| f.depth.is_some()));
}

#[test]
fn files_of_users_are_never_touched() {
    let place = Place::new();
    let own = place.take().join("priors/depth/0.png.png");
    std::fs::create_dir_all(own.parent().unwrap()).unwrap();
    std::fs::write(&own, b"mine").unwrap();
    let forced = Priors { force: true, ..place.request(&[(Part::Depth, "depth")]) };
    for request in [place.request(&[(Part::Depth, "depth")]), forced] {
        let text = priors(&request, &AtomicBool::new(false), &ignore).unwrap_err().to_string();
        assert!(text.contains("did not write") && text.contains("0.png.png"), "{text}");
    }
    assert_eq!(std::fs::read(&own).unwrap(), b"mine");
    // What the capture names itself is used, and nothing is computed for it.
    std::fs::remove_file(&own).unwrap();
    let marker = place.take().join("capture.json");
    let named = std::fs::read_to_string(&marker).unwrap().replace("\"images\"", "\"masks\": \"m%d.png\", \"images\"");
    std::fs::write(&marker, named).unwrap();
    for k in 0..FRAMES {
        image::GrayImage::from_pixel(WIDTH as u32, HEIGHT as u32, image::Luma([255]))
            .save(place.take().join(format!("m{k}.png")))
            .unwrap();
    }
    let made = place.run(&[(Part::Masks, "mask")]).unwrap();
    assert!(made.rows.is_empty() && !place.take().join("priors/masks").exists(), "{:?}", made.rows);
}

#[test]
fn constant_maps_are_left_out_with_a_warning() {
    let place = Place::new();
    let heard = RefCell::new(Vec::new());
    let listen = |event: &Event<'_>| {
        if let Event::Warning(text) = event {
            heard.borrow_mut().push((*text).to_owned());
        }
    };
    priors(&place.request(&[(Part::Depth, "flat")]), &AtomicBool::new(false), &listen).unwrap();
    let heard = heard.into_inner();
    assert!(heard.iter().any(|w| w.contains("4 of 4 images") && w.contains("all values are equal")), "{heard:?}");
    assert!(place.opened().frames.iter().all(|f| f.depth.is_none()));
}

#[test]
fn networks_of_another_kind_are_refused() {
    let place = Place::new();
    let text = place.run(&[(Part::Depth, "mask")]).unwrap_err().to_string();
    assert!(
        text.contains("expected a network for depth or inverse-depth, found mask") && text.contains("mask.onnx"),
        "{text}"
    );
    let text = place.run(&[]).unwrap_err().to_string();
    assert!(text.contains("no network"), "{text}");
}

#[test]
fn flow_is_unknown_where_the_flow_back_disagrees() {
    let size = (WIDTH, 4);
    let map = |u: &dyn Fn(usize) -> f32| {
        let values = (0..2 * size.0 * size.1).map(|i| if i < size.0 * size.1 { u(i % size.0) } else { 0.0 }).collect();
        Map { channels: 2, height: size.1, width: size.0, values }
    };
    // All pixels move by 5 to the right. Columns 20 to 24 of the next image show what was hidden: their flow back is that of
    // something else, so that columns 15 to 19 of this image are not seen there.
    let forth = map(&|_| 5.0);
    let back = map(&|x| if (20..25).contains(&x) { 1.0 } else { -5.0 });
    let Encoded::File(png) = write::flow(&forth, &back) else { panic!("flow is finite") };
    let decoded = image::load_from_memory(&png).unwrap().into_rgb16();
    for x in 0..WIDTH {
        let [u, _, known] = decoded.get_pixel(x as u32, 2).0;
        let hidden = (15..20).contains(&x) || x + 5 >= WIDTH;
        assert_eq!(known, u16::from(!hidden), "column {x}");
        assert_eq!(u, if hidden { 0 } else { 32768 + 5 * 64 }, "column {x}");
    }
}
