//! Networks of research code next to Gaussians, and checkpoints without names.

use crate::Reader;
use crate::zip::zip;
use splat4d::format::ply;
use splat4d::format::research;
use splat4d::scene::{GEOMETRY, Params};

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "research", seeds: networks, read: network },
    Reader { name: "research_pickle", seeds: pickles, read: |pickle| network(&archive(pickle)) },
];

/// Numbers of the one storage that all tensors share.
const NUMBERS: usize = 8192;
/// Gaussians, and what they have for control nodes.
const ROWS: usize = 3;
const HYPER: usize = 2;

type Tensor = (String, Vec<usize>);

/// An archive of `torch.save` with a storage that is sound.
fn archive(pickle: &[u8]) -> Vec<u8> {
    let numbers: Vec<u8> = (0..NUMBERS).flat_map(|i| ((i as f32 * 0.7).sin() * 0.3).to_le_bytes()).collect();
    zip(&[("archive/data.pkl", pickle), ("archive/data/0", &numbers)], false)
}

fn networks() -> Vec<Vec<u8>> {
    pickles().iter().map(|pickle| archive(pickle)).collect()
}

/// State dictionaries of all programs, and the tuple of a checkpoint.
fn pickles() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = [planes(), perceptron("", &[]), nodes()].iter().map(|t| dictionary(t)).collect();
    all.push(tuple());
    all
}

fn maps(prefix: &str, shapes: &[(&str, usize, usize)]) -> Vec<Tensor> {
    let both = |&(name, inputs, outputs): &(&str, usize, usize)| {
        [(format!("{prefix}{name}.weight"), vec![outputs, inputs]), (format!("{prefix}{name}.bias"), vec![outputs])]
    };
    shapes.iter().flat_map(both).collect()
}

/// 4DGaussians.
fn planes() -> Vec<Tensor> {
    let net = "deformation_net.";
    let mut all = vec![(format!("{net}grid.aabb"), vec![2, 3])];
    for (plane, [first, second]) in [[3, 3], [3, 3], [3, 2], [3, 3], [3, 2], [3, 2]].into_iter().enumerate() {
        all.push((format!("{net}grid.grids.0.{plane}"), vec![1, 16, second, first]));
    }
    all.extend(maps(net, &[("feature_out.0", 16, 4)]));
    for (head, outputs) in [("pos_deform", 3), ("scales_deform", 3), ("rotations_deform", 4)] {
        all.extend(maps(net, &[(&format!("{head}.1"), 4, 4), (&format!("{head}.3"), 4, outputs)]));
    }
    all
}

/// Deformable-3D-Gaussians, and the perceptron of SC-GS.
fn perceptron(prefix: &str, more: &[(&str, usize, usize)]) -> Vec<Tensor> {
    let inputs = 9 + 21;
    let mut all = maps(prefix, &[("linear.0", inputs, 4), ("linear.1", 4, 4), ("linear.2", 4 + inputs, 4)]);
    all.extend(maps(prefix, &[("gaussian_warp", 4, 3), ("gaussian_rotation", 4, 4), ("gaussian_scaling", 4, 3)]));
    all.extend(maps(prefix, more));
    all
}

/// SC-GS.
fn nodes() -> Vec<Tensor> {
    let mut all = perceptron("network.", &[("local_rotation", 4, 4)]);
    let own = [("nodes", vec![5, 3 + HYPER]), ("_node_radius", vec![5]), ("_node_weight", vec![5, 1])];
    all.extend(own.map(|(name, shape)| (name.to_owned(), shape)));
    all
}

fn text(p: &mut Vec<u8>, s: &str) {
    p.push(b'X');
    p.extend((s.len() as u32).to_le_bytes());
    p.extend(s.as_bytes());
}

fn int(p: &mut Vec<u8>, n: usize) {
    p.push(b'J');
    p.extend((n as u32).to_le_bytes());
}

fn tensor(p: &mut Vec<u8>, shape: &[usize]) {
    p.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
    text(p, "storage");
    p.extend(b"ctorch\nFloatStorage\n");
    text(p, "0");
    text(p, "cpu");
    int(p, NUMBERS);
    p.extend(b"tQ");
    int(p, 0);
    p.push(b'(');
    shape.iter().for_each(|d| int(p, *d));
    p.extend(b"t(");
    (0..shape.len()).for_each(|k| int(p, shape[k + 1..].iter().product()));
    p.extend(b"t\x89ccollections\nOrderedDict\n)RtR");
}

fn dictionary(tensors: &[Tensor]) -> Vec<u8> {
    let mut p = b"\x80\x02}(".to_vec();
    for (name, shape) in tensors {
        text(&mut p, name);
        tensor(&mut p, shape);
    }
    p.extend(b"u.");
    p
}

/// A checkpoint of 4d-gaussian-splatting: degree, tensors, statistics, optimiser, then what moves Gaussians, and the step.
fn tuple() -> Vec<u8> {
    let n = ROWS;
    let mut p = b"\x80\x02((K\x03".to_vec();
    for shape in [[n, 3, 1], [n, 1, 3], [n, 47, 3], [n, 3, 1], [n, 4, 1], [n, 1, 1]] {
        tensor(&mut p, &shape);
    }
    p.extend(b"NNNN}K\x05");
    [[n, 1], [n, 1], [n, 4]].iter().for_each(|shape| tensor(&mut p, shape));
    p.extend(b"\x88NK\x02tK\x07t.");
    p
}

/// Gaussians with features.
fn gaussians() -> Vec<u8> {
    let mut params = Params::new(ROWS, 1, &[]);
    (0..ROWS).for_each(|row| params[GEOMETRY].write(row, 0, [row as f32, 0.5, -1.0, 1.0]));
    let mut plain = Vec::new();
    ply::write(&params, &mut plain).expect("memory takes all bytes");
    let end = plain.windows(11).position(|w| w == b"end_header\n").expect("a header ends");
    let names: String = (0..HYPER).map(|i| format!("property float fea_{i}\n")).collect();
    let mut out = [&plain[..end], names.as_bytes(), b"end_header\n"].concat();
    for row in plain[end + 11..].chunks_exact((plain.len() - end - 11) / ROWS) {
        out.extend(row);
        out.extend([0; 4 * HYPER]);
    }
    out
}

/// Reads a network next to Gaussians, and as a checkpoint.
fn network(bytes: &[u8]) {
    if let Ok(opened) = research::read(&gaussians(), bytes, "", Some([0.0, 1.0])) {
        crate::formats::show(&opened.scene);
    }
    crate::formats::open(bytes);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_scenes() {
        let all = networks();
        let gaussians = gaussians();
        for network in &all[..3] {
            research::read(&gaussians, network, "", None).unwrap_or_else(|e| panic!("{e}"));
        }
        assert_eq!(splat4d::open(&all[3]).unwrap_or_else(|e| panic!("{e}")).len(), ROWS);
    }
}
