//! `scene.safetensors`: the lossless learnable state of a scene.
//!
//! Metadata `splat4d` holds JSON: version, clip, fps, up, background, head, `labels` (names) where Gaussians have some,
//! `offset` (world coordinates of the scene's origin) where it is not zero, and a list of layers with name, rows, SH
//! coefficients, life and motion, `frame` where the layer's axes are not the world's, and `cross_fade` (seconds at the
//! span's beginning and end) where it fades. Every column group of every table is one row-major array: `layers.0.means`
//! `[N,3]`, `layers.0.quats` `[N,4]` wxyz, `layers.0.sh` `[N,K,3]`, `layers.0.velocities` `[N,3·order]` … Seconds and
//! scene units.

use super::arrays::MASKS;
use super::safetensors::{Dtype, SafeTensors, Tensor, checksum, header, sealed};
use super::{params_to_arrays, tensors_to_loaded};
use crate::layers::{ALWAYS, Head, Layer, Scene};
use crate::math::Sim3;
use crate::motion::{BUILT_IN, Spec, build, is_registered};
use crate::scene::features::{FEATURES, MOST_CHANNELS};
use crate::scene::labels::LABEL_LOGITS;
use crate::scene::masks::WORD;
use crate::scene::{HeadKeys, KeyMasks, LifeKind, Params, SH, features, labels as scene_labels};
use crate::{Error, ErrorKind, Result};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Write;
use std::sync::Arc;

/// The newest version of the metadata that this library reads and writes: of scenes with labels or features.
pub(crate) const VERSION: u64 = 4;
/// The version of scenes whose layers cross-fade, without labels and features.
const FADING: u64 = 3;
/// The version of scenes whose layers have frames, and do not cross-fade.
const FRAMED: u64 = 2;
/// The version of scenes whose layers have no frame: programs without support for frames may read them.
const UNFRAMED: u64 = 1;
/// The metadata's key.
pub const METADATA: &str = "splat4d";

/// A scene's metadata as JSON.
pub fn metadata(scene: &Scene<f32>) -> Value {
    about(scene, scene.layers.iter().map(Stated::of).collect())
}

/// A layer in a file's metadata.
struct Stated {
    json: Value,
    framed: bool,
    fades: bool,
}

impl Stated {
    fn of(l: &Layer<f32>) -> Self {
        let mut layer = json!({
            "name": l.name,
            "rows": l.params.len(),
            "sh_coefficients": l.params[SH].width() / 3,
            "life": l.life.name(),
            "motion": spec_to_json(&l.motion.spec()),
        });
        // JSON has no infinity: a side that is open is null, and a layer that is always seen states nothing.
        if l.span != ALWAYS {
            layer["span"] = json!(l.span.map(|t| t.is_finite().then_some(t)));
        }
        if l.cross_fades() {
            layer["cross_fade"] = json!(l.cross_fade);
        }
        if let Some(masks) = &l.masks {
            layer["mask_times"] = json!(masks.times());
        }
        if !l.frame.is_identity() {
            let Sim3 { scale, rotation, translation } = l.frame;
            layer["frame"] = json!({ "scale": scale, "rotation": rotation, "translation": translation });
        }
        Self { json: layer, framed: !l.frame.is_identity(), fades: l.cross_fades() }
    }
}

/// The metadata of a scene with these layers in place of its own.
fn about(scene: &Scene<f32>, layers: Vec<Stated>) -> Value {
    let framed = if layers.iter().any(|l| l.framed) { FRAMED } else { UNFRAMED };
    let plain = if layers.iter().any(|l| l.fades) { FADING } else { framed };
    let mut out = json!({
        "version": if scene.labels.is_empty() && scene.feature_channels() == 0 { plain } else { VERSION },
        "units": "scene units, seconds, colours in [0, 1]",
        "axes": "OpenCV: x right, y down, z forward in the camera",
        "clip": scene.clip,
        "fps": scene.fps,
        "up": scene.up,
        "background": scene.background,
        "head": scene.head.name(),
        "layers": layers.into_iter().map(|l| l.json).collect::<Vec<_>>(),
    });
    if !scene.labels.is_empty() {
        out["labels"] = json!(scene.labels);
    }
    // Scenes near the origin keep the bytes of older versions.
    if scene.offset != [0.0; 3] {
        out["offset"] = json!(scene.offset);
    }
    out
}

/// A motion model's spec as JSON.
pub fn spec_to_json(spec: &Spec) -> Value {
    match spec.is_built_in() {
        true => serde_json::to_value(spec).expect("a spec is plain numbers, flags and names"),
        false => json!({ "model": spec.name(), "custom": true }),
    }
}

/// A motion model's spec from JSON. Errors: a model that this version does not support, or a field that is missing or
/// wrong.
pub fn spec_from_json(v: &Value) -> Result<Spec> {
    let model = text(v, "model")?;
    if v["custom"].as_bool() == Some(true) {
        if is_registered(&model) {
            return Ok(Spec::Custom(model));
        }
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!("the scene uses `{model}`, a motion model of another program"),
        )
        .remedy("Open it in the program that registers this model (Python: `motion=`), or open the baked .s4d file"));
    }
    if !BUILT_IN.contains(&model.as_str()) {
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!("the scene uses the motion model `{model}`, which this version does not support"),
        )
        .remedy("Open it with the splat4d that wrote it, or a newer one"));
    }
    serde_json::from_value(v.clone()).map_err(|e| broken(format!("invalid motion `{model}`: {e}")))
}

/// All arrays of a scene, ready to be written (also into a checkpoint).
pub fn arrays(scene: &Scene<f32>) -> Vec<super::arrays::Array> {
    scene.layers.iter().enumerate().flat_map(|(i, l)| params_to_arrays(&format!("layers.{i}."), &l.params)).collect()
}

/// The masks of a scene's layers, ready to be written (also into a checkpoint): `layers.i.masks`, u32 [keys,
/// ⌈rows/32⌉], row i is bit i % 32 of word i / 32. Their times are in the metadata.
pub fn masks(scene: &Scene<f32>) -> Vec<Tensor<'_>> {
    fn of((i, layer): (usize, &Layer<f32>)) -> Option<Tensor<'_>> {
        let m = layer.masks.as_deref()?;
        Some(Tensor::u32(format!("layers.{i}.{MASKS}"), &[m.times().len(), m.rows().div_ceil(WORD)], m.words()))
    }
    scene.layers.iter().enumerate().filter_map(of).collect()
}

/// Writes a scene. Errors: a number in it is NaN or infinite; the sink's.
pub fn write(scene: &Scene<f32>, out: &mut impl Write) -> Result<()> {
    check(scene)?;
    let arrays = arrays(scene);
    let mut tensors: Vec<Tensor<'_>> = arrays.iter().map(|a| a.tensor()).collect();
    tensors.extend(masks(scene));
    let metadata = BTreeMap::from([(METADATA.to_owned(), metadata(scene).to_string())]);
    super::safetensors::write(&tensors, &metadata, out)
}

/// Errors: a number of a scene, or of one of its motion models, is NaN or infinite, which no reader takes.
fn check(scene: &Scene<f32>) -> Result<()> {
    scene.check_finite()?;
    for layer in &scene.layers {
        let spec = layer.motion.spec();
        if spec.is_built_in() {
            // JSON has no such numbers, and readers take no deeper nesting than theirs.
            let text = spec_to_json(&spec).to_string();
            let same = serde_json::from_str(&text).is_ok_and(|v| spec_from_json(&v).is_ok_and(|s| s == spec));
            if !same {
                let what = "its motion has numbers that are NaN or infinite, or is nested too deeply to be read again";
                return Err(Error::input(what)
                    .at(format!("layer `{}`", layer.name))
                    .remedy("Take back the last edits"));
            }
        }
    }
    Ok(())
}

/// Writes a scene whose layers do not fit into memory together: the bytes of [`write()`]. `scene` has no layers;
/// `layer` is requested each of the `count` twice.
///
/// Errors: those of `layer`, the sink's. Panics: `scene` has layers; `layer` returns different results, or masks.
pub fn write_by_layer(
    scene: &Scene<f32>,
    count: usize,
    layer: &mut dyn FnMut(usize) -> Result<Layer<f32>>,
    out: &mut dyn Write,
) -> Result<()> {
    assert!(scene.layers.is_empty(), "the layers come one by one");
    let arrays_of = |i: usize, l: &Layer<f32>| {
        assert!(l.masks.is_none(), "layers with masks are written as a whole");
        let mut all = params_to_arrays(&format!("layers.{i}."), &l.params);
        all.sort_by(|a, b| a.name.cmp(&b.name));
        all
    };
    let (mut stated, mut order, mut sums) = (Vec::new(), Vec::new(), Vec::new());
    for i in 0..count {
        let l = layer(i)?;
        check(&Scene { layers: vec![l.clone()], ..scene.clone() })?;
        stated.push(Stated::of(&l));
        order.push((format!("layers.{i}."), i, Vec::new()));
        for array in arrays_of(i, &l) {
            sums.push((array.name.clone(), checksum(array.tensor().bytes())));
            order[i].2.push((array.name, array.shape));
        }
    }
    order.sort();
    let metadata = BTreeMap::from([(METADATA.to_owned(), about(scene, stated).to_string())]);
    let metadata = sealed(&metadata, sums.into_iter());
    let named = order.iter().flat_map(|(.., arrays)| arrays);
    let head = header(named.map(|(name, shape)| (name.as_str(), Dtype::F32, shape.as_slice())), &metadata);
    let mut put =
        |bytes: &[u8]| out.write_all(bytes).map_err(|e| Error::environment("the arrays could not be written", e));
    put(&head)?;
    for (_, i, arrays) in &order {
        let found = arrays_of(*i, &layer(*i)?);
        assert!(found.iter().map(|a| &a.shape).eq(arrays.iter().map(|(_, shape)| shape)), "layer {i} became another");
        found.iter().try_for_each(|a| put(a.tensor().bytes()))?;
    }
    Ok(())
}

/// Reads a scene. Errors: not a scene, a newer version, an unknown motion model, arrays that do not fit.
pub fn read(bytes: &[u8]) -> Result<Scene<f32>> {
    from_tensors(&SafeTensors::read(bytes)?)
}

/// The scene in an open file.
pub fn from_tensors(file: &SafeTensors<'_>) -> Result<Scene<f32>> {
    let Some(meta) = file.metadata().get(METADATA) else {
        return Err(broken("it has no `splat4d` metadata".into()));
    };
    let meta: Value = serde_json::from_str(meta).map_err(|e| broken(format!("its metadata is not JSON: {e}")))?;
    let version = meta["version"].as_u64().ok_or_else(|| broken("its metadata has no version".into()))?;
    if version > VERSION {
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!("the scene has version {version}, this splat4d reads up to {VERSION}"),
        )
        .remedy("Install a newer splat4d"));
    }
    let [start, end] = numbers::<2>(&meta, "clip")?;
    let mut scene = Scene {
        clip: [start, end],
        fps: number(&meta, "fps")?,
        up: numbers::<3>(&meta, "up")?,
        offset: if meta["offset"].is_null() { [0.0; 3] } else { numbers::<3>(&meta, "offset")? },
        background: numbers::<3>(&meta, "background")?.map(|x| x as f32),
        head: head(&meta)?,
        layers: Vec::new(),
        labels: label_names(&meta)?,
    };
    let layers = meta["layers"].as_array().ok_or_else(|| broken("its metadata lists no layers".into()))?;
    for (i, layer) in layers.iter().enumerate() {
        let layer = read_layer(file, layer, i, scene.labels.len());
        scene.layers.push(layer.map_err(|e| e.at(format!("layer {i}")))?);
    }
    let channels = scene.feature_channels();
    let widths = scene.layers.iter().filter_map(|l| Some(l.params[features::key(&l.params)?].width()));
    if let Some(other) = widths.into_iter().find(|&w| w != channels) {
        return Err(broken(format!("one layer has {channels} feature channels, another {other}")));
    }
    if scene.layers.iter().any(|l| HeadKeys::of(&l.params).is_some()) != (scene.head == Head::Features) {
        return Err(broken(format!("its head is `{}`, which does not fit its layers", scene.head.name())));
    }
    Ok(scene)
}

/// Mapping from blended channels to colour; files without it have no head.
fn head(meta: &Value) -> Result<Head> {
    if meta["head"].is_null() {
        return Ok(Head::Identity);
    }
    let name = text(meta, "head")?;
    Head::from_name(&name).ok_or_else(|| {
        Error::new(
            ErrorKind::Unsupported,
            format!("the scene has the pixel head `{name}`, which this version does not support"),
        )
        .remedy("Open it with the splat4d that wrote it, or a newer one")
    })
}

/// The scene's labels; none where the file has none.
fn label_names(meta: &Value) -> Result<Vec<String>> {
    if meta["labels"].is_null() {
        return Ok(Vec::new());
    }
    let names: Option<Vec<String>> =
        meta["labels"].as_array().and_then(|l| l.iter().map(|n| n.as_str().map(str::to_owned)).collect());
    let names = names.ok_or_else(|| broken("invalid `labels`: expected a list of names".into()))?;
    scene_labels::check(&names)?;
    Ok(names)
}

fn read_layer(file: &SafeTensors<'_>, meta: &Value, index: usize, labels: usize) -> Result<Layer<f32>> {
    let prefix = format!("layers.{index}.");
    let rows = count(meta, "rows")?;
    let coefficients = count(meta, "sh_coefficients")?;
    // The means bound what the metadata may claim, before anything is allocated.
    let means = file.tensor(&format!("{prefix}means"))?;
    if means.shape() != [rows, 3] {
        return Err(broken(format!("the metadata claims {rows} Gaussians, the means have shape {:?}", means.shape())));
    }
    let motion = spec_from_json(&meta["motion"])?;
    let blocks = motion.capabilities().unwrap_or_default().color_blocks;
    if coefficients > crate::math::sh::MAX_COEFFS * blocks {
        return Err(broken(format!("{coefficients} SH coefficients are more than degree 3 has")));
    }
    let life = text(meta, "life")?;
    let life = LifeKind::from_name(&life).ok_or_else(|| broken(format!("life `{life}` is not known")))?;
    let loaded = tensors_to_loaded(&prefix, file)?;
    let mut params = Params::build(loaded, rows, coefficients, life.columns())?;
    let motion = build(&motion, &mut params)?;
    if labels > 0 && params.unclaimed().iter().any(|a| a.name == LABEL_LOGITS) {
        scene_labels::claim(&mut params, labels)?;
    }
    if let Some(channels) = params.unclaimed().iter().find(|a| a.name == FEATURES).map(|a| a.width) {
        if !(1..=MOST_CHANNELS).contains(&channels) {
            return Err(broken(format!(
                "Gaussians have {channels} feature channels, 1 to {MOST_CHANNELS} are possible"
            )));
        }
        features::claim(&mut params, channels)?;
    }
    if let Some(array) = params.unclaimed().first() {
        return Err(broken(format!("array `{}` belongs to no table of this layer", array.name)));
    }
    let masks = read_masks(file, meta, &prefix, rows)?;
    let (name, span, frame) = (text(meta, "name")?, span(meta)?, frame(meta)?);
    let cross_fade = if meta["cross_fade"].is_null() { [0.0; 2] } else { numbers::<2>(meta, "cross_fade")? };
    if cross_fade.iter().any(|s| !(*s >= 0.0 && s.is_finite())) {
        return Err(broken(format!("`cross_fade` is {cross_fade:?}, not two lengths in seconds")));
    }
    Ok(Layer { span, cross_fade, masks, frame, ..Layer::new(name, params, motion, life) })
}

/// Reads the visibility masks of a layer; none where the file has none.
fn read_masks(file: &SafeTensors<'_>, meta: &Value, prefix: &str, rows: usize) -> Result<Option<Arc<KeyMasks>>> {
    let array = file.get(&format!("{prefix}{MASKS}"));
    if meta["mask_times"].is_null() && array.is_none() {
        return Ok(None);
    }
    let times: Option<Vec<f64>> = meta["mask_times"].as_array().and_then(|l| l.iter().map(Value::as_f64).collect());
    let rising = |t: &Vec<f64>| !t.is_empty() && t.windows(2).all(|w| w[0] < w[1]) && t.iter().all(|t| t.is_finite());
    let times = times.filter(rising).ok_or_else(|| broken("`mask_times` are not times that rise".into()))?;
    let array = array.ok_or_else(|| broken(format!("array `{prefix}{MASKS}` is missing")))?;
    if array.shape() != [times.len(), rows.div_ceil(WORD)] {
        let (keys, shape) = (times.len(), array.shape());
        return Err(broken(format!("masks of shape {shape:?} for {keys} key times and {rows} Gaussians")));
    }
    let masks = KeyMasks::from_words(times, rows, array.as_u32()?);
    let masks = masks.ok_or_else(|| broken(format!("the masks have bits beyond the {rows} Gaussians")))?;
    Ok(Some(Arc::new(masks)))
}

/// When the layer is seen; a side that is null is open, and so are both where the file states nothing.
fn span(meta: &Value) -> Result<[f64; 2]> {
    if meta["span"].is_null() {
        return Ok(ALWAYS);
    }
    let sides = meta["span"].as_array().filter(|l| l.len() == 2);
    let sides = sides.ok_or_else(|| broken("`span` is not a first and a last second".into()))?;
    let mut out = ALWAYS;
    for (o, side) in out.iter_mut().zip(sides).filter(|(_, side)| !side.is_null()) {
        *o = side.as_f64().ok_or_else(|| broken("`span` is not a first and a last second".into()))?;
    }
    Ok(out)
}

/// The similarity from the layer's axes to the world's; the identity where the file states nothing.
fn frame(meta: &Value) -> Result<Sim3> {
    let frame = &meta["frame"];
    if frame.is_null() {
        return Ok(Sim3::IDENTITY);
    }
    let row = |row: &Value| numbers::<3>(&json!({ "rotation": row }), "rotation");
    let rows = frame["rotation"].as_array().filter(|rows| rows.len() == 3);
    let rows = rows.ok_or_else(|| broken("its `frame` has no rotation of three rows".into()))?;
    let sim = Sim3 {
        scale: number(frame, "scale")?,
        rotation: [row(&rows[0])?, row(&rows[1])?, row(&rows[2])?],
        translation: numbers(frame, "translation")?,
    };
    if !sim.is_sound() {
        return Err(broken("invalid `frame`: expected a rotation with a scale above zero".into()));
    }
    Ok(sim)
}

fn broken(what: String) -> Error {
    Error::input(format!("this is not a readable scene: {what}"))
        .remedy("Export it again; `splat4d info` shows what a file holds")
}

fn text(v: &Value, key: &str) -> Result<String> {
    v[key].as_str().map(str::to_owned).ok_or_else(|| broken(format!("`{key}` is missing")))
}

fn count(v: &Value, key: &str) -> Result<usize> {
    let n = v[key].as_u64().and_then(|n| usize::try_from(n).ok());
    n.ok_or_else(|| broken(format!("`{key}` is not a count")))
}

fn number(v: &Value, key: &str) -> Result<f64> {
    v[key].as_f64().filter(|x| x.is_finite()).ok_or_else(|| broken(format!("`{key}` is not a number")))
}

fn numbers<const N: usize>(v: &Value, key: &str) -> Result<[f64; N]> {
    let list =
        v[key].as_array().filter(|l| l.len() == N).ok_or_else(|| broken(format!("`{key}` is not {N} numbers")))?;
    let mut out = [0.0; N];
    for (o, x) in out.iter_mut().zip(list) {
        *o = x.as_f64().filter(|x| x.is_finite()).ok_or_else(|| broken(format!("`{key}` is not {N} numbers")))?;
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::safetensors::unsealed;
    use crate::math::Rng;
    use crate::motion::SpacetimeSpec;
    use crate::scene::Time;

    fn scene() -> Scene<f32> {
        let layer = |spec: &Spec, life: LifeKind, seed: u64| {
            let mut params = Params::new(37, 4, life.columns());
            let motion = build(spec, &mut params).unwrap();
            for key in params.keys().collect::<Vec<_>>() {
                for r in 0..37 {
                    for c in 0..params[key].width() {
                        let x = Rng::new(seed, "x", u64::from(key.0)).normal((r * 99 + c) as u64) as f32;
                        params[key].set(r, c, x);
                    }
                }
            }
            let span = if seed == 2 { [0.1, f64::INFINITY] } else { ALWAYS };
            let mut masks = KeyMasks::new(vec![0.0, 0.1, 0.1 + 0.2], 37);
            (0..37).for_each(|row| masks.set((row as u64 * seed % 3) as usize, row));
            let masks = (seed != 1).then(|| Arc::new(masks));
            Layer { span, masks, ..Layer::new(format!("layer {seed}"), params, motion, life) }
        };
        let spacetime =
            Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: true, origin: 0.25, features: None });
        Scene {
            layers: vec![
                layer(&Spec::Still, LifeKind::Infinite, 1),
                layer(&spacetime, LifeKind::Interval, 2),
                layer(&Spec::Spacetime(SpacetimeSpec { order: 0, ..SpacetimeSpec::default() }), LifeKind::GaussHalf, 3),
            ],
            background: [1.0, 0.5, 0.0],
            clip: [0.0, 0.1 + 0.2],
            fps: 30.0,
            up: [0.0, -1.0, 0.0],
            offset: [0.0; 3],
            head: Head::Identity,
            labels: Vec::new(),
        }
    }

    #[test]
    fn layer_by_layer_the_same_bytes_are_written() {
        // More than ten, so that names do not sort like numbers.
        let mut scene = scene();
        scene.layers.iter_mut().for_each(|l| l.masks = None);
        let some = scene.layers.clone();
        scene.layers = some.iter().cycle().take(23).cloned().collect();
        scene.layers[4].cross_fade = [0.1, 0.0];
        let (mut whole, mut parts) = (Vec::new(), Vec::new());
        write(&scene, &mut whole).unwrap();
        let shell = Scene { layers: Vec::new(), ..scene.clone() };
        write_by_layer(&shell, 23, &mut |i| Ok(scene.layers[i].clone()), &mut parts).unwrap();
        assert!(whole == parts);
    }

    #[test]
    fn cross_fades_round_trip_and_older_readers_refuse_them() {
        let mut s = scene();
        s.layers[1].cross_fade = [0.1 + 0.2, 0.0];
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        assert_eq!(
            read(&bytes).unwrap().layers.iter().map(|l| l.cross_fade).collect::<Vec<_>>(),
            [[0.0; 2], [0.1 + 0.2, 0.0], [0.0; 2]]
        );
        assert_eq!(metadata(&s)["version"], json!(FADING));
        assert_eq!(metadata(&scene())["version"], json!(UNFRAMED), "other scenes stay readable");
        let mut bytes = unsealed(bytes);
        let at = bytes.windows(10).position(|w| w == b"cross_fade").unwrap();
        let minus = bytes[at..].iter().position(|b| *b == b'[').unwrap() + at + 1;
        bytes[minus] = b'-';
        assert!(read(&bytes).is_err());
    }

    #[test]
    fn an_offset_round_trips_and_near_scenes_store_none() {
        let mut s = scene();
        let near = metadata(&s).to_string();
        s.offset = [431_234.1, 5_412_345.6, -310.2];
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        assert_eq!(read(&bytes).unwrap().offset, s.offset);
        assert!(!near.contains("offset"));
        s.rotate(&[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
        assert_eq!(s.offset, [-5_412_345.6, 431_234.1, -310.2], "it turns with the scene");
    }

    #[test]
    fn features_round_trip_and_have_one_width() {
        let mut s = scene();
        let key = features::claim(&mut s.layers[1].params, 3).unwrap();
        s.layers[1].params[key].write(2, 0, [0.5, -1.5, 2.0]);
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        let back = read(&bytes).unwrap();
        assert_eq!((back.feature_channels(), &back.layers[1].params), (3, &s.layers[1].params));
        assert!(features::key(&back.layers[0].params).is_none(), "the others have none");
        features::claim(&mut s.layers[0].params, 2).unwrap();
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        assert!(read(&bytes).unwrap_err().to_string().contains("feature channels"));
    }

    #[test]
    fn labels_round_trip_and_older_readers_refuse_them() {
        let mut s = scene();
        s.labels = vec!["floor".into(), "hand".into()];
        scene_labels::state(&mut s.layers[1].params, 2, &[Some(1); 37]);
        assert_eq!(metadata(&s)["version"], json!(VERSION));
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        let back = read(&bytes).unwrap();
        assert_eq!((&back.labels, &back.layers[1].params), (&s.labels, &s.layers[1].params));
        assert!(scene_labels::key(&back.layers[0].params).is_none(), "the others have none");
        // One name more than logits.
        s.labels.push("ball".into());
        bytes.clear();
        write(&s, &mut bytes).unwrap();
        assert!(read(&bytes).unwrap_err().to_string().contains("label_logits"));
        s.labels.clear();
        bytes.clear();
        write(&s, &mut bytes).unwrap();
        assert!(read(&bytes).unwrap_err().to_string().contains("label_logits"), "logits of nothing");
    }

    #[test]
    fn a_scene_round_trips_bit_for_bit() {
        let s = scene();
        let mut bytes = Vec::new();
        write(&s, &mut bytes).unwrap();
        let back = read(&bytes).unwrap();
        assert_eq!((back.clip, back.fps, back.up, back.background), (s.clip, s.fps, s.up, s.background));
        for (a, b) in s.layers.iter().zip(&back.layers) {
            assert_eq!((&a.name, a.life, a.span, a.motion.spec()), (&b.name, b.life, b.span, b.motion.spec()));
            assert_eq!(a.params, b.params);
            assert_eq!(a.masks, b.masks);
        }
        let mut again = Vec::new();
        write(&back, &mut again).unwrap();
        assert_eq!(bytes, again);
    }

    #[test]
    fn a_head_round_trips_and_must_fit_its_layers() {
        let features = Some(crate::motion::spacetime::FeatureSpec { seed: 9 });
        let spec = Spec::Spacetime(SpacetimeSpec { features, ..SpacetimeSpec::default() });
        let mut params = Params::new(5, 1, LifeKind::GaussHalf.columns());
        let motion = build(&spec, &mut params).unwrap();
        let first = HeadKeys::of(&params).unwrap().first;
        params[first].set(7, 0, 0.25);
        let (life, name) = (LifeKind::GaussHalf, "a".to_owned());
        let layer = Layer::new(name, params, motion, life);
        let with = |head: Head, layers: Vec<Layer>| {
            let mut bytes = Vec::new();
            write(&Scene { layers, head, ..scene() }, &mut bytes).unwrap();
            read(&bytes)
        };
        let still = scene().layers.remove(0);
        let back = with(Head::Features, vec![still.clone(), layer.clone()]).unwrap();
        assert_eq!((back.head, back.layers[1].motion.spec()), (Head::Features, spec));
        assert_eq!(back.layers[1].params, layer.params);
        assert_eq!(back.head_keys().unwrap().0, 1);
        for (head, layer) in [(Head::Features, still), (Head::Identity, layer)] {
            let error = with(head, vec![layer]).unwrap_err().to_string();
            assert!(error.contains(head.name()), "{error}");
        }
        // Scenes without a head carry no information about features: older versions read them.
        let mut bytes = Vec::new();
        write(&scene(), &mut bytes).unwrap();
        assert!(!String::from_utf8_lossy(&bytes).contains("features"));
        let mut bytes = unsealed(bytes);
        let at = bytes.windows(8).position(|w| w == b"identity").unwrap();
        bytes[at..at + 8].copy_from_slice(b"identitx");
        let error = read(&bytes).unwrap_err();
        assert!(error.kind() == ErrorKind::Unsupported && error.to_string().contains("identitx"), "{error}");
    }

    #[test]
    fn mismatches_are_named() {
        let mut bytes = Vec::new();
        write(&scene(), &mut bytes).unwrap();
        let bytes = unsealed(bytes);
        let with = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            // Names of arrays are in the list of checksums too.
            let places: Vec<usize> = (0..bytes.len()).filter(|&at| bytes[at..].starts_with(from.as_bytes())).collect();
            assert!(!places.is_empty(), "{from}");
            let mut b = bytes.clone();
            places.iter().for_each(|&at| b[at..at + to.len()].copy_from_slice(to.as_bytes()));
            read(&b).expect_err(to).to_string()
        };
        assert!(with("\\\"spacetime\\\"", "\\\"spacetimf\\\"").contains("spacetimf"));
        assert!(with("\\\"version\\\":1", "\\\"version\\\":9").contains("version 9"));
        assert!(with("\\\"rows\\\":37", "\\\"rows\\\":99").contains("99"));
        assert!(with("layers.1.velocities", "layers.1.velocitiez").contains("velocit"));
        assert!(with("layers.1.masks", "layers.1.maskz").contains("maskz"));
        assert!(with("mask_times\\\":[0.0", "mask_times\\\":[7.0").contains("mask_times"));
        assert!(with("mask_times\\\":[0.0,", "mask_timez\\\":[0.0,").contains("mask_times"));
        assert!(with("mask_times\\\":[0.0,0.1,", "mask_times\\\":[0.00001,").contains("[3, 2]"));
        // A bit beyond the last row.
        let (s, words) = (scene(), [0, 0, 0, 1 << 5, 0, 0]);
        let arrays = arrays(&s);
        let mut tensors: Vec<Tensor<'_>> = arrays.iter().map(|a| a.tensor()).collect();
        tensors.extend(masks(&s).into_iter().filter(|t| t.name() != "layers.1.masks"));
        tensors.push(Tensor::u32("layers.1.masks", &[3, 2], &words));
        let metadata = BTreeMap::from([(METADATA.to_owned(), metadata(&s).to_string())]);
        let mut damaged = Vec::new();
        crate::format::safetensors::write(&tensors, &metadata, &mut damaged).unwrap();
        assert!(read(&damaged).unwrap_err().to_string().contains("beyond the 37"));
    }

    #[test]
    fn non_finite_scenes_are_not_written() {
        let refused = |s: &Scene<f32>| {
            let mut bytes = Vec::new();
            let error = write(s, &mut bytes).unwrap_err().to_string();
            assert!(bytes.is_empty(), "not one byte");
            error
        };
        let mut s = scene();
        s.layers[1].params[crate::scene::GEOMETRY].set(7, 1, f32::NAN);
        let error = refused(&s);
        assert!(error.contains("layer 2") && error.contains("means") && error.contains("Gaussian 7"), "{error}");
        assert!(refused(&Scene { fps: f64::INFINITY, ..scene() }).contains("fps"));
        assert!(refused(&Scene { clip: [0.0, f64::NAN], ..scene() }).contains("clip"));
        let mut s = scene();
        s.layers[0].frame.translation[2] = f64::INFINITY;
        assert!(refused(&s).contains("layer 1"));
        let mut s = scene();
        s.layers[1].params[crate::scene::GEOMETRY].set(7, 1, f32::INFINITY);
        s.layers[1].params[crate::scene::GEOMETRY].set(9, 1, f32::NAN);
        assert_eq!((s.drop_non_finite(), s.layers[1].params.len()), (2, 35));
        write(&s, &mut Vec::new()).unwrap();
    }

    #[test]
    fn mutated_files_never_panic() {
        let mut bytes = Vec::new();
        write(&scene(), &mut bytes).unwrap();
        let bytes = unsealed(bytes);
        let rng = Rng::new(5, "mutants", 0);
        for i in 0..400u64 {
            let mut b = bytes.clone();
            for k in 0..1 + rng.below(4 * i, 4) as u64 {
                let at = rng.fork(i).below(2 * k, b.len().min(4096));
                b[at] ^= 1 << rng.fork(i).below(2 * k + 1, 8);
            }
            if i % 3 == 0 {
                b.truncate(rng.below(4 * i + 1, b.len()));
            }
            if let Ok(s) = read(&b) {
                // What is accepted must also be usable.
                let mut instant = crate::layers::Evaluation::default();
                s.at(Time(0.1), &mut instant);
            }
        }
    }
}
