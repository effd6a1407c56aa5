use super::*;
use splat4d::math::Se3;
use splat4d::math::se3::{add, cross, dot, scale, sub};
use splat4d::scene::Camera;

/// A tag in the world.
pub(crate) struct Put {
    pub family: Family,
    pub id: usize,
    /// Where the dark square's first corner is.
    pub corner: [f64; 3],
    /// Along its upper edge, and down its left one.
    pub right: [f64; 3],
    pub down: [f64; 3],
}

impl Put {
    /// What is on the plane of the tag, in sides from its corner: dark, bright, nothing.
    fn shade(&self, code: u64, [s, t]: [f64; 2]) -> Option<f32> {
        let all = self.family.side + 2;
        let rim = 1.5 / all as f64;
        if !(-rim..1.0 + rim).contains(&s) || !(-rim..1.0 + rim).contains(&t) {
            return None;
        }
        let [column, row] = [s, t].map(|v| (v * all as f64).floor() as i64 - 1);
        let n = self.family.side as i64;
        let inside = (0..n).contains(&row) && (0..n).contains(&column);
        let outside = !(0.0..1.0).contains(&s) || !(0.0..1.0).contains(&t);
        let white = outside || inside && (code >> (n * n - 1 - (row * n + column))) & 1 == 1;
        Some(if white { 0.85 } else { 0.12 })
    }
}

/// What a camera sees of tags before something plain that brightens downwards.
pub(crate) fn drawn(camera: &Camera, puts: &[Put]) -> Planes<f32> {
    const FINE: usize = 4;
    let codes: Vec<u64> = puts.iter().map(|p| p.family.codes()[p.id]).collect();
    let mut out = Planes::new(1, camera.height, camera.width);
    let center = camera.center();
    for (p, value) in out.data.iter_mut().enumerate() {
        let (x, y) = (p % camera.width, p / camera.width);
        let mut sum = 0.0;
        for k in 0..FINE * FINE {
            let at = |i: usize, v: usize| v as f64 + (i as f64 + 0.5) / FINE as f64;
            let ray = sub(camera.unproject([at(k % FINE, x), at(k / FINE, y)], 1.0), center);
            let seen = puts.iter().zip(&codes).find_map(|(put, code)| {
                let normal = cross(put.right, put.down);
                let far = dot(normal, sub(put.corner, center)) / dot(normal, ray);
                let on = sub(add(center, scale(ray, far)), put.corner);
                let share = |v: [f64; 3]| dot(on, v) / dot(v, v);
                (far > 0.0).then(|| put.shade(*code, [share(put.right), share(put.down)])).flatten()
            });
            sum += seen.unwrap_or(0.35 + 0.2 * y as f32 / camera.height as f32);
        }
        *value = sum / (FINE * FINE) as f32;
    }
    out
}

fn family(name: &str) -> Family {
    FAMILIES.into_iter().find(|f| f.name == name).expect("it is known")
}

/// Pixels between the rendered corners and the found ones, at most.
fn worst(camera: &Camera, put: &Put, found: &Tag) -> f64 {
    let corners =
        [put.corner, add(put.corner, put.right), add(add(put.corner, put.right), put.down), add(put.corner, put.down)];
    let off = |(k, c): (usize, &[f64; 3])| {
        let (p, _) = camera.project(*c).expect("it lies before the camera");
        (p[0] - found.corners[k][0]).hypot(p[1] - found.corners[k][1])
    };
    corners.iter().enumerate().map(off).fold(0.0, f64::max)
}

#[test]
fn tags_of_all_families_are_read_at_an_angle() {
    for (k, name) in ["36h11", "4x4", "5x5", "6x6"].into_iter().enumerate() {
        let family = family(name);
        let id = [581, 7, 249, 120][k];
        for (turn, eye) in [(0.2, [0.3, -0.4, -2.2]), (1.9, [-0.9, 0.5, -1.7]), (3.6, [0.8, 0.9, -1.6])] {
            let camera = Camera::with_fov_y(Se3::look_at(eye, [0.05, 0.0, 0.0], [0.1, -1.0, 0.0]), 0.7, 320, 240);
            let [c, s] = [f64::cos(turn), f64::sin(turn)];
            let (right, down) = ([0.6 * c, 0.6 * s, 0.0], [-0.6 * s, 0.6 * c, 0.0]);
            let corner = scale(add(right, down), -0.5);
            let put = Put { family, id, corner, right, down };
            let found = tags(&drawn(&camera, std::slice::from_ref(&put)), &family);
            assert_eq!(found.iter().map(|t| t.id).collect::<Vec<_>>(), [id], "{name} turned by {turn}");
            let off = worst(&camera, &put, &found[0]);
            assert!(off < 0.1, "{name} turned by {turn}: corners are {off} px off");
        }
    }
}

#[test]
fn other_patterns_are_not_tags() {
    let family = family("36h11");
    let camera = Camera::with_fov_y(Se3::look_at([0.0, 0.0, -2.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.7, 320, 240);
    let mut picture = drawn(&camera, &[]);
    assert_eq!(tags(&picture, &family), []);
    // A dark square without bits, a stripe, and noise.
    for (p, v) in picture.data.iter_mut().enumerate() {
        let (x, y) = (p % 320, p / 320);
        if (60..120).contains(&x) && (60..120).contains(&y) || (200..206).contains(&x) {
            *v = 0.05;
        }
        if x > 220 {
            *v = ((x * 7919 + y * 104_729) % 251) as f32 / 250.0;
        }
    }
    assert_eq!(tags(&picture, &family), []);
    assert_eq!(tags(&Planes::new(1, 4, 4), &family), []);
}

#[test]
fn the_same_number_twice_in_an_image_is_left_out() {
    let family = family("5x5");
    let put =
        |id: usize, x: f64| Put { family, id, corner: [x, -0.2, 0.0], right: [0.4, 0.0, 0.0], down: [0.0, 0.4, 0.0] };
    let camera = Camera::with_fov_y(Se3::look_at([0.0, 0.0, -3.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.7, 400, 200);
    let found = tags(&drawn(&camera, &[put(3, -1.2), put(4, -0.2), put(3, 0.7)]), &family);
    assert_eq!(found.iter().map(|t| t.id).collect::<Vec<_>>(), [4]);
}

#[test]
fn a_board_is_parsed_from_one_word() {
    let board: Board = "36h11:0.16:floor".parse().expect("it is right");
    assert_eq!((board.family.name, board.side, board.lies), ("36h11", 0.16, Some(Lies::Floor)));
    assert_eq!("4x4: 0.03".parse::<Board>().expect("it is right").lies, None);
    for wrong in
        ["", "36h11", "36h12:0.1", "36h11:big", "36h11:-1", "36h11:nan", "36h11:0.1:roof", "36h11:0.1:floor:wall"]
    {
        let e = wrong.parse::<Board>().expect_err(wrong);
        assert!(e.to_string().contains("36h11:0.16"), "{e}");
    }
}

#[test]
fn no_two_patterns_of_a_family_are_confused() {
    for family in FAMILIES {
        let codes = family.codes();
        let n = family.side;
        let turned = |code: u64| {
            (0..n * n).fold(0u64, |out, k| {
                let (row, column) = (k % n, n - 1 - k / n);
                (out << 1) | ((code >> (n * n - 1 - (row * n + column))) & 1)
            })
        };
        for (i, a) in codes.iter().enumerate() {
            let mut b = *a;
            for _ in 0..4 {
                b = turned(b);
                for (k, c) in codes.iter().enumerate() {
                    let same = k == i && b == *a;
                    assert!(same || (b ^ c).count_ones() > 2 * family.wrong, "{}: {i} and {k}", family.name);
                }
            }
        }
    }
}

#[test]
fn a_homography_maps_corners_to_corners() {
    let corners = [[10.0, 12.0], [90.0, 20.0], [80.0, 95.0], [5.0, 70.0]];
    let square = Square::new(&corners).expect("it is one");
    for (unit, corner) in [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].into_iter().zip(corners) {
        let at = square.at(unit);
        assert!((at[0] - corner[0]).hypot(at[1] - corner[1]) < 1e-9, "{unit:?} goes to {at:?}");
    }
}
