//! Makes captures from videos: frames with timestamps, synchronisation, poses from images alone, and a folder that
//! training reads.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `board/` | square tags (AprilTag 36h11, ArUco): dark regions with four corners (`quads.rs`), their bits |
//! | `calibration/` | calibrations of other programs: one file per dialect over one tree of YAML, XML, JSON and TOML (`tree.rs`), chosen by content; names of videos (`matching.rs`), intrinsics of another size (`shape.rs`) |
//! | `video/` | images with timestamps: `ffmpeg` and `ffprobe` through pipes, folders of images, motion JPEG in AVI without a program; recordings in several files (`chapters.rs`), rate, lost and doubled frames (`clock.rs`) |
//! | `sync/` | synchronisation: lags of pairs by sound, motion (a guess) and epipolar geometry, offsets of all by robust least squares (`graph.rs`) |
//! | `sfm/`, `sfm/mapper/` | structure from motion: views (`pictures.rs`), tracks, matches of a network (`linking.rs`), two-view geometry, resection, locally optimised consensus (`sample.rs`), the mapper, exact positions by aligning windows (`overlay.rs`), bundle adjustment with lenses and time offsets, known cameras, up direction, walls and unit (`align.rs`) |
//! | `clicks/` | points that a user clicked in several cameras: their file, and the poses, focal lengths and time offsets that they determine; keypoints of people in all frames (`keypoints.rs`) |
//! | `clicks/people/` | the same poses, lenses and offsets from people: tracks, pairs that may be one person (`pairs.rs`), rigs that grow (`rig.rs`), refusal of rigs that may be wrong (`check.rs`) |
//! | `corrections.rs` | `import.toml`: results per camera, corrected by hand and read again |
//! | `write/` | images, masks, times and `capture.json`, continued after an interruption |
//! | `shipped.rs` | frames of captures shipped as a video per camera with poses (Neural 3D Video) |
//! | `generated.rs` | rigs that a network generated (4DAnyone): poses and a video per view |
//! | `predicted.rs` | poses, depth and images that a network predicted, in one `.npz` (VGGT, Depth Anything 3) |
//! | `recording/` | the whole import: inputs, synchronisation, given calibrations, COLMAP, poses and time offsets in turn, unit and axes, delay of sound, cache, report |
//! | `doctor/` | problems of a capture: one camera (`look.rs`, `alone.rs`), pairs of cameras (`between.rs`), time offsets and rolling shutters, vignetting, the dynamic volume, the list of findings (`check.rs`) |

pub mod board;
pub mod calibration;
mod clicks;
pub mod corrections;
pub mod doctor;
pub mod generated;
pub mod predicted;
pub mod recording;
pub mod sfm;
pub mod shipped;
pub mod sync;
pub mod video;
pub mod write;

pub use clicks::check_clicks;
pub use splat4d::{Error, ErrorKind, Result};
