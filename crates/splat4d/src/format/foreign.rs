//! Files that splat4d does not read: the format of each and a remedy.

use crate::{Error, ErrorKind};

/// A kind of file that is not read.
struct Foreign {
    /// Whether bytes are such a file.
    is: fn(&[u8]) -> bool,
    /// The kind of file.
    what: &'static str,
    /// The remedy.
    remedy: &'static str,
}

/// Known by their first bytes. Sources: the formats' specifications, or the programs' own readers.
const FOREIGN: [Foreign; 13] = [
    Foreign { is: <[u8]>::is_empty, what: "an empty file", remedy: "Copy or write it again." },
    Foreign {
        // A safetensors file whose header is 640 to 1,408 bytes long begins alike.
        is: |b| matches!(b, [0x80, 2..=5, ..]) && b.get(8) != Some(&b'{'),
        what: "a Python pickle, such as an old checkpoint of PyTorch, which may hold code and is not read",
        remedy: "Export .ply from its program.",
    },
    Foreign {
        is: |b| b.starts_with(b"PXR-USDC"),
        what: "a binary USD layer (.usdc), which is not read",
        remedy: "Convert it to text with `usdcat IN.usdc -o OUT.usda`.",
    },
    Foreign {
        is: |b| b.starts_with(b"\x93NUMPY"),
        what: "a NumPy array (.npy), not a scene",
        remedy: "Write the Gaussians as a 3DGS .ply; gsplat's export_splats does so.",
    },
    Foreign {
        is: |b| b.starts_with(b"LASF"),
        what: "a point cloud (.las or .laz), not Gaussians",
        remedy: "Points start a training: give them to a capture as .ply.",
    },
    Foreign {
        is: |b| b.starts_with(b"\x89PNG") || b.starts_with(b"\xff\xd8\xff") || b.starts_with(b"GIF8"),
        what: "an image, not a scene",
        remedy: "Give the folder of a capture to read images with their cameras.",
    },
    Foreign {
        is: |b| b.get(4..8) == Some(b"ftyp") || b.starts_with(b"\x1aE\xdf\xa3"),
        what: "a video, not a scene",
        remedy: "`splat4d import` makes a capture of videos.",
    },
    Foreign {
        is: |b| b.starts_with(b"version https://git-lfs"),
        what: "a pointer of Git LFS, not the file itself",
        remedy: "Fetch the files of its repository with `git lfs pull`.",
    },
    Foreign {
        is: |b| {
            let ustar = b.get(257..262).is_some_and(|mark| mark == b"ustar");
            ustar || PACKED.iter().any(|mark| b.starts_with(mark))
        },
        what: "an archive, not a scene",
        remedy: "Unpack it and give the file of the scene.",
    },
    Foreign {
        is: |b| b.starts_with(b"ASTM-E57"),
        what: "a point cloud (.e57), not Gaussians",
        remedy: "Points start a training: give them to a capture as .ply.",
    },
    Foreign {
        is: |b| b.starts_with(b"solid ") || b.starts_with(b"Kaydara FBX"),
        what: "a mesh, not Gaussians",
        remedy: MESH,
    },
    Foreign {
        is: |b| b.starts_with(b"\0\x05\x16\x07"),
        what: "what macOS stores next to a file (its name begins with ._), not the file",
        remedy: "Give the file without ._ in its name.",
    },
    Foreign {
        is: |b| {
            let text = b.trim_ascii_start().to_ascii_lowercase();
            text.starts_with(b"<!doctype html") || text.starts_with(b"<html")
        },
        what: "a web page, not a scene",
        remedy: "Where a download gave it, download the file itself again.",
    },
];

/// How packed files begin: 7z, RAR, Zstandard, xz, bzip2. (.spz begins as gzip does.)
const PACKED: [&[u8]; 5] = [b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"\x28\xb5\x2f\xfd", b"\xfd7zXZ\0", b"BZh"];
/// Remedy for a mesh.
const MESH: &str = "A mesh holds no Gaussians. Its points can start a training: give them to a capture as .ply.";

/// Endings of formats without a mark.
const ENDINGS: [(&str, &str, &str); 7] = [
    (".obj", "a mesh, not Gaussians", MESH),
    (".stl", "a mesh, not Gaussians", MESH),
    (".psht", "a project of Postshot", "Export it there as .ply."),
    (".lcc", "a scene of XGRIDS' LCC", "Export it as .ply with its program, or convert it with splat-transform."),
    (".rad", "a .rad of Spark", "Give the .ply or .spz that it was made of."),
    (
        ".splat4d",
        "a .splat4d of another program: those of splat4d begin with S4D",
        "Convert it to numbered .ply or .splat files with the program that wrote it.",
    ),
    (".4dgs", "a .4dgs of another program", "Convert it to numbered .ply files with the program that wrote it."),
];

/// Names of files in archives of other programs, by their ends: the kind of archive and a remedy.
const ARCHIVES: [(&str, &str, &str); 1] = [(
    ".npy",
    "a NumPy archive (.npz), not a SOG scene",
    "Write its Gaussians as a 3DGS .ply; gsplat's export_splats does so. Points, depths and tracks in .npz belong to a \
         capture.",
)];

/// Identifies a file that no reader supports. `name`: the file's, for formats without a mark; may be empty.
pub fn unread(name: &str, bytes: &[u8]) -> Option<Error> {
    let name = name.to_ascii_lowercase();
    let by_mark = FOREIGN.iter().find(|f| (f.is)(bytes)).map(|f| (f.what, f.remedy));
    let named = || ENDINGS.iter().find(|(ending, ..)| name.ends_with(ending)).map(|(_, what, remedy)| (*what, *remedy));
    let (what, remedy) = by_mark.or_else(named)?;
    Some(error(what, remedy))
}

/// Identifies a zip archive without the files of a SOG scene.
pub fn archive(names: &[String]) -> Option<Error> {
    let (_, what, remedy) = ARCHIVES.iter().find(|(end, ..)| names.iter().any(|n| n.ends_with(end)))?;
    Some(error(what, remedy))
}

fn error(what: &str, remedy: &str) -> Error {
    Error::new(ErrorKind::Unsupported, format!("this is {what}")).remedy(remedy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_other_programs_are_named() {
        for (bytes, name, says) in [
            (&b"SPLAT4D\0"[..], "a.splat4d", "another program"),
            (b"\0\0\0\0", "a.4DGS", "another program"),
            (b"\x80\x02}q\0.", "a.pth", "pickle"),
            (b"", "a.s4d", "empty"),
            (b"\x93NUMPY\x01\0", "a.npy", "NumPy"),
            (b"\0\0\0\x18ftypisom", "a.mp4", "import"),
            (b"version https://git-lfs.github.com/spec/v1\noid", "a.ply", "git lfs pull"),
            (b"\n <!doctype HTML><title>Virus scan warning", "a.ply", "web page"),
            (b"\x28\xb5\x2f\xfd\0", "a.ply.zst", "Unpack"),
            (b"solid cube\n", "a.stl", "mesh"),
            (b"# Blender\nv 1 2 3", "a.obj", "mesh"),
            (b"\0\x05\x16\x07\0", "._a.ply", "macOS"),
            (b"\x12\x34", "a.PSHT", "Postshot"),
        ] {
            let error = unread(name, bytes).map(|e| e.to_string()).unwrap_or_default();
            assert!(error.contains(says), "{name}: {error}");
        }
        assert!(unread("a.ply", b"ply\n").is_none() && unread("", b"S4D").is_none());
        assert!(unread("", b"\x80\x02\0\0\0\0\0\0{}").is_none(), "safetensors");
    }

    #[test]
    fn archives_of_other_programs_are_named() {
        let names = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
        let error = archive(&names(&["means3d.npy", "viewmats.npy"])).unwrap().to_string();
        assert!(error.contains(".npz"), "{error}");
        assert!(archive(&names(&["means_l.webp"])).is_none());
    }
}
