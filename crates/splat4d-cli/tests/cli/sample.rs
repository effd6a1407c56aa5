//! A synthetic capture: four cameras on an arc look at a bright square that crosses a grey wall, four frames each;
//! and a
//! way to call the binary.

use image::{GrayImage, Luma, Rgb, RgbImage};
use serde_json::{Value, json};
use splat4d::math::Se3;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

const CAMERAS: usize = 4;
/// Frames by default.
const FRAMES: usize = 4;
const SIZE: [u32; 2] = [32, 24];

/// The program that is tested: the command, or the studies, which share this file.
const PROGRAM: Option<&str> = match option_env!("CARGO_BIN_EXE_splat4d") {
    Some(program) => Some(program),
    None => option_env!("CARGO_BIN_EXE_studies"),
};

/// Sample capture that is written, and how it is spoilt.
pub(crate) struct Capture {
    folder: PathBuf,
    pub frames: usize,
    pub distance: f64,
    pub focal: f64,
    /// Size of the image files.
    pub pictures: [u32; 2],
    /// (camera, frame) whose image is not there.
    pub missing: Option<(usize, usize)>,
    /// (camera, frame) whose image file ends early.
    pub truncated: Option<(usize, usize)>,
    pub mirrored: bool,
    /// Two cameras have one pose.
    pub twins: bool,
    pub cut_json: bool,
    pub black_masks: bool,
}

impl Capture {
    pub(crate) fn new(work: &Path) -> Self {
        Self {
            folder: work.join("capture"),
            frames: FRAMES,
            distance: 3.0,
            focal: 30.0,
            pictures: SIZE,
            missing: None,
            truncated: None,
            mirrored: false,
            twins: false,
            cut_json: false,
            black_masks: false,
        }
    }

    /// Writes the folder and returns it.
    pub(crate) fn write(&self) -> PathBuf {
        let cameras: Vec<Value> = (0..CAMERAS).map(|c| self.camera(c)).collect();
        let text = json!({"version": 1, "fps": 30, "cameras": cameras}).to_string();
        let text = if self.cut_json { text[..text.len() / 2].to_owned() } else { text };
        std::fs::create_dir_all(&self.folder).unwrap();
        std::fs::write(self.folder.join("capture.json"), text).unwrap();
        self.folder.clone()
    }

    fn pose(&self, camera: usize) -> Se3 {
        let camera = if self.twins && camera == 3 { 2 } else { camera };
        let angle = 0.35 * (camera as f64 - 1.5);
        let eye = [self.distance * angle.sin(), 0.4, -self.distance * angle.cos()];
        Se3::look_at(eye, [0.0; 3], [0.0, 1.0, 0.0])
    }

    fn camera(&self, camera: usize) -> Value {
        let pose = self.pose(camera);
        let images = self.folder.join(format!("images/cam{camera}"));
        let masks = self.folder.join(format!("masks/cam{camera}"));
        std::fs::create_dir_all(&images).unwrap();
        std::fs::create_dir_all(&masks).unwrap();
        for frame in 0..self.frames {
            let path = images.join(format!("{frame:04}.png"));
            if self.missing == Some((camera, frame)) {
                let _ = std::fs::remove_file(&path);
                continue;
            }
            self.picture(&pose, frame).save(&path).unwrap();
            if self.truncated == Some((camera, frame)) {
                let bytes = std::fs::read(&path).unwrap();
                std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
            }
            if self.black_masks {
                GrayImage::from_pixel(SIZE[0], SIZE[1], Luma([0])).save(masks.join(format!("{frame:04}.png"))).unwrap();
            }
        }
        let rows: Vec<[f64; 4]> = (0..3)
            .map(|i| {
                let r = pose.rotation[i].map(|x| if self.mirrored && i == 0 { -x } else { x });
                [r[0], r[1], r[2], pose.translation[i]]
            })
            .chain([[0.0, 0.0, 0.0, 1.0]])
            .collect();
        let mut value = json!({
            "name": format!("cam{camera}"), "width": SIZE[0], "height": SIZE[1], "fx": self.focal, "fy": self.focal,
            "cx": 16, "cy": 12, "world_to_camera": rows, "images": format!("images/cam{camera}/%04d.png"),
            "frames": self.frames,
        });
        if self.black_masks {
            value["masks"] = json!(format!("masks/cam{camera}/%04d.png"));
        }
        value
    }

    /// A square of half-width 0.3 at x = −0.6 … 0.6 before a wall with a slow pattern.
    fn picture(&self, pose: &Se3, frame: usize) -> RgbImage {
        let center = -0.6 + 1.2 * frame as f64 / (self.frames - 1) as f64;
        let world = pose.inverse();
        let eye = world.translation;
        RgbImage::from_fn(self.pictures[0], self.pictures[1], |x, y| {
            let ray = [(f64::from(x) + 0.5 - 16.0) / 30.0, (f64::from(y) + 0.5 - 12.0) / 30.0, 1.0];
            let far = world.apply(ray);
            let direction: [f64; 3] = std::array::from_fn(|k| far[k] - eye[k]);
            let at = |z: f64| {
                let s = (z - eye[2]) / direction[2];
                [eye[0] + s * direction[0], eye[1] + s * direction[1]]
            };
            let square = at(0.0);
            if (square[0] - center).abs() < 0.3 && square[1].abs() < 0.3 {
                return Rgb([230, 120, 40]);
            }
            let wall = at(1.0);
            let shade = 120.0 + 50.0 * (3.0 * wall[0]).sin() * (3.0 * wall[1]).cos();
            Rgb([shade as u8, shade as u8, (shade * 0.8) as u8])
        })
    }
}

/// Visible files of a folder, in the order of their names: without the record of what splat4d wrote there.
pub(crate) fn shown(folder: &Path) -> Vec<PathBuf> {
    let all = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<PathBuf> = all.filter(|p| !p.file_name().unwrap().to_string_lossy().starts_with('.')).collect();
    files.sort();
    files
}

/// A call of the binary.
pub(crate) struct Call {
    args: Vec<OsString>,
    /// Names and values that the program finds in its environment.
    environment: Vec<(&'static str, OsString)>,
}

/// How it went.
pub(crate) struct Output {
    call: String,
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

/// The program with these arguments.
pub(crate) fn splat4d(args: &[&str]) -> Call {
    Call { args: args.iter().map(OsString::from).collect(), environment: Vec::new() }
}

impl Call {
    /// More arguments.
    pub(crate) fn args(mut self, args: &[&str]) -> Self {
        self.args.extend(args.iter().map(OsString::from));
        self
    }

    /// More arguments, which need not be text.
    pub(crate) fn paths(mut self, paths: &[&Path]) -> Self {
        self.args.extend(paths.iter().map(|p| p.as_os_str().to_owned()));
        self
    }

    /// Programs are searched for in these folders alone.
    #[cfg(unix)]
    pub(crate) fn path(self, folders: &str) -> Self {
        self.with("PATH", folders)
    }

    /// With a variable of the environment.
    pub(crate) fn with(mut self, name: &'static str, value: &str) -> Self {
        self.environment.push((name, value.into()));
        self
    }

    /// Runs in the current folder.
    pub(crate) fn run(self) -> Output {
        self.run_in(Path::new("."))
    }

    /// Runs in a folder.
    pub(crate) fn run_in(self, folder: &Path) -> Output {
        let mut command = Command::new(PROGRAM.expect("cargo builds the program"));
        command.envs(self.environment.iter().map(|(name, value)| (name, value)));
        let output = command.args(&self.args).current_dir(folder).output().unwrap();
        let stdout = String::from_utf8(output.stdout).unwrap();
        if self.args.iter().any(|a| a == "--json") && option_env!("CARGO_BIN_EXE_splat4d").is_some() {
            stdout.lines().filter(|l| l.starts_with('{')).for_each(check_event);
        }
        Output {
            call: format!("{:?}", self.args),
            code: output.status.code(),
            stdout,
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

/// The schema of the objects that `--json` prints.
pub(crate) fn event_schema() -> Value {
    serde_json::from_str(include_str!("../../../../docs/events.schema.json")).expect("the schema is JSON")
}

/// Whether a line of `--json` is an object of the schema, by the words that the schema uses.
fn check_event(line: &str) {
    let event: Value = serde_json::from_str(line).unwrap_or_else(|e| panic!("{e}: {line}"));
    let (schema, name) = (event_schema(), event["type"].as_str().expect("every object has a type"));
    let own = schema["$defs"].get(name).unwrap_or_else(|| panic!("docs/events.schema.json lacks {name}: {line}"));
    let required =
        |of: &Value| of["required"].as_array().unwrap().iter().all(|k| event.get(k.as_str().unwrap()).is_some());
    assert!(required(&schema) && required(own), "a field is missing: {line}");
    for (field, rule) in own["properties"].as_object().unwrap() {
        let Some(value) = event.get(field) else { continue };
        let is = |kind: &Value| match kind.as_str().expect("types are names") {
            "string" => value.is_string(),
            "integer" => value.is_u64() || value.is_i64(),
            "number" => value.is_number(),
            "boolean" => value.is_boolean(),
            "array" => value.is_array(),
            "object" => value.is_object(),
            "null" => value.is_null(),
            other => panic!("{other} is not used"),
        };
        let kinds = rule["type"].as_array().cloned().unwrap_or_else(|| vec![rule["type"].clone()]);
        assert!(kinds.iter().any(is), "{field} is not {kinds:?}: {line}");
    }
}

impl Output {
    /// Standard output of a call that worked.
    pub(crate) fn ok(self) -> String {
        assert_eq!(self.code, Some(0), "{}: {}", self.call, self.stderr);
        self.stdout
    }

    /// All output of a successful call.
    pub(crate) fn all(self) -> String {
        assert_eq!(self.code, Some(0), "{}: {}", self.call, self.stderr);
        self.stdout + &self.stderr
    }

    /// Standard error of a call that worked.
    pub(crate) fn told(self) -> String {
        assert_eq!(self.code, Some(0), "{}: {}", self.call, self.stderr);
        self.stderr
    }

    /// The one-paragraph error of a call that was refused for bad input.
    pub(crate) fn refused(self) -> String {
        self.ended(2)
    }

    /// Standard output of a call that listed what it refuses the input for.
    pub(crate) fn listed(self) -> String {
        let listed = self.stdout.clone();
        self.ended(2);
        listed
    }

    /// The one-paragraph error of a call that failed through no fault of its input.
    pub(crate) fn failed(self) -> String {
        self.ended(1)
    }

    fn ended(self, code: i32) -> String {
        assert_eq!(self.code, Some(code), "{}: {}{}", self.call, self.stdout, self.stderr);
        let errors: Vec<&str> = self.stderr.lines().filter(|l| l.starts_with("error: ")).collect();
        assert_eq!(errors.len(), 1, "{}: one paragraph, not {:?}", self.call, self.stderr);
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        self.stderr
    }
}
