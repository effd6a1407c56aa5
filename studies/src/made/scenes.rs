//! The synthetic captures: contents, cameras and difficulty. Nothing here was chosen by how well it is learnt.

use super::world::{Pinhole, Shape, Texture, Thing, V3, World, sin_cos};
use splat4d::math::Se3;

/// Images, pixels; the focal length gives 59° across, as of an ordinary camera.
const SIZE: [usize; 2] = [160, 120];
const FOCAL: f64 = 140.0;
/// Distance of the cameras from their target, scene units.
const RADIUS: f64 = 4.0;
/// Heights of neighbouring cameras, alternately.
const HEIGHTS: [f64; 2] = [1.1, 1.9];
/// Target of rigs.
const TARGET: V3 = [0.0, 0.7, -0.3];
/// Half the arc of rigs that are before the scene, and of one that is all round it, radians.
const HALF_ARC: f64 = 0.9;
const HALF_RING: f64 = 3.0;
/// Times of captures in which something moves, and of the rig with many cameras.
const MOMENTS: usize = 10;
const FEW_MOMENTS: usize = 5;
/// Distance of a far background, in distances of the cameras.
const FAR: f64 = 100.0;
/// Gains of training cameras, alternately: their product is 1, so that the held-out cameras represent their mean.
const GAINS: [f64; 4] = [0.65, 1.25, 1.0 / 0.65, 0.8];
/// Turn of a pose that is wrong: 3°.
const WRONG: f64 = 3.0 * std::f64::consts::PI / 180.0;
/// Training camera with the wrong pose.
const WRONG_CAMERA: usize = 4;
/// Poses of the two hand-held takes.
const SHORT_PATH: usize = 12;
const LONG_PATH: usize = 60;
/// Poses of the two walks, and points of each pose's image in their clouds.
const SHORT_WALK: usize = 60;
const LONG_WALK: usize = 300;
const WALK_POINTS: usize = 20;
/// Distance of a walk, scene units.
const WALKED: f64 = 24.0;
/// Points of the other clouds.
const POINTS: usize = 500;

/// A camera of a synthetic capture.
#[derive(Clone, Debug)]
pub(crate) struct Viewer {
    /// Its pose at every time, or the one that it keeps.
    pub poses: Vec<Pinhole>,
    pub gain: f64,
    pub held: bool,
    /// Angle by which the pose that is written differs from the true one, radians.
    pub wrong: f64,
}

impl Viewer {
    fn fixed(pose: Pinhole) -> Self {
        Self { poses: vec![pose], gain: 1.0, held: false, wrong: 0.0 }
    }

    /// The true camera at a time.
    pub(crate) fn at(&self, moment: usize) -> &Pinhole {
        &self.poses[moment.min(self.poses.len() - 1)]
    }
}

/// A capture before it is rendered.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub world: World,
    pub viewers: Vec<Viewer>,
    pub moments: usize,
    pub fps: f64,
    /// Units of the files in units of the world.
    pub units: f64,
    /// Points of the cloud, and whether those of moving objects belong to it.
    pub points: usize,
    pub moving_points: bool,
    /// Whether depth and flow of the images to train on are written next to them.
    pub truth: bool,
}

/// Names of the synthetic captures, each with what is hard about it.
pub(crate) const NAMES: [(&str, &str); 13] = [
    ("far-background", "an object before a background at a hundred times the cameras' distance"),
    ("one-wall", "one moment of one textured wall, seen from the front, and little else"),
    ("tiny-units", "a room in units of a thousandth"),
    ("huge-units", "a room in units of a thousand"),
    ("four-cameras", "a room, seen by four cameras"),
    ("sixty-cameras", "sixty cameras all round"),
    ("exposure", "cameras whose gains differ by more than twice"),
    ("wrong-pose", "one camera of eight is turned by three degrees"),
    ("enters", "something comes into view at half time"),
    ("hand-held-12", "twelve moments from the path of one camera before a wall; a fixed camera is held out"),
    ("hand-held-60", "the same with sixty moments"),
    ("walk-60", "one camera walks past near posts, stairs and houses; nothing moves, and the horizon is far"),
    ("walk-300", "the same with five times the images"),
];

/// A synthetic capture by its name.
pub(crate) fn scene(name: &str) -> Option<Scene> {
    let room = || Scene {
        world: room(),
        viewers: arc(10, HALF_ARC, &[3, 6]),
        moments: MOMENTS,
        fps: 10.0,
        units: 1.0,
        points: POINTS,
        moving_points: true,
        truth: false,
    };
    let scene = match name {
        "far-background" => Scene { world: outdoors(), ..room() },
        "one-wall" => Scene { world: wall(), viewers: grid(), moments: 1, ..room() },
        "tiny-units" => Scene { units: 1e-3, ..room() },
        "huge-units" => Scene { units: 1e3, ..room() },
        "four-cameras" => Scene { viewers: arc(5, HALF_ARC, &[2]), ..room() },
        "sixty-cameras" => {
            Scene { world: hall(), viewers: arc(60, HALF_RING, &[7, 22, 37, 52]), moments: FEW_MOMENTS, ..room() }
        }
        "exposure" => {
            let mut scene = room();
            let training = scene.viewers.iter_mut().filter(|v| !v.held);
            training.zip(GAINS.into_iter().cycle()).for_each(|(v, gain)| v.gain = gain);
            scene
        }
        "wrong-pose" => {
            let mut scene = room();
            let camera = scene.viewers.iter_mut().filter(|v| !v.held).nth(WRONG_CAMERA);
            camera.expect("the rig has enough training cameras").wrong = WRONG;
            scene
        }
        "enters" => {
            let mut scene = room();
            let crate_ = thing(Shape::Crate([0.35; 3]), falls, texture(9, 0.4));
            scene.world.things.push(Thing { moves: true, ..crate_ });
            scene
        }
        "hand-held-12" => hand_held(SHORT_PATH),
        "hand-held-60" => hand_held(LONG_PATH),
        "walk-60" => walk(SHORT_WALK),
        "walk-300" => walk(LONG_WALK),
        _ => return None,
    };
    Some(scene)
}

/// Colours of objects, alternately dark and light.
const COLORS: [[V3; 2]; 5] = [
    [[0.12, 0.16, 0.28], [0.52, 0.54, 0.46]],
    [[0.30, 0.10, 0.08], [0.60, 0.46, 0.18]],
    [[0.08, 0.24, 0.12], [0.50, 0.58, 0.24]],
    [[0.16, 0.10, 0.26], [0.56, 0.36, 0.44]],
    [[0.10, 0.10, 0.10], [0.58, 0.58, 0.60]],
];

fn texture(seed: u64, grain: f64) -> Texture {
    let [dark, light] = COLORS[seed as usize % COLORS.len()];
    Texture { seed, grain, dark, light }
}

fn thing(shape: Shape, place: fn(f64) -> V3, texture: Texture) -> Thing {
    Thing { shape, texture, place, moves: false }
}

/// The path of what bounces through every scene that moves: two parabolas, from left to right.
fn bounces(at: f64) -> V3 {
    let half = if at < 0.5 { 2.0 * at } else { 2.0 * at - 1.0 };
    [-1.3 + 2.6 * at, 0.3 + 2.4 * half * (1.0 - half), 0.6]
}

/// Above all images until half time, on the floor at nine tenths of the capture.
fn falls(at: f64) -> V3 {
    let fall = ((at - 0.5) / 0.4).clamp(0.0, 1.0);
    [-0.1, 3.2 - 2.85 * fall, 0.9]
}

fn ball() -> Thing {
    Thing { moves: true, ..thing(Shape::Ball(0.3), bounces, texture(3, 0.25)) }
}

/// An object: a crate, a pillar and a ball that are static.
fn object() -> [Thing; 3] {
    [
        thing(Shape::Crate([0.4; 3]), |_| [-0.9, 0.4, -0.3], texture(1, 0.4)),
        thing(Shape::Crate([0.2, 0.8, 0.2]), |_| [0.2, 0.8, -1.4], texture(2, 0.4)),
        thing(Shape::Ball(0.5), |_| [0.9, 0.5, -0.5], texture(6, 0.4)),
    ]
}

fn floor(half: f64) -> Thing {
    thing(Shape::Crate([half, 0.1, half]), |_| [0.0, -0.1, 0.0], texture(4, 0.8))
}

fn back_wall() -> Thing {
    thing(Shape::Crate([20.0, 20.0, 0.1]), |_| [0.0, 0.0, -3.1], texture(5, 0.7))
}

fn dome(radius: f64) -> Thing {
    thing(Shape::Ball(radius), |_| [0.0; 3], texture(7, 0.2 * radius))
}

/// A floor, a wall behind, an object, a bouncing ball.
fn room() -> World {
    World { things: [floor(20.0), back_wall(), ball()].into_iter().chain(object()).collect() }
}

/// The same in a round hall.
fn hall() -> World {
    World { things: [floor(12.0), dome(12.0), ball()].into_iter().chain(object()).collect() }
}

/// The same on a small floor under a far sky.
fn outdoors() -> World {
    World { things: [floor(2.5), dome(FAR * RADIUS), ball()].into_iter().chain(object()).collect() }
}

fn wall() -> World {
    let bowl = thing(Shape::Ball(0.25), |_| [0.5, 1.0, -2.0], texture(6, 0.4));
    World { things: vec![back_wall(), bowl] }
}

fn camera(eye: V3, target: V3) -> Pinhole {
    Pinhole { cam_from_world: Se3::look_at(eye, target, [0.0, 1.0, 0.0]), focal: FOCAL, size: SIZE }
}

/// Cameras on an arc before the scene, at two alternating heights.
fn arc(count: usize, half: f64, held: &[usize]) -> Vec<Viewer> {
    let viewer = |i: usize| {
        let (sin, cos) = sin_cos(half * (2.0 * i as f64 / (count - 1) as f64 - 1.0));
        let eye = [RADIUS * sin, HEIGHTS[i % 2], RADIUS * cos];
        Viewer { held: held.contains(&i), ..Viewer::fixed(camera(eye, TARGET)) }
    };
    (0..count).map(viewer).collect()
}

/// Twelve cameras side by side, all pointing straight ahead; two of the inner ones are held out.
fn grid() -> Vec<Viewer> {
    let viewer = |i: usize| {
        let (column, row) = ((i % 4) as f64, (i / 4) as f64);
        let eye = [-0.9 + 0.6 * column, 0.6 + 0.4 * row, 1.0];
        let ahead = [eye[0], eye[1], 0.0];
        Viewer { held: [5, 10].contains(&i), ..Viewer::fixed(camera(eye, ahead)) }
    };
    (0..12).map(viewer).collect()
}

/// One camera that sways before a wall with a moving ball, and a fixed one that is held out.
fn hand_held(moments: usize) -> Scene {
    let pose = |i: usize| {
        let at = i as f64 / (moments - 1) as f64;
        // Two sways sideways and three up and down, as of a hand-held camera.
        let turn = |times: f64| half_turns(times * at);
        let eye = [1.2 * (2.0 * at - 1.0) + 0.25 * turn(4.0), 1.2 + 0.2 * turn(6.0), 2.6 + 0.2 * turn(2.0)];
        camera(eye, [0.3 * (2.0 * at - 1.0), 0.8 + 0.05 * turn(6.0), -1.0])
    };
    let path = Viewer { poses: (0..moments).map(pose).collect(), ..Viewer::fixed(pose(0)) };
    let fixed = Viewer { held: true, ..Viewer::fixed(camera([0.3, 1.3, 2.8], [0.0, 0.8, -1.0])) };
    let world = World { things: vec![floor(20.0), back_wall(), ball()] };
    // Both takes last the same time.
    let fps = (moments - 1) as f64 / 1.1;
    let points = POINTS;
    Scene { world, viewers: vec![path, fixed], moments, fps, units: 1.0, points, moving_points: false, truth: true }
}

/// Minus the sine of a number of half turns.
fn half_turns(turns: f64) -> f64 {
    sin_cos(std::f64::consts::PI * (turns % 2.0 - 1.0)).0
}

/// A place in tenths of a unit, at all times.
fn at<const X: i32, const Y: i32, const Z: i32>(_: f64) -> V3 {
    [X, Y, Z].map(|v| 0.1 * f64::from(v))
}

/// Where something is at a share of the capture.
type Place = fn(f64) -> V3;

/// A street: a railing close to the walker, stairs, houses on both sides, two round trees, a far horizon.
fn street() -> World {
    let part = |half: V3, seed: u64, grain: f64| move |place| thing(Shape::Crate(half), place, texture(seed, grain));
    let posts = [at::<9, 5, -100>, at::<9, 5, -60>, at::<9, 5, -20>, at::<9, 5, 20>, at::<9, 5, 60>, at::<9, 5, 100>];
    let bars = [at::<9, 10, 0>, at::<9, 6, 0>];
    let houses = [at::<60, 30, -80>, at::<-70, 30, -70>, at::<65, 30, 40>, at::<-60, 30, 60>, at::<10, 30, -180>];
    let steps: [(Place, f64); 4] =
        [(at::<-22, 1, -20>, 0.1), (at::<-22, 2, -26>, 0.2), (at::<-22, 3, -32>, 0.3), (at::<-22, 4, -38>, 0.4)];
    let trunks = [at::<-25, 8, 30>, at::<25, 8, -40>];
    let crowns: [Place; 2] = [at::<-25, 20, 30>, at::<25, 20, -40>];
    let things = [floor(40.0), dome(FAR * RADIUS)].into_iter();
    let things = things.chain(posts.map(part([0.03, 0.5, 0.03], 2, 0.1)));
    let things = things.chain(bars.map(part([0.02, 0.02, 11.0], 8, 0.2)));
    let things = things.chain(houses.map(part([2.0, 3.0, 2.5], 1, 0.6)));
    let things = things.chain(steps.map(|(place, height)| part([1.2, height, 0.3], 5, 0.3)(place)));
    let things = things.chain(trunks.map(part([0.12, 0.8, 0.12], 6, 0.2)));
    World { things: things.chain(crowns.map(|place| thing(Shape::Ball(0.8), place, texture(7, 0.3)))).collect() }
}

/// One camera that walks through the street, swaying, and looks to both sides.
fn walk(moments: usize) -> Scene {
    let pose = |i: usize| {
        let at = i as f64 / (moments - 1) as f64;
        let eye = [0.15 * half_turns(12.0 * at), 1.5 + 0.05 * half_turns(24.0 * at), WALKED * (0.5 - at)];
        let [x, y, z] = eye;
        camera(eye, [x + 0.9 * half_turns(4.0 * at), y - 0.25, z - 3.0])
    };
    let path = Viewer { poses: (0..moments).map(pose).collect(), ..Viewer::fixed(pose(0)) };
    Scene {
        world: street(),
        viewers: vec![path],
        moments,
        fps: 10.0,
        units: 1.0,
        points: WALK_POINTS * moments,
        moving_points: true,
        truth: false,
    }
}
