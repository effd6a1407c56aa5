//! Pixels: downscaling, EXIF, bit depths, undistortion borders, the cache.

use super::super::*;
use super::samples::{self, HEIGHT, WIDTH};
use crate::capture::lens::Distortion;
use image::{ImageBuffer, Luma};
use serde_json::json;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

const JPEG: &[u8] = include_bytes!("tiny.jpg");

fn open(root: &Path, downscale: usize) -> Arc<Capture> {
    Arc::new(Capture::open(root, &CaptureOptions { downscale, ..CaptureOptions::default() }).unwrap())
}

fn load(capture: &Arc<Capture>, frame: usize) -> Picture {
    ImageStore::new(Arc::clone(capture), 1 << 20).load(frame).unwrap().to_picture()
}

#[test]
fn downscaling_composites_then_averages_boxes() {
    let sample = samples::dnerf();
    let (full, small) = (open(sample.root(), 1), open(sample.root(), 5));
    let (f, s) = (load(&full, 0), load(&small, 0));
    assert_eq!((s.color.width, s.color.height), (WIDTH / 5, HEIGHT / 5));
    let view = &small.frames[0].view;
    assert_eq!((view.width, view.height, view.intrinsics.cx), (4, 3, 2.4));
    for c in 0..3 {
        for (y, x) in [(0, 0), (2, 2), (1, 3)] {
            let mean = (0..25).map(|i| f.color.get(c, 5 * y + i / 5, 5 * x + i % 5)).sum::<f32>() / 25.0;
            assert!((s.color.get(c, y, x) - mean).abs() < 2e-5, "{c} {y} {x}");
        }
    }
    // The box from 10 to 14 straddles the mask's edge at 12: two of five columns have alpha 128/255.
    assert!((s.mask.unwrap().get(0, 0, 2) - 0.4 * 128.0 / 255.0).abs() < 0.5 / 255.0);
}

#[test]
fn eight_bit_images_stay_exact_and_small() {
    let sample = samples::own();
    let capture = open(sample.root(), 1);
    let stored = ImageStore::new(Arc::clone(&capture), 0).load(3).unwrap();
    assert_eq!(stored.bytes(), 4 * WIDTH * HEIGHT);
    assert_eq!(stored.to_picture().color.get(1, 7, 3), 105.0 / 255.0);
}

#[test]
fn sixteen_bit_grey_is_read_in_full() {
    let sample = samples::own();
    let ramp = |x: u32, _| Luma([(x * 257 + 3) as u16]);
    sample.save("images/cam00/0005.png", ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, ramp));
    let picture = load(&open(sample.root(), 1), 0);
    assert_eq!(picture.color.get(2, 4, 9), (9.0 * 257.0 + 3.0) / 65535.0);
}

/// The tiny JPEG with an EXIF segment that states an orientation.
fn oriented(orientation: u8) -> Vec<u8> {
    let mut tiff = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    tiff.extend([orientation, 0, 0, 0, 0, 0, 0]);
    let mut bytes = JPEG[..2].to_vec();
    bytes.extend([0xFF, 0xE1]);
    bytes.extend((tiff.len() as u16 + 2).to_be_bytes());
    bytes.extend(tiff);
    bytes.extend(&JPEG[2..]);
    bytes
}

#[test]
fn jpeg_orientation_is_honoured() {
    let sample = samples::own();
    let jpeg = |orientation: Option<u8>, turned: bool| {
        sample.write("images/a.jpg", &orientation.map_or_else(|| JPEG.to_vec(), oriented));
        sample.edit("capture.json", |v| {
            let mut camera = v["cameras"][0].clone();
            camera["images"] = json!(["images/a.jpg"]);
            camera.as_object_mut().unwrap().remove("masks");
            (camera["width"], camera["height"]) = if turned { (json!(16), json!(24)) } else { (json!(24), json!(16)) };
            v["cameras"] = json!([camera]);
        });
        load(&open(sample.root(), 1), 0).color
    };
    let plain = jpeg(None, false);
    assert!(plain.get(0, 0, 0) > 0.7 && plain.get(2, 15, 23) > 0.7, "red at the top left, blue at the bottom right");
    assert_eq!(jpeg(Some(1), false), plain);
    let half = jpeg(Some(3), false);
    assert_eq!(half.get(0, 15, 23), plain.get(0, 0, 0));
    // Orientation 6: the stored image must be turned by 90° clockwise, its top left goes to the top right.
    let quarter = jpeg(Some(6), true);
    assert_eq!((quarter.width, quarter.height), (16, 24));
    assert_eq!(quarter.get(0, 0, 15), plain.get(0, 0, 0));
    assert_eq!(quarter.get(1, 23, 15), plain.get(1, 0, 23));
}

#[test]
fn fisheye_borders_are_marked() {
    let sample = samples::own();
    sample.edit("capture.json", |v| {
        v["cameras"][1]["distortion"] = json!({"model": "fisheye", "k": [2.5]});
    });
    let picture = load(&open(sample.root(), 1), 2);
    let valid = picture.valid.expect("strong pincushion distortion must leave borders");
    assert_eq!((valid.get(0, 0, 0), valid.get(0, 8, 12)), (0.0, 1.0));
    assert!((picture.color.get(0, 8, 12) - 120.0 / 255.0).abs() < 0.01);
}

#[test]
fn undistortion_inverts_a_distorted_image() {
    // An image whose colours are linear in its ray is distorted by the closed model and must be linear again
    // afterwards.
    let sample = samples::own();
    let lens = splat4d::scene::Lens::Brown { k: [-0.2, 0.03, 0.0, 0.0, 0.0, 0.0], p: [2e-3, -1e-3], s: [0.0; 4] };
    let distortion = Distortion::new(lens);
    let ramp = |x: u32, y: u32| {
        let image = [(f64::from(x) + 0.5 - 12.0) / 20.0, (f64::from(y) + 0.5 - 8.0) / 20.0];
        let ray = distortion.undistort(image).expect("every pixel sees a ray");
        Luma([((0.5 + 0.4 * ray[0]) * 65535.0) as u16])
    };
    sample.save("images/cam00/0005.png", ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, ramp));
    sample.edit("capture.json", |v| {
        v["cameras"][0]["distortion"] = json!({"model": "opencv", "k": [-0.2, 0.03], "p": [2e-3, -1e-3]});
    });
    let picture = load(&open(sample.root(), 1), 0);
    for (x, y) in [(4, 3), (12, 8), (20, 12), (7, 10)] {
        let want = 0.5 + 0.4 * (x as f32 + 0.5 - 12.0) / 20.0;
        assert!((picture.color.get(0, y, x) - want).abs() < 1e-3, "{x} {y}: {}", picture.color.get(0, y, x));
    }
}

#[test]
fn cache_keeps_its_budget_and_never_changes_pixels() {
    let sample = samples::own();
    let capture = open(sample.root(), 1);
    let one = 4 * WIDTH * HEIGHT;
    let free = ImageStore::new(Arc::clone(&capture), 0);
    let tight = ImageStore::new(Arc::clone(&capture), 2 * one + one / 2);
    tight.prefetch(&[5, 0, 1, 2]);
    let order = [0, 1, 2, 0, 5, 4, 3, 2, 1, 0];
    std::thread::scope(|s| {
        for shift in 0..3 {
            let (free, tight) = (&free, &tight);
            s.spawn(move || {
                for i in order {
                    let frame = (i + shift) % 6;
                    assert_eq!(free.load(frame).unwrap(), tight.load(frame).unwrap());
                }
            });
        }
    });
    assert!(tight.peak_bytes() <= 2 * one + one / 2 && tight.peak_bytes() >= 2 * one, "{}", tight.peak_bytes());
    assert_eq!((free.peak_bytes(), free.bytes()), (0, 0));
    let roomy = ImageStore::new(capture, 100 * one);
    roomy.prefetch(&[0, 1, 2]);
    let start = std::time::Instant::now();
    while roomy.decoded() < 3 && start.elapsed().as_secs() < 10 {
        std::thread::sleep(Duration::from_millis(1));
    }
    (0..3).for_each(|i| drop(roomy.load(i).unwrap()));
    assert_eq!(roomy.decoded(), 3, "prefetched pictures must not be decoded again");
}

#[test]
fn an_image_is_undistorted_while_all_workers_are_busy() {
    // A worker that waits for an image cannot help to make it: the thread that makes one must not need the workers.
    let sample = samples::own();
    sample.edit("capture.json", |v| {
        v["cameras"][1]["distortion"] = json!({"model": "opencv", "k": [-0.2, 0.03], "p": [0.002, -0.001]});
    });
    let store = ImageStore::new(open(sample.root(), 1), 1 << 30);
    let busy = Arc::new((Mutex::new((0, false)), Condvar::new()));
    let workers = rayon::current_num_threads();
    for _ in 0..workers {
        let busy = Arc::clone(&busy);
        rayon::spawn(move || {
            let mut state = busy.0.lock().unwrap();
            state.0 += 1;
            busy.1.notify_all();
            drop(busy.1.wait_while(state, |s| !s.1).unwrap());
        });
    }
    // Where other tests keep a worker for longer, it is busy too.
    let all = busy.1.wait_timeout_while(busy.0.lock().unwrap(), Duration::from_secs(2), |s| s.0 < workers).unwrap();
    drop(all);
    let (done, ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || done.send(store.load(2).is_ok()));
    let answer = ended.recv_timeout(Duration::from_secs(20));
    busy.0.lock().unwrap().1 = true;
    busy.1.notify_all();
    assert_eq!(answer, Ok(true));
}

#[test]
fn black_borders_are_neither_trained_nor_scored() {
    // Six photos that undistortion left a black column at either side of; one is damaged by a dark stripe across.
    let sample = samples::photos(6, |c| format!("{c}.png"), None);
    for c in 0..6u32 {
        let pixel = |x: u32, y: u32| {
            let black = x == 0 || x == WIDTH as u32 - 1 || (c == 0 && y == 8);
            image::Rgb(if black { [3, 0, 12] } else { [90 + 6 * x as u8, 60 + 7 * (y + c) as u8, 50] })
        };
        sample.save(&format!("images/{c}.png"), ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, pixel));
    }
    let capture = open(sample.root(), 1);
    assert!(capture.notes.iter().any(|n| n.contains("6 images have black borders")), "{:?}", capture.notes);
    let valid = load(&capture, 0).valid.expect("the borders are left out");
    let row: Vec<f32> = (0..WIDTH).map(|x| valid.get(0, 8, x)).collect();
    assert_eq!((&row[..4], &row[WIDTH - 4..]), (&[0.0, 0.0, 0.0, 1.0][..], &[1.0, 0.0, 0.0, 0.0][..]));
    let half = load(&open(sample.root(), 2), 1).valid.expect("at half size too");
    assert_eq!([0, 1, 2].map(|x| (2.0 * half.get(0, 4, x)).round()), [0.0, 1.0, 2.0], "half of a pixel is recorded");
    let keep = CaptureOptions { borders: Borders::Keep, ..CaptureOptions::default() };
    let kept = Arc::new(Capture::open(sample.root(), &keep).unwrap());
    assert!(load(&kept, 0).valid.is_none() && kept.notes.iter().all(|n| !n.contains("borders")));
}

#[test]
fn every_part_of_a_capture_has_the_borders_of_the_whole() {
    // Six fixed cameras whose first frame has a letterbox; a bright flash fills the second.
    let sample = samples::own();
    sample.edit("capture.json", |v| {
        let cameras: Vec<_> = (0..6)
            .map(|c| {
                let mut camera = v["cameras"][c % 3].clone();
                camera["name"] = format!("cam{c:02}").into();
                camera["images"] = format!("images/cam{c:02}/%04d.png").into();
                camera["world_to_camera"] = samples::rows(&samples::pose(c));
                camera.as_object_mut().unwrap().remove("masks");
                camera
            })
            .collect();
        v["cameras"] = cameras.into();
    });
    for c in 0..6u32 {
        for t in 0..2 {
            let pixel = |x: u32, y: u32| {
                let black = t == 0 && (y == 0 || y == HEIGHT as u32 - 1);
                image::Rgb(if black { [0, 0, 0] } else { [90 + 6 * x as u8, 60 + 7 * (y + c) as u8, 50] })
            };
            let image = ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, pixel);
            sample.save(&format!("images/cam{c:02}/{:04}.png", 5 + t), image);
        }
    }
    let part = |frames: Range<usize>, lenses: &Lenses| {
        let options = CaptureOptions { frames: vec![frames], lenses: lenses.clone(), ..CaptureOptions::default() };
        Capture::open(sample.root(), &options).unwrap()
    };
    let whole = open(sample.root(), 1);
    assert!(whole.frames.iter().all(|f| f.recorded.is_some()));
    let second = part(1..2, &Lenses::default());
    assert_eq!((second.frames.len(), &second.lenses), (6, &whole.lenses));
    assert_eq!(second.frames[0].recorded, whole.frames[0].recorded);
    // What is known is not searched for again.
    let flash = ImageBuffer::from_pixel(WIDTH as u32, HEIGHT as u32, image::Rgb([200u8; 3]));
    (0..6).for_each(|c| sample.save(&format!("images/cam{c:02}/0005.png"), flash.clone()));
    assert!(part(1..2, &Lenses::default()).frames[0].recorded.is_none());
    assert_eq!(part(1..2, &whole.lenses).frames[0].recorded, whole.frames[0].recorded);
}
