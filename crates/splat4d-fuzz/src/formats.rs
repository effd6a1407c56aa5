//! Files of scenes and arrays.

use crate::Reader;
use crate::zip::zip;
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use splat4d::format::dialect::{WriteOptions, still};
use splat4d::format::playback::{self, HEADER_BYTES, Index, Sound};
use splat4d::format::sog::levels;
use splat4d::format::{DIALECTS, foreign, npy, ply, safetensors, scene, sog, splat};
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::Rng;
use splat4d::motion::{Spacetime, SpacetimeSpec};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params, SH, Time};
use splat4d_workflow::source::Source;
use std::borrow::Cow;
use std::cell::RefCell;
use std::io::{Read, Write};
use std::sync::Arc;
use tempfile::TempDir;

pub(crate) const READERS: &[Reader] = &[
    Reader { name: "playback", seeds: playback_seeds, read: playback_file },
    Reader { name: "sound_mp4", seeds: sound_seeds, read: sound_file },
    Reader { name: "ply", seeds: || written(".ply"), read: open },
    Reader { name: "ply_points", seeds: point_seeds, read: |b| drop(ply::read_points(b)) },
    Reader { name: "ply_compressed", seeds: || written(".compressed.ply"), read: open },
    Reader { name: "stg_ply", seeds: || written(".stg.ply"), read: open },
    Reader { name: "spz", seeds: || written(".spz"), read: open },
    Reader { name: "spz_gzip", seeds: spz_bodies, read: |b| open(&gzip(b)) },
    Reader { name: "splat", seeds: || written(".splat"), read: |b| drop(splat::read(b)) },
    Reader { name: "splatv", seeds: || written(".splatv"), read: open },
    Reader { name: "sog_zip", seeds: sog_seeds, read: open },
    Reader { name: "sog_meta", seeds: meta_seeds, read: sog_meta },
    Reader { name: "scene", seeds: scene_seeds, read: open },
    Reader { name: "safetensors", seeds: scene_seeds, read: |b| drop(safetensors::SafeTensors::read(b)) },
    Reader { name: "npy", seeds: npy_seeds, read: |b| drop(npy::Npy::read(b)) },
    Reader { name: "npz", seeds: npz_seeds, read: |b| drop(npy::Npy::read_member(b, "data")) },
    Reader { name: "ply_zip", seeds: ply_zips, read: |b| file("scene.zip", b) },
    Reader { name: "glb", seeds: || [written(".glb"), written(".spz.glb")].concat(), read: open },
    Reader { name: "gltf", seeds: gltf_seeds, read: open },
    Reader { name: "usda", seeds: usda_seeds, read: open },
    Reader { name: "ftgs_ply", seeds: || written(".ftgs.ply"), read: open },
    Reader { name: "torch", seeds: torch_seeds, read: open },
    Reader { name: "torch_pickle", seeds: || vec![PICKLE.to_vec()], read: torch_pickle },
    Reader { name: "dynamic3d", seeds: || vec![dynamic3d()], read: open },
    Reader { name: "fourdgs", seeds: || written(".4dgs"), read: open },
    Reader { name: "ksplat", seeds: || vec![KSPLAT.to_vec()], read: open },
    Reader { name: "usdz", seeds: || written(".usdz"), read: open },
    Reader { name: "sog_levels", seeds: || vec![LEVELS.into()], read: sog_levels },
    Reader { name: "foreign", seeds: foreign_seeds, read: |b| drop(foreign::unread("a.splat4d", b)) },
];

/// The index of a streamed SOG scene.
const LEVELS: &str = r#"{"version": 1, "lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"], "environment": "env/meta.json",
    "tree": {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 2}, "1": {"file": 1, "offset": 0, "count": 1}}},
    {"lods": {"0": {"file": 0, "offset": 2, "count": 1}}}]}}"#;

/// A SOG scene of some Gaussians, made by splat-transform 3.7 of numbers of our own.
const SOG: &[u8] = include_bytes!("../seeds/few.sog");

/// Some Gaussians of our own as GaussianSplats3D 0.4.7 writes them, at compression level 2.
const KSPLAT: &[u8] = include_bytes!("../seeds/few.ksplat");

/// Most pieces of a streamed scene that are put together: each is the whole seed.
const PIECES: usize = 64;

/// Opens a file of any kind and shows a time of it.
pub(crate) fn open(bytes: &[u8]) {
    if let Ok(scene) = splat4d::open(bytes) {
        show(&scene);
    }
}

pub(crate) fn show(scene: &Scene<f32>) {
    scene.at(Time(scene.clip[0]), &mut Evaluation::default());
}

fn numbers(rows: usize, coefficients: usize, life: LifeKind) -> Params {
    let mut p = Params::new(rows, coefficients, life.columns());
    let rng = Rng::new(1, "fuzz seeds", 0);
    for row in 0..rows {
        let n = |i: u64| rng.fork(row as u64).normal(i) as f32;
        p[GEOMETRY].write(row, 0, [n(0), n(1), n(2)]);
        p[GEOMETRY].write(row, QUAT, [n(3), n(4), n(5), n(6)]);
        p[GEOMETRY].write(row, LOG_SCALE, [n(7) - 4.0, n(8) - 4.0, n(9) - 4.0]);
        p[GEOMETRY].set(row, OPACITY, n(10));
        (0..3 * coefficients).for_each(|k| p[SH].set(row, k, 0.2 * n(20 + k as u64)));
        (0..life.columns().len()).for_each(|k| p[LIFE].set(row, k, 0.3 * n(80 + k as u64)));
    }
    p
}

fn standing() -> Scene<f32> {
    still(numbers(5, 4, LifeKind::Infinite))
}

pub(crate) fn moving() -> Scene<f32> {
    let mut params = numbers(5, 1, LifeKind::GaussHalf);
    let spec = SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5, features: None };
    let motion = Spacetime::new(spec, &mut params).expect("the order is known");
    let layer = Layer::new("moving", params, Arc::new(motion), LifeKind::GaussHalf);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, up: [0.0, -1.0, 0.0], ..Scene::default() }
}

/// Output of the dialect with this ending, in every version.
fn written(ending: &str) -> Vec<Vec<u8>> {
    let dialect = DIALECTS.iter().find(|d| d.ending == ending).expect("the ending is a dialect's");
    let scene = if dialect.moves { moving() } else { standing() };
    let mut out = Vec::new();
    for spz_version in 2..=4 {
        let mut bytes = Vec::new();
        let options = WriteOptions { spz_version, ..WriteOptions::default() };
        dialect.write(&scene, &options, &mut bytes).expect("memory takes all bytes");
        out.push(bytes);
    }
    out.dedup();
    out
}

/// A JSON with its numbers inside, and one that names another file.
fn gltf_seeds() -> Vec<Vec<u8>> {
    let mut all = written(".gltf");
    let text = String::from_utf8_lossy(&all[0]).replace("data:application/octet-stream;base64,", "scene.bin?");
    all.push(text.into_bytes());
    all
}

/// A stage as other programs write it, with what ours lacks.
const STAGE: &str = r#"#usda 1.0
( upAxis = "Z" metersPerUnit = 0.01
  timeCodesPerSecond = 10 )
def Xform "w" ( prepend apiSchemas = ["A"] ) {
    double3 xformOp:translate = (1, 2, 3)
    float3 xformOp:rotateXYZ = (10, 20, 30)
    matrix4d xformOp:transform = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "!invert!xformOp:translate", "xformOp:transform"]
    variantSet "v" = { "a" { def Mesh "m" { int[] i = [1] } } }
    def ParticleField3DGaussianSplat "g" {
        point3h[] positionsh.timeSamples = { 0: [(1, 2, 3), (4, 5, 6)], 1: [(1, 2, 4), (4, 5, 7)] }
        float[] opacities = [0.5, 0.25] ( interpolation = "vertex" )
        uniform int radiance:sphericalHarmonicsDegree = 0
        float3[] radiance:sphericalHarmonicsCoefficients = [(1, 2, 3), (1, 2, 3)]
    }
}
"#;

/// The pickle of a checkpoint of two Gaussians with degree 0, as `torch.save` writes it: {'splats': OrderedDict(...)}.
const PICKLE: &[u8] = include_bytes!("../seeds/splats.pkl");

/// The archive of a pickle and storages of 32 numbers.
fn torch(pickle: &[u8]) -> Vec<u8> {
    let numbers: Vec<u8> = (0..32).flat_map(|i| (i as f32 * 0.1).to_le_bytes()).collect();
    let names: Vec<String> = (0..9).map(|i| format!("archive/data/{i}")).collect();
    let storages = names.iter().map(|name| (name.as_str(), &numbers[..]));
    zip(&std::iter::once(("archive/data.pkl", pickle)).chain(storages).collect::<Vec<_>>(), false)
}

fn torch_seeds() -> Vec<Vec<u8>> {
    vec![torch(PICKLE)]
}

/// Another pickle for storages that are sound.
fn torch_pickle(bytes: &[u8]) {
    open(&torch(bytes));
}

/// Three frames of two Gaussians of Dynamic3DGaussians.
fn dynamic3d() -> Vec<u8> {
    let arrays = [("means3D", &[3, 2, 3][..]), ("unnorm_rotations", &[3, 2, 4]), ("rgb_colors", &[3, 2, 3])];
    let arrays = arrays.into_iter().chain([("log_scales", &[2, 3][..]), ("logit_opacities", &[2, 1])]);
    let files: Vec<(String, Vec<u8>)> = arrays.map(|(name, shape)| (format!("{name}.npy"), array(shape))).collect();
    zip(&files.iter().map(|(n, b)| (n.as_str(), &b[..])).collect::<Vec<_>>(), true)
}

fn usda_seeds() -> Vec<Vec<u8>> {
    let mut all = written(".usda");
    all.push(STAGE.into());
    all
}

fn point_seeds() -> Vec<Vec<u8>> {
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n\
                  property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float time\nelement face 1\n\
                  property list uchar int vertex_indices\nend_header\n0 1 2 255 0 9 0.5\n1e3 -2 3 1 2 3 nan\n3 0 1 1\n";
    let mut all = written(".ply");
    all.push(header.into());
    all
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut zip = GzEncoder::new(Vec::new(), Compression::fast());
    zip.write_all(bytes).expect("memory takes all bytes");
    zip.finish().expect("memory takes all bytes")
}

/// Content of the gzip streams of versions 2 and 3: damage reaches it past the checksum.
fn spz_bodies() -> Vec<Vec<u8>> {
    let inside = |file: Vec<u8>| {
        let mut body = Vec::new();
        GzDecoder::new(&file[..]).read_to_end(&mut body).ok().map(|_| body)
    };
    written(".spz").into_iter().filter_map(inside).collect()
}

fn scene_seeds() -> Vec<Vec<u8>> {
    [standing(), moving()]
        .map(|s| {
            let mut bytes = Vec::new();
            scene::write(&s, &mut bytes).expect("memory takes all bytes");
            bytes
        })
        .into()
}

fn sog_seeds() -> Vec<Vec<u8>> {
    vec![SOG.to_vec()]
}

fn meta_seeds() -> Vec<Vec<u8>> {
    vec![sog::unzip(SOG).expect("the seed is sound")[sog::META].to_vec()]
}

/// Another `meta.json` for the seed's images.
fn sog_meta(bytes: &[u8]) {
    let mut files = sog::unzip(SOG).expect("the seed is sound");
    files.insert(sog::META.into(), Cow::Borrowed(bytes));
    drop(sog::files_of(bytes));
    drop(sog::read(&files));
}

/// Another index for parts that all equal the seed.
fn sog_levels(bytes: &[u8]) {
    let Ok(finest) = levels::finest(bytes) else { return };
    let params = sog::unzip(SOG).and_then(|files| sog::read(&files)).expect("the seed is sound").0;
    let pieces: Vec<_> = finest.pieces.into_iter().take(PIECES).map(|(_, rows)| (params.clone(), rows)).collect();
    drop(levels::join(&pieces));
}

/// Archives of one scene, stored and deflated.
fn ply_zips() -> Vec<Vec<u8>> {
    let ply = &written(".ply")[0];
    [false, true].map(|deflate| zip(&[("a/scene.ply", ply), ("readme.txt", b"x")], deflate)).into()
}

/// Beginnings of files that are named and not read.
fn foreign_seeds() -> Vec<Vec<u8>> {
    let json = r#"{"format": "a", "version": 1, "gaussians": 5, "filenames": []}"#;
    let torch = zip(&[("archive/data.pkl", b"x"), ("archive/version", b"3")], false);
    vec![
        json.into(),
        torch,
        b"\x80\x02}q\0.".to_vec(),
        b"S4D1\0\0\0\x01aaaaaaaaaaaaaaaa".to_vec(),
        b"glTF\x02\0\0\0".to_vec(),
    ]
}

thread_local! {
    static FOLDER: RefCell<Option<TempDir>> = const { RefCell::new(None) };
}

/// Opens a file by its path, as the commands do.
fn file(name: &str, bytes: &[u8]) {
    FOLDER.with_borrow_mut(|folder| {
        let folder = folder.get_or_insert_with(|| tempfile::tempdir().expect("there is a place for temporary files"));
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("the disk takes a file");
        if let Ok(source) = Source::open(&path) {
            show(&source.scene);
        }
    });
}

fn array(shape: &[usize]) -> Vec<u8> {
    let (mut out, count) = (Vec::new(), shape.iter().product::<usize>());
    let data: Vec<f32> = (0..count).map(|i| i as f32).collect();
    npy::write_f32(shape, &data, &mut out).expect("memory takes all bytes");
    out
}

fn npy_seeds() -> Vec<Vec<u8>> {
    // Big-endian integers, column by column.
    let dict = b"{'descr': '>i2', 'fortran_order': True, 'shape': (2, 3), }\n";
    let columns = [b"\x93NUMPY\x01\0", &(dict.len() as u16).to_le_bytes()[..], dict, &[0; 12]].concat();
    vec![array(&[2, 3]), array(&[7]), array(&[]), columns]
}

fn npz_seeds() -> Vec<Vec<u8>> {
    [false, true].map(|deflate| zip(&[("data.npy", &array(&[4, 7]))], deflate)).into()
}

fn playback_seeds() -> Vec<Vec<u8>> {
    let plain = include_bytes!("../../splat4d/tests/data/tiny.s4d");
    let sound = Sound::try_from((0.0, TONE.to_vec())).expect("a tone");
    vec![plain.to_vec(), playback::with_extras(plain, None, Some(&sound)).expect("a file with sound")]
}

/// A tone.
const TONE: &[u8] = include_bytes!("../../splat4d/tests/data/tone.m4a");

fn sound_seeds() -> Vec<Vec<u8>> {
    vec![TONE.to_vec()]
}

fn sound_file(bytes: &[u8]) {
    let _ = Sound::try_from((0.0, bytes.to_vec()));
}

/// Reads a playback file unchanged, and with its checksums corrected: almost every input would stop at these.
fn playback_file(bytes: &[u8]) {
    let look = |bytes: &[u8]| {
        let _ = Index::parse(bytes, Some(bytes.len() as u64));
        let _ = playback::provenance(bytes);
        let _ = playback::sound(bytes);
        if let Ok(scene) = playback::read(bytes) {
            show(&scene);
        }
    };
    look(bytes);
    let mut mended = bytes.to_vec();
    mend(&mut mended);
    look(&mended);
}

/// Bytes of an entry of the table of sections.
const ENTRY: usize = 64;

fn crc(bytes: &[u8]) -> [u8; 4] {
    let mut crc = flate2::Crc::new();
    crc.update(bytes);
    crc.sum().to_le_bytes()
}

/// Writes the checksums that fit (docs/format.md, "Layout").
fn mend(bytes: &mut [u8]) {
    let number = |b: &[u8], at: usize| {
        b.get(at..at.checked_add(4)?).map(|x| u32::from_le_bytes([x[0], x[1], x[2], x[3]]) as usize)
    };
    let Some(index) = number(bytes, 12) else { return };
    if bytes.len() < HEADER_BYTES || index > bytes.len() - HEADER_BYTES {
        return;
    }
    let end = HEADER_BYTES + index;
    let table = number(bytes, HEADER_BYTES).and_then(|json| json.checked_add(HEADER_BYTES + 8)).unwrap_or(end);
    for at in (table..(end + 1).saturating_sub(ENTRY)).step_by(ENTRY) {
        let (Some(offset), Some(size)) = (number(bytes, at + 8), number(bytes, at + 16)) else { continue };
        if let Some(sum) = bytes.get(offset..offset.saturating_add(size)).map(crc) {
            bytes[at + 24..at + 28].copy_from_slice(&sum);
        }
    }
    let sum = crc(&bytes[HEADER_BYTES..end]);
    bytes[24..28].copy_from_slice(&sum);
    let sum = crc(&bytes[..HEADER_BYTES - 4]);
    bytes[HEADER_BYTES - 4..HEADER_BYTES].copy_from_slice(&sum);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_of_trained_models_are_sound() {
        for (bytes, rows) in [(torch(PICKLE), 2), (dynamic3d(), 2), (STAGE.into(), 2)] {
            assert!(splat4d::open(&bytes).unwrap_or_else(|e| panic!("{e}")).len() >= rows);
        }
    }

    #[test]
    fn seeds_are_sound() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.zip");
        for zip in ply_zips() {
            std::fs::write(&path, zip).unwrap();
            assert_eq!(Source::open(&path).unwrap_or_else(|e| panic!("{e}")).scene.len(), 5);
        }
        assert_eq!(levels::finest(LEVELS.as_bytes()).unwrap().pieces.len(), 2);
    }
}
