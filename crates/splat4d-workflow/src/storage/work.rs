//! The work on a storage: parts of long captures, joining, and what a run contains.

use super::claim::{BEAT, Claim, DEAD, Record};
use super::mirror::{Mirror, Remote};
use super::needed::not_needed;
use super::{Address, Place, Storage, Store};
use crate::chunked::{self, ChunkSelection};
use crate::deadline::Deadline;
use crate::evaluating::Measure;
use crate::events::{Event, Listener};
use crate::inspecting::{self, InspectOptions, Inspection};
use crate::status::{self, Status};
use crate::training::{self, Trained, TrainingOptions};
use serde_json::Value;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::output::{OutputFolder, STATE, write_atomically};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::{Chunked, Part, look_ahead};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Time between two uploads of checkpoints.
const UPLOAD: Duration = Duration::from_secs(30);
/// Time between two checks whether other workers are done.
const POLL: Duration = Duration::from_secs(5);
/// Time between two checks whether to stop.
const GLANCE: Duration = Duration::from_millis(100);
/// Files of a run that a worker needs whatever it does.
const COMMON: [&str; 4] = ["recipe.toml", "run.json", "cameras.json", "chunks/plan.json"];
/// Files of which only the existence counts for a status.
const MARKERS: [&str; 3] = ["scene.safetensors", "still.safetensors", "checkpoints/"];

/// Trains a capture, or parts of it (option `chunk`), where the capture, the output or both are on a storage.
///
/// Errors: those of training and of the storage; an output on a storage without the option `chunk`.
pub fn train(
    capture: &Path,
    recipe: &Recipe,
    options: &TrainingOptions,
    storage: &Storage,
    stop: &AtomicBool,
    listener: &dyn Listener,
) -> Result<Trained> {
    let source = Source::of(capture, storage)?;
    let output = options.output.as_deref().map_or(Ok(None), Address::of)?;
    let Some(address) = output else {
        let capture = source.whole(stop, listener)?;
        return training::train(&capture, recipe, options, stop, listener);
    };
    if let Source::Remote { address: capture, .. } = &source
        && capture.overlaps(&address)
    {
        return Err(Error::input("output and capture are in the same folder")
            .at(&address)
            .remedy("Choose another folder"));
    }
    let wanted = options.chunk.ok_or_else(|| {
        Error::input("an output on object storage needs the option `chunk`").at(&address).remedy(
            "Give --chunk all on every machine, or --chunk shared, 0, 1, ...; train captures that fit into one chunk into a \
             local folder",
        )
    })?;
    let store = storage.store(&address)?;
    let place = storage.place(&address)?;
    place.clear()?;
    let mirror = Mirror::new(store.as_ref(), &address, &place.files);
    let mirror = match &source {
        Source::Local(_) => mirror,
        Source::Remote { place, address, .. } => mirror.with(&place.files, address),
    };
    let record = Record::new(place.who());
    let work = Work { source, recipe, options, mirror, place, record, stop, listener };
    let interrupted = match wanted {
        ChunkSelection::One(part) => work.one(part)?,
        ChunkSelection::All => work.all()?,
    };
    listener.clear();
    if !interrupted {
        work.place.clear()?;
    }
    Ok(Trained { run: PathBuf::from(address.to_string()), iteration: None, interrupted })
}

/// The capture of a training.
enum Source {
    Local(PathBuf),
    Remote { store: Box<dyn Store>, address: Address, place: Box<Place> },
}

impl Source {
    fn of(capture: &Path, storage: &Storage) -> Result<Self> {
        Ok(match Address::of(capture)? {
            None => Self::Local(capture.to_owned()),
            Some(address) => {
                Self::Remote { store: storage.store(&address)?, place: Box::new(storage.place(&address)?), address }
            }
        })
    }

    /// The folder with all files of the capture.
    fn whole(&self, stop: &AtomicBool, listener: &dyn Listener) -> Result<PathBuf> {
        self.part(&|_| true, stop, listener)
    }

    /// The folder with the files of some frames, where its layout allows that.
    fn frames(
        &self,
        recipe: &Recipe,
        frames: &[std::ops::Range<usize>],
        stop: &AtomicBool,
        listener: &dyn Listener,
    ) -> Result<PathBuf> {
        let marker = "capture.json";
        let count = Cell::new(0);
        let folder = self.part(
            &|name| {
                count.set(count.get() + 1);
                name == marker
            },
            stop,
            listener,
        )?;
        let text = std::fs::read(folder.join(marker)).unwrap_or_default();
        let other =
            serde_json::from_slice::<Value>(&text).map(|capture| not_needed(&capture, recipe, frames, count.get()));
        let other = other.unwrap_or_default();
        self.part(&|name| !other.contains(name), stop, listener)
    }

    fn part(&self, wanted: &dyn Fn(&str) -> bool, stop: &AtomicBool, listener: &dyn Listener) -> Result<PathBuf> {
        let (store, address, place) = match self {
            Self::Local(path) => return Ok(path.clone()),
            Self::Remote { store, address, place } => (store, address, place),
        };
        let known = place.folder.join("objects.json");
        let mirror = Mirror::new(store.as_ref(), address, &place.files).known(&known);
        let mut objects = mirror.list()?;
        if objects.is_empty() {
            return Err(Error::input("there is no capture").at(address).remedy("Upload it, or correct the address"));
        }
        mirror.drop_others(&objects)?;
        objects.retain(|o| wanted(&o.name));
        let fetched = fetch(&mirror, &objects, &|_| true, "downloading the capture", stop, listener);
        mirror.keep(&known)?;
        fetched.map(|()| place.files.clone())
    }
}

fn fetch(
    mirror: &Mirror<'_>,
    objects: &[Remote],
    wanted: &dyn Fn(&str) -> bool,
    name: &str,
    stop: &AtomicBool,
    listener: &dyn Listener,
) -> Result<()> {
    mirror.fetch(objects, wanted, stop, &mut |done, total| listener.phase(name, done, total))
}

struct Work<'a> {
    source: Source,
    recipe: &'a Recipe,
    options: &'a TrainingOptions,
    mirror: Mirror<'a>,
    place: Place,
    record: Record,
    stop: &'a AtomicBool,
    listener: &'a dyn Listener,
}

impl Work<'_> {
    /// Works on a part; returns whether it was interrupted.
    fn one(&self, part: Part) -> Result<bool> {
        let objects = self.mirror.list()?;
        let chunked = self.begun(&objects)?;
        if part != Part::Shared && chunked.is_none() {
            return Err(Error::input("the run has not begun")
                .at(self.mirror.address)
                .remedy("Do this first: --chunk shared"));
        }
        if let (Part::Chunk(c), Some(chunked)) = (part, &chunked)
            && c >= chunked.plan().len()
        {
            return Err(Error::input(format!("there is no chunk {c}: the take has {}", chunked.plan().len()))
                .at(self.mirror.address)
                .remedy("Chunks are counted from 0"));
        }
        if is_done(&objects, part) {
            return Ok(false);
        }
        let missing: Vec<String> = (chunked.iter().flat_map(|c| c.needs(part)))
            .filter(|p| !is_done(&objects, *p))
            .map(|p| format!("--chunk {p}"))
            .collect();
        if !missing.is_empty() {
            return Err(Error::input(format!("chunk {part} begins where others end that are not finished"))
                .at(self.mirror.address)
                .remedy(format!("Do these first: {}", missing.join(", "))));
        }
        match self.claim(part)? {
            Ok(claim) => self.claimed(part, claim),
            Err(who) => Err(Error::new(ErrorKind::Io, format!("chunk {part} is in use by {}", who.worker))
                .at(self.mirror.address)
                .remedy("Wait for it, stop it, or train another chunk")),
        }
    }

    /// Works on all parts until they are done; returns whether it was interrupted.
    fn all(&self) -> Result<bool> {
        loop {
            let objects = self.mirror.list()?;
            let chunked = self.begun(&objects)?;
            let parts = chunked.as_ref().map_or(vec![Part::Shared], Chunked::parts);
            let open: Vec<Part> = parts.into_iter().filter(|p| !is_done(&objects, *p)).collect();
            if open.is_empty() && chunked.is_some() {
                return Ok(false);
            }
            let mut busy = false;
            for part in open {
                if chunked.iter().flat_map(|c| c.needs(part)).any(|p| !is_done(&objects, p)) {
                    continue;
                }
                let Ok(claim) = self.claim(part)? else { continue };
                busy = true;
                if self.claimed(part, claim)? {
                    return Ok(true);
                }
                break;
            }
            if !busy {
                self.listener.phase("waiting for other workers", 0, 0);
                let began = Instant::now();
                while began.elapsed() < POLL && !self.stop.load(Ordering::Relaxed) {
                    std::thread::sleep(GLANCE);
                }
            }
            if self.stop.load(Ordering::Relaxed) {
                return Err(Error::new(ErrorKind::Interrupted, "stopped while other workers train")
                    .remedy("Run the same command again to continue"));
            }
        }
    }

    /// The run, where it has begun, with the files that every worker needs.
    fn begun(&self, objects: &[Remote]) -> Result<Option<Chunked>> {
        if !objects.iter().any(|o| o.name == COMMON[3]) {
            return Ok(None);
        }
        fetch(&self.mirror, objects, &|name| COMMON.contains(&name), "reading the run", self.stop, self.listener)?;
        Chunked::open(&self.place.files).map(Some)
    }

    fn claim(&self, part: Part) -> Result<std::result::Result<Claim<'_>, Record>> {
        Claim::take(self.mirror.store, &self.mirror.address.key(&format!("{STATE}/claims/{part}")), &self.record)
    }

    /// Works on a part that this worker has claimed.
    fn claimed(&self, part: Part, claim: Claim<'_>) -> Result<bool> {
        match self.prepared(part, &claim) {
            Ok(Some(capture)) => self.trained(part, &capture, claim),
            Ok(None) => {
                claim.release();
                Ok(false)
            }
            Err(error) => {
                claim.release();
                Err(error)
            }
        }
    }

    /// Downloads what a part needs, and returns the capture's folder; `None`: another worker has just finished it.
    fn prepared(&self, part: Part, claim: &Claim<'_>) -> Result<Option<PathBuf>> {
        let mut alive = BeatNow::new(claim);
        let objects = self.mirror.list()?;
        if is_done(&objects, part) {
            return Ok(None);
        }
        let chunked = self.begun(&objects)?;
        let own = folder(part);
        let before = folder(Part::Shared);
        let others: Vec<Part> = chunked.iter().flat_map(|c| c.needs(part)).collect();
        let wanted = |name: &str| {
            let of_shared = name.starts_with(&before) && !name.contains("/capture/images/") && !name.contains("/calm/");
            let scene = |p: &Part| name == format!("{}scene.safetensors", folder(*p));
            chunked.is_some() && name.starts_with(&own)
                || part != Part::Shared && (of_shared || others.iter().any(scene))
        };
        alive.during(|| {
            fetch(&self.mirror, &objects, &wanted, "downloading finished parts", self.stop, self.listener)
        })?;
        let capture = alive.during(|| match (&chunked, part) {
            (Some(chunked), Part::Chunk(c)) => {
                let mut frames = look_ahead(self.recipe);
                frames.push(chunked.plan().frames(c));
                self.source.frames(self.recipe, &frames, self.stop, self.listener)
            }
            _ => self.source.whole(self.stop, self.listener),
        })?;
        self.listener.clear();
        Ok(Some(capture))
    }

    /// Trains a part while its claim is renewed and its checkpoints are uploaded, and uploads the result.
    fn trained(&self, part: Part, capture: &Path, claim: Claim<'_>) -> Result<bool> {
        let [halt, lost, over] = [const { AtomicBool::new(false) }; 3];
        let own = folder(part);
        let of_part = |name: &str| name.starts_with(&own) || part == Part::Shared && COMMON.contains(&name);
        let mirror = &self.mirror;
        let result = std::thread::scope(|scope| {
            // The threads end even if training panics.
            let _over = Over(&over);
            scope.spawn(|| pulse(&claim, self.stop, [&halt, &lost, &over]));
            scope.spawn(|| {
                let mut last = Instant::now();
                while !over.load(Ordering::Relaxed) {
                    std::thread::sleep(GLANCE);
                    if last.elapsed() >= UPLOAD && !lost.load(Ordering::Relaxed) {
                        // What fails here is uploaded later, or the last upload reports it.
                        let _ = mirror.push(&|name| of_part(name) && !ends(&own, name));
                        last = Instant::now();
                    }
                }
            });
            let options = TrainingOptions {
                output: Some(self.place.files.clone()),
                chunk: Some(ChunkSelection::One(part)),
                grow: false,
                ..self.options.clone()
            };
            let listener = Stopping { listener: self.listener, stop: self.stop, halt: &halt };
            training::train(capture, self.recipe, &options, &halt, &listener)
        });
        let gone = || {
            Error::new(
                ErrorKind::Io,
                format!(
                    "chunk {part} is not this worker's any more: the storage was out of reach for {} s",
                    DEAD.as_secs()
                ),
            )
            .at(self.mirror.address)
            .remedy("Check the network, and run the same command again: what is uploaded is kept")
        };
        if lost.load(Ordering::Relaxed) {
            return Err(gone());
        }
        let interrupted = match result {
            Ok(trained) => trained.interrupted,
            Err(error) => {
                claim.release();
                return Err(error);
            }
        };
        self.listener.phase("uploading", 0, 0);
        // At the end of a long upload the claim may be another worker's, whose result has the same bits.
        if !claim.beat()? {
            return Err(gone());
        }
        BeatNow::new(&claim)
            .during(|| self.mirror.push(&|name| of_part(name) && (!interrupted || !ends(&own, name))))?;
        claim.release();
        self.listener.clear();
        Ok(interrupted)
    }
}

/// Marks the end of a part's training.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// A listener that hands the user's stop on at every event: a stop at the last checkpoint of a short part would
/// otherwise come after its end.
struct Stopping<'a> {
    listener: &'a dyn Listener,
    stop: &'a AtomicBool,
    halt: &'a AtomicBool,
}

impl Listener for Stopping<'_> {
    fn on_event(&self, event: &Event<'_>) {
        self.listener.on_event(event);
        if self.stop.load(Ordering::Relaxed) {
            self.halt.store(true, Ordering::Relaxed);
        }
    }

    fn snapshots(&self) -> Option<Duration> {
        self.listener.snapshots()
    }
}

/// Renews a claim during short work of this thread.
struct BeatNow<'a, 'b>(&'a Claim<'b>);

impl<'a, 'b> BeatNow<'a, 'b> {
    fn new(claim: &'a Claim<'b>) -> Self {
        Self(claim)
    }

    fn during<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let over = AtomicBool::new(false);
        let [halt, lost, stop] = [const { AtomicBool::new(false) }; 3];
        std::thread::scope(|scope| {
            let _over = Over(&over);
            scope.spawn(|| pulse(self.0, &stop, [&halt, &lost, &over]));
            work()
        })
    }
}

/// Renews a claim until the work is over. Sets `halt` if the user stops the work or the claim is lost.
fn pulse(claim: &Claim<'_>, stop: &AtomicBool, [halt, lost, over]: [&AtomicBool; 3]) {
    let (mut last, mut tried) = (Instant::now(), Instant::now());
    while !over.load(Ordering::Relaxed) {
        std::thread::sleep(GLANCE);
        if stop.load(Ordering::Relaxed) {
            halt.store(true, Ordering::Relaxed);
        }
        if tried.elapsed() < BEAT {
            continue;
        }
        let renewed = claim.beat();
        tried = Instant::now();
        match renewed {
            Ok(true) => last = tried,
            Err(_) if last.elapsed() < DEAD => {}
            Ok(false) | Err(_) => {
                lost.store(true, Ordering::Relaxed);
                halt.store(true, Ordering::Relaxed);
                return;
            }
        }
    }
}

/// The folder of a part in its run, with a slash.
fn folder(part: Part) -> String {
    match part {
        Part::Shared => "chunks/shared/".into(),
        Part::Chunk(c) => format!("chunks/{c:02}/"),
    }
}

/// Whether a file states that a part is finished.
fn ends(own: &str, name: &str) -> bool {
    name.strip_prefix(own).is_some_and(|file| file == "scene.safetensors" || file == "still.safetensors")
}

fn is_done(objects: &[Remote], part: Part) -> bool {
    let file = if part == Part::Shared { "still.safetensors" } else { "scene.safetensors" };
    let name = format!("{}{file}", folder(part));
    objects.iter().any(|o| o.name == name)
}

/// Joins the chunks of a run on a storage, measures and reports.
pub fn join(
    run: &Path,
    no_eval: bool,
    measure: &Measure,
    storage: &Storage,
    stop: &AtomicBool,
    listener: &dyn Listener,
) -> Result<()> {
    let address = Address::of(run)?.expect("the caller has checked that it is one");
    let store = storage.store(&address)?;
    let place = storage.place(&address)?;
    place.clear()?;
    let mirror = Mirror::new(store.as_ref(), &address, &place.files);
    let objects = mirror.list()?;
    check_run(&objects, &address)?;
    let info = store.read(&address.key("run.json"))?.map(|found| found.bytes).unwrap_or_default();
    let info: Value = serde_json::from_slice(&info).unwrap_or_default();
    let capture = Path::new(info["capture"].as_str().unwrap_or_default());
    let record = Record::new(place.who());
    let claim =
        Claim::take(store.as_ref(), &address.key(&format!("{STATE}/claims/join")), &record)?.map_err(|who| {
            Error::new(ErrorKind::Io, format!("the run is being joined by {}", who.worker))
                .at(&address)
                .remedy("Wait for it, or stop it")
        })?;
    let source = Source::of(capture, storage)?;
    let mirror = match &source {
        Source::Local(_) => mirror,
        Source::Remote { place, address, .. } => mirror.with(&place.files, address),
    };
    let joined = BeatNow::new(&claim).during(|| {
        fetch(&mirror, &objects, &|_| true, "downloading the run", stop, listener)?;
        source.whole(stop, listener)?;
        listener.clear();
        let chunked = Chunked::open(&place.files)?;
        let folder = OutputFolder::amend(&place.files, "join")?;
        chunked::join(&place.files, &chunked, no_eval, measure, &Deadline::default(), stop, listener)?;
        drop(folder);
        listener.phase("uploading", 0, 0);
        mirror.push(&|_| true)
    });
    claim.release();
    listener.clear();
    joined?;
    place.clear()
}

/// Errors: there is no run.
fn check_run(objects: &[Remote], address: &Address) -> Result<()> {
    match objects.iter().any(|o| o.name == COMMON[3]) {
        true => Ok(()),
        false => Err(Error::input("there is no run of a long capture: chunks/plan.json is missing")
            .at(address)
            .remedy("Give the address that `splat4d train ... -o s3://BUCKET/FOLDER --chunk shared` wrote")),
    }
}

/// Reads how far a run on a storage is, and who works on it.
pub fn status(run: &Path, storage: &Storage) -> Result<Status> {
    let address = Address::of(run)?.expect("the caller has checked that it is one");
    let store = storage.store(&address)?;
    let place = storage.place(&address)?;
    let found = outline(&place, store.as_ref(), &address, false)
        .and_then(|workers| status::of_copy(&place.files, Path::new(&address.to_string()), &workers));
    place.clear()?;
    found
}

/// Reads what a capture or run on a storage contains.
pub fn info(path: &Path, options: &InspectOptions, storage: &Storage, listener: &dyn Listener) -> Result<Inspection> {
    let address = Address::of(path)?.expect("the caller has checked that it is one");
    let store = storage.store(&address)?;
    let probe = storage.place(&address)?;
    let mirror = Mirror::new(store.as_ref(), &address, &probe.files);
    let is_run = mirror.list()?.iter().any(|o| o.name == "recipe.toml" || o.name == COMMON[3]);
    if !is_run {
        drop(probe);
        let capture = Source::of(path, storage)?.whole(&AtomicBool::new(false), listener)?;
        listener.clear();
        return inspecting::inspect(&capture, options, listener);
    }
    let found = outline(&probe, store.as_ref(), &address, true)
        .and_then(|_| inspecting::inspect(&probe.files, options, listener));
    probe.clear()?;
    found
}

/// A copy of a run's small files, in which results of parts are empty files, and the workers of its parts; `scene`:
/// with the scene of the whole.
fn outline(place: &Place, store: &dyn Store, address: &Address, scene: bool) -> Result<BTreeMap<String, String>> {
    place.clear()?;
    let mirror = Mirror::new(store, address, &place.files);
    let objects = mirror.list()?;
    if objects.is_empty() {
        return Err(Error::input("no such run").at(address).remedy("Give the address of a run"));
    }
    let small = |name: &str| {
        let large = ["/images/", "/calm/", "/test/", "test/"].iter().any(|part| name.contains(part));
        let text = [".json", ".toml", ".csv"].iter().any(|end| name.ends_with(end));
        text && !large || scene && name == "scene.safetensors"
    };
    mirror.fetch(&objects, &small, &AtomicBool::new(false), &mut |_, _| {})?;
    for object in &objects {
        let of_chunk = object.name.starts_with("chunks/") && MARKERS.iter().any(|m| object.name.contains(m));
        if of_chunk || !scene && object.name == "scene.safetensors" {
            write_atomically(&place.files.join(&object.name), b"")?;
        }
    }
    Ok(Claim::all(store, &address.key(&format!("{STATE}/claims/")))?.into_iter().collect())
}
