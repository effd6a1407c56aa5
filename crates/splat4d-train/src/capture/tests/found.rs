//! Captures that others left half way: dialects of text files, workspaces, images elsewhere or in other formats, what is listed
//! twice, intrinsics of other images. They are read, or the message names the file and what to do.

use super::super::*;
use super::samples::{self, HEIGHT, Sample, WIDTH};
use serde_json::json;

fn open(sample: &Sample) -> Capture {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn refuse(path: &Path) -> String {
    Capture::open(path, &CaptureOptions::default()).err().map_or_else(String::new, |e| e.to_string())
}

fn assert_has(text: &str, parts: &[&str]) {
    assert!(parts.iter().all(|part| text.contains(part)), "{parts:?} must be in {text}");
}

fn assert_warns(capture: &Capture, parts: &[&str]) {
    let found = capture.warnings.iter().any(|w| parts.iter().all(|part| w.contains(part)));
    assert!(found, "{parts:?} must be in {:?}", capture.warnings);
}

fn assert_notes(capture: &Capture, parts: &[&str]) {
    let found = capture.notes.iter().any(|n| parts.iter().all(|part| n.contains(part)));
    assert!(found, "{parts:?} must be in {:?}", capture.notes);
}

/// Photos with a COLMAP model and no transforms.json.
fn colmap() -> Sample {
    let sample = photos();
    std::fs::remove_file(sample.path("transforms.json")).unwrap();
    sample
}

fn photos() -> Sample {
    samples::photos(6, |c| format!("IMG {c}.png"), Some(&splat4d::math::Sim3::default()))
}

fn change(sample: &Sample, name: &str, change: impl Fn(&str) -> String) {
    let text = std::fs::read_to_string(sample.path(name)).unwrap();
    sample.write(name, change(&text).as_bytes());
}

fn rename(sample: &Sample, from: &str, to: &str) {
    std::fs::create_dir_all(sample.path(to).parent().unwrap()).unwrap();
    std::fs::rename(sample.path(from), sample.path(to)).unwrap();
}

/// The images of every frame are there.
fn assert_found(capture: &Capture, count: usize) {
    assert_eq!(capture.frames.len(), count);
    assert!(capture.frames.iter().all(|f| f.image.is_file()));
}

#[test]
fn dialects_of_model_texts_are_read() {
    const FILES: [&str; 3] = ["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"];
    let spaced = |separator: &'static str| {
        move |text: &str| {
            let line = |line: &str| {
                let words: Vec<&str> = line.split_ascii_whitespace().collect();
                // The name of an image holds a space, which stays.
                match words.split_last().filter(|(last, _)| last.ends_with(".png")) {
                    Some((last, front)) => {
                        format!("  {} {last}   ", front.join(separator).replace(&format!("{separator}IMG"), " IMG"))
                    }
                    None => words.join(separator),
                }
            };
            text.lines().map(|l| line(l) + "\r\n# a comment\r\n").collect()
        }
    };
    for separator in ["  ", "\t", " \t "] {
        let sample = colmap();
        FILES.iter().for_each(|file| change(&sample, file, spaced(separator)));
        assert_found(&open(&sample), 6);
    }
    // Cameras that no image uses may be of any model.
    let sample = colmap();
    change(&sample, FILES[0], |text| format!("{text}\n77 NEWER_MODEL 24 16 1\n78 PINHOLE 24 16 0 0 0 0\n"));
    assert_found(&open(&sample), 6);
    change(&sample, FILES[0], |text| text.replace("PINHOLE", "NEWER_MODEL"));
    assert_has(&refuse(sample.root()), &["NEWER_MODEL", "image_undistorter"]);
    // What macOS leaves on foreign disks.
    let sample = colmap();
    for name in ["images/._IMG 0.png", "sparse/0/._images.txt", "._sparse", "masks/._IMG 0.png"] {
        sample.write(name, b"\0\x05\x16\x07");
    }
    let capture = open(&sample);
    assert!(capture.warnings.is_empty() && capture.frames.len() == 6, "{:?}", capture.warnings);
    // Names of files in another letter case, and a model's file as the path.
    let sample = colmap();
    rename(&sample, FILES[0], "sparse/0/Cameras.TXT");
    rename(&sample, "sparse", "Sparse");
    assert_found(&open(&sample), 6);
    let capture = Capture::open(&sample.path("Sparse/0/images.txt"), &CaptureOptions::default()).unwrap();
    assert_found(&capture, 6);
}

#[test]
fn workspaces_of_colmap_are_read_and_named() {
    let sample = colmap();
    rename(&sample, "sparse/0", "dense/0/sparse");
    std::fs::remove_dir(sample.path("sparse")).unwrap();
    rename(&sample, "images", "dense/0/images");
    let capture = open(&sample);
    assert_found(&capture, 6);
    assert_notes(&capture, &["dense/0/sparse is read"]);
    // The model next to it has no images: the workspace's go first.
    std::fs::create_dir_all(sample.path("sparse/0")).unwrap();
    for name in ["cameras.txt", "images.txt"] {
        std::fs::copy(sample.path("dense/0/sparse").join(name), sample.path("sparse/0").join(name)).unwrap();
    }
    assert_found(&open(&sample), 6);
    // What the converter of 3DGS leaves: the undistorted model goes first, and the other one is named.
    let sample = colmap();
    for name in ["cameras.txt", "images.txt"] {
        let text = std::fs::read(sample.path("sparse/0").join(name)).unwrap();
        sample.write(&format!("distorted/sparse/0/{name}"), &text);
    }
    let capture = open(&sample);
    assert_notes(&capture, &["in sparse is read", "Not read: distorted/sparse"]);
    assert!(capture.warnings.is_empty(), "{:?}", capture.warnings);
    std::fs::remove_dir_all(sample.path("sparse")).unwrap();
    assert_notes(&open(&sample), &["distorted/sparse is read"]);
}

#[test]
fn models_in_folders_of_other_names_are_read() {
    let sample = colmap();
    rename(&sample, "sparse/0", "sparse/geo");
    assert_found(&open(&sample), 6);
    // Several: the one with most images, and both are named.
    for name in ["cameras.txt", "images.txt"] {
        let text = std::fs::read(sample.path("sparse/geo").join(name)).unwrap();
        sample.write(&format!("sparse/small/{name}"), &text);
    }
    let capture = open(&sample);
    assert_found(&capture, 6);
    assert!(capture.warnings.iter().any(|w| w.contains("There are 2 separate models")), "{:?}", capture.warnings);
    std::fs::remove_dir_all(sample.path("sparse/small")).unwrap();
    // A folder of results next to the images.
    rename(&sample, "sparse", "output/sparse");
    assert_found(&Capture::open(&sample.path("output"), &CaptureOptions::default()).unwrap(), 6);
}

#[test]
fn projects_of_other_programs_are_named_with_the_way_out() {
    let sample = photos();
    for name in ["transforms.json", "points.ply"] {
        let _ = std::fs::remove_file(sample.path(name));
    }
    std::fs::remove_dir_all(sample.path("sparse")).unwrap();
    for (name, text, what) in [
        ("room.psx", "<document/>", "project of Metashape: export its cameras"),
        ("room.rcproj", "x", "project of RealityCapture: export the registration"),
        ("model.nvm", "NVM_V3", "VisualSFM: export the cameras as COLMAP"),
        ("blocks.xml", "<?xml version=\"1.0\"?><BlocksExchange/>", "BlocksExchange, which is not read"),
        ("list.txt", "a.jpg 1 2 3 4 5 6\n", "table of images with numbers"),
        ("bundle.out", "# Bundle", "Bundler reconstructions"),
    ] {
        sample.write(name, text.as_bytes());
        assert_has(&refuse(sample.root()), &[name, what]);
        std::fs::remove_file(sample.path(name)).unwrap();
    }
    // What is there is named, and the message is short.
    std::fs::remove_dir_all(sample.path("images")).unwrap();
    sample.write("notes/a.md", b"x");
    let text = refuse(sample.root());
    assert_has(&text, &["It holds", "notes", "transforms.json"]);
    assert!(text.len() < 500, "{text}");
}

#[test]
fn a_folder_near_a_capture_names_the_capture() {
    let sample = photos();
    assert_has(&refuse(&sample.path("images")), &["The folder that holds it is a capture"]);
    rename(&sample, "transforms.json", "transforms_all.json");
    std::fs::remove_dir_all(sample.path("sparse")).unwrap();
    assert_has(&refuse(sample.root()), &["transforms_all.json has poses"]);
    let named = Capture::open(&sample.path("transforms_all.json"), &CaptureOptions::default()).unwrap();
    assert_found(&named, 6);
    rename(&sample, "transforms_all.json", "scene/Transforms.JSON");
    assert_has(&refuse(sample.root()), &["A folder in it is a capture", "scene"]);
    std::fs::remove_dir_all(sample.path("scene")).unwrap();
    assert_has(&refuse(sample.root()), &["images, but no camera poses", "splat4d import"]);
    sample.write("database.db", b"SQLite format 3\0");
    assert_has(&refuse(sample.root()), &["database.db holds no poses", "colmap mapper"]);
    sample.write("cameras.json", b"[]");
    assert_has(&refuse(sample.root()), &["3DGS output"]);
    sample.write("take.r3d", b"PK");
    assert_has(&refuse(&sample.path("take.r3d")), &["archive", "Unpack"]);
    std::fs::remove_file(sample.path("take.r3d")).unwrap();
    sample.write("room.zip", b"PK");
    assert_has(&refuse(sample.root()), &["room.zip is an archive", "unpack"]);
}

#[test]
fn names_with_codes_and_folders_of_elsewhere_are_found() {
    let spellings: [&dyn Fn(&str) -> String; 7] = [
        &|n| n.replace(' ', "%20"),
        &|n| format!("file:///home/x/{}", n.replace(' ', "%20")),
        &|n| format!(" {n} "),
        &|n| format!("a/b/{n}"),
        &|n| format!("../other/{n}"),
        &|n| format!("~/{n}"),
        &|n| format!("\\\\nas\\share\\{}", n.replace('/', "\\")),
    ];
    for spell in spellings {
        let sample = photos();
        sample.edit("transforms.json", |v| {
            for frame in v["frames"].as_array_mut().unwrap() {
                frame["file_path"] = json!(spell(frame["file_path"].as_str().unwrap()));
            }
        });
        let capture = open(&sample);
        assert_found(&capture, 6);
        assert_notes(&capture, &["6 names differ from their files"]);
    }
    // A folder that is there is no leading folder: its image is missing, and that of another folder is not taken.
    let sample = photos();
    sample.rgb("left/other.png", 0, 0);
    sample.edit("transforms.json", |v| v["frames"][1]["file_path"] = json!("left/IMG 1.png"));
    assert_warns(&open(&sample), &["1 of 6 images are missing", "left/IMG 1.png"]);
    // Folders that names do not have.
    let sample = colmap();
    rename(&sample, "images", "x");
    rename(&sample, "x", "images/images");
    assert_found(&open(&sample), 6);
    let sample = colmap();
    for c in 0..6 {
        rename(&sample, &format!("images/IMG {c}.png"), &format!("images/{}/IMG {c}.png", ["a", "b"][c % 2]));
    }
    assert_found(&open(&sample), 6);
    // One name in two folders is ambiguous, and no guess is made.
    sample.rgb("images/b/IMG 0.png", 0, 0);
    assert_has(&refuse(sample.root()), &["6 of 6 images are missing"]);
}

#[test]
fn images_without_a_mark_of_their_format_are_named_by_their_ending() {
    let sample = Sample::new(&["transforms.json"]);
    let frames: Vec<_> = (0..3)
        .map(|c| {
            sample.write(&format!("images/{c}.tga"), &[0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 24, 0, 16, 0, 24, 0]);
            json!({"file_path": format!("images/{c}.tga"), "transform_matrix": samples::opengl(c)})
        })
        .collect();
    let top = json!({"w": 24, "h": 16, "fl_x": 20, "fl_y": 20, "cx": 12, "cy": 8, "frames": frames});
    sample.write("transforms.json", top.to_string().as_bytes());
    assert_has(&refuse(sample.root()), &["TGA", "Convert"]);
}

#[test]
fn unreadable_images_are_named_by_their_format() {
    let heads: [(&[u8], &[&str]); 8] = [
        (b"\0\0\0\x18ftypheic\0\0\0\0", &["HEIC", "Convert"]),
        (b"\0\0\0\x18ftypavif\0\0\0\0", &["AVIF", "Convert"]),
        (b"II*\0\x08\0\0\0", &["TIFF", "Convert"]),
        (b"BM\x36\0\0\0", &["BMP", "Convert"]),
        (b"P6\n8 8\n255\n", &["PNM", "Convert"]),
        (b"", &["is empty", "write it again"]),
        (b"version https://git-lfs.github.com/spec/v1\n", &["Git LFS", "git lfs pull"]),
        (b"<!DOCTYPE html>", &["web page", "Download"]),
    ];
    for (head, parts) in heads {
        let sample = colmap();
        sample.write("images/IMG 3.png", head);
        let message = refuse(sample.root());
        assert_has(&message, parts);
        assert_has(&message, &["IMG 3.png"]);
    }
    // The images are there in a format that is not read.
    let sample = colmap();
    (0..6).for_each(|c| rename(&sample, &format!("images/IMG {c}.png"), &format!("images/IMG {c}.tiff")));
    assert_has(&refuse(sample.root()), &["6 of 6 images are missing", "IMG 0.tiff is there instead", "convert"]);
}

#[test]
fn images_that_are_cut_short_are_found_by_their_ends() {
    let sample = colmap();
    let whole = std::fs::read(sample.path("images/IMG 2.png")).unwrap();
    sample.write("images/IMG 2.png", &whole[..whole.len() - 20]);
    assert_has(&refuse(sample.root()), &["IMG 2.png", "truncated"]);
    // Something after the end is no harm.
    sample.write("images/IMG 2.png", &[&whole[..], &[0; 6000]].concat());
    assert_found(&open(&sample), 6);
    let jpeg = |bytes: &[u8]| sample.write("images/IMG 2.png", bytes);
    let mut bytes = Vec::new();
    let pixels = image::ImageBuffer::from_fn(WIDTH as u32, HEIGHT as u32, |x, y| image::Rgb([x as u8, y as u8, 9]));
    pixels.write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg).unwrap();
    jpeg(&bytes);
    assert_found(&open(&sample), 6);
    jpeg(&bytes[..bytes.len() - 30]);
    assert_has(&refuse(sample.root()), &["IMG 2.png", "end-of-image"]);
}

#[test]
fn frames_that_are_listed_twice_are_read_once() {
    let sample = photos();
    sample.edit("transforms.json", |v| {
        let again = v["frames"][2].clone();
        v["frames"].as_array_mut().unwrap().push(again);
    });
    let capture = open(&sample);
    assert_found(&capture, 6);
    assert_warns(&capture, &["1 of 7 frames are listed twice", "IMG 2.png"]);
    assert!(!capture.warnings.iter().any(|w| w.contains("without any frame")), "{:?}", capture.warnings);
}

#[test]
fn intrinsics_of_other_images_are_named() {
    let set = |key: &'static str, value: f64| {
        let sample = photos();
        sample.edit("transforms.json", |v| {
            v[key] = json!(value);
            v["frames"].as_array_mut().unwrap().iter_mut().for_each(|f| drop(f.as_object_mut().unwrap().remove(key)));
        });
        open(&sample)
    };
    assert_warns(&set("cx", 48.0), &["6 of 6 images", "principal point (48.0", "24x16"]);
    for focal in [0.7, 2.0] {
        assert_warns(&set("fl_x", focal), &["field of view"]);
    }
    assert_warns(&set("k1", 80.0), &["lens moves the middle of a side"]);
    for (key, value) in [("cx", 12.5), ("fl_x", 22.0), ("k1", -0.1)] {
        assert!(set(key, value).warnings.is_empty(), "{key}");
    }
}

#[test]
fn panoptic_lists_that_names_do_not_follow_are_named() {
    let sample = samples::panoptic();
    let backwards = |found: &Capture| found.warnings.iter().any(|w| w.contains("order of the lists"));
    assert!(!backwards(&open(&sample)));
    for file in ["train_meta.json", "test_meta.json"] {
        sample.edit(file, |v| {
            ["k", "w2c", "fn", "cam_id"].iter().for_each(|key| v[*key].as_array_mut().unwrap().reverse());
        });
    }
    assert!(backwards(&open(&sample)));
}

#[test]
fn keys_that_are_like_others_are_named() {
    for (key, meant) in [
        ("K1", "k1"),
        ("Depth_File_Path", "depth_file_path"),
        ("mask", "mask_path"),
        ("frame_rate", "fps"),
        ("timestamp", "time"),
        ("timestep_index", "time"),
    ] {
        let sample = photos();
        sample.edit("transforms.json", |v| v["frames"][0][key] = json!(0.1));
        assert_warns(&open(&sample), &[key, &format!("meant {meant}?")]);
    }
    let sample = photos();
    sample.edit("transforms.json", |v| {
        let frame = v["frames"][3].as_object_mut().unwrap();
        let matrix = frame.remove("transform_matrix").unwrap();
        frame.insert("Transform".into(), matrix);
    });
    assert_has(&refuse(sample.root()), &["frames[3]", "\"transform_matrix\" is missing", "Transform"]);
}

#[test]
fn fixed_cameras_that_number_their_frames_apart_are_matched_by_order() {
    let sample = Sample::new(&[]);
    let mut text = String::new();
    for (c, t) in (0..3).flat_map(|c| (0..4).map(move |t| (c, t))) {
        let name = format!("side{c}/frame_{:04}.png", 1000 * c + t);
        sample.rgb(&format!("images/{name}"), c, t);
        let p = samples::pose(c);
        let q = splat4d::math::quat::from_rotation(&p.rotation);
        let [x, y, z] = p.translation;
        text += &format!("{} {} {} {} {} {x} {y} {z} 1 {name}\n\n", 4 * c + t + 1, q[0], q[1], q[2], q[3]);
    }
    sample.write("sparse/0/images.txt", text.as_bytes());
    sample.write("sparse/0/cameras.txt", b"1 PINHOLE 24 16 20 20 12 8\n");
    let capture = open(&sample);
    assert_eq!((capture.frames.len(), capture.time_range()), (12, (0.0, 0.1)));
    assert_warns(&capture, &["numbers of their own", "matched by their order"]);
}

#[test]
fn masks_under_other_names_and_of_other_shapes_are_named() {
    let sample = colmap();
    (0..6).for_each(|c| sample.mask(&format!("sam_masks/IMG {c}.png"), |_, _| 255));
    assert_warns(&open(&sample), &["sam_masks/ are named like the images", "call the folder masks"]);
    let sample = colmap();
    let square = image::ImageBuffer::from_pixel(16, 16, image::Luma([255u8]));
    (0..6).for_each(|c| sample.save(&format!("masks/IMG {c}.png"), square.clone()));
    assert_has(&refuse(sample.root()), &["mask is 16x16", "24x16"]);
}

#[test]
fn images_of_one_name_and_two_endings_are_read_once() {
    for (sample, folder) in [(samples::n3dv(), "cam01/images"), (colmap(), "images")] {
        let before = open(&sample);
        let names: Vec<_> = std::fs::read_dir(sample.path(folder)).unwrap().map(|e| e.unwrap().path()).collect();
        let twin = |path: &PathBuf| path.with_extension("jpg");
        names.iter().for_each(|path| image::open(path).unwrap().into_rgb8().save(twin(path)).unwrap());
        let after = open(&sample);
        let read = |capture: &Capture| capture.frames.iter().map(|f| (f.image.clone(), f.index)).collect::<Vec<_>>();
        assert_eq!(read(&after), read(&before));
        let told: Vec<&str> = after.account.iter().map(|r| r.what.as_str()).filter(|w| w.contains("ending")).collect();
        assert_eq!(told.len(), 1, "{:?}", after.account);
        assert_has(told[0], &[&format!("{} images", names.len()), ".png is read"]);
    }
    // The size decides which is meant, and nothing here states it.
    let sample = samples::n3dv();
    image::RgbImage::new(6, 4).save(sample.path("cam01/images/0000.jpg")).unwrap();
    assert_has(&refuse(sample.root()), &["0000.jpg", "another size (6x4, here 24x16)", "Remove"]);
}

#[test]
fn masks_of_other_numbers_than_their_images_are_warned_of() {
    let sample = samples::photos(6, |c| format!("{c:04}.png"), None);
    (0..6).for_each(|c| sample.mask(&format!("masks/{:04}.png", c + 1), |_, _| 255));
    assert_warns(&open(&sample), &["1 of 6 images have none (images/0000.png)", "(0006.png)", "one frame off"]);
    std::fs::remove_file(sample.path("masks/0006.png")).unwrap();
    assert!(!open(&sample).warnings.iter().any(|w| w.contains("one frame off")));
}

#[test]
fn images_that_are_all_reduced_alike_are_noted_and_others_warned_of() {
    let sample = photos();
    let larger = |v: &mut serde_json::Value, by: f64| {
        for (key, value) in [("w", 24.0), ("h", 16.0), ("fl_x", 20.0), ("fl_y", 20.0), ("cx", 12.0), ("cy", 8.0)] {
            v[key] = json!((by * value).round());
        }
    };
    // Rounded: 16 is 51.8 divided by 3.24.
    sample.edit("transforms.json", |v| larger(v, 3.24));
    let capture = open(&sample);
    assert_notes(&capture, &["6 images are of another size"]);
    assert!(!capture.warnings.iter().any(|w| w.contains("another size")));
    sample.edit("transforms.json", |v| larger(&mut v["frames"][2], 1.0));
    assert_warns(&open(&sample), &["5 images are of another size"]);
}

#[test]
fn comments_in_json_and_links_that_lead_nowhere_are_named() {
    let sample = photos();
    change(&sample, "transforms.json", |text| format!("// poses of the garden\n{text}"));
    assert_has(&refuse(sample.root()), &["JSON has no comments"]);
    #[cfg(unix)]
    {
        let sample = colmap();
        std::fs::remove_dir_all(sample.path("images")).unwrap();
        std::os::unix::fs::symlink("/nowhere/photos", sample.path("images")).unwrap();
        assert_has(&refuse(sample.root()), &["6 of 6 images are missing", "is a link to /nowhere/photos"]);
    }
}

#[test]
fn images_whose_camera_file_is_missing_are_left_out() {
    let sample = samples::nerfies();
    std::fs::remove_file(sample.path("camera/000001.json")).unwrap();
    assert_has(&refuse(sample.root()), &["1 of 4 camera files are missing: 000001.json", "dataset.json"]);
    let options = CaptureOptions { max_missing: 0.3, ..CaptureOptions::default() };
    let capture = Capture::open(sample.root(), &options).unwrap();
    assert_warns(&capture, &["1 of 4 camera files", "left out"]);
    assert_eq!(capture.frames.len(), 3);
}

#[test]
fn times_that_contradict_the_path_of_a_camera_are_warned_of() {
    let timed = |time: &dyn Fn(usize) -> usize| {
        let sample = samples::photos(14, |c| format!("{c:04}.png"), None);
        sample.edit("transforms.json", |v| {
            for c in 0..14 {
                // A straight walk.
                let matrix = json!([[1, 0, 0, 0.1 * c as f64], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
                v["frames"][c]["transform_matrix"] = matrix;
                v["frames"][c]["time"] = json!(0.1 * time(c) as f64);
            }
        });
        open(&sample).preflight().into_iter().any(|f| f.what.contains("probably in disorder"))
    };
    assert!(timed(&|c| 5 * c % 14) && !timed(&|c| c) && !timed(&|c| 13 - c));
}

#[test]
fn a_capture_two_folders_below_is_named() {
    let sample = samples::photos(6, |c| format!("{c}.png"), None);
    for name in ["images", "transforms.json"] {
        rename(&sample, name, &format!("scene/scene/{name}"));
    }
    assert_has(&refuse(sample.root()), &["A folder in it is a capture", "scene/scene"]);
    // The list of cameras of a calibration next to videos is no output of 3DGS.
    let sample = Sample::new(&[]);
    sample.write("cameras.json", br#"{"cameras": []}"#);
    sample.write("videos/cam01.mp4", b"x");
    assert_has(&refuse(sample.root()), &["It holds videos", "splat4d import"]);
    sample.write("cameras.json", br#" [{"id": 0, "img_name": "a"}]"#);
    assert_has(&refuse(sample.root()), &["3DGS output"]);
}

#[test]
fn images_in_two_split_lists_are_counted() {
    let sample = photos();
    let names: Vec<String> = (0..6).map(|c| format!("images/IMG {c}.png")).collect();
    sample.edit("transforms.json", |v| {
        v["train_filenames"] = json!(names);
        v["test_filenames"] = json!(names[..2]);
    });
    let capture = open(&sample);
    assert_notes(&capture, &["2 of 6 images are in several split lists"]);
    assert_eq!((capture.train.len(), capture.held.len()), (4, 2));
}
