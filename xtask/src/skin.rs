//! A character: node tree, skinned and attached meshes, clips and texture; posed by linear blend skinning.

use crate::glb::{Glb, number};
use crate::mesh::Mesh;
use crate::texture::Texture;
use crate::vector::{Affine, Quat, V3, nlerp, v3};
use anyhow::{Context, Result, ensure};
use serde_json::Value;

/// Local transform of one node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Trs {
    translation: V3,
    rotation: Quat,
    scale: V3,
}

/// Local transforms of all nodes.
pub(crate) type Pose = Vec<Trs>;

#[derive(Clone, Copy, PartialEq)]
enum Path {
    Translation,
    Rotation,
    Scale,
}

struct Channel {
    node: usize,
    path: Path,
    step: bool,
    times: Vec<f64>,
    /// Rows of 3 or 4 numbers.
    values: Vec<f64>,
}

struct Clip {
    name: String,
    seconds: f64,
    channels: Vec<Channel>,
}

/// One drawable part.
struct Part {
    node: usize,
    positions: Vec<V3>,
    normals: Vec<V3>,
    uvs: Vec<[f64; 2]>,
    triangles: Vec<[u32; 3]>,
    /// Per vertex four (joint, weight); empty for parts that hang rigidly on their node.
    influences: Vec<[(usize, f64); 4]>,
}

/// A loaded character.
pub(crate) struct Character {
    names: Vec<String>,
    parents: Vec<Option<usize>>,
    rest: Pose,
    joints: Vec<usize>,
    joint_from_mesh: Vec<Affine>,
    parts: Vec<Part>,
    clips: Vec<Clip>,
    /// Base colour.
    pub texture: Texture,
}

impl Character {
    /// Loads the first skin, all meshes and all clips. Errors: features this small reader does not support.
    pub(crate) fn load(glb: &Glb) -> Result<Character> {
        let nodes = glb.list("nodes");
        let mut parents = vec![None; nodes.len()];
        for (i, node) in nodes.iter().enumerate() {
            for child in node.get("children").and_then(Value::as_array).into_iter().flatten() {
                let child = child.as_u64().context("child index")? as usize;
                *parents.get_mut(child).context("child index beyond the nodes")? = Some(i);
            }
        }
        let rest = nodes.iter().map(rest_transform).collect::<Result<Pose>>()?;
        let skin = glb.list("skins").first().context("the file has no skin")?;
        let joints: Vec<usize> = skin["joints"]
            .as_array()
            .context("joints")?
            .iter()
            .filter_map(|j| j.as_u64().map(|j| j as usize))
            .collect();
        ensure!(joints.iter().all(|j| *j < nodes.len()), "a joint index is beyond the nodes");
        let (binds, width) = glb.accessor(number(skin, "inverseBindMatrices").context("inverseBindMatrices")?)?;
        ensure!(width == 16 && binds.len() == 16 * joints.len(), "one inverse bind matrix per joint");
        let joint_from_mesh = binds.chunks_exact(16).map(Affine::from_columns).collect();
        let mut parts = Vec::new();
        for (i, node) in nodes.iter().enumerate() {
            if let Some(mesh) = number(node, "mesh") {
                let mesh = glb.list("meshes").get(mesh).context("mesh index beyond the meshes")?;
                for primitive in mesh["primitives"].as_array().into_iter().flatten() {
                    parts
                        .push(part(glb, i, primitive, joints.len()).with_context(|| format!("mesh {}", mesh["name"]))?);
                }
            }
        }
        let clips = glb.list("animations").iter().map(|a| clip(glb, a, nodes.len())).collect::<Result<_>>()?;
        let image = glb.list("images").first().context("the file has no texture")?;
        let png = glb.view(number(image, "bufferView").context("the texture is not embedded")?)?;
        let names = nodes.iter().map(|n| n["name"].as_str().unwrap_or("").to_owned()).collect();
        Ok(Character { names, parents, rest, joints, joint_from_mesh, parts, clips, texture: Texture::from_png(png)? })
    }

    /// Index of the node `name`.
    pub(crate) fn node(&self, name: &str) -> Result<usize> {
        self.names.iter().position(|n| n == name).with_context(|| format!("no node is named {name}"))
    }

    /// The pose that the file rests in.
    pub(crate) fn rest(&self) -> &Pose {
        &self.rest
    }

    /// The pose of `clip` at `seconds`, repeated beyond its end.
    pub(crate) fn sample(&self, clip: &str, seconds: f64) -> Result<Pose> {
        let clip = self.clips.iter().find(|c| c.name == clip).with_context(|| format!("no clip is named {clip}"))?;
        let t = if clip.seconds > 0.0 { seconds - (seconds / clip.seconds).floor() * clip.seconds } else { 0.0 };
        let mut pose = self.rest.clone();
        for channel in &clip.channels {
            channel.apply(t, &mut pose[channel.node]);
        }
        Ok(pose)
    }

    /// `a` at s = 0, `b` at s = 1.
    pub(crate) fn blend(a: &Pose, b: &Pose, s: f64) -> Pose {
        let mix = |(a, b): (&Trs, &Trs)| Trs {
            translation: a.translation.lerp(b.translation, s),
            rotation: nlerp(a.rotation, b.rotation, s),
            scale: a.scale.lerp(b.scale, s),
        };
        a.iter().zip(b).map(mix).collect()
    }

    /// `lower` with the subtree under node `root` taken from `upper` (walk and cast at once).
    pub(crate) fn combine(&self, lower: &Pose, upper: &Pose, root: &str) -> Result<Pose> {
        let root = self.node(root)?;
        let under = |mut i: usize| loop {
            match self.parents[i] {
                _ if i == root => break true,
                Some(parent) => i = parent,
                None => break false,
            }
        };
        Ok((0..lower.len()).map(|i| if under(i) { upper[i] } else { lower[i] }).collect())
    }

    /// Node-to-character maps of all nodes.
    pub(crate) fn globals(&self, pose: &Pose) -> Vec<Affine> {
        let local = |i: usize| Affine::from_trs(pose[i].translation, pose[i].rotation, pose[i].scale);
        let up_to_root = |i: usize| {
            let (mut map, mut at) = (local(i), self.parents[i]);
            while let Some(parent) = at {
                map = local(parent).compose(&map);
                at = self.parents[parent];
            }
            map
        };
        (0..pose.len()).map(up_to_root).collect()
    }

    /// Appends the posed character to `mesh`, skinned parts first, and returns the number of skinned vertices.
    pub(crate) fn draw(&self, pose: &Pose, world: &Affine, material: u16, object: u8, mesh: &mut Mesh) -> usize {
        let globals = self.globals(pose);
        let skinning: Vec<Affine> = self
            .joints
            .iter()
            .zip(&self.joint_from_mesh)
            .map(|(j, bind)| world.compose(&globals[*j].compose(bind)))
            .collect();
        let (skinned, rigid): (Vec<&Part>, Vec<&Part>) = self.parts.iter().partition(|p| !p.influences.is_empty());
        for part in &skinned {
            let maps = part.influences.iter().map(|influences| {
                let mut map = Affine { x: V3::default(), y: V3::default(), z: V3::default(), origin: V3::default() };
                influences.iter().for_each(|(joint, weight)| map.add_scaled(&skinning[*joint], *weight));
                map
            });
            part.push(maps, material, object, mesh);
        }
        for part in &rigid {
            let map = world.compose(&globals[part.node]);
            part.push(std::iter::repeat_n(map, part.positions.len()), material, object, mesh);
        }
        skinned.iter().map(|p| p.positions.len()).sum()
    }
}

impl Part {
    fn push(&self, maps: impl Iterator<Item = Affine>, material: u16, object: u8, mesh: &mut Mesh) {
        let first = mesh.positions.len() as u32;
        for (i, map) in maps.enumerate() {
            mesh.push_vertex(map.point(self.positions[i]), map.turn(self.normals[i]).unit(), self.uvs[i]);
        }
        for t in &self.triangles {
            mesh.push_triangle(t.map(|v| v + first), material, object);
        }
    }
}

impl Channel {
    fn apply(&self, t: f64, trs: &mut Trs) {
        let after = self.times.partition_point(|k| *k <= t);
        let (a, b) = (after.saturating_sub(1), after.min(self.times.len() - 1));
        let gap = self.times[b] - self.times[a];
        let s = if self.step || gap <= 0.0 { 0.0 } else { ((t - self.times[a]) / gap).clamp(0.0, 1.0) };
        let vector = |i: usize| v3(self.values[3 * i], self.values[3 * i + 1], self.values[3 * i + 2]);
        let quat = |i: usize| -> Quat { std::array::from_fn(|c| self.values[4 * i + c]) };
        match self.path {
            Path::Translation => trs.translation = vector(a).lerp(vector(b), s),
            Path::Scale => trs.scale = vector(a).lerp(vector(b), s),
            Path::Rotation => trs.rotation = nlerp(quat(a), quat(b), s),
        }
    }
}

fn rest_transform(node: &Value) -> Result<Trs> {
    ensure!(
        node.get("matrix").is_none(),
        "node {} is given by a matrix, which this reader does not know",
        node["name"]
    );
    let numbers = |name: &str, default: &[f64]| -> Vec<f64> {
        node.get(name)
            .and_then(Value::as_array)
            .map_or_else(|| default.to_vec(), |list| list.iter().filter_map(Value::as_f64).collect())
    };
    let (t, r, s) =
        (numbers("translation", &[0.0; 3]), numbers("rotation", &[0.0, 0.0, 0.0, 1.0]), numbers("scale", &[1.0; 3]));
    ensure!(t.len() == 3 && r.len() == 4 && s.len() == 3, "node {} has a malformed transform", node["name"]);
    Ok(Trs { translation: v3(t[0], t[1], t[2]), rotation: [r[0], r[1], r[2], r[3]], scale: v3(s[0], s[1], s[2]) })
}

fn part(glb: &Glb, node: usize, primitive: &Value, joints: usize) -> Result<Part> {
    let attribute = |name: &str, width: usize| -> Result<Option<Vec<f64>>> {
        let Some(index) = number(&primitive["attributes"], name) else { return Ok(None) };
        let (values, w) = glb.accessor(index)?;
        ensure!(w == width, "{name} has {w} components instead of {width}");
        Ok(Some(values))
    };
    let vectors = |v: Vec<f64>| -> Vec<V3> { v.chunks_exact(3).map(|c| v3(c[0], c[1], c[2])).collect() };
    let positions = vectors(attribute("POSITION", 3)?.context("no POSITION")?);
    let normals = vectors(attribute("NORMAL", 3)?.context("no NORMAL")?);
    let uvs: Vec<[f64; 2]> =
        attribute("TEXCOORD_0", 2)?.context("no TEXCOORD_0")?.chunks_exact(2).map(|c| [c[0], c[1]]).collect();
    let (indices, _) = glb.accessor(number(primitive, "indices").context("no indices")?)?;
    ensure!(normals.len() == positions.len() && uvs.len() == positions.len(), "attributes of different lengths");
    ensure!(indices.iter().all(|i| (*i as usize) < positions.len()), "a vertex index is beyond the vertices");
    let triangles = indices.chunks_exact(3).map(|t| [t[0] as u32, t[1] as u32, t[2] as u32]).collect();
    let influences: Vec<[(usize, f64); 4]> = match (attribute("JOINTS_0", 4)?, attribute("WEIGHTS_0", 4)?) {
        (Some(j), Some(w)) => j
            .chunks_exact(4)
            .zip(w.chunks_exact(4))
            .map(|(j, w)| {
                let sum: f64 = w.iter().sum();
                std::array::from_fn(|i| (j[i] as usize, w[i] / sum))
            })
            .collect(),
        _ => Vec::new(),
    };
    ensure!(influences.is_empty() || influences.len() == positions.len(), "JOINTS_0 of another length");
    ensure!(influences.iter().flatten().all(|(j, w)| *j < joints && w.is_finite()), "JOINTS_0 or WEIGHTS_0 is wrong");
    Ok(Part { node, positions, normals, uvs, triangles, influences })
}

fn clip(glb: &Glb, animation: &Value, nodes: usize) -> Result<Clip> {
    let samplers = animation["samplers"].as_array().context("animation without samplers")?;
    let mut channels = Vec::new();
    for channel in animation["channels"].as_array().into_iter().flatten() {
        let path = match channel["target"]["path"].as_str() {
            Some("translation") => Path::Translation,
            Some("rotation") => Path::Rotation,
            Some("scale") => Path::Scale,
            _ => continue,
        };
        let Some(node) = number(&channel["target"], "node") else { continue };
        let sampler = number(channel, "sampler").and_then(|i| samplers.get(i)).context("channel without sampler")?;
        let interpolation = sampler.get("interpolation").and_then(Value::as_str).unwrap_or("LINEAR");
        ensure!(matches!(interpolation, "LINEAR" | "STEP"), "interpolation {interpolation} is not known");
        let (times, _) = glb.accessor(number(sampler, "input").context("sampler without input")?)?;
        let (values, width) = glb.accessor(number(sampler, "output").context("sampler without output")?)?;
        ensure!(width == if path == Path::Rotation { 4 } else { 3 }, "sampler output of the wrong width");
        ensure!(!times.is_empty() && values.len() == width * times.len() && node < nodes, "malformed channel");
        channels.push(Channel { node, path, step: interpolation == "STEP", times, values });
    }
    let seconds = channels.iter().filter_map(|c| c.times.last().copied()).fold(0.0, f64::max);
    Ok(Clip { name: animation["name"].as_str().unwrap_or("").to_owned(), seconds, channels })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn knight() -> Character {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/knight/characters/Knight.glb");
        Character::load(&Glb::parse(&std::fs::read(path).expect("the file is there")).expect("parses")).expect("loads")
    }

    #[test]
    fn the_bind_pose_does_not_move_skinned_vertices() {
        let knight = knight();
        let mut mesh = Mesh::default();
        let skinned = knight.draw(&knight.rest, &Affine::IDENTITY, 0, 1, &mut mesh);
        let at_rest = knight.parts.iter().filter(|p| !p.influences.is_empty()).flat_map(|p| &p.positions);
        let worst = at_rest.zip(&mesh.positions).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max);
        assert!(skinned > 3000 && mesh.positions.len() > skinned, "{skinned} of {}", mesh.positions.len());
        // The file's transforms are single precision.
        assert!(worst < 1e-5, "a vertex moved by {worst}");
        let posed = knight.sample("Running_A", 0.2).expect("the clip is kept");
        let mut running = Mesh::default();
        knight.draw(&posed, &Affine::IDENTITY, 0, 1, &mut running);
        let moved = mesh.positions.iter().zip(&running.positions).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max);
        assert!(moved > 0.3, "running moves vertices, the furthest by {moved}");
    }

    #[test]
    fn clips_interpolate_and_repeat() {
        let channel = |step| Channel {
            node: 0,
            path: Path::Translation,
            step,
            times: vec![0.0, 1.0],
            values: vec![0.0, 0.0, 0.0, 2.0, 0.0, 0.0],
        };
        let at = |step, t| {
            let mut trs = Trs { translation: V3::default(), rotation: [0.0, 0.0, 0.0, 1.0], scale: v3(1.0, 1.0, 1.0) };
            channel(step).apply(t, &mut trs);
            trs.translation.x
        };
        assert_eq!((at(false, 0.25), at(true, 0.25), at(false, 1.0), at(false, 9.0)), (0.5, 0.0, 2.0, 2.0));
        let knight = knight();
        let (a, b) = (knight.sample("Running_A", 0.1), knight.sample("Running_A", 0.9));
        let (a, b) = (a.expect("clip"), b.expect("clip"));
        let off = a.iter().zip(&b).map(|(a, b)| (a.translation - b.translation).length()).fold(0.0, f64::max);
        assert!(off < 1e-6, "the clip lasts 0.8 s, so both times are one; off by {off}");
        assert!(knight.sample("Swimming", 0.0).is_err());
    }

    #[test]
    fn files_with_wild_indices_are_refused() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/knight/characters/Knight.glb");
        let glb = Glb::parse(&std::fs::read(path).expect("the file is there")).expect("parses");
        for (list, index, member) in
            [("skins", 0, "inverseBindMatrices"), ("nodes", 50, "mesh"), ("images", 0, "bufferView")]
        {
            let mut wild = Glb { json: glb.json.clone(), bin: glb.bin.clone() };
            wild.json[list][index][member] = serde_json::json!(99_999);
            assert!(Character::load(&wild).is_err(), "{list}[{index}].{member}");
        }
        let mut short = Glb { json: glb.json.clone(), bin: glb.bin.clone() };
        short.bin.truncate(1000);
        assert!(Character::load(&short).is_err());
    }
}
