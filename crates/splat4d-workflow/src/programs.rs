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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::converting::{Conversion, run};
    use crate::events::ignore;
    use splat4d::format::{dialect, ply, scene};
    use splat4d::layers::Scene;
    use splat4d::scene::params::LOG_SCALE;
    use splat4d::scene::{GEOMETRY, Params};

    /// A small Gaussian one unit above another one, a third one to the right of it and a fourth one in front (y is up, x right,
    /// −z front), turned about the vertical.
    fn landmarks(up: [f64; 3]) -> Scene<f32> {
        let mut params = Params::new(4, 4, &[]);
        for (row, place) in [[0.0; 3], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]].into_iter().enumerate() {
            params[GEOMETRY].write(row, 0, place.map(|x| x as f32));
            params[GEOMETRY].write(row, 3, [0.9f32, 0.0, 0.4, 0.0]);
            params[GEOMETRY].write(row, LOG_SCALE, [-2.0f32, -3.0, -4.0]);
        }
        let mut scene = Scene { up: [0.0, 1.0, 0.0], ..dialect::still(params) };
        let turn = splat4d::layers::rotation_between([0.0, 1.0, 0.0], up).unwrap();
        scene.rotate(&turn);
        scene
    }

    fn write(scene: &Scene<f32>, folder: &std::path::Path) -> std::path::PathBuf {
        let (mut bytes, path) = (Vec::new(), folder.join("scene.safetensors"));
        scene::write(scene, &mut bytes).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    }

    /// Positions relative to the first one: above, right and in front.
    fn landmarks_of(params: &Params) -> [[f32; 3]; 3] {
        let place = |row: usize| params[GEOMETRY].read::<3>(row, 0);
        let from = place(0);
        [1, 2, 3].map(|row| std::array::from_fn(|k| place(row)[k] - from[k]))
    }

    #[test]
    fn every_program_gets_its_up_unit_and_handedness() {
        let dir = tempfile::tempdir().unwrap();
        for (name, up, handed, unit) in [
            ("blender", 2, 1.0, 1.0),
            ("unreal", 2, -1.0, 100.0),
            ("unity", 1, -1.0, 1.0),
            ("nuke", 1, 1.0, 1.0),
            ("isaac", 2, 1.0, 1.0),
        ] {
            let program = Program::of(name).unwrap();
            for from in [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0]] {
                let input = write(&landmarks(from), dir.path());
                let output = dir.path().join(format!("{name}.ply"));
                run(&Conversion { program: Some(program), ..Conversion::new(&input, &output) }, &ignore).unwrap();
                let (params, _) = ply::read(&std::fs::read(&output).unwrap()).unwrap();
                let [above, right, front] = landmarks_of(&params);
                let along = |v: [f32; 3], axis: usize, length: f32| {
                    (0..3).all(|k| (v[k] - if k == axis { length } else { 0.0 }).abs() < 1e-4 * unit)
                };
                assert!(along(above, up, unit), "{name}: {above:?}");
                // Right, front and up are a right-handed system, unless the program is left-handed.
                let [[a, b, c], [d, e, f], [g, h, i]] = [right, front, above].map(|v| v.map(|x| x / unit));
                let volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
                assert!((volume - handed).abs() < 1e-4, "{name}: {volume}");
                let scale = params[GEOMETRY].get(1, LOG_SCALE);
                assert!((scale - (unit.ln() - 2.0)).abs() < 1e-5, "{name}: {scale}");
            }
        }
    }

    #[test]
    fn files_that_state_their_axes_stay_right_handed_and_sequences_get_names() {
        let dir = tempfile::tempdir().unwrap();
        let input = write(&landmarks([0.0, -1.0, 0.0]), dir.path());
        let program = Program::of("unreal");
        let output = dir.path().join("scene.usda");
        run(&Conversion { program, ..Conversion::new(&input, &output) }, &ignore).unwrap();
        let opened = splat4d::format::open(&std::fs::read(&output).unwrap()).unwrap();
        let [above, ..] = landmarks_of(&opened.layers[0].params);
        assert!(opened.up == [0.0, 0.0, 1.0] && (above[2] - 1.0).abs() < 1e-5, "{:?} {above:?}", opened.up);
        let frames = dir.path().join("nuke");
        let conversion = Conversion { program: Program::of("nuke"), frames: true, ..Conversion::new(&input, &frames) };
        run(&conversion, &ignore).unwrap();
        assert!(frames.join("frame.0000.ply").is_file());
        let error = run(&Conversion { program, ..Conversion::new(&input, dir.path().join("a.splatv")) }, &ignore);
        assert!(error.unwrap_err().to_string().contains("mirrored"));
    }
}
