//! `import` on the bundled capture's pictures, of which nothing but the pictures is told.

use crate::sample::splat4d;
use crate::{json_of, str};
use splat4d_import::sfm::align::apart;
use splat4d_train::capture::{Capture, CaptureOptions};
use std::path::{Path, PathBuf};

/// Neighbouring cameras, and after how many frames each of them begins.
const CAMERAS: [(&str, usize); 6] =
    [("cam06", 0), ("cam07", 2), ("cam08", 1), ("cam09", 3), ("cam10", 0), ("cam11", 2)];
/// Frames that each films.
const FRAMES: usize = 14;

fn bundled() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight")
}

/// Folders of pictures, cut out of the bundled capture.
fn filmed(to: &Path) {
    for (name, begin) in CAMERAS {
        let folder = to.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for k in 0..FRAMES {
            let from = bundled().join(format!("images/{name}/{:04}.jpg", begin + k));
            std::fs::copy(from, folder.join(format!("{k:04}.jpg"))).unwrap();
        }
    }
}

#[test]
fn pictures_alone_become_a_capture_with_clocks_and_poses() {
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    filmed(&films);
    let told = splat4d(&["import", str(&films), "-o", str(&take)]).run().ok();
    assert!(told.contains("cam09") && told.contains("geometry"), "{told}");

    let report = json_of(&take.join("import/report.json"));
    let offset = |k: usize| report["cameras"][k]["offset"].as_f64().unwrap();
    for (k, (name, begin)) in CAMERAS.iter().enumerate() {
        // The same event is at a smaller time on the clock of a camera that began later.
        let off = (offset(k) - offset(0)) * 30.0 - *begin as f64;
        assert!(off.abs() < 0.2, "{name}: {off} frames off");
    }
    let open = |path: &Path| Capture::open(path, &CaptureOptions::default()).unwrap();
    let (found, truth) = (open(&take), open(&bundled()));
    assert_eq!((found.cameras.len(), found.frames.len()), (CAMERAS.len(), CAMERAS.len() * FRAMES));
    let poses = |capture: &Capture| {
        let of = |(name, _): &(&str, usize)| {
            let frame = capture.frames.iter().find(|f| capture.cameras[f.camera].name == *name).unwrap();
            frame.source.cam_from_world
        };
        CAMERAS.iter().map(of).collect::<Vec<_>>()
    };
    for (off, (name, _)) in apart(&poses(&found), &poses(&truth)).unwrap().iter().zip(&CAMERAS) {
        assert!(off.degrees < 3.0 && off.center < 0.05, "{name}: {off:?}");
    }
}

#[test]
fn what_cannot_be_imported_is_explained() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let take = at("take");
    let refused =
        |input: &Path, more: &[&str]| splat4d(&["import", str(input), "-o", str(&take)]).args(more).run().refused();
    assert!(refused(&at("nothing.mp4"), &[]).contains("nothing.mp4"));
    std::fs::create_dir(at("empty")).unwrap();
    assert!(refused(&at("empty"), &[]).contains("neither a video nor a picture"));
    std::fs::write(at("zero.mp4"), []).unwrap();
    assert!(refused(&at("zero.mp4"), &[]).contains("empty"));
    let films = at("films");
    filmed(&films);
    let one = films.join("cam06");
    assert!(refused(&one, &["--rig", "fixed"]).contains("nothing from two sides"));
    assert!(refused(&films, &["--from", "3", "--to", "2"]).contains("come after"));
    assert!(refused(&films, &["--apart", "cam06"]).contains("left,right=2.4"));
    assert!(refused(&films, &["--apart", "cam06,cam99=2"]).contains("cam99"));
    let twice = splat4d(&["import", str(&one), str(&one), "-o", str(&take)]).run().refused();
    assert!(twice.contains("the same as"), "{twice}");
    // Two cameras that see nothing in common.
    let far = at("far");
    for name in ["cam00", "cam19"] {
        std::fs::create_dir_all(far.join(name)).unwrap();
        for k in 0..4 {
            let from = bundled().join(format!("images/{name}/{k:04}.jpg"));
            std::fs::copy(from, far.join(name).join(format!("{k:04}.jpg"))).unwrap();
        }
    }
    let alone = refused(&far, &[]);
    assert!(alone.contains("30 degrees"), "{alone}");
    // Who is left out stays out.
    let path = take.join("import.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let (before, own) = text.split_once("name = \"cam19\"").unwrap();
    let own = own.replacen("use = true", "use = false", 1);
    std::fs::write(&path, format!("{before}name = \"cam19\"{own}")).unwrap();
    assert!(refused(&far, &["--rig", "fixed"]).contains("nothing from two sides"));
    // A capture that is somebody's own stays.
    let own = at("own");
    std::fs::create_dir(&own).unwrap();
    std::fs::write(own.join("capture.json"), "{}").unwrap();
    assert!(splat4d(&["import", str(&films), "-o", str(&own)]).run().refused().contains("a capture already"));
}
