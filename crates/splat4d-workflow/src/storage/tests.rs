//! The work of several workers on a storage in memory, with conditions as S3 has them.

use super::claim::{Claim, DEAD, Record};
use super::mirror::Mirror;
use super::*;
use crate::chunked::ChunkSelection;
use crate::evaluating::Measure;
use crate::events::{Event, Listener, ignore};
use crate::training::{self, TrainingOptions};
use splat4d::math::Se3;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::{Chunked, Part};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Objects by key: bytes, etag, seconds of the clock at which they were written.
type Objects = BTreeMap<String, (Vec<u8>, String, u64)>;

/// A storage in memory. Clones share it.
#[derive(Clone, Default)]
struct Memory {
    objects: Arc<Mutex<Objects>>,
    clock: Arc<AtomicU64>,
    count: Arc<AtomicU64>,
    /// Whether it answers.
    gone: Arc<AtomicBool>,
    /// Whether it ignores conditions, as old storages do.
    careless: bool,
}

impl Memory {
    fn put(&self, key: &str, bytes: &[u8]) -> String {
        let etag = format!("\"e{}\"", self.count.fetch_add(1, Ordering::Relaxed));
        let now = self.clock.load(Ordering::Relaxed);
        self.objects.lock().unwrap().insert(key.into(), (bytes.to_vec(), etag.clone(), now));
        etag
    }

    fn answers(&self) -> Result<()> {
        let gone = || Error::environment("does not answer", std::io::Error::other("gone"));
        if self.gone.load(Ordering::Relaxed) { Err(gone()) } else { Ok(()) }
    }

    fn keys(&self, part: &str) -> Vec<String> {
        self.objects.lock().unwrap().keys().filter(|key| key.contains(part)).cloned().collect()
    }

    fn storage(&self, local: &Path) -> Storage {
        let store = self.clone();
        let connect: Connect = Box::new(move |bucket| {
            if bucket == "takes" { Ok(Box::new(store.clone())) } else { Err(Error::input("there is no such bucket")) }
        });
        Storage { local: local.into(), name: "memory".into(), connect }
    }

    /// Uploads a folder.
    fn upload_folder(&self, folder: &Path, address: &str) {
        let address = Address::of(Path::new(address)).unwrap().unwrap();
        Mirror::new(self, &address, folder).push(&|_| true).unwrap();
    }
}

impl Store for Memory {
    fn list(&self, prefix: &str) -> Result<Vec<Object>> {
        self.answers()?;
        let objects = self.objects.lock().unwrap();
        let below = objects.iter().filter(|(key, _)| key.starts_with(prefix));
        Ok(below.map(|(key, o)| Object { key: key.clone(), size: o.0.len() as u64, etag: o.1.clone() }).collect())
    }

    fn read(&self, key: &str) -> Result<Option<Content>> {
        self.answers()?;
        let now = self.clock.load(Ordering::Relaxed);
        Ok(self.objects.lock().unwrap().get(key).map(|(bytes, etag, then)| Content {
            bytes: bytes.clone(),
            etag: etag.clone(),
            age: Some(Duration::from_secs(now - then)),
        }))
    }

    fn write(&self, key: &str, bytes: &[u8], condition: Condition<'_>) -> Result<Option<String>> {
        self.answers()?;
        let mut objects = self.objects.lock().unwrap();
        let met = match condition {
            _ if self.careless => true,
            Condition::Absent => !objects.contains_key(key),
            Condition::Is(etag) => objects.get(key).is_some_and(|o| o.1 == etag),
        };
        if !met {
            return Ok(None);
        }
        let etag = format!("\"e{}\"", self.count.fetch_add(1, Ordering::Relaxed));
        objects.insert(key.into(), (bytes.to_vec(), etag.clone(), self.clock.load(Ordering::Relaxed)));
        Ok(Some(etag))
    }

    fn download(&self, key: &str, to: &Path) -> Result<Option<String>> {
        let Some(found) = self.read(key)? else { return Ok(None) };
        splat4d_train::output::write_atomically(to, &found.bytes)?;
        Ok(Some(found.etag))
    }

    fn upload(&self, key: &str, from: &Path) -> Result<String> {
        self.answers()?;
        let bytes = std::fs::read(from).map_err(|e| crate::files::cannot_read(from, e))?;
        Ok(self.put(key, &bytes))
    }

    fn remove(&self, key: &str) -> Result<()> {
        self.answers()?;
        self.objects.lock().unwrap().remove(key);
        Ok(())
    }
}

/// A capture of fixed cameras, 12 frames.
fn take(work: &Path) -> PathBuf {
    let folder = work.join("capture");
    let mut cameras = Vec::new();
    for camera in 0..3u32 {
        let angle = 0.4 * (f64::from(camera) - 1.0);
        let pose = Se3::look_at([3.0 * angle.sin(), 0.4, -3.0 * angle.cos()], [0.0; 3], [0.0, 1.0, 0.0]);
        let row = |i: usize| [pose.rotation[i][0], pose.rotation[i][1], pose.rotation[i][2], pose.translation[i]];
        cameras.push(serde_json::json!({
            "name": format!("cam{camera}"), "width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12, "frames": 12,
            "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]], "images": format!("images/{camera}/%04d.png"),
        }));
        for frame in 0..12u32 {
            let at = |x: u32, y: u32| {
                let inside = x.abs_diff(10 + frame) < 5 && y.abs_diff(12) < 5;
                image::Rgb(if inside {
                    [250, 220, 40]
                } else {
                    [90 + (3 * x + camera) as u8, 100, 110 + (2 * y) as u8]
                })
            };
            let path = folder.join(format!("images/{camera}/{frame:04}.png"));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            image::RgbImage::from_fn(32, 24, at).save(path).unwrap();
        }
    }
    let text = serde_json::json!({"version": 1, "fps": 30, "cameras": cameras}).to_string();
    std::fs::write(folder.join("capture.json"), text).unwrap();
    folder
}

fn recipe() -> Recipe {
    let mut recipe = Recipe::default();
    for setting in [
        "chunks.frames=6",
        "chunks.overlap=2",
        "run.motion=spacetime",
        "init.source=random",
        "init.count=60",
        "max_cap=120",
        "iterations=20",
        "checkpoint_interval=10",
        "sh_degree=0",
        "hold_out=none",
    ] {
        recipe.set(setting).unwrap();
    }
    recipe
}

fn options(output: &str, chunk: ChunkSelection) -> TrainingOptions {
    TrainingOptions { output: Some(output.into()), chunk: Some(chunk), ..TrainingOptions::default() }
}

const CAPTURE: &str = "s3://takes/days/capture";
const RUN: &str = "s3://takes/runs/run";

fn work(
    storage: &Storage,
    chunk: ChunkSelection,
    listener: &dyn Listener,
    stop: &AtomicBool,
) -> Result<training::Trained> {
    train(CAPTURE.as_ref(), &recipe(), &options(RUN, chunk), storage, stop, listener)
}

fn quietly(storage: &Storage, chunk: ChunkSelection) -> Result<training::Trained> {
    work(storage, chunk, &ignore, &AtomicBool::new(false))
}

/// The tensors and chunks of a run that workers shared in one folder.
fn of_a_folder(capture: &Path, work: &Path) -> [Vec<u8>; 3] {
    let run = work.join("folder");
    let stop = AtomicBool::new(false);
    let output = run.to_str().unwrap();
    training::train(capture, &recipe(), &options(output, ChunkSelection::All), &stop, &ignore).unwrap();
    let chunked = Chunked::open(&run).unwrap();
    chunked.join().unwrap();
    ["chunks/01/scene.safetensors", "chunks/shared/still.safetensors", "scene.safetensors"]
        .map(|file| std::fs::read(run.join(file)).unwrap())
}

#[test]
fn workers_without_a_shared_folder_make_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let (capture, memory) = (take(folder.path()), Memory::default());
    let expected = of_a_folder(&capture, folder.path());
    memory.upload_folder(&capture, CAPTURE);
    std::fs::remove_dir_all(&capture).unwrap();
    let machine = |n: usize| memory.storage(&folder.path().join(format!("machine{n}")));
    let early = quietly(&machine(0), ChunkSelection::One(Part::Chunk(0))).unwrap_err().to_string();
    assert!(early.contains("--chunk shared"), "{early}");
    quietly(&machine(0), ChunkSelection::One(Part::Shared)).unwrap();
    let state = |storage: &Storage| serde_json::to_value(status(RUN.as_ref(), storage).unwrap()).unwrap();
    let told = state(&machine(9));
    assert_eq!((&told["done"], &told["total"], &told["run"]), (&1.into(), &3.into(), &RUN.into()), "{told}");
    let early = quietly(&machine(1), ChunkSelection::One(Part::Chunk(1))).unwrap_err().to_string();
    assert!(early.contains("--chunk 0"), "{early}");
    assert!(quietly(&machine(1), ChunkSelection::One(Part::Chunk(7))).unwrap_err().to_string().contains("no chunk 7"));
    quietly(&machine(1), ChunkSelection::One(Part::Chunk(0))).unwrap();
    // A part that is done needs nothing.
    quietly(&machine(4), ChunkSelection::One(Part::Chunk(0))).unwrap();
    assert!(!folder.path().join("machine4").exists() || images(&folder.path().join("machine4")) == 0);
    quietly(&machine(2), ChunkSelection::All).unwrap();
    assert_eq!(state(&machine(9))["done"], 3);
    let measure = Measure::default();
    join(RUN.as_ref(), true, &measure, &machine(3), &AtomicBool::new(false), &ignore).unwrap();
    let objects = memory.objects.lock().unwrap();
    for (file, bytes) in
        ["chunks/01/scene.safetensors", "chunks/shared/still.safetensors", "scene.safetensors"].iter().zip(expected)
    {
        assert!(objects[&format!("runs/run/{file}")].0 == bytes, "{file}");
    }
    assert!(objects.contains_key("runs/run/scene.s4d"));
    let info = String::from_utf8(objects["runs/run/run.json"].0.clone()).unwrap();
    assert!(info.contains(CAPTURE) && !info.contains("machine"), "no path of a machine is uploaded: {info}");
    let infos = objects.iter().filter(|(key, _)| key.ends_with("run.json"));
    assert_eq!(infos.clone().count(), 4);
    assert!(infos.map(|(_, o)| String::from_utf8_lossy(&o.0)).all(|text| !text.contains("machine")));
    drop(objects);
    assert!(memory.keys("claims").is_empty(), "all claims were given back");
    assert_eq!(state(&machine(9))["finished"], true);
    let told = info_of(&machine(9), RUN);
    assert!(told.contains("finished, 3 parts joined"), "{told}");
    assert!(info_of(&machine(9), CAPTURE).contains("3 fixed"));
}

fn info_of(storage: &Storage, address: &str) -> String {
    info(address.as_ref(), &crate::inspecting::InspectOptions::default(), storage, &ignore).unwrap().text
}

fn images(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|e| {
            if e.path().is_dir() {
                images(&e.path())
            } else {
                usize::from(e.path().extension().is_some_and(|x| x == "png"))
            }
        })
        .sum()
}

#[test]
fn a_killed_worker_loses_what_it_had_not_uploaded() {
    let folder = tempfile::tempdir().unwrap();
    let (capture, memory) = (take(folder.path()), Memory::default());
    let expected = of_a_folder(&capture, folder.path());
    memory.upload_folder(&capture, CAPTURE);
    let machine = |n: usize| memory.storage(&folder.path().join(format!("machine{n}")));
    // Stopped at a checkpoint: it is uploaded.
    let stop = AtomicBool::new(false);
    let listener = |event: &Event<'_>| {
        if let Event::Training(splat4d_train::event::Event::Checkpoint { iteration: 10, .. }) = event {
            stop.store(true, Ordering::Relaxed);
        }
    };
    assert!(work(&machine(0), ChunkSelection::One(Part::Shared), &listener, &stop).unwrap().interrupted);
    let newest = || {
        let names = memory.keys("runs/run/chunks/shared/checkpoints/");
        let step = |name: &String| name.rsplit('/').next()?.strip_suffix(".safetensors")?.parse::<usize>().ok();
        names.iter().filter_map(step).max()
    };
    let step = newest().expect("its checkpoint is uploaded");
    assert!(step >= 10 && memory.keys("claims").is_empty(), "{step}");
    // As if that worker had been killed: its claim stays, without a heartbeat.
    let key = "runs/run/.splat4d/claims/shared";
    memory.put(key, br#"{"id":"dead","worker":"process 7 on far","beat":3}"#);
    let refused = quietly(&machine(1), ChunkSelection::One(Part::Shared)).unwrap_err();
    assert!(refused.to_string().contains("in use by process 7 on far") && !refused.is_users(), "{refused}");
    let told = serde_json::to_value(status(RUN.as_ref(), &machine(9)).unwrap()).unwrap();
    assert_eq!(
        (&told["parts"][0]["state"], &told["parts"][0]["worker"]),
        (&"training".into(), &"process 7 on far".into()),
        "{told}"
    );
    memory.clock.fetch_add(DEAD.as_secs() + 1, Ordering::Relaxed);
    let first = Mutex::new(None);
    let listener = |event: &Event<'_>| {
        if let Event::Training(splat4d_train::event::Event::Started { iteration, .. }) = event {
            first.lock().unwrap().get_or_insert(*iteration);
        }
    };
    work(&machine(1), ChunkSelection::One(Part::Shared), &listener, &AtomicBool::new(false)).unwrap();
    assert_eq!(*first.lock().unwrap(), Some(step), "it goes on from the uploaded checkpoint");
    assert!(memory.objects.lock().unwrap()["runs/run/chunks/shared/still.safetensors"].0 == expected[1]);
    // The storage is gone in the middle.
    let listener = |event: &Event<'_>| {
        if let Event::Training(splat4d_train::event::Event::Started { .. }) = event {
            memory.gone.store(true, Ordering::Relaxed);
        }
    };
    let error = work(&machine(1), ChunkSelection::One(Part::Chunk(0)), &listener, &AtomicBool::new(false)).unwrap_err();
    assert!(!error.is_users() && error.to_string().contains("does not answer"), "{error}");
    memory.gone.store(false, Ordering::Relaxed);
    memory.clock.fetch_add(DEAD.as_secs() + 1, Ordering::Relaxed);
    quietly(&machine(2), ChunkSelection::All).unwrap();
    assert!(memory.objects.lock().unwrap()["runs/run/chunks/01/scene.safetensors"].0 == expected[0]);
}

#[test]
fn a_part_has_one_owner() {
    let memory = Memory::default();
    let record = |n: usize| Record::new(format!("worker {n}"));
    let key = "run/.splat4d/claims/0";
    // Many at once: one gets it.
    let owners: Vec<usize> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..16)
            .map(|n| {
                let (memory, record) = (&memory, record(n));
                scope.spawn(move || Claim::take(memory, key, &record).unwrap().map(std::mem::forget).is_ok())
            })
            .collect();
        threads.into_iter().enumerate().filter_map(|(n, t)| t.join().unwrap().then_some(n)).collect()
    });
    assert_eq!(owners.len(), 1);
    // The owner is dead: again one of many takes over.
    memory.clock.fetch_add(DEAD.as_secs() + 1, Ordering::Relaxed);
    let first = Claim::take(&memory, key, &record(20)).unwrap().ok().unwrap();
    let other = Claim::take(&memory, key, &record(21)).unwrap().err().unwrap();
    assert_eq!(other.worker, "worker 20");
    assert!(first.beat().unwrap() && first.beat().unwrap());
    memory.clock.fetch_add(DEAD.as_secs(), Ordering::Relaxed);
    assert!(Claim::take(&memory, key, &record(22)).unwrap().is_err(), "60 s are not too long");
    memory.clock.fetch_add(1, Ordering::Relaxed);
    let second = Claim::take(&memory, key, &record(23)).unwrap().ok().unwrap();
    assert!(!first.beat().unwrap(), "the first one has lost it");
    first.release();
    assert!(second.beat().unwrap(), "and does not remove the second one's claim");
    second.release();
    assert!(memory.keys("claims").is_empty());
    let careless = Memory { careless: true, ..Memory::default() };
    let refused = Claim::take(&careless, key, &record(0)).err().unwrap().to_string();
    assert!(refused.contains("ignores the conditions"), "{refused}");
}

#[test]
fn names_that_lead_elsewhere_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["../x", "a/../../x", "/x", "a//x", "./x", "a\\..\\x", "x\u{0}", "x\n", ".."] {
        let memory = Memory::default();
        memory.put("days/capture/capture.json", b"{}");
        memory.put(&format!("days/capture/{name}"), b"x");
        let local = folder.path().join("local");
        let error = quietly(&memory.storage(&local), ChunkSelection::One(Part::Shared)).unwrap_err();
        assert!(error.is_users() && error.to_string().contains("invalid object"), "{name:?}: {error}");
        assert!(!folder.path().join("x").exists() && !local.join("x").exists());
    }
    for bad in ["s3://", "s3:///x", "s3://takes", "s3://takes/", "s3://takes/../x", "s3://ta kes/x", "s3://takes/a//b"]
    {
        assert!(Address::of(Path::new(bad)).unwrap_err().is_users(), "{bad}");
    }
    assert_eq!(Address::of(Path::new("runs/s3")).unwrap(), None);
    let of = |text: &str| Address::of(Path::new(text)).unwrap().unwrap();
    assert_eq!((of("s3://b/a/c/").to_string(), of("s3://b/a/c").name()), ("s3://b/a/c".into(), "c"));
    let memory = Memory::default();
    let storage = memory.storage(folder.path());
    let refused = |capture: &str, output: &str, chunk: Option<ChunkSelection>| {
        let options = TrainingOptions { output: Some(output.into()), chunk, ..TrainingOptions::default() };
        train(capture.as_ref(), &recipe(), &options, &storage, &AtomicBool::new(false), &ignore)
            .unwrap_err()
            .to_string()
    };
    let all = Some(ChunkSelection::All);
    assert!(refused("s3://takes/a", "s3://takes/a/run", all).contains("same folder"));
    assert!(refused("s3://takes/a", "s3://takes/run", None).contains("--chunk all"));
    assert!(refused("s3://takes/a", "s3://takes/run", all).contains("there is no capture"));
    assert!(refused("s3://others/a", "s3://takes/run", all).contains("no such bucket"));
    assert!(
        join("s3://takes/run".as_ref(), true, &Measure::default(), &storage, &AtomicBool::new(false), &ignore).is_err()
    );
    assert!(status("s3://takes/run".as_ref(), &storage).unwrap_err().to_string().contains("no such run"));
}

#[test]
fn a_capture_is_downloaded_once_and_followed() {
    let folder = tempfile::tempdir().unwrap();
    let memory = Memory::default();
    for (name, bytes) in [("a.png", "1"), ("b/c.png", "2"), ("d.png", "3")] {
        memory.put(&format!("days/capture/{name}"), bytes.as_bytes());
    }
    memory.put("days/capture/b/", b"");
    memory.put("days/capture/.splat4d/claims/x", b"");
    let address = Address::of(Path::new(CAPTURE)).unwrap().unwrap();
    let (files, list) = (folder.path().join("files"), folder.path().join("objects.json"));
    let update = || {
        let mirror = Mirror::new(&memory, &address, &files).known(&list);
        let objects = mirror.list().unwrap();
        mirror.drop_others(&objects).unwrap();
        let mut count = 0;
        mirror.fetch(&objects, &|_| true, &AtomicBool::new(false), &mut |_, total| count = total).unwrap();
        mirror.keep(&list).unwrap();
        count
    };
    assert_eq!((update(), update()), (3, 0));
    memory.put("days/capture/a.png", b"4");
    std::fs::write(files.join("d.png"), "spoilt").unwrap();
    memory.remove("days/capture/b/c.png").unwrap();
    assert_eq!(update(), 2);
    let read = |name: &str| std::fs::read_to_string(files.join(name)).ok();
    assert_eq!((read("a.png"), read("d.png"), read("b/c.png")), (Some("4".into()), Some("3".into()), None));
}
