//! Optical flow computed by splat4d where a capture has none and the recipe requests it: once, from every training
//! image to the next one of its camera. It is stored in the run's `flow/` and then used like flow of the capture.

use super::checkpoint::write_atomically;
use super::identity::fingerprint;
use super::open::{OpenCapture, training_frames};
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::capture::{Capture, FlowFile, FlowSource, flow_picture};
use crate::encode::{self, Pixels};
use crate::event::{Event, Progress};
use crate::recipe::Recipe;
use crate::vision::flow::{Pyramid, dense};
use crate::vision::raster::grey;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The folder next to the run, and the file that identifies the flow's input.
const FOLDER: &str = "flow";
const MARK: &str = "of.txt";
/// The next training image may be this many frames later: one between them may be held out.
const MOST_FRAMES: usize = 2;

/// The capture with flow between its training images, where it brings none and the recipe needs our own.
pub(super) fn complete(
    opened: OpenCapture,
    recipe: &Recipe,
    run: &Path,
    listen: &mut dyn FnMut(&Event),
) -> Result<OpenCapture> {
    let capture = &opened.capture;
    let wanted = wanted(capture, recipe, run);
    if wanted.is_empty() {
        return Ok(opened);
    }
    let mark = format!("{} {}", fingerprint(capture), env!("CARGO_PKG_VERSION"));
    let kept = crate::files::read(&run.join(FOLDER).join(MARK)).is_ok_and(|text| text == mark.as_bytes());
    if !kept {
        let mut progress = Progress(listen);
        // Of most images the pyramid is needed twice: as source and as target of flow.
        let mut last: Option<(usize, Pyramid)> = None;
        for (done, (frame, file)) in wanted.iter().enumerate() {
            progress.phase("flow from images", done, wanted.len());
            let from = match last.take().filter(|(i, _)| i == frame) {
                Some((_, pyramid)) => pyramid,
                None => pyramid(&opened, *frame)?,
            };
            let to = pyramid(&opened, file.to)?;
            let flow = dense(&from, &to);
            let picture = encode::png(Pixels::Sixteen(&flow_picture(&flow)), [flow.width, flow.height], 3);
            write_atomically(&file.path, &picture)?;
            last = Some((file.to, to));
        }
        write_atomically(&run.join(FOLDER).join(MARK), mark.as_bytes())?;
    }
    let completed = with_found(Capture::clone(capture), recipe, run);
    Ok(OpenCapture::with(training_frames(Arc::new(completed), recipe)?).on(opened.device))
}

/// The capture with the flow that was followed for a run, if any was.
pub(crate) fn with_found(mut capture: Capture, recipe: &Recipe, run: &Path) -> Capture {
    for (frame, file) in wanted(&capture, recipe, run) {
        if file.path.is_file() {
            capture.frames[frame].flow = Some(file);
        }
    }
    capture
}

/// Training frames without flow, each with where its own is kept; none where it is not needed.
fn wanted(capture: &Capture, recipe: &Recipe, run: &Path) -> Vec<(usize, FlowFile)> {
    if recipe.loss.flow == 0.0 || recipe.capture.flow != FlowSource::Own {
        return Vec::new();
    }
    let mut order = capture.train.clone();
    order.sort_by_key(|&i| (capture.frames[i].camera, capture.frames[i].index));
    let pair = |w: &[usize]| {
        let [from, to] = [w[0], w[1]].map(|i| &capture.frames[i]);
        let follows = from.camera == to.camera && (1..=MOST_FRAMES).contains(&(to.index - from.index));
        let same = (from.view.width, from.view.height) == (to.view.width, to.view.height);
        let path: PathBuf = run.join(FOLDER).join(format!("{:03}", from.camera)).join(format!("{:06}.png", from.index));
        (follows && same && from.flow.is_none()).then(|| (w[0], FlowFile { path, to: w[1], of_view: true }))
    };
    order.windows(2).filter_map(pair).collect()
}

fn pyramid(opened: &OpenCapture, frame: usize) -> Result<Pyramid> {
    let place = opened.capture.train.binary_search(&frame).expect("flow is between training images");
    let mut picture = Picture::default();
    opened.frames.load(place, &mut picture)?;
    Ok(Pyramid::new(grey(&picture.color)))
}
