//! Point tracks on disk.

use super::bad_input::assert_says;
use super::samples::{self, HEIGHT, Sample, WIDTH};
use crate::capture::{Capture, CaptureOptions};
use serde_json::json;
use splat4d::format::npy;

fn sample(text: &str) -> Sample {
    let sample = samples::own();
    sample.write("tracks.csv", text.as_bytes());
    sample.edit("capture.json", |v| v["cameras"][1]["tracks"] = json!("tracks.csv"));
    sample
}

fn open(sample: &Sample) -> splat4d::Result<Capture> {
    Capture::open(sample.root(), &CaptureOptions::default())
}

/// A .npz of these arrays, stored.
fn npz(arrays: &[(&str, &[usize], Vec<f32>)]) -> Vec<u8> {
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, shape, values) in arrays {
        let mut body = Vec::new();
        npy::write_f32(shape, values, &mut body).unwrap();
        let name = format!("{name}.npy");
        let start = out.len() as u32;
        let size = (body.len() as u32).to_le_bytes();
        let crc = crc32(&body).to_le_bytes();
        let common =
            [&[20, 0, 0, 0, 0, 0, 0, 0, 0, 0][..], &crc, &size, &size, &(name.len() as u16).to_le_bytes(), &[0, 0]];
        out.extend([&b"PK\x03\x04"[..], &common.concat(), name.as_bytes(), &body].concat());
        let rest = [&[0; 10][..], &start.to_le_bytes(), name.as_bytes()].concat();
        directory.extend([&b"PK\x01\x02\x14\x00"[..], &common.concat(), &rest].concat());
    }
    let (count, at) = ((arrays.len() as u16).to_le_bytes(), (out.len() as u32).to_le_bytes());
    let size = (directory.len() as u32).to_le_bytes();
    [out, directory, [&b"PK\x05\x06\0\0\0\0"[..], &count, &count, &size, &at, &[0, 0]].concat()].concat()
}

fn crc32(bytes: &[u8]) -> u32 {
    let step = |c: u32, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 };
    !bytes.iter().fold(!0, |c, b| (0..8).fold(c ^ u32::from(*b), step))
}

#[test]
fn tables_and_arrays_give_the_same_tracks() {
    let sample = sample("point, frame, x, y, visible\n7,0,3.5,4,1\n7,1,5,6.25,1\n2,1,9,9,0\n2,0,1,1,1\n");
    let capture = open(&sample).unwrap();
    assert!(capture.frames.iter().enumerate().all(|(i, f)| f.tracks.is_some() == [2, 3].contains(&i)));
    let tracks = capture.frames[2].tracks.clone().unwrap();
    assert_eq!(tracks.pairs(0, 1).collect::<Vec<_>>(), [[[3.5, 4.0], [5.0, 6.25]]], "2 is not visible in frame 1");
    assert!(tracks.shares(0, 1) && !tracks.shares(0, 0) && !tracks.shares(0, 9));
    let view = &capture.frames[2].view.downscaled(2);
    let place = tracks.in_view([3.5, 4.0], &capture.frames[2].source, view).unwrap();
    assert!((place[0] - 1.75).abs() < 1e-9 && (place[1] - 2.0).abs() < 1e-9);
    let places = vec![1.0, 1.0, 3.5, 4.0, 99.0, 99.0, 5.0, 6.25];
    let arrays = npz(&[("tracks", &[2, 2, 2], places), ("visibility", &[2, 2], vec![1.0, 1.0, 0.0, 1.0])]);
    sample.write("tracks.npz", &arrays);
    sample.edit("capture.json", |v| v["cameras"][1]["tracks"] = json!("tracks.npz"));
    let other = open(&sample).unwrap().frames[2].tracks.clone().unwrap();
    assert_eq!(other.pairs(0, 1).collect::<Vec<_>>(), tracks.pairs(0, 1).collect::<Vec<_>>());
    let message = |arrays: Vec<u8>| {
        sample.write("tracks.npz", &arrays);
        open(&sample).unwrap_err().to_string()
    };
    assert_says(&message(npz(&[("xy", &[1], vec![0.0])])), &["cam01", "tracks.npz", "no array `tracks`", "xy"]);
    let wrong = npz(&[("tracks", &[2, 1, 2], vec![0.0; 4]), ("visibility", &[1, 2], vec![1.0; 2])]);
    assert_says(&message(wrong), &["tracks.npz", "visibility is [1, 2]", "[2, 1, 2]"]);
    let wrong = npz(&[("tracks", &[1, 1, 2], vec![f32::NAN; 2]), ("visibility", &[1, 1], vec![1.0])]);
    assert_says(&message(wrong), &["tracks.npz", "point 0, frame 0", "not finite"]);
}

#[test]
fn wrong_tracks_are_refused_by_point_and_frame() {
    let message = |text: &str| open(&sample(text)).unwrap_err().to_string();
    let head = "point,frame,x,y\n";
    let out = format!("({}, 4), outside of the {WIDTH}x{HEIGHT} image", WIDTH + 1);
    let rows = format!("{head}3,1,{},4\n", WIDTH + 1);
    assert_says(&message(&rows), &["cam01", "tracks.csv", "point 3, frame 1", &out]);
    assert_says(&message(&format!("{head}3,1,nan,4\n")), &["line 2", "\"nan\" is no x"]);
    assert_says(&message(&format!("{head}3,2,1,4\n")), &["point 3, frame 2", "the camera has 2"]);
    assert_says(&message(&format!("{head}3,1,1\n")), &["line 2", "3 fields, not 4"]);
    assert_says(&message(&format!("{head}-3,1,1,1\n")), &["line 2", "\"-3\" is no point"]);
    assert_says(&message(&format!("{head}3,1,1,1\n3,1,2,2\n")), &["point 3 is given twice in frame 1"]);
    assert_says(&message("point,frame,x,y,visible\n3,1,1,1,2\n"), &["line 2", "visible is \"2\", not 0 or 1"]);
    assert_says(&message(head), &["tracks.csv", "no point is ever visible"]);
    assert_says(&message("id,t,x,y\n1,1,1,1\n"), &["first line is", "point,frame,x,y"]);
    assert_says(&message(""), &["tracks.csv", "point,frame,x,y"]);
}
