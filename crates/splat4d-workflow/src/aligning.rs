//! The work behind `import --assist`: a page in which a user clicks points, before the import uses them.

use crate::editor::token;
use crate::events::Listener;
use crate::importing::{claimed, placed};
use serde_json::{Value, json};
use splat4d::Result;
use splat4d_import::recording::{Desk, Request};
use splat4d_serve::{Config, EditResponse, Editing, Photo, Photos};
use splat4d_train::event::{Event, Progress};
use splat4d_train::output::OutputFolder;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A page that is ready to be served. Dropping it releases the capture's folder.
#[derive(Debug)]
pub struct Aligning {
    token: String,
    file: PathBuf,
    finished: Arc<AtomicBool>,
    _owned: OutputFolder,
}

impl Aligning {
    /// Stores the images of the cameras, and what to serve.
    ///
    /// Errors: those of an import until images are stored; cameras that move; `stop` was raised.
    pub fn begin(request: &Request, stop: &AtomicBool, console: &dyn Listener) -> Result<(Self, Config)> {
        let owned = claimed(request)?;
        console.stop_not_polled("stored results are kept, and the same command continues from there");
        let mut listen = |event: &Event| console.event(event);
        let desk = Desk::open(request, &mut Progress(&mut listen), &|| stop.load(Ordering::SeqCst));
        console.clear();
        let desk = Arc::new(desk.map_err(placed)?);
        let (token, finished) = (token()?, Arc::new(AtomicBool::new(false)));
        let own = Self { token: token.clone(), file: desk.file(), finished: finished.clone(), _owned: owned };
        let mut about = desk.about();
        about["title"] = json!("Manual alignment");
        let images = desk.clone();
        let photos =
            Photos::new(move |wanted| images.image(wanted.view, wanted.time).map(|(jpeg, time)| Photo { jpeg, time }));
        let answer = move |asked: Value| {
            let result = desk.answer(&asked)?;
            if result["finished"] == true {
                finished.store(true, Ordering::SeqCst);
            }
            Ok(EditResponse { result, scene: None })
        };
        let assist = Some(Editing::new(token, answer));
        Ok((own, Config { about, assist, photos: Some(photos), ..Config::default() }))
    }

    /// What a page needs to send points.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// The file of the points.
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// Whether the user finished: the points give a pose to every camera.
    pub fn is_finished(&self) -> bool {
        self.finished.load(Ordering::SeqCst)
    }
}
