//! The world of a capture: its unit of length, what is up in it, and its axes.

use super::poses::Solved;
use super::stored::Stored;
use super::{Report, Request, tags};
use crate::board::Lies;
use crate::sfm::align::{Axes, axes, floor};
use crate::{Error, Result};
use splat4d::math::se3::{add, dot, mat_mul, mat_vec, norm, sub};
use splat4d::math::{Se3, Sim3};
use splat4d_train::event::Progress;

/// Upwards is an axis of a calibrated world where that is so near (cosine of 15 degrees): people calibrate on floors.
const ALONG_AXIS: f64 = 0.966;
/// Degrees between the up direction of floor and walls and that of the cameras from which on it is reported.
const REPORTED: f64 = 1.0;

/// Source of the world's axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Origin {
    /// A calibration, whose axes and lengths stay; whether these are metres.
    Calibrated { metres: bool },
    /// Clicked points: normal and centre of the floor, and whether a length among them is known.
    Clicked { floor: Option<([f64; 3], [f64; 3])>, metres: bool },
    /// None: axes and unit are arbitrary.
    Free,
}

/// Gives a solution its unit and its axes, and states so in the report; whether the unit is the metre.
///
/// Errors: the reference of the scale is not visible, or contradicts itself.
pub(super) fn settle(
    request: &Request,
    stored: &Stored<'_>,
    origin: Origin,
    solved: &mut Solved,
    report: &mut Report,
    progress: &mut Progress<'_>,
) -> Result<bool> {
    let mut scale = 1.0;
    let found = request.board.as_ref().map(|b| tags::measured(b, stored, solved, progress)).transpose()?;
    if let Some(found) = &found {
        scale = found.scale;
        solved.place(&Sim3 { scale, ..Sim3::default() });
        report.guesses.push(found.about());
    }
    if let Some((pair, metres)) = &request.apart {
        scale = apart(solved, stored, pair, *metres)?;
        solved.place(&Sim3 { scale, ..Sim3::default() });
    }
    let laid = found.as_ref().and_then(|f| f.frame);
    if let Some((up, origin)) = laid {
        let turned = turn(solved, up, true);
        let at = mat_vec(&turned.rotation, origin);
        solved.place(&Sim3 { translation: at.map(|v| -v), ..Sim3::default() });
        let place =
            if request.board.is_some_and(|b| b.lies == Some(Lies::Floor)) { "on the floor" } else { "on the wall" };
        report.guesses.push(format!("The up direction (+z) and the origin are those of the board {place}."));
    } else if let Origin::Clicked { floor: Some((up, middle)), .. } = origin {
        let turned = turn(solved, up, true);
        let at = mat_vec(&turned.rotation, middle.map(|v| v * scale));
        solved.place(&Sim3 { translation: at.map(|v| -v), ..Sim3::default() });
        report
            .guesses
            .push("The up direction (+z) is the normal of the clicked floor, which contains the origin.".into());
    } else if let Origin::Calibrated { .. } = origin {
        match along_axis(solved.up) {
            Some((axis, name)) => {
                solved.up = axis;
                report.guesses.push(format!("Upwards is {name} of the calibration, which most cameras hold upwards."));
            }
            None => report.guesses.push("Upwards is what most cameras hold upwards.".into()),
        }
    } else {
        let held = solved.up;
        let turned = turn(solved, held, false);
        let off = dot(turned.rotation[2], held).clamp(-1.0, 1.0).acos().to_degrees();
        report.guesses.push(match (turned.upright, turned.along) {
            (true, _) if off > REPORTED => format!(
                "Upwards (+z) and the other axes are those of floor and walls; cameras were held {off:.0} degrees off."
            ),
            (true, _) => "Upwards (+z) and the other axes are those of floor and walls.".into(),
            (false, true) => "Up (+z) is the up direction of most cameras; x and y follow the walls.".into(),
            (false, false) => "Upwards (+z) is what most cameras hold upwards.".into(),
        });
    }
    if let Some((name, metres)) = &request.camera_height {
        let by = metres / height(solved, stored, name)?;
        solved.place(&Sim3 { scale: by, ..Sim3::default() });
        report.guesses.push(format!(
            "The unit of length is the metre: {name} is {metres} m above the floor among the points. Tags or the \
             distance of two cameras are more accurate."
        ));
    }
    let told = found.is_some() || request.apart.is_some() || request.camera_height.is_some();
    let free = matches!(origin, Origin::Free | Origin::Clicked { metres: false, .. });
    if !told && (free || request.colmap) {
        report.guesses.push(format!(
            "The unit of length is {}. For metres, give the distance of two cameras (--apart A,B=METRES) or film tags (--board).",
            if request.colmap { "COLMAP's" } else { "the median distance of the cameras from the points" }
        ));
    }
    Ok(told || matches!(origin, Origin::Calibrated { metres: true } | Origin::Clicked { metres: true, .. }))
}

/// Rotates the world so that z is upwards and x and y are along walls, if there are any, with cameras looking along y.
fn turn(solved: &mut Solved, up: [f64; 3], fixed: bool) -> Axes {
    let points: Vec<[f64; 3]> = solved.points.iter().map(|p| p.0).collect();
    let found = axes(&points, up, fixed);
    let mut ahead = [0.0; 3];
    for pose in solved.cameras.iter().flatten().flat_map(|s| s.poses.iter().flatten()) {
        ahead = add(ahead, pose.rotation[2]);
    }
    let ahead = mat_vec(&found.rotation, ahead);
    // Four frames have the same axes; one of them looks ahead.
    let quarter = |k: usize| [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]][k];
    let along = |k: usize| quarter(k)[1] * ahead[0] + quarter(k)[0] * ahead[1];
    let best = (0..4).max_by(|&a, &b| along(a).total_cmp(&along(b))).expect("there are four");
    let [c, s] = quarter(best);
    let rotation = mat_mul(&[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], &found.rotation);
    solved.place(&Sim3::from_rotation(rotation));
    solved.up = [0.0, 0.0, 1.0];
    Axes { rotation, ..found }
}

/// A camera's only, or first known, position.
fn place(solved: &Solved, stored: &Stored<'_>, name: &str) -> Option<[f64; 3]> {
    let k = stored.pictures.iter().position(|p| p.name == name)?;
    let stand = solved.cameras[k].as_ref().ok()?;
    stand.poses.iter().flatten().next().map(|p: &Se3| p.inverse().translation)
}

/// Scale that gives two cameras this distance in metres.
fn apart(solved: &Solved, stored: &Stored<'_>, pair: &[String; 2], metres: f64) -> Result<f64> {
    let other = |what: String| Error::input(what).remedy("Give the distance of two other cameras.");
    let (Some(a), Some(b)) = (place(solved, stored, &pair[0]), place(solved, stored, &pair[1])) else {
        return Err(other(format!("{} or {} could not be placed", pair[0], pair[1])));
    };
    let now = norm(sub(a, b));
    if now <= 0.0 {
        return Err(other(format!("{} and {} have the same position", pair[0], pair[1])));
    }
    Ok(metres / now)
}

/// How high a camera is above the floor, in the current unit.
fn height(solved: &Solved, stored: &Stored<'_>, name: &str) -> Result<f64> {
    let other = |what: String| {
        Error::input(what)
            .remedy("Give the distance of two cameras instead (--apart A,B=METRES), or film tags (--board).")
    };
    let Some(camera) = place(solved, stored, name) else {
        return Err(other(format!("{name}, whose height is given, could not be placed")));
    };
    let points: Vec<[f64; 3]> = solved.points.iter().map(|p| p.0).collect();
    let Some(floor) = floor(&points, solved.up) else {
        return Err(other("no floor is seen: no height at the bottom of the scene has many points".into()));
    };
    let high = dot(camera, solved.up) - floor;
    if high <= 0.0 {
        return Err(other(format!("{name} is below the floor")));
    }
    Ok(high)
}

/// The axis that a direction is near to, and its name.
fn along_axis(up: [f64; 3]) -> Option<([f64; 3], String)> {
    let k = (0..3).max_by(|&a, &b| up[a].abs().total_cmp(&up[b].abs()))?;
    let mut axis = [0.0; 3];
    axis[k] = up[k].signum();
    let sign = if up[k] > 0.0 { "+" } else { "-" };
    (up[k].abs() > ALONG_AXIS).then(|| (axis, format!("{sign}{}", ["x", "y", "z"][k])))
}

impl Solved {
    /// Moves the whole world.
    pub(super) fn place(&mut self, by: &Sim3) {
        for pose in self.cameras.iter_mut().flatten().flat_map(|s| s.poses.iter_mut().flatten()) {
            *pose = by.pose(pose);
        }
        self.points.iter_mut().for_each(|(p, _)| *p = by.apply(*p));
        self.up = mat_vec(&by.rotation, self.up);
    }
}
