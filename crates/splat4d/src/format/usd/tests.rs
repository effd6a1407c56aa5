use super::*;
use crate::format::dialect::still;
use crate::format::kinematic::tests::moving;
use crate::format::mutate::mutants;
use crate::format::samples::{gaussians, worst};
use crate::layers::{Layer, freeze};
use crate::math::{Sim3, quat};
use crate::scene::params::{LOG_SCALE, OPACITY};
use crate::scene::{GEOMETRY, LifeKind, Params, SH, Time};

fn written(dialect: Dialect, scene: &Scene<f32>) -> Vec<u8> {
    let mut bytes = Vec::new();
    let scene = Scene { up: Y_UP, ..scene.clone() };
    dialect.write(&scene, &WriteOptions::default(), &mut bytes).unwrap();
    bytes
}

fn open(text: &str) -> Result<Opened> {
    TEXT.open(text.as_bytes())
}

fn error(text: &str) -> String {
    open(text).unwrap_err().to_string()
}

#[test]
fn static_gaussians_round_trip_as_text_and_archive() {
    let p = gaussians(40, 16);
    for dialect in [TEXT, ARCHIVE] {
        let bytes = written(dialect, &still(p.clone()));
        assert_eq!(Dialect::of(&bytes), Some(dialect));
        let opened = dialect.open(&bytes).unwrap();
        assert!(!opened.scene.is_moving() && opened.warnings.lines().is_empty(), "{:?}", opened.warnings);
        let w = worst(&p, &opened.scene.layers[0].params);
        assert!(w.mean == 0.0 && w.sh == 0.0 && w.dc == 0.0, "{w:?}");
        assert!(w.turn < 1e-6 && w.log_scale < 1e-5 && w.opacity < 1e-6, "{w:?}");
    }
}

#[test]
fn every_frame_of_an_animated_scene_round_trips() {
    let scene = Scene { up: Y_UP, ..moving(30, LifeKind::GaussHalf, 3, true) };
    let bytes = written(ARCHIVE, &scene);
    let back = ARCHIVE.open(&bytes).unwrap().scene;
    assert_eq!((back.clip, back.fps), (scene.clip, scene.fps));
    for i in 0..=75 {
        let t = scene.clip[0] + f64::from(i) / scene.fps;
        let (a, b) = (freeze(&scene, Time(t)).unwrap(), freeze(&back, Time(t)).unwrap());
        let w = worst(&a, &b);
        assert!(w.mean < 1e-5 && w.turn < 1e-3 && w.log_scale < 1e-3 && w.opacity < 1e-5, "frame {i}: {w:?}");
    }
    // Between frames Gaussians are on their way.
    let t = scene.clip[0] + 10.5 / scene.fps;
    let [before, between, after] = [10.0, 10.5, 11.0].map(|i| {
        let p = freeze(&back, Time(scene.clip[0] + i / scene.fps)).unwrap();
        p[GEOMETRY].read::<3>(0, 0)
    });
    let middle = freeze(&back, Time(t)).unwrap()[GEOMETRY].read::<3>(0, 0);
    assert_eq!(middle, between);
    (0..3).for_each(|k| {
        assert!((2.0 * between[k] - before[k] - after[k]).abs() < 0.05, "{before:?} {between:?} {after:?}")
    });
}

/// Two Gaussians of degree 1, written by hand as other programs may.
const BY_HAND: &str = r#"#usda 1.0
(
    "A comment"
    defaultPrim = "world"
    customLayerData = { string creator = "x (y)"; int[] a = [1, 2] }
    metersPerUnit = 0.01
    upAxis = "Z"
)
class "_base"
{
    def ParticleField3DGaussianSplat "no"
    {
        point3f[] positions = [(9, 9, 9)]
    }
}
over "nothing" { }
def Xform "world" (
    prepend apiSchemas = ["A", "B"]   # two
    variants = { string lod = "fine" }
    prepend variantSets = "lod"
)
{
    double3 xformOp:translate = (10, 0, 0)
    float xformOp:rotateZ = 90
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ", "xformOp:scale"]
    rel material:binding = </world/m> ( bindMaterialAs = "x" )
    custom string note = """many
lines } "quoted" """
    reorder nameChildren = ["b", "a"]
    variantSet "lod" = {
        "fine" {
            def Mesh "m" { int[] i = [1]; }
        }
    }
    def "group" (active = true) {
        def ParticleField3DGaussianSplat "gaussians" (
            doc = 'ignored }'
        )
        {
            float3[] extent = [(-1, -1, -1), (1, 1, 1)]
            float[] opacities = [0.5, 0.25] (
                interpolation = "vertex"
            )
            quath[] orientationsh = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]
            point3f[] positions = [(1, 2, 3), (4, 5, -6e-1)]
            uniform int radiance:sphericalHarmonicsDegree = 1
            float3[] radiance:sphericalHarmonicsCoefficients = [(0.1, 0.2, 0.3), (1, 2, 3), (4, 5, 6), (7, 8, 9),
                (-0.1, -0.2, -0.3), (11, 12, 13), (14, 15, 16), (17, 18, 19)] /* eight */
            float3[] scales = [(1, 2, 3), (0.5, 0.5, 0.5)]
            token outputs:x.connect = </world/y.z>
            token purpose = "default"
        }
        def ParticleField3DGaussianSplat "hidden" ( active = false ) { point3f[] positions = [(9, 9, 9)]; }
    }
}
"#;

#[test]
fn files_of_other_programs_are_read() {
    let opened = open(BY_HAND).unwrap();
    assert_eq!((opened.scene.len(), opened.scene.up), (2, [0.0, 0.0, 1.0]));
    assert!(opened.warnings.lines()[0].contains("unit is 0.01 m"), "{:?}", opened.warnings);
    let (g, sh) = (&opened.scene.layers[0].params[GEOMETRY], &opened.scene.layers[0].params[SH]);
    // Scaled by 2, turned by 90° about z, moved by 10 along x.
    let [x, y, z] = g.read::<3>(0, 0);
    assert!((x - 6.0).abs() < 1e-5 && (y - 2.0).abs() < 1e-5 && (z - 6.0).abs() < 1e-5, "{x} {y} {z}");
    assert!((g.get(0, LOG_SCALE + 2) - 6f32.ln()).abs() < 1e-6);
    assert!((g.get(1, OPACITY) - (0.25f32 / 0.75).ln()).abs() < 1e-6);
    assert_eq!((sh.width(), sh.read::<3>(1, 0)), (12, [-0.1, -0.2, -0.3]));
    // Of degree 1 the coefficient of z stays, those of x and y turn.
    assert!((sh.get(1, 6) - 14.0).abs() < 1e-5, "{}", sh.get(1, 6));
}

#[test]
fn transforms_are_those_of_usd() {
    // Results of UsdGeom.Xformable.GetLocalTransformation (usd-core 26.11) for the point (1, 2, 3).
    for (ops, order, expected) in [
        ("float3 xformOp:rotateXYZ = (10, 20, 30)", r#"["xformOp:rotateXYZ"]"#, [1.06743, 2.28906, 2.76058]),
        ("float3 xformOp:rotateZYX = (10, 20, 30)", r#"["xformOp:rotateZYX"]"#, [0.90017, 1.70066, 3.20897]),
        (
            "quatf xformOp:orient = (0.5, 0.5, 0.5, 0.5)\n double3 xformOp:translate:a = (1, 0, 0)",
            r#"["xformOp:orient", "xformOp:translate:a"]"#,
            [3.0, 2.0, 2.0],
        ),
        (
            "double3 xformOp:translate:p = (1, 1, 1)\n float xformOp:rotateY = 90",
            r#"["xformOp:translate:p", "xformOp:rotateY", "!invert!xformOp:translate:p"]"#,
            [3.0, 2.0, 1.0],
        ),
        (
            "matrix4d xformOp:transform = ((0, 2, 0, 0), (-2, 0, 0, 0), (0, 0, 2, 0), (5, 6, 7, 1))",
            r#"["xformOp:transform"]"#,
            [1.0, 8.0, 13.0],
        ),
    ] {
        let text = format!(
            "#usda 1.0\ndef ParticleField3DGaussianSplat \"g\" {{\n point3f[] positions = [(1, 2, 3)]\n {ops}\n \
             uniform token[] xformOpOrder = {order}\n}}"
        );
        let p = &open(&text).unwrap().scene.layers[0].params;
        let found = p[GEOMETRY].read::<3>(0, 0);
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4), "{ops}: {found:?}");
    }
}

#[test]
fn positions_alone_that_move_are_tracked() {
    let text = r#"#usda 1.0
( timeCodesPerSecond = 10 )
def ParticleField3DGaussianSplat "g" {
    point3f[] positions.timeSamples = { 0: [(0, 0, 0), (1, 0, 0)], 5: [(1, 0, 0), (1, 1, 0)], 20: [(4, 0, 0), (1, 1, 3)], }
    float[] opacities = [0.5, 0.6]
}"#;
    let opened = open(text).unwrap();
    let scene = &opened.scene;
    assert_eq!((scene.len(), scene.clip, scene.fps, scene.layers.len()), (2, [0.0, 2.0], 10.0, 1));
    let said = opened.warnings.lines().join("\n");
    assert!(said.contains("scales are missing") && said.contains("orientations are missing"), "{said}");
    for (t, x) in [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (1.25, 2.5), (9.0, 4.0)] {
        let p = freeze(scene, Time(t)).unwrap();
        assert!((p[GEOMETRY].get(0, 0) - x).abs() < 1e-6, "{t}");
    }
    // Other counts at other times are frames of their own.
    let varying = text.replace("5: [(1, 0, 0), (1, 1, 0)]", "5: [(1, 0, 0)]");
    let scene = open(&varying).unwrap().scene;
    assert_eq!([0.1, 0.6, 2.1].map(|t| freeze(&scene, Time(t)).unwrap().len()), [2, 1, 2]);
}

#[test]
fn damage_and_stages_without_gaussians_are_refused() {
    assert!(error("#usda 1.0\n(\n subLayers = [@./a.usda@]\n)\n").contains("other files"));
    assert!(error("#usda 1.0\ndef Mesh \"m\" { int[] a = [1] }\n").contains("no Gaussians"));
    let field = |inside: &str| format!("#usda 1.0\ndef ParticleField3DGaussianSplat \"g\" {{\n{inside}\n}}");
    assert!(error(&field("float[] opacities = [1]")).contains("no positions"));
    assert!(error(&field("point3f[] positions = [(1, 2, x)]")).contains("`x` is not a number, at byte"));
    assert!(
        error(&field(
            "point3f[] positions = [(1, 2, 3)]\n float3 xformOp:scale = (1, 2, 1)\n uniform token[] \
        xformOpOrder = [\"xformOp:scale\"]"
        ))
        .contains("scales axes differently")
    );
    assert!(error(&field("point3f[] positions = [(1, 2, 3)]").replace('}', "")).contains("cut short"));
    assert!(error(&"(".repeat(500).replacen('(', "#usda 1.0\n(a = [", 1)).contains("damaged"));
    // Many samples of another attribute must not make many Gaussians of few numbers.
    let samples: String = (0..3000).map(|i| format!("{i}: [1], ")).collect();
    let rows = "(1, 2, 3), ".repeat(300);
    let many = field(&format!("point3f[] positions = [{rows}]\nfloat[] opacities.timeSamples = {{ {samples} }}"));
    assert!(error(&many).contains("3000 time samples"));
    let binary = zipped(&[("a.usdc", b"PXR-USDC\0\x08\0")]);
    let said = ARCHIVE.open(&binary).unwrap_err().to_string();
    assert!(said.contains("binary") && said.contains("usdcat"), "{said}");
}

fn zipped(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    zip::write(files, ALIGN, &mut bytes).unwrap();
    bytes
}

#[test]
fn damaged_files_never_panic() {
    let scene = moving(3, LifeKind::GaussHalf, 1, true);
    let own = written(TEXT, &Scene { clip: [3.0, 3.1], ..scene });
    for seed in [BY_HAND.as_bytes(), &own] {
        for mutant in mutants(seed, 400, "usda") {
            if let Ok(opened) = TEXT.open(&mutant) {
                let _ = freeze(&opened.scene, Time(0.1));
            }
        }
        for cut in (0..seed.len()).step_by(13) {
            let _ = TEXT.open(&seed[..cut]);
        }
    }
}

#[test]
fn only_changing_attributes_are_sampled() {
    let scene = Scene { up: Y_UP, ..moving(20, LifeKind::GaussHalf, 1, false) };
    let text = String::from_utf8(written(TEXT, &scene)).unwrap();
    for (name, sampled) in [("positions", true), ("opacities", true), ("scales", false), ("orientations", false)] {
        assert_eq!(text.contains(&format!("{name}.timeSamples")), sampled, "{name}");
    }
    assert!(text.contains("startTimeCode = 50\n") && text.contains("endTimeCode = 125\n"), "{}", &text[..400]);
    assert!(text.contains("timeCodesPerSecond = 25\n") && text.contains("upAxis = \"Y\"\n"));
    assert!(text.contains("125: [") && !text.contains("126: ["));
    // A layer with a frame is written in the world.
    let rotation = quat::to_rotation(quat::normalize([0.4, -0.3, 0.8, 0.2]).0);
    let frame = Sim3 { scale: 1.7, rotation, translation: [0.4, -0.7, 0.2] };
    let layer = Layer { frame, ..still(gaussians(5, 4)).layers.remove(0) };
    let framed = Scene { layers: vec![layer], ..Scene::default() };
    let back = TEXT.open(&written(TEXT, &framed)).unwrap().scene;
    let expected: Params = freeze(&framed, Time(0.0)).unwrap();
    assert!(worst(&expected, &back.layers[0].params).mean < 1e-5);
}
