//! Axes, units and file names that other programs expect of numbered files and scenes (`convert --for`).

/// A program and what its importers take for granted.
///
/// Files that state their axes (USD, .spz) only get `up`, and glTF nothing: importers convert them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Program {
    /// Its name as an option.
    pub name: &'static str,
    /// Direction of up.
    pub up: [f64; 3],
    /// Axis along which the scene is mirrored, because the program is left-handed.
    pub mirrored: Option<usize>,
    /// Units of the program in one of the scene.
    pub units: f64,
    /// Names of numbered files in a folder.
    pub frame: &'static str,
}

/// Up along z and y.
const Z: [f64; 3] = [0.0, 0.0, 1.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];

/// All programs. Sources: manuals of Blender (z up, metres), Unreal Engine (left-handed, z up, centimetres), Unity (left-handed, y
/// up, metres), Nuke (y up) and Isaac Sim (z up, metres).
pub const PROGRAMS: [Program; 5] = [
    Program { name: "blender", up: Z, mirrored: None, units: 1.0, frame: "frame_%04d.ply" },
    Program { name: "unreal", up: Z, mirrored: Some(1), units: 100.0, frame: "frame_%04d.ply" },
    Program { name: "unity", up: Y, mirrored: Some(2), units: 1.0, frame: "frame_%04d.ply" },
    Program { name: "nuke", up: Y, mirrored: None, units: 1.0, frame: "frame.%04d.ply" },
    Program { name: "isaac", up: Z, mirrored: None, units: 1.0, frame: "frame_%04d.ply" },
];

impl Program {
    /// The program of this name.
    pub fn of(name: &str) -> Option<Self> {
        PROGRAMS.into_iter().find(|p| p.name == name)
    }
}
