use super::*;
use image::RgbImage;
use serde_json::json;

fn side(gaussians: usize, bytes: u64, psnr: f64, fps: f64) -> Side {
    Side {
        gaussians,
        bytes,
        float_bytes: 56 * gaussians as u64,
        psnr: Some(psnr),
        fps,
        raster_fps: 2.0 * fps,
        ..Side::default()
    }
}

fn told(source: &Path) -> Compressed {
    Compressed {
        source: source.to_owned(),
        level: Some(2),
        settings: json!({"prune": 0.5, "palette": 4096}),
        before: side(150_000, 9_000_000, 31.0, 40.0),
        unpruned: Some(side(150_000, 9_000_000, 31.2, 40.0)),
        plain: None,
        after: side(75_000, 400_000, 30.95, 110.0),
        stages: vec![
            Step { name: "prune".into(), seconds: 61.0, steps: 1000, gaussians: 75_000 },
            Step { name: "quantise".into(), seconds: 59.0, steps: 500, gaussians: 75_000 },
        ],
        guard: Some(Guard { loss_db: 0.25, limit_db: 0.4, passed: true }),
        tried: vec![
            Tried { prune: 0.2, bytes: 2 << 20, psnr: 31.1 },
            Tried { prune: 0.5, bytes: 1 << 20, psnr: 30.95 },
        ],
        warnings: vec!["the <orb> is thin.".into()],
        activity: [
            None,
            Some(Activity {
                times: vec![0.0, 0.5, 1.0],
                inactive: vec![0.25, 0.5, 0.75],
                overlap: vec![[0.5, 0.8], [1.0, 0.3]],
            }),
        ],
    }
}

/// A run with an image of one colour.
fn run(folder: &Path, colour: u8) {
    std::fs::write(folder.join("recipe.toml"), "").unwrap();
    let psnr = json!({"00000.png": 30.0});
    std::fs::write(folder.join("per_view.json"), json!({"ours_10": {"PSNR": psnr}}).to_string()).unwrap();
    std::fs::write(folder.join("results.json"), json!({"ours_10": {"PSNR": 30.0}}).to_string()).unwrap();
    let renders = folder.join("test/ours_10/renders");
    std::fs::create_dir_all(&renders).unwrap();
    RgbImage::from_pixel(32, 24, image::Rgb([colour; 3])).save(renders.join("00000.png")).unwrap();
}

fn page(folder: &Path) -> String {
    let mut out = String::new();
    section(&mut out, &Run::open(folder).unwrap());
    out
}

#[test]
fn the_section_shows_before_after_images_and_settings() {
    let (before, after) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    run(before.path(), 100);
    run(after.path(), 120);
    let told = told(before.path());
    let text = serde_json::to_string_pretty(&told).unwrap();
    assert_eq!(serde_json::from_str::<Compressed>(&text).unwrap(), told);
    std::fs::write(after.path().join(FILE), text).unwrap();
    assert!(!page(after.path()).contains("removed Gaussians alone"), "nothing was drawn");
    std::fs::create_dir(after.path().join(REMOVED)).unwrap();
    RgbImage::from_pixel(32, 24, image::Rgb([9; 3])).save(after.path().join(REMOVED).join("00000.png")).unwrap();
    let html = page(after.path());
    for text in [
        "level 2",
        "not pruned, same steps",
        "-0.25",
        "2.75x",
        "21.0x less than the source",
        "2.0x less",
        "within the limit of 0.40 dB",
        "&lt;orb&gt;",
        "together",
        "1,500",
        "2:00",
        "50 % pruned",
        "palette = 4096",
        "Inactive Gaussians by frame",
    ] {
        assert!(html.contains(text), "{text} is missing in {html}");
    }
    assert!(!html.contains("plain file") && !html.contains("flicker"), "what was not measured is not there");
    assert_eq!(html.matches("data:image/jpeg;base64,").count(), 4, "before, compressed, difference, removed");
    assert!(!html.contains("NaN") && !html.contains("inf"));
    let whole = std::fs::read_to_string(super::super::write(&Run::open(after.path()).unwrap()).unwrap()).unwrap();
    for text in [
        "Compressed to 390.6 KiB, 21.0 times smaller than 32-bit floats. Held-out views: 30.95 dB PSNR, -0.05 dB",
        "<b>390.6<small>KiB</small></b><span>compressed file",
        "splat4d compress ",
    ] {
        assert!(whole.contains(text), "{text} is missing in the page");
    }
    assert!(!whole.contains("splat4d train "), "the source's training does not reproduce it");
}

#[test]
fn compressed_files_are_compared_with_plain_ones() {
    let mut told = told(Path::new("source"));
    told.plain = Some(side(150_000, 1_000_000, 31.0, 40.0));
    assert!(verdict(&told).contains("2.5 times smaller than the plain file"), "{}", verdict(&told));
    told.guard = Some(Guard { loss_db: -0.22, limit_db: 0.5, passed: true });
    let mut out = String::new();
    guard(&mut out, &told);
    assert!(out.contains("0.22 dB gained"), "{out}");
}

#[test]
fn missing_or_odd_values_do_not_fail_the_page() {
    let folder = tempfile::tempdir().unwrap();
    run(folder.path(), 90);
    assert_eq!(page(folder.path()), "", "a run that was not compressed");
    std::fs::write(folder.path().join(FILE), "{}").unwrap();
    let html = page(folder.path());
    assert!(html.contains("<table class=\"numbers\">") && !html.contains("NaN") && !html.contains("Stages"), "{html}");
    std::fs::write(folder.path().join(FILE), "{\"after\": 3}").unwrap();
    assert!(page(folder.path()).contains("written by another version"));
    std::fs::write(folder.path().join(FILE), "{\"after\":").unwrap();
    assert!(Run::open(folder.path()).unwrap_err().to_string().contains(FILE));
}

#[test]
fn the_guard_warns_where_too_much_is_lost() {
    let failed = Guard { loss_db: 0.7, limit_db: 0.4, passed: false };
    let mut out = String::new();
    guard(&mut out, &Compressed { guard: Some(failed), ..Compressed::default() });
    assert!(out.contains("class=\"warn\"") && out.contains("more than the limit of 0.40 dB"), "{out}");
}

#[test]
fn the_report_lists_bytes_by_part() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight.s4d");
    let chart = parts(&file).unwrap();
    for part in ["Gaussians", "palette", "poster", "index"] {
        assert!(chart.contains(part), "{part}");
    }
    assert!(parts(Path::new("nothing")).is_none());
}
