use super::*;
use crate::format::kinematic::tests::{apart, moving};
use crate::format::mutate::mutants;
use crate::format::samples::gaussians;
use crate::format::{DIALECTS, dialect::WriteOptions};
use crate::layers::{Scene, freeze};
use crate::scene::{GEOMETRY, LifeKind, SH, Time};

fn written(scene: &Scene<f32>, exact: bool) -> (Vec<u8>, Vec<String>) {
    let mut file = Vec::new();
    let warnings = write::write(scene, &WriteOptions { exact, ..WriteOptions::default() }, &mut file).unwrap();
    (file, warnings.lines().to_vec())
}

#[test]
fn linear_paths_come_back_within_the_steps() {
    for life in [LifeKind::GaussHalf, LifeKind::GaussOne, LifeKind::Infinite] {
        let mut scene = moving(200, life, 1, false);
        scene.layers[0].params[SH] = gaussians(200, 16)[SH].clone();
        let (file, said) = written(&scene, true);
        assert!(file.starts_with(&MAGIC) && file.ends_with(&MAGIC) && said.is_empty(), "{said:?}");
        let back = DIALECT.open(&file).unwrap();
        assert!(back.warnings.lines().is_empty(), "{:?}", back.warnings);
        assert_eq!((back.scene.clip, back.scene.fps, back.scene.len()), (scene.clip, scene.fps, 200));
        let (a, b) = (0.4 * scene.clip[0] + 0.6 * scene.clip[1], scene.clip[0]);
        for t in [a, b] {
            let [before, after] = [&scene, &back.scene].map(|s| freeze(s, Time(t)).unwrap());
            let mut lost = 0;
            for row in 0..before.len() {
                let mean = before[GEOMETRY].read::<3>(row, 0);
                let near = |r: &usize| {
                    let other = after[GEOMETRY].read::<3>(*r, 0);
                    (0..3).all(|k| (mean[k] - other[k]).abs() < 2e-3)
                };
                lost += usize::from(!(0..after.len()).any(|r| near(&r)));
            }
            assert!(lost <= before.len() / 50, "{life:?} at {t}: {lost} of {}", before.len());
        }
    }
}

#[test]
fn steps_bound_the_errors_of_every_attribute() {
    let scene = moving(150, LifeKind::GaussHalf, 1, false);
    let (file, _) = written(&scene, true);
    let back = DIALECT.open(&file).unwrap().scene;
    // Rows are sorted: the same scene is written again to the same bytes but for rounding, and compared by those.
    let (again, _) = written(&back, true);
    let twice = DIALECT.open(&again).unwrap().scene;
    let [mean, cov, opacity] = apart(&back, &twice);
    assert!(mean < 1e-2 && cov < 0.02 && opacity < 5e-3, "{mean} {cov} {opacity}");
}

#[test]
fn what_the_format_lacks_is_fitted_or_refused() {
    let scene = moving(50, LifeKind::GaussHalf, 3, true);
    let error = write::write(&scene, &WriteOptions { exact: true, ..WriteOptions::default() }, &mut Vec::new());
    let error = error.unwrap_err().to_string();
    assert!(error.contains("paths curve") && error.contains("rotate"), "{error}");
    let (_, said) = written(&scene, false);
    assert!(said.iter().any(|w| w.contains("curved paths")), "{said:?}");
}

#[test]
fn other_versions_models_and_codecs_are_named() {
    let (file, _) = written(&moving(20, LifeKind::GaussHalf, 1, false), false);
    let said = |bytes: &[u8]| read::read(bytes).err().map(|e| e.to_string()).unwrap_or_default();
    let mut other = file.clone();
    other[5] = b'2';
    assert!(said(&other).contains("version '2'"), "{}", said(&other));
    let at = file.windows(MODEL.len()).position(|w| w == MODEL.as_bytes()).unwrap();
    let mut other = file.clone();
    other[at..at + 14].copy_from_slice(b"keyframe-delta");
    assert!(said(&other).contains("keyframe-delta"), "{}", said(&other));
    let at = file.windows(SCHEME.len()).position(|w| w == SCHEME.as_bytes()).unwrap();
    let mut other = file.clone();
    other[at + 9] = b'2';
    assert!(said(&other).contains("uniform-v2"), "{}", said(&other));
    assert!(said(&file[..file.len() / 2]).contains("ends in the middle"));
}

#[test]
fn unknown_records_are_skipped_and_sound_is_named() {
    let (file, _) = written(&moving(20, LifeKind::GaussHalf, 1, false), false);
    let mut more = file[..MAGIC.len()].to_vec();
    for code in [0x7F, 0xFF, 0x11] {
        more.push(code);
        more.extend(3u64.to_le_bytes());
        more.extend([1, 2, 3]);
    }
    more.extend(&file[MAGIC.len()..]);
    let opened = DIALECT.open(&more).unwrap();
    assert_eq!(opened.scene.len(), 20);
    assert!(opened.warnings.lines()[0].contains("sound"), "{:?}", opened.warnings);
    let at = MAGIC.len();
    let length = u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize;
    let twice = [&file[..at], &file[at..at + 9 + length], &file[at..]].concat();
    assert!(DIALECT.open(&twice).unwrap_err().to_string().contains("two records `header`"));
}

#[test]
fn damaged_files_never_panic() {
    let (file, _) = written(&moving(12, LifeKind::GaussHalf, 1, false), false);
    for mutant in mutants(&file, 4000, "4dgs") {
        let _ = read::read(&mutant);
    }
    assert!(DIALECTS.contains(&DIALECT));
}
