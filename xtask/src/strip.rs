//! `strip-character IN.glb OUT.glb CLIP… [--drop NODE…]`: keeps the named animation clips, drops the named mesh nodes
//! and every accessor and buffer view nothing refers to any more.

use crate::glb::{Glb, number};
use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};

/// The stripped file. Errors: a clip or node that the file does not have.
pub(crate) fn strip(glb: &Glb, clips: &[String], drop: &[String]) -> Result<Glb> {
    let mut json = glb.json.clone();
    for clip in clips {
        ensure!(glb.list("animations").iter().any(|a| a["name"] == clip.as_str()), "no clip is named {clip}");
    }
    let animations = glb.list("animations").iter().filter(|a| clips.iter().any(|c| a["name"] == c.as_str()));
    json["animations"] = animations.cloned().collect();
    for name in drop {
        let nodes = json["nodes"].as_array_mut().context("no nodes")?;
        let node = nodes.iter_mut().find(|n| n["name"] == name.as_str());
        // The node stays as an empty one: joints and channels refer to nodes by index.
        node.and_then(Value::as_object_mut).with_context(|| format!("no node is named {name}"))?.remove("mesh");
    }
    let meshes = renumber(&mut json, "meshes", |json, visit| {
        for node in array(json, "nodes") {
            visit_member(node, "mesh", visit);
        }
    })?;
    json["meshes"] = meshes;
    let accessors = renumber(&mut json, "accessors", |json, visit| {
        for mesh in array(json, "meshes") {
            for primitive in array(mesh, "primitives") {
                visit_member(primitive, "indices", visit);
                let attributes = primitive.get_mut("attributes").and_then(Value::as_object_mut);
                attributes.into_iter().flat_map(|a| a.values_mut()).for_each(&mut *visit);
            }
        }
        for skin in array(json, "skins") {
            visit_member(skin, "inverseBindMatrices", visit);
        }
        for animation in array(json, "animations") {
            for sampler in array(animation, "samplers") {
                visit_member(sampler, "input", visit);
                visit_member(sampler, "output", visit);
            }
        }
    })?;
    json["accessors"] = accessors;
    let mut views = renumber(&mut json, "bufferViews", |json, visit| {
        for name in ["accessors", "images"] {
            for user in array(json, name) {
                visit_member(user, "bufferView", visit);
            }
        }
    })?;
    let mut bin = Vec::new();
    for view in views.as_array_mut().context("bufferViews")? {
        let start = number(view, "byteOffset").unwrap_or(0);
        let length = number(view, "byteLength").context("bufferView without byteLength")?;
        let bytes = glb.bin.get(start..start + length).context("bufferView leaves the binary chunk")?;
        view["byteOffset"] = json!(bin.len());
        bin.extend_from_slice(bytes);
        bin.resize(bin.len().next_multiple_of(4), 0);
    }
    json["bufferViews"] = views;
    json["buffers"] = json!([{"byteLength": bin.len()}]);
    Ok(Glb { json, bin })
}

fn array<'a>(value: &'a mut Value, name: &str) -> &'a mut [Value] {
    value.get_mut(name).and_then(Value::as_array_mut).map_or(&mut [], Vec::as_mut_slice)
}

fn visit_member(value: &mut Value, name: &str, visit: &mut dyn FnMut(&mut Value)) {
    if let Some(member) = value.get_mut(name) {
        visit(member);
    }
}

/// Gives the entries of `list` that `walk` visits new numbers in their old order, writes those into the references
/// and returns the surviving entries.
fn renumber(json: &mut Value, list: &str, walk: impl Fn(&mut Value, &mut dyn FnMut(&mut Value))) -> Result<Value> {
    let entries = json[list].as_array().cloned().unwrap_or_default();
    let mut used = vec![false; entries.len()];
    let mut stray = false;
    walk(json, &mut |reference| match reference.as_u64().and_then(|i| used.get_mut(i as usize)) {
        Some(flag) => *flag = true,
        None => stray = true,
    });
    ensure!(!stray, "a reference into {list} points nowhere");
    let new_index: Vec<usize> = (0..used.len()).map(|i| used[..i].iter().filter(|u| **u).count()).collect();
    walk(json, &mut |reference| {
        let old = reference.as_u64().unwrap_or(0) as usize;
        *reference = json!(new_index[old]);
    });
    Ok(entries.into_iter().zip(used).filter(|(_, used)| *used).map(|(entry, _)| entry).collect())
}
