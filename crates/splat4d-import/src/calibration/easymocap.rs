//! EasyMocap's intri.yml and extri.yml: all cameras in one file, with the camera's name behind each key.

use super::opencv::{intrinsics, lens, numbers, pose, whole_size};
use super::tree::Tree;
use super::{Dialect, Part, Said, Text};
use splat4d::{Error, Result};

pub(super) const DIALECT: Dialect = Dialect { name: "EasyMocap (intri.yml, extri.yml)", reads, read };

/// Prefix of a camera's name.
const KEYS: [&str; 4] = ["K_", "Rot_", "R_", "T_"];

/// Names of cameras: as listed, else as keys have them.
fn names(tree: &Tree) -> Vec<String> {
    let mut out: Vec<String> = match tree.get("names").and_then(Tree::list) {
        Some(list) => list.iter().filter_map(Tree::text).collect(),
        None => Vec::new(),
    };
    if out.is_empty() {
        for (key, _) in tree.entries() {
            let name = KEYS.iter().find_map(|k| key.strip_prefix(k));
            if let Some(name) = name.filter(|n| !out.iter().any(|o| o == n)) {
                out.push(name.to_owned());
            }
        }
    }
    out
}

fn reads(text: &Text) -> bool {
    let there = |key: &str| text.tree.entries().iter().any(|(k, v)| k.starts_with(key) && v.matrix().is_some());
    there("K_") || there("T_") && (there("Rot_") || there("R_"))
}

fn read(text: &Text) -> Result<Said> {
    let tree = &text.tree;
    let has = |key: &str| tree.entries().iter().any(|(k, _)| k.starts_with(key));
    let (lenses, places) = (has("K_"), has("T_"));
    let mut said = Said::default();
    for name in names(tree) {
        let place = |e: Error| e.at(format!("camera {name:.80}"));
        let matrix = |key: &str| {
            let key = format!("{key}{name}");
            tree.get(&key).map(|v| numbers(&key, v)).transpose().map_err(place)
        };
        let missing = |key: &str| {
            let what = format!("{key}{name} is missing");
            place(Error::input(what).remedy("Add it, or take the camera out of names."))
        };
        let optics = if lenses {
            let k = matrix("K_")?.ok_or_else(|| missing("K_"))?;
            let terms = matrix("dist_")?.or(matrix("D_")?).map_or_else(Vec::new, |d| d.data);
            Some((intrinsics(&k).map_err(place)?, lens(&terms, false).map_err(place)?))
        } else {
            None
        };
        let pose = if places {
            let rotation = matrix("Rot_")?.or(matrix("R_")?).ok_or_else(|| missing("R_"))?;
            Some(pose(&rotation, &matrix("T_")?.ok_or_else(|| missing("T_"))?).map_err(place)?)
        } else {
            None
        };
        let side = |key: &str| tree.get(&format!("{key}{name}")).and_then(Tree::number);
        let size = side("W_").zip(side("H_")).map(|(w, h)| whole_size(&[w, h])).transpose().map_err(place)?;
        if said.parts.iter().any(|p: &Part| p.names[0] == name) {
            return Err(place(Error::input("it is there twice").remedy("Take one out of names.")));
        }
        said.parts.push(Part { names: vec![name.clone()], size, optics, pose });
    }
    Ok(said)
}
