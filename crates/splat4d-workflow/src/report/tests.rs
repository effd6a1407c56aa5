use super::*;
use image::RgbImage;
use serde_json::json;
use std::path::Path;

fn fill(run: &Path) {
    let write = |name: &str, text: &str| std::fs::write(run.join(name), text).unwrap();
    write("recipe.toml", "motion = \"spacetime\"\nseed = 3\n");
    write(
        "run.json",
        &json!({"capture": "examples/<knight>", "capture_name": "knight", "version": "0.1.0", "simd": "avx2", "threads": 2,
                "seconds": 181.0, "gaussians": 30000, "peak_memory": 700u64 << 20, "iteration": 6000,
                "notes": ["camera 3 is <odd>."]})
        .to_string(),
    );
    let mut csv = String::from("iteration,stage,loss,l1,ssim,psnr,gaussians,seconds,motion_ms,render_ms,other_ms\n");
    for i in 1..=600 {
        let (x, loss) = (i * 10, 0.2 / (1.0 + i as f64 * 0.05) + 0.01 * (i as f64).sin().abs());
        csv += &format!("{x},train,{loss},0.1,0.8,{},{},1.0,1.5,8.5,0.3\n", 32.0 - 100.0 * loss, 10_000 + 33 * i);
    }
    write("metrics.csv", &csv);
    let files: Vec<String> = (0..24).map(|i| format!("{i:05}.png")).collect();
    let map = |f: &dyn Fn(usize) -> Value| -> Value { (0..24).map(|i| (files[i].clone(), f(i))).collect() };
    let psnr = map(&|i| json!(30.0 + (i % 7) as f64 * 0.3 + (i / 12) as f64));
    let camera = map(&|i| json!(format!("cam{:02}", i / 12)));
    let corrected = map(&|i| json!(33.0 + (i / 12) as f64));
    let time = map(&|i| json!((i % 12) as f64 / 30.0));
    write(
        "per_view.json",
        &json!({"ours_6000": {"PSNR": psnr, "PSNR-cc": corrected, "camera": camera, "time": time}}).to_string(),
    );
    let mut ours = json!({"PSNR": 31.25, "PSNR-cc": 33.75, "SSIM": 0.952, "PSNR-dynamic": 26.1, "flicker": 1.2});
    let told = |background: f64| json!({"split": "test", "background": vec![background; 3], "step": 6000, "simd": "avx2", "device": "CPU"});
    ours["conditions"] = told(1.0);
    let black = json!({"ours_4000": {}, "ours_6000": {"PSNR": 32.5, "conditions": told(0.0)}});
    let all = json!({"ours_6000": ours, "still": {"PSNR-dynamic": 18.6}, "test-black": black});
    write("results.json", &all.to_string());
    for kind in ["renders", "gt", "errors"] {
        let folder = run.join("test/ours_6000").join(kind);
        std::fs::create_dir_all(&folder).unwrap();
        for file in &files {
            RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8 * 3, y as u8 * 4, 90]))
                .save(folder.join(file))
                .unwrap();
        }
    }
}

#[test]
fn the_report_is_complete_and_self_contained() {
    let folder = tempfile::tempdir().unwrap();
    fill(folder.path());
    let path = write(&Run::open(folder.path()).unwrap()).unwrap();
    let html = std::fs::read_to_string(path).unwrap();
    for text in [
        "31.25",
        "33.75",
        "dB (34.00)",
        "26.10",
        "+7.50",
        "cam01",
        "&lt;odd&gt;",
        "all settings",
        "avx2",
        "3:01",
        "30,000",
        "26.10 dB, 7.50 dB better than a static scene",
        "<a href=\"test/ours_6000/renders/00000.png\">",
        "LPIPS was not",
        "<td>test</td><td>white</td><td>6,000</td><td>31.25</td><td>33.75</td>",
        "<td>black</td><td>6,000</td><td>32.50</td>",
    ] {
        assert!(html.contains(text), "{text} is missing");
    }
    assert_eq!(html.matches("data:image/jpeg;base64,").count(), 3 * VIEWS);
    assert_eq!(html.matches("<svg").count(), 6);
    // PSNR is 30 + 0.3 (i mod 7), one dB more for the second camera, whose first views are numbers 12 to 23.
    let place = |text: &str| html.find(text).unwrap_or_else(|| panic!("{text} is missing"));
    let shown = ["renders/00000.png", "renders/00014.png", "renders/00007.png", "renders/00021.png"].map(place);
    assert!(shown.is_sorted(), "the worst of each camera first: {shown:?}");
    for outside in ["http://", "https://", "<script", "NaN", "<odd>"] {
        assert!(!html.contains(outside), "{outside} must not be there");
    }
    // To view it in a browser: KEEP_REPORT=/somewhere cargo test the_page
    if let Some(keep) = std::env::var_os("KEEP_REPORT") {
        std::fs::write(keep, html).unwrap();
    }
}

#[test]
fn without_a_trained_baseline_the_verdict_compares_with_static_images() {
    let folder = tempfile::tempdir().unwrap();
    fill(folder.path());
    let file = folder.path().join("results.json");
    let mut results: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    results.as_object_mut().unwrap().remove("still");
    results["ours_6000"]["PSNR-dynamic-still"] = json!(20.1);
    std::fs::write(&file, results.to_string()).unwrap();
    let html = std::fs::read_to_string(write(&Run::open(folder.path()).unwrap()).unwrap()).unwrap();
    assert!(
        html.contains("26.10 dB, 6.00 dB better than a static image of each camera") && html.contains("--baseline")
    );
}

#[test]
fn a_run_that_has_just_begun_gets_a_page_too() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("recipe.toml"), "").unwrap();
    let html = std::fs::read_to_string(write(&Run::open(folder.path()).unwrap()).unwrap()).unwrap();
    assert!(html.contains("<h1>") && !html.contains("<svg"));
    std::fs::write(folder.path().join("results.json"), "{\"ours_1\": ").unwrap();
    let message = Run::open(folder.path()).unwrap_err().to_string();
    assert!(message.contains("results.json") && message.contains("truncated"), "{message}");
}
