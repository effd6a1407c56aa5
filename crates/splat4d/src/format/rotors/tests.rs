use super::*;
use crate::format::checkpoint;
use crate::format::zip;
use crate::layers::{Evaluation, freeze};
use crate::math::Rng;
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Space, Time};

const ROWS: usize = 11;

/// Tensors of a checkpoint: shape and numbers.
type Tensors = Vec<(Vec<usize>, Vec<f32>)>;

fn random(seed: u64, shape: &[usize], size: f64) -> (Vec<usize>, Vec<f32>) {
    let rng = Rng::new(seed, "rotors", 0);
    (shape.to_vec(), (0..shape.iter().product::<usize>()).map(|i| (size * rng.normal(i as u64)) as f32).collect())
}

/// A file of `torch.save` of ((degree, tensors..., None..., tensors..., flag, None, 2), step).
fn saved(first: &Tensors, between: usize, second: &Tensors, rotates: Option<bool>) -> Vec<u8> {
    let mut p = b"\x80\x02((K\x03".to_vec();
    let mut files: Vec<(String, Vec<u8>)> = Vec::new();
    let mut put = |p: &mut Vec<u8>, (shape, numbers): &(Vec<usize>, Vec<f32>)| {
        let text = |p: &mut Vec<u8>, s: &str| {
            p.push(b'X');
            p.extend((s.len() as u32).to_le_bytes());
            p.extend(s.as_bytes());
        };
        let int = |p: &mut Vec<u8>, n: usize| {
            p.push(b'J');
            p.extend((n as u32).to_le_bytes());
        };
        let key = files.len().to_string();
        // A parameter, as trained tensors are: it holds a tensor.
        p.extend(b"ctorch._utils\n_rebuild_parameter\n(ctorch._utils\n_rebuild_tensor_v2\n((");
        text(p, "storage");
        p.extend(b"ctorch\nFloatStorage\n");
        text(p, &key);
        text(p, "cuda:0");
        int(p, numbers.len());
        p.extend(b"tQ");
        int(p, 0);
        p.push(b'(');
        shape.iter().for_each(|d| int(p, *d));
        p.extend(b"t(");
        (0..shape.len()).for_each(|k| int(p, shape[k + 1..].iter().product()));
        p.extend(b"t\x89ccollections\nOrderedDict\n)RtR\x88ccollections\nOrderedDict\n)RtR");
        files.push((format!("chkpnt/data/{key}"), numbers.iter().flat_map(|x| x.to_le_bytes()).collect()));
    };
    first.iter().for_each(|t| put(&mut p, t));
    p.extend(vec![b'N'; between - 2]);
    // The optimiser and the size of the scene.
    p.extend(b"}K\x05");
    second.iter().for_each(|t| put(&mut p, t));
    if let Some(rotates) = rotates {
        p.extend([if rotates { 0x88 } else { 0x89 }, b'N', b'K', 2]);
    }
    p.extend(b"tK\x07t.");
    files.insert(0, ("chkpnt/data.pkl".into(), p));
    let all: Vec<(&str, &[u8])> = files.iter().map(|(n, b)| (n.as_str(), &b[..])).collect();
    let mut out = Vec::new();
    zip::write(&all, 64, &mut out).unwrap();
    out
}

/// xyz, f_dc, f_rest, log scales, quaternions, logits.
fn static_tensors(further: usize) -> Tensors {
    vec![
        random(1, &[ROWS, 3], 0.8),
        random(2, &[ROWS, 1, 3], 0.5),
        random(3, &[ROWS, further, 3], 0.2),
        random(4, &[ROWS, 3], 0.4),
        random(5, &[ROWS, 4], 1.0),
        random(6, &[ROWS, 1], 1.5),
    ]
}

/// Times over 0 to 2, log scales in time, right quaternions.
fn moving_tensors() -> Tensors {
    let mut times = random(7, &[ROWS, 1], 0.0);
    times.1.iter_mut().enumerate().for_each(|(i, t)| *t = -0.2 + 2.4 * i as f32 / (ROWS - 1) as f32);
    vec![times, random(8, &[ROWS, 1], 0.4), random(9, &[ROWS, 4], 1.0)]
}

/// Their rotation of four dimensions: rows and columns x, y, z, t.
fn rotation(l: [f64; 4], r: [f64; 4]) -> [[f64; 4]; 4] {
    let unit = |q: [f64; 4]| {
        let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        q.map(|x| x / norm)
    };
    let ([a, b, c, d], [p, q, r, s]) = (unit(l), unit(r));
    let left = [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]];
    let right = [[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]];
    let product = |i: usize, j: usize| (0..4).map(|k| left[i][k] * right[k][j]).sum::<f64>();
    std::array::from_fn(|i| std::array::from_fn(|j| product(3 - i, 3 - j)))
}

#[test]
fn gaussians_of_space_and_time_are_sliced_as_there() {
    let (first, second) = (static_tensors(47), moving_tensors());
    let file = saved(&first, 6, &second, Some(true));
    let opened = checkpoint::DIALECT.open(&file).unwrap();
    assert!(opened.warnings.lines()[0].contains("0 to 2"), "{:?}", opened.warnings);
    let on_capture = checkpoint::open_on(&file, Some([10.0, 14.0])).unwrap().scene;
    for (scene, from, unit) in [(&opened.scene, 0.0, 1.0), (&on_capture, 10.0, 2.0)] {
        for step in 0..10 {
            let t = 2.0 * f64::from(step) / 9.0;
            let layer = &scene.layers[0];
            let seen = Evaluation::of_layer(layer, Space::Gaussians, crate::scene::Rows::All, Time(from + t * unit));
            let (out, mut colors) = (seen.tape(0).out(), Vec::new());
            for row in 0..ROWS {
                let number =
                    |tensor: &(Vec<usize>, Vec<f32>), k: usize| f64::from(tensor.1[row * tensor.1.len() / ROWS + k]);
                let quat = |tensor| std::array::from_fn(|k| number(tensor, k));
                let r = rotation(quat(&first[4]), quat(&second[2]));
                let s = [0, 1, 2, 3].map(|k| if k < 3 { number(&first[3], k) } else { number(&second[1], 0) }.exp());
                let cov = |i: usize, j: usize| (0..4).map(|k| r[i][k] * s[k] * s[k] * r[j][k]).sum::<f64>();
                let dt = t - number(&second[0], 0);
                for k in 0..3 {
                    let mean = number(&first[0], k) + cov(k, 3) / cov(3, 3) * dt;
                    assert!((f64::from(out.get(row, k)) - mean).abs() < 1e-4, "{row} {k} at {t}");
                }
                for (c, (i, j)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].into_iter().enumerate() {
                    let expected = cov(i, j) - cov(i, 3) * cov(j, 3) / cov(3, 3);
                    let got = f64::from(out.get(row, COV + c));
                    assert!((got - expected).abs() < 1e-4 * expected.abs().max(1.0), "{row} {i}{j} at {t}");
                }
                let alpha = 1.0 / (1.0 + (-number(&first[5], 0)).exp()) * (-0.5 * dt * dt / cov(3, 3)).exp();
                assert!((f64::from(out.get(row, SPLAT_OPACITY)) - alpha).abs() < 1e-4, "{row} at {t}");
                if alpha >= 1.0 / 255.0 {
                    let wave = |n: usize| (std::f64::consts::TAU * n as f64 * dt / 2.0).cos();
                    let rest = |k: usize| f64::from(first[2].1[(row * 47 + k - 1) * 3 + 1]);
                    colors.push(wave(0) * rest(8) + wave(1) * rest(24) + wave(2) * rest(40));
                }
            }
            let now = freeze(scene, Time(from + t * unit)).unwrap();
            assert_eq!(now.len(), colors.len(), "at {t}");
            for (row, expected) in colors.into_iter().enumerate() {
                let got = f64::from(now[SH].get(row, 3 * 8 + 1));
                assert!((got - expected).abs() < 1e-4, "{row} at {t}: {got} {expected}");
            }
        }
    }
}

#[test]
fn checkpoints_of_3dgs_are_static_and_others_are_refused() {
    let file = saved(&static_tensors(15), 5, &Vec::new(), None);
    let opened = checkpoint::DIALECT.open(&file).unwrap();
    assert!(!opened.scene.is_moving());
    let now = freeze(&opened.scene, Time(0.0)).unwrap();
    assert_eq!((now.len(), now[SH].width()), (ROWS, 48));
    let error = |bytes: Vec<u8>| checkpoint::DIALECT.open(&bytes).unwrap_err().to_string();
    assert!(error(saved(&static_tensors(15), 6, &moving_tensors(), Some(false))).contains("rot_4d"));
    assert!(error(saved(&static_tensors(20), 6, &moving_tensors(), Some(true))).contains("21 coefficients"));
    let mut short = moving_tensors();
    short[2] = random(9, &[ROWS - 1, 4], 1.0);
    assert!(error(saved(&static_tensors(15), 6, &short, Some(true))).contains("entry 15"));
}

#[test]
fn ranges_of_time_are_estimated() {
    let spread = |from: f32, to: f32| (0..1000).map(|i| from + (to - from) * i as f32 / 999.0).collect::<Vec<_>>();
    assert_eq!(range_of(&spread(-0.1, 1.1)), [0.0, 1.0]);
    assert_eq!(range_of(&spread(-1.0, 11.0)), [0.0, 10.0]);
    assert_eq!(range_of(&spread(-0.6, 0.6)), [-0.5, 0.5]);
    assert_eq!(range_of(&[]), [0.0, 1.0]);
    assert_eq!(range_of(&[f32::NAN]), [0.0, 1.0]);
}
