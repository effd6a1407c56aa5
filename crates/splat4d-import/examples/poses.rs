//! Throws the poses of a capture away, finds them again in its images, and prints how far they are from the truth.
//!
//! ```sh
//! cargo run --release -p splat4d-import --example poses -- examples/knight [--downscale 2] [--walking 100]
//! [--no-clocks] [--shared] [--times 10]
//! ```

use splat4d::math::align::apart;
use splat4d::scene::Planes;
use splat4d_import::sfm::pictures::Pictures;
use splat4d_import::sfm::{Options, solve};
use splat4d_train::Result;
use splat4d_train::capture::{Capture, CaptureOptions, ImageStore};
use splat4d_train::event::{Event, Progress};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

struct Shown {
    capture: Arc<Capture>,
    store: ImageStore,
    cameras: Vec<Vec<usize>>,
    shared: bool,
}

impl Pictures for Shown {
    fn cameras(&self) -> usize {
        self.cameras.len()
    }

    fn name(&self, camera: usize) -> String {
        self.capture.cameras[self.capture.frames[self.cameras[camera][0]].camera].name.clone()
    }

    fn frames(&self, camera: usize) -> usize {
        self.cameras[camera].len()
    }

    fn time(&self, camera: usize, frame: usize) -> f64 {
        self.capture.frames[self.cameras[camera][frame]].time.0
    }

    fn lens(&self, camera: usize) -> usize {
        if self.shared { 0 } else { camera }
    }

    fn load(&self, camera: usize, frame: usize) -> Result<Planes<f32>> {
        Ok(self.store.load(self.cameras[camera][frame])?.to_picture().color)
    }
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let value = |name: &str| {
        args.iter().position(|a| a == name).and_then(|k| args.get(k + 1)).and_then(|v| v.parse::<usize>().ok())
    };
    let path = args.first().expect("the first argument is a capture");
    let options = CaptureOptions { downscale: value("--downscale").unwrap_or(1), ..CaptureOptions::default() };
    let capture = Arc::new(Capture::open(Path::new(path), &options)?);
    let mut cameras = vec![Vec::new(); capture.cameras.len()];
    (0..capture.frames.len()).for_each(|i| cameras[capture.frames[i].camera].push(i));
    cameras.retain(|c: &Vec<usize>| !c.is_empty());
    cameras.iter_mut().for_each(|c| c.sort_by(|&a, &b| capture.frames[a].time.0.total_cmp(&capture.frames[b].time.0)));
    let shown = Shown {
        store: ImageStore::new(capture.clone(), 1 << 30),
        capture: capture.clone(),
        cameras,
        shared: args.iter().any(|a| a == "--shared"),
    };
    let mut options = Options { walking: value("--walking"), ..Options::default() };
    options.mapping.clocks = !args.iter().any(|a| a == "--no-clocks");
    let number = |name: &str| {
        args.iter().position(|a| a == name).and_then(|k| args.get(k + 1)).and_then(|v| v.parse::<f64>().ok())
    };
    let set = |name: &str, to: &mut dyn FnMut(f64)| number(name).map(to);
    set("--moments", &mut |v| options.look.moments = v as usize);
    set("--contrast", &mut |v| options.look.contrast = v);
    set("--still", &mut |v| options.look.still = v as usize);
    set("--moving", &mut |v| options.look.moving = v as usize);
    set("--tolerance", &mut |v| options.mapping.tolerance = v);
    set("--starts", &mut |v| options.mapping.starts = v as usize);
    let start = Instant::now();
    let mut last = String::new();
    let mut tell = |event: &Event| {
        if let Event::Phase { name, done, total } = event
            && (*name != last || done % 16 == 0)
        {
            last.clone_from(name);
            eprintln!("{:7.1} s  {name} {done}/{total}", start.elapsed().as_secs_f64());
        }
    };
    let solution = solve(&shown, &options, &mut Progress(&mut tell), &|| false)?;
    println!("{:.1} s, {} pairs, {} points", start.elapsed().as_secs_f64(), solution.pairs, solution.points.len());
    let truth = |k: usize| {
        let taken = &solution.taken[k];
        &capture.frames[shown.cameras[taken.camera][taken.frame.unwrap_or(0)]].view
    };
    let found: Vec<usize> = (0..solution.taken.len()).filter(|&k| solution.taken[k].placed.is_ok()).collect();
    let placed = |k: usize| *solution.taken[k].placed.as_ref().expect("it was found");
    let poses: Vec<_> = found.iter().map(|&k| placed(k).pose).collect();
    let true_poses: Vec<_> = found.iter().map(|&k| truth(k).cam_from_world).collect();
    let Some(apart) = apart(&poses, &true_poses) else {
        println!("no similarity takes the cameras to the truth");
        return Ok(());
    };
    let zoom = |k: usize| placed(k).lens.focal / truth(k).intrinsics.fx - 1.0;
    println!("camera              degrees  centre %  focal %     k1     cx     cy   tau ms  points    px");
    for (&k, a) in found.iter().zip(&apart) {
        let (p, t) = (placed(k), truth(k));
        println!(
            "{:<20}{:7.3}{:10.3}{:9.2}{:8.3}{:7.1}{:7.1}{:8.2}{:8}{:7.2}",
            solution.taken[k].name,
            a.degrees,
            100.0 * a.center,
            100.0 * zoom(k),
            p.lens.k1,
            p.lens.center[0] - t.intrinsics.cx,
            p.lens.center[1] - t.intrinsics.cy,
            1e3 * p.tau,
            p.sightings,
            p.error
        );
    }
    for t in &solution.taken {
        if let Err(reason) = &t.placed {
            println!("{}: {reason}", t.name);
        }
    }
    let middle = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        (v[v.len() / 2], v[v.len() - 1])
    };
    let (degrees, worst_degrees) = middle(apart.iter().map(|a| a.degrees).collect());
    let (center, worst_center) = middle(apart.iter().map(|a| 100.0 * a.center).collect());
    let (focal, worst_focal) = middle(found.iter().map(|&k| 100.0 * zoom(k).abs()).collect());
    println!(
        "{} of {} found; median (worst): {degrees:.3} ({worst_degrees:.3}) degrees, centre {center:.3} ({worst_center:.3}) %, focal {focal:.2} ({worst_focal:.2}) %",
        found.len(),
        solution.taken.len()
    );
    Ok(())
}
