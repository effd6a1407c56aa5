//! Models that other programs trained, from their output folders; programs and conformance.

use crate::sample::splat4d;
use splat4d::format::ply;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, Params};
use std::path::Path;

/// Positions before the deformation.
const MEANS: [[f32; 3]; 3] = [[0.2, -0.3, 0.5], [-0.6, 0.1, 0.0], [0.9, 0.9, -0.9]];
/// What the network in tests/data/deformation.pth makes of them at the first, the middle and the last time. The file was written by
/// `torch.save` of PyTorch 2.15: a small network of 4DGaussians' own code with random numbers, evaluated there on the CPU.
const MOVED: [(f64, [[f32; 3]; 3]); 3] = [
    (0.0, [[1.497689, -1.034021, -0.455946], [0.440389, -0.571025, -0.792446], [0.630957, -0.19285, -1.097986]]),
    (0.5, [[1.632634, -1.120226, -0.541058], [0.341307, -0.81224, -0.763454], [0.771873, -0.394097, -0.988907]]),
    (1.0, [[1.851204, -1.186519, -0.676464], [0.180986, -1.109068, -0.70581], [1.030871, -0.518819, -1.039848]]),
];

/// An output folder of 4DGaussians.
fn output(folder: &Path) {
    let mut params = Params::new(3, 16, &[]);
    for (row, mean) in MEANS.into_iter().enumerate() {
        params[GEOMETRY].write(row, 0, mean);
        params[GEOMETRY].set(row, QUAT, 1.0);
        params[GEOMETRY].write(row, LOG_SCALE, [-2.0f32; 3]);
        params[GEOMETRY].set(row, OPACITY, 2.0);
    }
    let at = folder.join("point_cloud/iteration_14000");
    std::fs::create_dir_all(&at).unwrap();
    let mut bytes = Vec::new();
    ply::write(&params, &mut bytes).unwrap();
    std::fs::write(at.join("point_cloud.ply"), bytes).unwrap();
    std::fs::copy("tests/data/deformation.pth", at.join("deformation.pth")).unwrap();
    let settings = "Namespace(sh_degree=3, no_dx=False, no_ds=False, no_dr=False, no_do=True, no_dshs=True)";
    std::fs::write(folder.join("cfg_args"), settings).unwrap();
}

#[test]
fn a_trained_model_moves_as_in_the_program_that_trained_it() {
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("lego");
    output(&folder);
    let told = splat4d(&["info", "lego"]).run_in(work.path()).all();
    assert!(told.contains("Gaussians with their network") && told.contains("hexplane"), "{told}");
    for (time, moved) in MOVED {
        splat4d(&["convert", "lego", "now.ply", "--time", &time.to_string()]).run_in(work.path()).ok();
        let (params, _) = ply::read(&std::fs::read(work.path().join("now.ply")).unwrap()).unwrap();
        for (row, mean) in moved.into_iter().enumerate() {
            let got = params[GEOMETRY].read::<3>(row, 0);
            assert!((0..3).all(|k| (got[k] - mean[k]).abs() < 1e-4), "{row} at {time}: {got:?}, expected {mean:?}");
        }
    }
    // It becomes a playback file, which conforms, and a file of the libraries of .4dgs through it.
    splat4d(&["convert", "lego", "lego.s4d"]).run_in(work.path()).ok();
    let told = splat4d(&["info", "lego.s4d", "--strict"]).run_in(work.path()).ok();
    assert!(told.contains("conforms to the format"), "{told}");
    splat4d(&["convert", "lego.s4d", "lego.4dgs"]).run_in(work.path()).ok();
    splat4d(&["info", "lego.4dgs"]).run_in(work.path()).ok();
    let refused = splat4d(&["info", "lego.4dgs", "--strict"]).run_in(work.path()).refused();
    assert!(refused.contains("strict"), "{refused}");
    // A network with a part that is not read is named, and the Gaussians are opened without it.
    std::fs::write(folder.join("cfg_args"), "Namespace(static_mlp=True)").unwrap();
    let told = splat4d(&["info", "lego"]).run_in(work.path()).all();
    assert!(told.contains("static_mlp=True") && told.contains("not the scene as trained"), "{told}");
    std::fs::write(folder.join("point_cloud/iteration_14000/deformation.pth"), b"PK\x03\x04").unwrap();
    assert!(splat4d(&["info", "lego"]).run_in(work.path()).refused().contains("deformation.pth"));
}

#[test]
fn files_for_a_program_have_its_names_and_axes() {
    let work = tempfile::tempdir().unwrap();
    output(&work.path().join("lego"));
    splat4d(&["convert", "lego", "take", "--frames", "--fps", "2", "--for", "unreal"]).run_in(work.path()).ok();
    let names = |i: usize| work.path().join(format!("take/frame_{i:04}.ply"));
    let [first, last] = [0, 2].map(|i| ply::read(&std::fs::read(names(i)).unwrap()).unwrap().0);
    assert_eq!((first.len(), last.len()), (3, 3));
    // Up was −y, so that z is −y; centimetres, and y mirrored.
    let (got, mean) = (last[GEOMETRY].read::<3>(0, 0), MOVED[2].1[0]);
    assert!((got[2] + 100.0 * mean[1]).abs() < 0.02 && (got[0] - 100.0 * mean[0]).abs() < 0.02, "{got:?} {mean:?}");
    assert!(splat4d(&["convert", "lego", "a.ply", "--for", "maya"]).run_in(work.path()).refused().contains("blender"));
}
