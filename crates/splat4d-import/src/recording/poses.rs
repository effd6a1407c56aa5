//! Poses and time offsets of the cameras: each needs the other, so they are solved in turn until both converge.

use super::cache::Cache;
use super::stored::Stored;
use crate::sfm::pictures::Pictures as _;
use crate::sfm::{self, Options, Solution};
use crate::sync::graph::{self, Kind, Offset};
use crate::write::{Masks, Pictures, Placed, Poses};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use splat4d::math::Se3;
use splat4d::scene::{Intrinsics, Lens};
use splat4d_train::capture::PointCloud;
use splat4d_train::event::Progress;

/// Rounds of clocks and poses at most. Of a hall whose clocks were up to four frames off, the worst was 0.3 frames off
/// after three rounds, and no better after five (methods/16).
const ROUNDS: usize = 4;
/// Clocks rest when the one that changed most changed by less, frames.
const RESTED: f64 = 0.05;
/// A clock is believed that this many moving points agree on.
const MOVING_POINTS: usize = 20;
/// The standard deviation of a clock that they agree on, frames: half of a hall's 31 clocks were 0.04 off.
const BY_GEOMETRY: f64 = 0.06;
/// Difference in frames from which geometry contradicts a clock from sound.
const CONTRADICTS: f64 = 1.0;
/// Of points that are static training starts; where there are fewer, of all.
const ENOUGH_STILL: usize = 200;

/// A camera that could be placed.
#[derive(Clone, Debug)]
pub(super) struct SolvedCamera {
    /// One, or one for every stored frame; none where it could not be placed.
    pub poses: Vec<Option<Se3>>,
    /// One pose for all frames.
    pub fixed: bool,
    /// Pixels of the stored images.
    pub intrinsics: Intrinsics,
    pub lens: Lens,
    pub sightings: usize,
    /// Pixels of the stored images.
    pub error: f64,
}

/// The result.
pub(super) struct Solved {
    /// In the order of the stored cameras; why not, where one could not be placed.
    pub cameras: Vec<Result<SolvedCamera, String>>,
    pub offsets: Vec<Option<Offset>>,
    pub points: Vec<([f64; 3], [u8; 3])>,
    pub up: [f64; 3],
    pub moving: bool,
    /// See [`sfm::Solution::contradiction`].
    pub contradiction: Vec<Option<f64>>,
    /// Cameras whose clock adjusting did not find, for motion in them contradicts the others.
    pub stray: Vec<bool>,
}

/// A stored solution; empty for given lenses.
#[derive(Serialize, Deserialize)]
struct Note {
    cameras: Vec<Result<Row, String>>,
    offsets: Vec<Option<Offset>>,
    points: Vec<([f64; 3], [u8; 3])>,
    up: [f64; 3],
    moving: bool,
    contradiction: Vec<Option<f64>>,
    stray: Vec<bool>,
}

#[derive(Serialize, Deserialize)]
struct Row {
    /// Rotation row by row, then translation.
    poses: Vec<Option<[f64; 12]>>,
    fixed: bool,
    /// fx fy cx cy.
    intrinsics: [f64; 4],
    /// k1 to k6, p1, p2; estimated lenses have no other terms.
    brown: Option<[f64; 8]>,
    sightings: usize,
    error: f64,
}

impl Note {
    fn of(solved: &Solved) -> Self {
        let numbers = |p: &Se3| -> [f64; 12] {
            let r = p.rotation.as_flattened();
            std::array::from_fn(|k| if k < 9 { r[k] } else { p.translation[k - 9] })
        };
        let row = |s: &SolvedCamera| {
            let Intrinsics { fx, fy, cx, cy } = s.intrinsics;
            let brown = match &s.lens {
                Lens::Brown { k, p, .. } => Some([k[0], k[1], k[2], k[3], k[4], k[5], p[0], p[1]]),
                _ => None,
            };
            Row {
                poses: s.poses.iter().map(|p| p.as_ref().map(numbers)).collect(),
                fixed: s.fixed,
                intrinsics: [fx, fy, cx, cy],
                brown,
                sightings: s.sightings,
                error: s.error,
            }
        };
        Self {
            cameras: solved.cameras.iter().map(|c| c.as_ref().map(row).map_err(Clone::clone)).collect(),
            offsets: solved.offsets.clone(),
            points: solved.points.clone(),
            up: solved.up,
            moving: solved.moving,
            contradiction: solved.contradiction.clone(),
            stray: solved.stray.clone(),
        }
    }

    fn solved(self, stored: &Stored<'_>) -> Solved {
        let pose = |n: [f64; 12]| Se3 {
            rotation: std::array::from_fn(|i| std::array::from_fn(|k| n[3 * i + k])),
            translation: [n[9], n[10], n[11]],
        };
        let stand = |(c, row): (usize, Result<Row, String>)| {
            row.map(|r| {
                let [fx, fy, cx, cy] = r.intrinsics;
                let lens = r.brown.map_or(Lens::Pinhole, |b| Lens::Brown {
                    k: std::array::from_fn(|i| b[i]),
                    p: [b[6], b[7]],
                    s: [0.0; 4],
                });
                let given = stored.known(c);
                SolvedCamera {
                    poses: r.poses.into_iter().map(|p| p.map(pose)).collect(),
                    fixed: r.fixed,
                    intrinsics: given.map_or(Intrinsics { fx, fy, cx, cy }, |g| g.intrinsics),
                    lens: given.map_or(lens, |g| g.lens),
                    sightings: r.sightings,
                    error: r.error,
                }
            })
        };
        Solved {
            cameras: self.cameras.into_iter().enumerate().map(stand).collect(),
            offsets: self.offsets,
            points: self.points,
            up: self.up,
            moving: self.moving,
            contradiction: self.contradiction,
            stray: self.stray,
        }
    }
}

/// The stored solution for the same images, clocks and lenses, else that of `solve`.
pub(super) fn once(
    cache: &Cache,
    stored: &Stored<'_>,
    clock: &str,
    solve: impl FnOnce() -> Result<Solved>,
) -> Result<Solved> {
    let made_of = format!("{} {clock}", stored.fingerprint());
    Ok(cache.or("solved", &made_of, || Ok(Note::of(&solve()?)))?.solved(stored))
}

/// Places fixed cameras, and refines their clocks.
pub(super) fn fixed_cameras(
    stored: &Stored<'_>,
    clock: graph::Solution,
    told: &[Option<f64>],
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Solved> {
    let n = stored.pictures.len();
    let mut offsets = clock.offsets;
    // Without evidence, the values of the files stay.
    let mut current: Vec<Offset> = offsets.iter().map(|o| o.clone().unwrap_or_default()).collect();
    let before: Vec<f64> = current.iter().map(|o| o.seconds).collect();
    let begun = offsets.clone();
    let frame = stored.pictures.iter().map(|p| p.clock.interval).filter(|i| *i > 0.0).fold(f64::INFINITY, f64::min);
    let all_told = told.iter().all(Option::is_some);
    let mut options = Options::default();
    options.mapping.clocks = !all_told && frame.is_finite();
    let mut solution;
    let mut round = 0;
    loop {
        round += 1;
        let on: Vec<Option<Offset>> = current.iter().cloned().map(Some).collect();
        solution = sfm::solve(&stored.on(&on), &options, progress, stop)?;
        if !options.mapping.clocks {
            break;
        }
        let moved = refined(&solution, &mut current, &mut offsets, told, frame);
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped").remedy("Run the same command again to continue."));
        }
        if moved < RESTED * frame || round == ROUNDS {
            break;
        }
    }
    let mut stray = vec![false; n];
    for (taken, contradicts) in solution.taken.iter().zip(&solution.stray) {
        let c = taken.camera;
        if *contradicts && told[c].is_none() {
            // What adjusting made of its time offset is chance.
            stray[c] = true;
            offsets[c].clone_from(&begun[c]);
        }
    }
    for c in 0..n {
        // Sound that geometry contradicts was sound of something else.
        if let Some(o) = &mut offsets[c]
            && (o.seconds - before[c]).abs() > CONTRADICTS * frame
        {
            o.kinds.retain(|k| *k != Kind::Sound);
        }
    }
    let placed = |c: usize| {
        let taken = solution.taken.iter().find(|t| t.camera == c).expect("every camera is a sight");
        taken.placed.clone().map(|p| {
            let (intrinsics, lens) = optics(stored, c, &p.lens);
            let poses = vec![Some(p.pose)];
            SolvedCamera { poses, fixed: true, intrinsics, lens, sightings: p.sightings, error: p.error }
        })
    };
    let cameras = (0..n).map(placed).collect();
    let (points, contradiction) = (points_of(&solution), solution.contradiction);
    Ok(Solved { cameras, offsets, points, up: solution.up, moving: false, contradiction, stray })
}

/// Adds what geometry found to the clocks; by how many seconds the one moved that moved most.
fn refined(
    solution: &Solution,
    current: &mut [Offset],
    offsets: &mut [Option<Offset>],
    told: &[Option<f64>],
    frame: f64,
) -> f64 {
    let n = current.len();
    let mut seen = vec![0; n];
    solution.taken.iter().zip(&solution.moving).for_each(|(t, moving)| seen[t.camera] += moving);
    let tau = |c: usize| {
        let taken = solution.taken.iter().find(|t| t.camera == c)?;
        taken.placed.as_ref().ok().filter(|_| seen[c] >= MOVING_POINTS).map(|p| p.tau)
    };
    // Of three cameras clocks are not adjusted.
    if (0..n).filter_map(tau).all(|tau| tau == 0.0) {
        return 0.0;
    }
    // The clock of those that are given, else of the first camera that geometry determined.
    let mut fixed: Vec<f64> = (0..n).filter(|&c| told[c].is_some()).filter_map(tau).collect();
    fixed.sort_by(f64::total_cmp);
    let Some(zero) = fixed.get(fixed.len() / 2).copied().or_else(|| (0..n).find_map(tau)) else { return 0.0 };
    let mut most: f64 = 0.0;
    for c in 0..n {
        let Some(tau) = tau(c).filter(|_| told[c].is_none()) else { continue };
        // A clock that is ahead is put back.
        let change = zero - tau;
        most = most.max(change.abs());
        let own = &mut current[c];
        own.seconds += change;
        own.sigma = BY_GEOMETRY * frame;
        if !own.kinds.contains(&Kind::Geometry) {
            own.kinds.push(Kind::Geometry);
            own.kinds.sort();
        }
        own.checked = true;
        offsets[c] = Some(own.clone());
    }
    most
}

/// Places the frames of moving cameras, each on its own.
pub(super) fn walking(
    stored: &Stored<'_>,
    most: usize,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Solved> {
    let frames: usize = stored.pictures.iter().map(|p| p.shots.len()).sum();
    if frames < 3 {
        return Err(Error::input(format!("{frames} frames of a moving camera show nothing from enough sides"))
            .remedy("Choose a longer part."));
    }
    if frames > most {
        progress.warn(format!(
            "{frames} frames are more than the {most} that are placed; others are left out. Take every {}th frame (--every) \
             or a shorter part (--from, --to).",
            frames.div_ceil(most)
        ));
    }
    // One device, one lens: its frames share it.
    let options = Options { walking: Some(most), ..Options::default() };
    let solution = sfm::solve(stored, &options, progress, stop)?;
    let mut cameras: Vec<Result<SolvedCamera, String>> =
        stored.pictures.iter().map(|_| Err("no frame was placed".into())).collect();
    for taken in &solution.taken {
        let Ok(placed) = &taken.placed else { continue };
        let shots = stored.pictures[taken.camera].shots.len();
        let fresh = || {
            let (intrinsics, lens) = optics(stored, taken.camera, &placed.lens);
            SolvedCamera { poses: vec![None; shots], fixed: false, intrinsics, lens, sightings: 0, error: placed.error }
        };
        if cameras[taken.camera].is_err() {
            cameras[taken.camera] = Ok(fresh());
        }
        if let (Ok(stand), Some(frame)) = (&mut cameras[taken.camera], taken.frame) {
            stand.poses[frame] = Some(placed.pose);
            stand.sightings += placed.sightings;
            stand.error = stand.error.max(placed.error);
        }
    }
    let offsets = vec![None; stored.cameras()];
    Ok(Solved {
        cameras,
        offsets,
        points: points_of(&solution),
        up: solution.up,
        moving: true,
        contradiction: Vec::new(),
        stray: Vec::new(),
    })
}

/// The lens that was given, else the one that was found.
fn optics(stored: &Stored<'_>, camera: usize, found: &sfm::lens::Lens) -> (Intrinsics, Lens) {
    let [width, height] = stored.pictures[camera].size;
    let found = found.camera(Se3::IDENTITY, width, height);
    stored.known(camera).map_or((found.intrinsics, found.lens), |k| (k.intrinsics, k.lens))
}

fn points_of(solution: &Solution) -> Vec<([f64; 3], [u8; 3])> {
    let still = solution.points.iter().filter(|p| p.moment == 0).count();
    let wanted = |p: &&sfm::Point| still < ENOUGH_STILL || p.moment == 0;
    solution.points.iter().filter(wanted).map(|p| (p.place, p.color)).collect()
}

impl Solved {
    /// The clock of a camera; its file's where nothing is known.
    pub(super) fn offset(&self, camera: usize) -> Offset {
        self.offsets[camera].clone().unwrap_or_default()
    }

    /// Takes points from elsewhere, of the same world.
    pub(super) fn take_points(&mut self, cloud: &PointCloud) {
        let color = |c: &[f32; 3]| c.map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8);
        self.points = cloud.points.iter().zip(&cloud.colors).map(|(p, c)| (*p, color(c))).collect();
    }

    pub(super) fn cloud(&self) -> PointCloud {
        PointCloud {
            points: self.points.iter().map(|p| p.0).collect(),
            colors: self.points.iter().map(|p| p.1.map(|v| f32::from(v) / 255.0)).collect(),
            times: vec![None; self.points.len()],
            left_out: 0,
        }
    }
}

impl SolvedCamera {
    /// As written.
    pub(super) fn written(&self, pictures: &Pictures, offset: Offset, masks: Option<Masks>) -> Placed {
        let poses = match &self.poses[..] {
            [Some(pose)] if self.fixed => Poses::Fixed(*pose),
            all => Poses::Moving(all.to_vec()),
        };
        Placed { pictures: pictures.clone(), offset, intrinsics: self.intrinsics, lens: self.lens, poses, masks }
    }
}
