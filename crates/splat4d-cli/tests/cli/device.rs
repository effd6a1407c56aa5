//! `--device gpu` where there is no driver: one line states so, and the CPU does the work.

use super::sample::{Call, Capture, splat4d};
use super::{TINY, str};

/// With no Vulkan driver to be found.
fn without_drivers(args: &[&str]) -> Call {
    splat4d(args).with("VK_DRIVER_FILES", "/dev/null").with("VK_ICD_FILENAMES", "/dev/null")
}

#[test]
#[cfg(all(feature = "gpu", target_os = "linux"))]
fn without_a_driver_every_verb_warns_once_and_continues() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let (run, small, film) = (work.path().join("run"), work.path().join("small"), work.path().join("film"));
    let once = |told: &str, what: &str| {
        let lines = told.lines().filter(|l| l.contains("no Vulkan, Metal or Direct3D 12 driver was found")).count();
        assert_eq!(lines, 1, "{what}: {told}");
    };
    let train = ["train", str(&capture), "-o", str(&run), "--device", "gpu", "--no-eval"];
    once(&without_drivers(&train).args(&TINY).run().told(), "train");
    once(&without_drivers(&["eval", str(&run), "--device", "gpu"]).run().told(), "eval");
    let render = ["render", str(&run), "-o", str(&film), "--size", "40x30", "--fps", "4", "--device", "gpu"];
    once(&without_drivers(&render).run().told(), "render");
    let compress = ["compress", str(&run), "-o", str(&small), "--device", "gpu", "--no-eval", "--fine-tune", "4"];
    once(&without_drivers(&compress).run().told(), "compress");
}
