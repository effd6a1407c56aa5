//! Points that users request: a file of pixels or positions, followed through a scene, and their visibility.

use crate::paths::View;
use splat4d::flow::query::{Followed, Place, PointView, Query, follow, sights};
use splat4d::layers::Scene;
use splat4d::scene::{Camera, Time};
use splat4d::{Error, Result};

/// Most points of a file.
const MOST_POINTS: usize = 1_000_000;

/// A point of the file.
#[derive(Clone, Debug, PartialEq)]
pub struct PointQuery {
    query: Query,
    /// The camera whose view of it is returned.
    camera: Option<String>,
}

/// Columns of a file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Column {
    Camera,
    Time,
    X,
    Y,
    Z,
}

fn remedy() -> String {
    "The first line names the columns: camera,x,y,time for pixels, or time,x,y,z for points, \
     with camera where its visibility is needed."
        .into()
}

/// Reads points. `views` are the cameras of the scene's file.
///
/// Errors, with the line's number: columns that are unknown, missing or duplicate, an invalid number, a camera that is
/// not there, a pixel outside of its image, a time outside of the clip.
pub fn read(text: &str, views: &[View], clip: [f64; 2]) -> Result<Vec<PointQuery>> {
    let mut lines = text.lines().enumerate().map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty());
    let (_, header) = lines.next().ok_or_else(|| Error::input("the file of points is empty").remedy(remedy()))?;
    let mut columns = Vec::new();
    for name in header.trim_start_matches('\u{feff}').split(',').map(str::trim) {
        let column = match name.to_ascii_lowercase().as_str() {
            "camera" => Column::Camera,
            "time" | "t" => Column::Time,
            "x" => Column::X,
            "y" => Column::Y,
            "z" => Column::Z,
            _ => {
                return Err(Error::input(format!("unknown column `{name:.40}`")).at("line 1").remedy(remedy()));
            }
        };
        if columns.contains(&column) {
            return Err(Error::input(format!("duplicate column `{name}`")).at("line 1").remedy(remedy()));
        }
        columns.push(column);
    }
    let has = |c: Column| columns.contains(&c);
    let pixels = !has(Column::Z);
    if !(has(Column::Time) && has(Column::X) && has(Column::Y)) || pixels && !has(Column::Camera) {
        return Err(Error::input(format!("invalid columns `{header:.80}`: neither pixels nor points"))
            .at("line 1")
            .remedy(remedy()));
    }
    let mut out = Vec::new();
    for (number, line) in lines {
        let place = |e: Error| e.at(format!("line {number}"));
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        if fields.len() != columns.len() {
            let what = format!("{} fields for {} columns", fields.len(), columns.len());
            return Err(place(Error::input(what).remedy(remedy())));
        }
        if out.len() == MOST_POINTS {
            return Err(place(
                Error::input(format!("more than {MOST_POINTS} points")).remedy("Split them into several files."),
            ));
        }
        let field = |c: Column| columns.iter().position(|k| *k == c).map(|i| fields[i]);
        let value = |c: Column| {
            let text = field(c).expect("the column is there");
            text.parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| {
                place(Error::input(format!("`{text:.40}` is not a number")).remedy("Write plain numbers."))
            })
        };
        let (time, x, y) = (value(Column::Time)?, value(Column::X)?, value(Column::Y)?);
        if time < clip[0] - 1e-9 || time > clip[1] + 1e-9 {
            return Err(place(
                Error::input(format!("{time} s is outside the scene's clip"))
                    .remedy(format!("The clip lasts from {} to {} s.", clip[0], clip[1])),
            ));
        }
        let camera = field(Column::Camera).filter(|name| !name.is_empty()).map(str::to_owned);
        let seen_by = camera.as_ref().map(|name| at(views, name, time).map_err(place)).transpose()?;
        let place = match seen_by {
            _ if !pixels => Place::World([x, y, value(Column::Z)?]),
            Some(camera) => {
                let inside = (0.0..camera.width as f64).contains(&x) && (0.0..camera.height as f64).contains(&y);
                if !inside {
                    let what = format!("pixel ({x}, {y}) is outside the image of {}x{}", camera.width, camera.height);
                    return Err(place(
                        Error::input(what)
                            .remedy("Pixels are those of the run's images (divided by its option `downscale`)."),
                    ));
                }
                Place::Pixel(Box::new(camera.clone()), [x, y])
            }
            None => return Err(place(Error::input("a pixel has no camera").remedy(remedy()))),
        };
        out.push(PointQuery { query: Query { time, place }, camera });
    }
    if out.is_empty() {
        return Err(Error::input("the file contains no points").remedy(remedy()));
    }
    Ok(out)
}

/// The camera of that name at a time: of one that moves the view nearest in time.
fn at<'a>(views: &'a [View], name: &str, t: f64) -> Result<&'a Camera> {
    let own = views.iter().filter(|v| v.name == name);
    let near = own.min_by(|a, b| (a.time - t).abs().total_cmp(&(b.time - t).abs()));
    near.map(|v| &v.camera).ok_or_else(|| {
        let mut names: Vec<&str> = views.iter().map(|v| v.name.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        let remedy = match names.len() {
            0 => "The file contains no cameras. Use a run, or give points without a camera.".to_owned(),
            n => format!("There are {n}: {}.", names[..n.min(24)].join(", ")),
        };
        Error::input(format!("there is no camera `{name:.80}`")).remedy(remedy)
    })
}

/// Points that were followed, and what their cameras see of them.
pub struct QueryResult {
    asked: Vec<PointQuery>,
    followed: Followed,
    /// [points, times]
    sights: Vec<Option<PointView>>,
}

impl QueryResult {
    /// Follows points to some times. `progress` is called with the finished and the total number of times.
    pub fn of(
        scene: &Scene<f32>,
        asked: Vec<PointQuery>,
        views: &[View],
        times: &[f64],
        progress: &mut dyn FnMut(usize, usize),
    ) -> Self {
        let queries: Vec<Query> = asked.iter().map(|a| a.query.clone()).collect();
        let followed = follow(scene, &queries, times);
        let mut seen = vec![None; asked.len() * times.len()];
        let mut cameras: Vec<&str> = asked.iter().filter_map(|a| a.camera.as_deref()).collect();
        cameras.sort_unstable();
        cameras.dedup();
        for (k, &t) in times.iter().enumerate() {
            progress(k, times.len());
            for &name in &cameras {
                let camera = at(views, name, t).expect("a camera that was found before");
                let own: Vec<usize> = (0..asked.len()).filter(|&i| asked[i].camera.as_deref() == Some(name)).collect();
                let points: Vec<Option<[f64; 3]>> = own.iter().map(|&i| followed.path(i)[k]).collect();
                for (&i, sight) in own.iter().zip(sights(scene, camera, Time(t), &points)) {
                    seen[i * times.len() + k] = sight;
                }
            }
        }
        Self { asked, followed, sights: seen }
    }

    /// Points of which nothing was there to follow.
    pub fn missing(&self) -> usize {
        self.followed.starts.iter().filter(|s| s.is_none()).count()
    }

    /// Points that were requested.
    pub fn len(&self) -> usize {
        self.asked.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// As CSV: `point,time,x,y,z,camera,u,v,visible`, a line for every time at which a point is there. `point` counts
    /// the file's lines from 0; without a camera the last four are empty.
    pub fn to_csv(&self) -> String {
        let mut out = csv::Writer::from_writer(Vec::new());
        let header = ["point", "time", "x", "y", "z", "camera", "u", "v", "visible"];
        out.write_record(header).expect("memory takes every row");
        for (i, asked) in self.asked.iter().enumerate() {
            for (k, (t, place)) in self.followed.times.iter().zip(self.followed.path(i)).enumerate() {
                let Some([x, y, z]) = place else { continue };
                let seen = match self.sights[i * self.followed.times.len() + k] {
                    Some(s) => [s.pixel[0].to_string(), s.pixel[1].to_string(), u8::from(s.visible).to_string()],
                    None => Default::default(),
                };
                let camera = asked.camera.clone().unwrap_or_default();
                let place = [i.to_string(), t.to_string(), x.to_string(), y.to_string(), z.to_string(), camera];
                out.write_record(place.iter().chain(&seen)).expect("memory takes every row");
            }
        }
        String::from_utf8(out.into_inner().expect("memory takes every row")).expect("all of it is text")
    }

    /// As JSON:
    ///
    ///
    ///
    ///
    /// `{"version": 1, "times": [s], "points": [{"start": [x, y, z], "camera": name, "path": [[x, y, z] or null], "pixels": [[u, v] or null], "visible": [bool]}]}`;
    /// the last two only of points with a camera.
    pub fn to_json(&self) -> String {
        let times = self.followed.times.len();
        let points: Vec<serde_json::Value> = (0..self.asked.len())
            .map(|i| {
                let mut point = serde_json::json!({ "start": self.followed.starts[i], "path": self.followed.path(i) });
                if let Some(camera) = &self.asked[i].camera {
                    let own = &self.sights[i * times..(i + 1) * times];
                    point["camera"] = camera.as_str().into();
                    point["pixels"] = own
                        .iter()
                        .map(|s| s.map(|s| s.pixel))
                        .collect::<Vec<_>>()
                        .into_iter()
                        .map(|p| serde_json::json!(p))
                        .collect();
                    point["visible"] = own.iter().map(|s| s.is_some_and(|s| s.visible)).collect();
                }
                point
            })
            .collect();
        serde_json::json!({ "version": 1, "times": self.followed.times, "points": points }).to_string() + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;

    fn views() -> Vec<View> {
        let pose = Se3::look_at([0.0, 0.0, 4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.7, 40, 30);
        vec![View { camera, name: "front".into(), time: 0.0, held: false }]
    }

    #[test]
    fn pixels_and_places_are_read() {
        let asked = read("camera,x,y,time\nfront, 3.5,8,0.2\n\n", &views(), [0.0, 1.0]).unwrap();
        assert_eq!(
            asked[0].query,
            Query { time: 0.2, place: Place::Pixel(Box::new(views()[0].camera.clone()), [3.5, 8.0]) }
        );
        let asked = read("t,x,y,z,camera\n0,1,2,3,front\n0.5,1,2,3,\n", &views(), [0.0, 1.0]).unwrap();
        assert_eq!(asked[0].query, Query { time: 0.0, place: Place::World([1.0, 2.0, 3.0]) });
        assert_eq!([&asked[0].camera, &asked[1].camera], [&Some("front".to_owned()), &None]);
    }

    #[test]
    fn mistakes_in_a_points_file_are_reported_with_their_line() {
        for (text, words) in [
            ("", "empty"),
            ("camera,x,y,time\n", "contains no points"),
            ("camera,x,y,tim\n", "`tim`"),
            ("x,x,y,time\n", "duplicate"),
            ("x,y,time\n1,2,0\n", "neither"),
            ("camera,x,y,time\nfront,1,0\n", "line 2: 3 fields"),
            ("camera,x,y,time\nfront,1,nan,0\n", "`nan`"),
            ("camera,x,y,time\nback,1,1,0\n", "front"),
            ("camera,x,y,time\nfront,1,1,0\nfront,40,1,0\n", "line 3: pixel (40, 1)"),
            ("camera,x,y,time\nfront,1,1,7\n", "clip"),
        ] {
            let error = read(text, &views(), [0.0, 1.0]).unwrap_err().to_string();
            assert!(error.contains(words), "{text}: {error}");
        }
    }
}
