//! Scenes of other programs that are more than one file: output folders of 3DGS, archives with one scene, streamed SOG,
//! glTF with its numbers in other files.

use crate::files;
use crate::sequence::newest;
use crate::source::{Source, dialect_of};
use splat4d::format::dialect::Opened;
use splat4d::format::research;
use splat4d::format::sog::{self, levels};
use splat4d::format::{Dialect, dialect, dynamic3d, gltf, ply, zip};
use splat4d::layers::Scene;
use splat4d::scene::Params;
use splat4d::{Error, Result};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

/// Files next to them without which they are not the scene: networks that move Gaussians (Deformable 3DGS,
/// 4DGaussians) or
/// make them (Scaffold-GS).
const NETWORKS: [&str; 4] = ["deformation.pth", "deform.pth", "opacity_mlp.pt", "checkpoints.pth"];

/// Those of them that are read.
const READ: [&str; 2] = ["deformation.pth", "deform.pth"];
/// Ending of checkpoints, which may hold Gaussians on a clock without seconds.
const CHECKPOINT: &str = ".pt";
/// The settings of a training, in its folder.
const SETTINGS: &str = "cfg_args";

/// Deformable 3DGS's folder of networks, next to that of results.
const DEFORM: &str = "deform";

/// Longest file that is inflated from an archive: bytes, and times its packed bytes. Gaussians shrink by less than 20:1.
const MOST_SMALL: usize = 1 << 20;
const MOST_RATIO: usize = 64;

/// Whether a folder is one of these, and no capture or run.
pub fn is_scene(folder: &Path) -> bool {
    newest(folder).is_some() || [levels::LEVELS, dynamic3d::NAME].iter().any(|name| folder.join(name).is_file())
}

/// Opens a folder of these kinds; none where it is no such folder.
pub(crate) fn open(folder: &Path, fps: f64, clip: Option<[f64; 2]>) -> Result<Option<Source>> {
    if folder.join(levels::LEVELS).is_file() {
        return streamed(folder).map(Some);
    }
    if folder.join(dynamic3d::NAME).is_file() {
        return Source::open_at(&folder.join(dynamic3d::NAME), fps).map(Some);
    }
    let Some((file, iteration)) = newest(folder) else { return Ok(None) };
    let mut source = Source::open_with(&file, fps, clip)?;
    if iteration.is_some() {
        source.warnings.add(format!("the newest iteration is read: {}", file.display()));
    }
    Ok(Some(source))
}

/// A network's file that belongs to the Gaussians of a file, without which they are not the scene as trained.
pub(crate) fn network_of(file: &Path) -> Option<PathBuf> {
    let beside = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut folders = vec![beside.to_path_buf()];
    // Deformable 3DGS: point_cloud/iteration_N/point_cloud.ply, deform/iteration_N/deform.pth.
    let full = std::path::absolute(file).ok()?;
    if let (Some(iteration), Some(root)) = (full.parent().and_then(Path::file_name), full.ancestors().nth(3)) {
        folders.push(root.join(DEFORM).join(iteration));
    }
    folders.iter().flat_map(|folder| NETWORKS.map(|name| folder.join(name))).find(|path| path.is_file())
}

/// What Gaussians with a network are called, where a dialect is named.
pub(crate) fn with_network() -> Dialect {
    let mut dialect = ply::DIALECT;
    (dialect.name, dialect.moves) = ("Gaussians with their network", true);
    dialect
}

/// Opens Gaussians together with the network that moves them. `None`: there is none that is read.
pub(crate) fn trained(kind: Dialect, path: &Path, bytes: &[u8], clip: Option<[f64; 2]>) -> Option<Result<Opened>> {
    if kind != ply::DIALECT {
        return None;
    }
    let network = network_of(path).filter(|n| n.file_name().is_some_and(|n| READ.iter().any(|r| n == *r)))?;
    let full = std::path::absolute(path).ok()?;
    // point_cloud/iteration_N/point_cloud.ply, or all files in one folder.
    let folders = [full.ancestors().nth(3), full.parent()];
    let settings = folders.into_iter().flatten().map(|f| f.join(SETTINGS)).find(|f| f.is_file());
    let open = || {
        let settings = settings.map_or(Ok(Vec::new()), |file| files::read(&file))?;
        let settings = String::from_utf8_lossy(&settings);
        let weights = files::read(&network)?;
        research::read(bytes, &weights, &settings, clip).map_err(|e| e.at(network.display()))
    };
    Some(open())
}

/// Opens a file of a dialect, with the files next to it that a .gltf names.
pub(crate) fn open_file(kind: Dialect, path: &Path, bytes: &[u8], clip: Option<[f64; 2]>) -> Result<Opened> {
    if kind.ending == CHECKPOINT {
        return research::read(&[], bytes, "", clip);
    }
    if kind != gltf::TEXT {
        return kind.open(bytes);
    }
    let mut buffers = BTreeMap::new();
    for uri in gltf::buffers_of(bytes)? {
        let file = within(path, &from_uri(&uri))?;
        buffers.insert(uri, files::read(&file)?);
    }
    gltf::read_text(bytes, &buffers)
}

/// A file's name of a relative URI, whose percent codes are bytes of UTF-8 (RFC 3986).
fn from_uri(uri: &str) -> String {
    let (bytes, mut out, mut i) = (uri.as_bytes(), Vec::with_capacity(uri.len()), 0);
    while i < bytes.len() {
        let code = uri.get(i + 1..i + 3).filter(|_| bytes[i] == b'%').and_then(|h| u8::from_str_radix(h, 16).ok());
        out.push(code.unwrap_or(bytes[i]));
        i += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// Opens an archive with one scene in it; none where the archive itself is of a dialect (SOG, .usdz, checkpoints, .npz).
pub(crate) fn open_archive(path: &Path, bytes: &[u8]) -> Result<Option<Source>> {
    if !bytes.starts_with(&zip::MAGIC) || Dialect::of_file("", bytes).is_some_and(|d| d != sog::DIALECT) {
        return Ok(None);
    }
    let archive = zip::Archive::open(bytes).map_err(|e| e.at(path.display()))?;
    let names = archive.names();
    if names.iter().any(|n| n.rsplit('/').next() == Some(sog::META)) {
        return Ok(None);
    }
    // macOS keeps a shadow of every file.
    let endings = dialect::extensions(|_| true);
    let is_scene =
        |name: &&String| !name.starts_with("__MACOSX/") && endings.iter().any(|e| name.to_lowercase().ends_with(e));
    let scenes: Vec<&String> = names.iter().filter(is_scene).collect();
    let name = match scenes[..] {
        [] => {
            let error = splat4d::format::foreign::archive(&names).unwrap_or_else(|| {
                Error::input("is an archive without a scene file").remedy("Unpack it and give one file.")
            });
            return Err(error.at(path.display()));
        }
        [name] => name,
        _ => {
            let some: Vec<&str> = scenes.iter().map(|n| n.as_str()).take(4).collect();
            let what = format!("is an archive of {} scene files, such as {}", scenes.len(), some.join(", "));
            return Err(Error::input(what)
                .at(path.display())
                .remedy("Unpack it and give one file, or a folder of numbered ones."));
        }
    };
    let place = |e: Error| e.at(format!("{name} in {}", path.display()));
    let most = MOST_SMALL + MOST_RATIO * archive.packed(name).unwrap_or_default();
    let inside = archive.file(name, most).expect("it is one of the names").map_err(place)?;
    let dialect = dialect_of(Path::new(name), &inside)
        .ok_or_else(|| place(Error::input("unknown format: its first bytes match none that splat4d reads")))?;
    let opened = dialect.open(&inside).map_err(place)?;
    let (ply, warnings) = (opened.ply, opened.warnings);
    Ok(Some(Source { ply, dialect: Some(dialect), warnings, ..Source::own(opened.scene) }))
}

/// The finest level of a streamed SOG scene.
fn streamed(folder: &Path) -> Result<Source> {
    let index = folder.join(levels::LEVELS);
    let bytes = files::read(&index)?;
    let place = |e: Error| e.at(index.display());
    let finest = levels::finest(&bytes).map_err(place)?;
    let mut pieces: Vec<(Params, _)> = Vec::with_capacity(finest.pieces.len());
    let mut warnings = splat4d::format::Warnings::default();
    for (name, rows) in finest.pieces {
        let meta = within(&index, &name)?;
        let (params, said) = read_sog(meta.parent().unwrap_or(folder))?;
        warnings.append(said);
        pieces.push((params, rows));
    }
    let params = levels::join(&pieces).map_err(place)?;
    if finest.levels > 1 {
        warnings.add(format!("the finest of {} levels of detail is read", finest.levels));
    }
    let scene = Scene { up: sog::DIALECT.up, ..dialect::still(params) };
    Ok(Source { dialect: Some(sog::DIALECT), warnings, ..Source::own(scene) })
}

/// A SOG scene whose files are in a folder.
pub(crate) fn open_sog(folder: &Path) -> Result<Source> {
    let (params, warnings) = read_sog(folder)?;
    let scene = Scene { up: sog::DIALECT.up, ..dialect::still(params) };
    Ok(Source { dialect: Some(sog::DIALECT), warnings, ..Source::own(scene) })
}

fn read_sog(folder: &Path) -> Result<(Params, splat4d::format::Warnings)> {
    let read = |file: PathBuf| files::read(&file);
    let index = folder.join(sog::META);
    let meta = read(index.clone())?;
    let mut files = sog::Files::new();
    for name in sog::files_of(&meta).map_err(|e| e.at(folder.display()))? {
        let bytes = read(within(&index, &name)?)?;
        files.insert(name, Cow::Owned(bytes));
    }
    files.insert(sog::META.into(), Cow::Owned(meta));
    sog::read(&files).map_err(|e| e.at(folder.display()))
}

/// The file next to `index` that it names. Errors: the name leads out of the folder.
fn within(index: &Path, name: &str) -> Result<PathBuf> {
    if Path::new(name).components().any(|c| !matches!(c, Component::Normal(_))) {
        return Err(Error::input(format!("refers to the file `{name}`, which is outside its folder"))
            .at(index.display())
            .remedy("Export the scene again."));
    }
    Ok(index.parent().unwrap_or(Path::new("")).join(name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn ply_of(rows: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        ply::write(&Params::new(rows, 1, &[]), &mut bytes).unwrap();
        bytes
    }

    fn put(folder: &Path, name: &str, bytes: &[u8]) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    #[test]
    fn the_newest_iteration_of_an_output_folder_is_read() {
        let dir = tempfile::tempdir().unwrap();
        let at = dir.path();
        assert!(!is_scene(at));
        put(at, "cfg_args", b"Namespace()");
        put(at, "point_cloud/iteration_7000/point_cloud.ply", &ply_of(2));
        put(at, "point_cloud/iteration_30000/point_cloud.ply", &ply_of(3));
        put(at, "point_cloud/iteration_best/notes.txt", b"");
        for (folder, rows) in [("", 3), ("point_cloud", 3), ("point_cloud/iteration_7000", 2)] {
            assert_eq!(Source::open(&at.join(folder)).unwrap().scene.len(), rows, "{folder}");
        }
        let said = Source::open(at).unwrap().warnings;
        assert!(said.lines().iter().any(|w| w.contains("iteration_30000")), "{said:?}");
        for network in ["point_cloud/iteration_30000/deformation.pth", "deform/iteration_30000/deform.pth"] {
            put(at, network, b"");
            for path in [at.to_path_buf(), at.join("point_cloud/iteration_30000/point_cloud.ply")] {
                let error = Source::open(&path).err().unwrap().to_string();
                let name = Path::new(network).file_name().unwrap().to_str().unwrap();
                assert!(error.contains(name), "{error}");
            }
            std::fs::remove_file(at.join(network)).unwrap();
        }
        put(at, "point_cloud/iteration_30000/opacity_mlp.pt", b"");
        let said = Source::open(at).unwrap().warnings;
        assert!(said.lines().iter().any(|w| w.contains("opacity_mlp.pt")), "{said:?}");
        let of_7000 = Source::open(&at.join("point_cloud/iteration_7000")).unwrap().warnings;
        assert!(!of_7000.lines().iter().any(|w| w.contains("network")), "{of_7000:?}");
    }

    #[test]
    fn a_gltf_is_read_with_the_file_of_its_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let (mut glb, at) = (Vec::new(), dir.path());
        let mut params = Params::new(3, 1, &[]);
        (0..3).for_each(|row| params[splat4d::scene::GEOMETRY].set(row, 3, 1.0));
        gltf::DIALECT.write(&dialect::still(params), &dialect::WriteOptions::default(), &mut glb).unwrap();
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let mut json: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        put(at, "my scene.bin", &glb[28 + length..]);
        for (uri, says) in [("my%20scene.bin", ""), ("../my%20scene.bin", "outside"), ("none.bin", "none.bin")] {
            json["buffers"][0]["uri"] = uri.into();
            put(at, "scene.gltf", json.to_string().as_bytes());
            match Source::open(&at.join("scene.gltf")) {
                Ok(source) => assert_eq!((source.scene.len(), says), (3, "")),
                Err(e) => assert!(!says.is_empty() && e.to_string().contains(says), "{uri}: {e}"),
            }
        }
    }

    #[test]
    fn folders_of_one_frame_each_are_a_sequence() {
        let dir = tempfile::tempdir().unwrap();
        put(dir.path(), "000/point_cloud.ply", &ply_of(2));
        put(dir.path(), "frame001/point_cloud/iteration_5/point_cloud.ply", &ply_of(3));
        put(dir.path(), "2/anything.ply", &ply_of(4));
        let source = Source::open(dir.path()).unwrap();
        assert_eq!((source.scene.len(), source.scene.is_moving()), (9, true));
    }

    /// CRC-32, bit by bit.
    fn crc(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(u32::MAX, |crc, b| {
            (0..8).fold(crc ^ u32::from(*b), |c, _| if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 })
        })
    }

    #[test]
    fn an_archive_with_one_scene_is_opened() {
        // Stored entries, by hand (APPNOTE 4.3): local headers, directory, end record.
        let zip = |files: &[(&str, &[u8])]| {
            let (mut out, mut directory) = (Vec::new(), Vec::new());
            for (name, bytes) in files {
                let offset = out.len() as u32;
                let (crc, n) = (crc(bytes).to_le_bytes(), (bytes.len() as u32).to_le_bytes());
                let sizes = [crc, n, n].concat();
                out.extend(b"PK\x03\x04\x14\0\0\0\0\0\0\0\0\0");
                out.extend(&sizes);
                out.extend([name.len() as u8, 0, 0, 0]);
                out.extend(name.as_bytes());
                out.extend(*bytes);
                directory.extend(b"PK\x01\x02\x14\0\x14\0\0\0\0\0\0\0\0\0");
                directory.extend(&sizes);
                directory.extend([name.len() as u8, 0]);
                directory.extend([0; 12]);
                directory.extend(offset.to_le_bytes());
                directory.extend(name.as_bytes());
            }
            let (at, length) = (out.len() as u32, directory.len() as u32);
            out.extend(directory);
            out.extend(b"PK\x05\x06\0\0\0\0");
            out.extend([files.len() as u8, 0, files.len() as u8, 0]);
            out.write_all(&length.to_le_bytes()).unwrap();
            out.extend(at.to_le_bytes());
            out.extend([0, 0]);
            out
        };
        let dir = tempfile::tempdir().unwrap();
        let (one, path) = (ply_of(3), dir.path().join("scene.zip"));
        std::fs::write(&path, zip(&[("a/scene.ply", &one), ("readme.txt", b"x"), ("__MACOSX/a/scene.ply", &one)]))
            .unwrap();
        assert_eq!(Source::open(&path).unwrap().scene.len(), 3);
        std::fs::write(&path, zip(&[("a.ply", &one), ("b.ply", &one)])).unwrap();
        let error = Source::open(&path).err().unwrap().to_string();
        assert!(error.contains("2 scene files") && error.contains("a.ply"), "{error}");
        std::fs::write(&path, zip(&[("readme.txt", b"x")])).unwrap();
        assert!(Source::open(&path).err().unwrap().to_string().contains("without a scene"));
    }
}
