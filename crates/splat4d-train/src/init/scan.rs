//! Colours of a scan that has none: those of the images in which measured depth shows its points.

use super::{Seeds, UNKNOWN_COLOR};
use crate::Result;
use crate::capture::frames::{Frames, Picture};

/// Images that are looked at, evenly chosen.
const LOOKED_AT: usize = 24;
/// A point is seen where its depth is within this share of the measured one.
const SEEN: f64 = 0.02;

/// Gives points of unknown colour the mean of what images show there. Points that none shows stay grey.
///
/// Errors: an image cannot be read.
pub(crate) fn colour(frames: &dyn Frames, seeds: &mut Seeds) -> Result<()> {
    let grey: Vec<usize> = (0..seeds.len()).filter(|&i| seeds.colors[i] == UNKNOWN_COLOR).collect();
    if grey.is_empty() {
        return Ok(());
    }
    let mut sums = vec![[0.0f32; 4]; seeds.len()];
    let (looks, mut picture) = (frames.len().min(LOOKED_AT), Picture::default());
    for k in 0..looks {
        // One more each time, so that a rig whose cameras alternate shows more than one of them.
        let i = (k * frames.len() / looks + k) % frames.len();
        frames.load(i, &mut picture)?;
        let Some(map) = &picture.measured else { continue };
        let (camera, time) = (frames.camera(i), frames.time(i).0);
        for &s in grey.iter().filter(|&&s| seeds.times[s].is_none_or(|t| t == time)) {
            let Some(([u, v], z)) = camera.project(seeds.points[s]) else { continue };
            if !(0.0..map.width as f64).contains(&u) || !(0.0..map.height as f64).contains(&v) {
                continue;
            }
            let (x, y) = (u as usize, v as usize);
            let depth = f64::from(map.get(0, y, x));
            if depth > 0.0 && (z / depth - 1.0).abs() <= SEEN {
                (0..3).for_each(|c| sums[s][c] += picture.color.get(c, y, x));
                sums[s][3] += 1.0;
            }
        }
    }
    for s in grey.into_iter().filter(|&s| sums[s][3] > 0.0) {
        seeds.colors[s] = std::array::from_fn(|c| sums[s][c] / sums[s][3]);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;
    use splat4d::scene::{Camera, Planes, Time};

    /// A red wall at depth 3.
    struct Wall(Camera);

    impl Frames for Wall {
        fn len(&self) -> usize {
            2
        }

        fn camera(&self, _: usize) -> &Camera {
            &self.0
        }

        fn time(&self, i: usize) -> Time {
            Time(i as f64)
        }

        fn rig(&self, _: usize) -> usize {
            0
        }

        fn name(&self, _: usize) -> String {
            "wall".into()
        }

        fn load(&self, _: usize, out: &mut Picture) -> Result<()> {
            out.color = Planes::new(3, 8, 8);
            out.color.plane_mut(0).fill(0.75);
            let mut map = Planes::new(1, 8, 8);
            map.data.fill(3.0);
            out.measured = Some(map);
            Ok(())
        }
    }

    #[test]
    fn points_on_the_measured_surface_get_its_colour() {
        let mut seeds = Seeds::default();
        seeds.push([0.0, 0.0, 3.01], UNKNOWN_COLOR, None);
        seeds.push([0.1, 0.0, 4.0], UNKNOWN_COLOR, None);
        seeds.push([0.0, 0.1, 3.0], [0.1; 3], None);
        seeds.push([0.0, 0.1, 3.0], UNKNOWN_COLOR, Some(0.5));
        seeds.push([0.0, 0.1, -3.0], UNKNOWN_COLOR, None);
        colour(&Wall(Camera::with_fov_y(Se3::IDENTITY, 0.8, 8, 8)), &mut seeds).unwrap();
        let red = [0.75, 0.0, 0.0];
        assert_eq!(
            seeds.colors,
            [red, UNKNOWN_COLOR, [0.1; 3], UNKNOWN_COLOR, UNKNOWN_COLOR],
            "seen, hidden, known, of no image's time, behind"
        );
    }
}
