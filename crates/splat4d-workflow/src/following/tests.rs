//! The bundled capture, small, recorded again by a thread while it is followed.

use super::*;
use crate::events::{Event as Report, ignore};
use splat4d::format::playback::Index;
use std::cell::RefCell;
use std::path::PathBuf;

const CAMERAS: usize = 6;
/// Much longer than a frame of it takes.
const TIMEOUT: f64 = 20.0;

/// A capture that is recorded into `capture`, and a place for runs.
struct Take {
    folder: tempfile::TempDir,
}

impl Take {
    fn new() -> Self {
        let take = Self { folder: tempfile::tempdir().unwrap() };
        let text = std::fs::read_to_string(Self::knight().join("capture.json")).unwrap();
        let mut value: serde_json::Value = serde_json::from_str(&text).unwrap();
        let cameras = value["cameras"].as_array_mut().unwrap();
        cameras.truncate(CAMERAS);
        for camera in cameras {
            let camera = camera.as_object_mut().unwrap();
            for key in ["frames", "masks"] {
                camera.remove(key);
            }
        }
        for key in ["frames", "labels", "hold_out"] {
            value.as_object_mut().unwrap().remove(key);
        }
        std::fs::create_dir(take.capture()).unwrap();
        std::fs::write(take.capture().join("capture.json"), value.to_string()).unwrap();
        std::fs::copy(Self::knight().join("points.ply"), take.capture().join("points.ply")).unwrap();
        take
    }

    fn knight() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight")
    }

    fn capture(&self) -> PathBuf {
        self.folder.path().join("capture")
    }

    fn run(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    /// Writes a frame of some cameras; each image is first there in half.
    fn record(&self, frame: usize, cameras: std::ops::Range<usize>) {
        for camera in cameras {
            let name = format!("images/cam{camera:02}/{frame:04}.jpg");
            let (bytes, path) = (std::fs::read(Self::knight().join(&name)).unwrap(), self.capture().join(&name));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
            std::fs::write(&path, &bytes).unwrap();
        }
    }

    /// Writes a number of frames into `capture.json`.
    fn state_frames(&self, frames: usize) {
        let file = self.capture().join("capture.json");
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replacen('{', &format!(r#"{{"frames": {frames}, "#), 1)).unwrap();
    }

    fn end(&self) {
        std::fs::write(self.capture().join("capture.end"), "").unwrap();
    }

    fn recipe(timeout: f64) -> Recipe {
        let mut recipe = Recipe::default();
        let timeout = format!("follow.timeout={timeout}");
        let settings = [
            "downscale=8",
            "follow.first_steps=40",
            "follow.frame_steps=5",
            "follow.segment=2",
            "num_pts=400",
            timeout.as_str(),
        ];
        settings.iter().for_each(|set| recipe.set(set).unwrap());
        recipe
    }

    fn options(&self) -> TrainingOptions {
        TrainingOptions { output: Some(self.run()), finish: Finish::Playback, ..TrainingOptions::default() }
    }

    fn follow(&self, timeout: f64, stop: &AtomicBool, listener: &dyn Listener) -> Result<Trained> {
        follow(&self.capture(), &Self::recipe(timeout), &self.options(), stop, listener)
    }

    /// The lines of the table of frames.
    fn lines(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.run().join(TABLE)).unwrap();
        assert!(text.starts_with(HEADER));
        text.lines().skip(1).map(str::to_owned).collect()
    }

    fn index(&self) -> Index {
        let bytes = std::fs::read(self.run().join(FILE)).unwrap();
        playback::read(&bytes).unwrap();
        Index::parse(&bytes, Some(bytes.len() as u64)).unwrap()
    }
}

#[test]
fn a_capture_becomes_a_run_while_a_thread_records_it() {
    let (take, stop) = (Take::new(), AtomicBool::new(false));
    let seen = RefCell::new((Vec::new(), Vec::new()));
    let listen = |event: &Report<'_>| match event {
        Report::Training(Event::Frame(frame)) => seen.borrow_mut().0.push(frame.frame),
        Report::Record(value) if value["type"] == "grown" => seen.borrow_mut().1.push(value["frames"].clone()),
        _ => {}
    };
    let trained = std::thread::scope(|scope| {
        scope.spawn(|| {
            for frame in 0..4 {
                std::thread::sleep(Duration::from_millis(120));
                take.record(frame, 0..CAMERAS);
            }
            take.end();
        });
        take.follow(TIMEOUT, &stop, &listen)
    });
    assert!(!trained.unwrap().interrupted);
    let (frames, grown) = seen.into_inner();
    assert_eq!(frames, [0, 1, 2, 3]);
    assert_eq!(grown, [json!([0, 1]), json!([1, 3]), json!([3, 4])]);
    let index = take.index();
    assert_eq!((index.meta.clip, index.meta.cameras.len()), ([0.0, 3.0 / index.meta.fps], CAMERAS));
    assert!(index.meta.parts.is_empty(), "it is a finished file");
    let lines = take.lines();
    assert_eq!(lines.len(), 4);
    assert!(lines.iter().all(|line| line.split(',').count() == 7 && !line.ends_with(',')), "{lines:?}");
    let run = Run::open(&take.run()).unwrap();
    assert_eq!((run.info["frames"].as_u64(), run.info["finished"].as_bool()), (Some(4), Some(true)));
    assert_eq!(run.open_capture().unwrap().0.train.len(), 4 * (CAMERAS - 1));
    // The scene is the one that the file shows, and is not older than the file.
    let scene = crate::source::read_scene(&take.run().join("scene.safetensors")).unwrap();
    assert_eq!(scene.len(), index.meta.gaussians);
    let scores = evaluating::evaluate(&take.run(), &Default::default(), &stop, &ignore).unwrap();
    assert!(scores.held("PSNR").is_some_and(|db| db > 8.0), "{:?}", scores.held("PSNR"));
    // The same command finds it finished.
    assert!(take.follow(TIMEOUT, &stop, &ignore).is_err());
}

#[test]
fn what_was_stopped_plays_and_is_continued() {
    let take = Take::new();
    (0..4).for_each(|frame| take.record(frame, 0..CAMERAS));
    take.end();
    let stop = AtomicBool::new(false);
    let listen = |event: &Report<'_>| {
        if matches!(event, Report::Training(Event::Frame(frame)) if frame.frame == 1) {
            stop.store(true, Ordering::Relaxed);
        }
    };
    assert!(take.follow(TIMEOUT, &stop, &listen).unwrap().interrupted);
    assert!(!take.run().join("scene.safetensors").exists());
    let index = take.index();
    assert_eq!(
        (index.meta.parts.clone(), index.meta.clip[1]),
        (vec!["0..1".to_owned(), "1..2".to_owned()], 1.0 / index.meta.fps)
    );
    assert_eq!(take.lines().len(), 2);
    let go_on = AtomicBool::new(false);
    let resumed = resume(&take.run(), &take.options(), &go_on, &ignore).unwrap();
    assert!(!resumed.interrupted);
    assert_eq!((take.lines().len(), take.index().meta.clip[1]), (4, 3.0 / index.meta.fps));
}

#[test]
fn frames_that_never_come_are_left_out_or_reported() {
    let (take, stop) = (Take::new(), AtomicBool::new(false));
    // Nothing at all.
    let error = take.follow(0.3, &stop, &ignore).unwrap_err().to_string();
    assert!(error.contains("no frame of the capture is complete within 0.3 s") && error.contains("cam00"), "{error}");
    assert!(!take.run().join("frames").exists(), "nothing is left to continue");
    // A camera misses a frame, the last frame is incomplete, and the capture states more frames.
    take.state_frames(30);
    take.record(0, 0..CAMERAS);
    take.record(1, 0..CAMERAS - 1);
    take.record(2, 0..CAMERAS);
    take.record(3, 0..2);
    let warned = RefCell::new(Vec::new());
    let listen = |event: &Report<'_>| {
        if let Report::Warning(text) = event {
            warned.borrow_mut().push((*text).to_owned());
        }
    };
    take.follow(0.5, &stop, &listen).unwrap();
    let warned: Vec<String> = warned.into_inner().into_iter().filter(|w| w.contains("left out")).collect();
    assert_eq!(warned.len(), 2, "{warned:?}");
    assert!(warned[0].contains("frames 1 to 1") && warned[0].contains("cam05"), "{warned:?}");
    assert!(warned[1].contains("frame 3") && warned[1].contains("cam02"), "{warned:?}");
    assert_eq!(take.lines().len(), 2);
    assert_eq!(take.index().meta.clip[1], 2.0 / take.index().meta.fps);
    // The frames that were taken are scored.
    let scored = || evaluating::evaluate(&take.run(), &Default::default(), &stop, &ignore);
    assert!(scored().unwrap().held("PSNR").is_some_and(|db| db > 8.0));
    let times: Vec<Option<f64>> = Run::open(&take.run()).unwrap().views.iter().map(|view| view.time).collect();
    assert_eq!(times, [Some(0.0), Some(take.index().meta.clip[1])]);
    for camera in 2..CAMERAS {
        std::fs::remove_file(take.capture().join(format!("images/cam{camera:02}/0002.jpg"))).unwrap();
    }
    let error = scored().unwrap_err().to_string();
    assert!(error.contains("4 of 12 images are missing: images/cam02/0002.jpg"), "{error}");
    // Options that make no sense.
    let options = TrainingOptions { minutes: Some(1.0), ..take.options() };
    let error = follow(&take.capture(), &Take::recipe(1.0), &options, &stop, &ignore).unwrap_err();
    assert!(error.to_string().contains("`minutes`"), "{error}");
}
