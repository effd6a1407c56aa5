pub(crate) mod onnx;

use super::*;
use onnx::{Attribute, Graph, IMAGES, channel, of_channel, of_means, of_points};
use splat4d_train::capture::Rgb8;

/// A description of one image in any size.
const PLAIN: &str = "version = 1\n[input]\nrange = 255\n[output]\nkind = \"inverse-depth\"\n";

fn image(width: usize, height: usize) -> Rgb8 {
    let value = |i: usize| ((i * 37 + i / 7 * 11) % 256) as u8;
    Rgb8 { width, height, data: (0..3 * width * height).map(value).collect() }
}

fn red(image: &Rgb8) -> Vec<f32> {
    image.data.iter().step_by(3).map(|v| f32::from(*v)).collect()
}

fn written(network: &[u8], description: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("net.onnx"), network).unwrap();
    std::fs::write(folder.path().join("model.toml"), description).unwrap();
    folder
}

fn load(folder: &tempfile::TempDir) -> Result<Model> {
    Model::load(&folder.path().join("net.onnx"), None)
}

fn error(network: &[u8], description: &str) -> String {
    load(&written(network, description)).err().expect("it must be refused").to_string()
}

#[test]
fn a_network_gets_the_numbers_that_its_description_states() {
    let text = "version = 1\n[input]\nrange = 1\nmean = [0.5, 0.4, 0.3]\nstd = [0.25, 0.5, 2]\n[output]\nkind = \"depth\"\n\
                metric = true\nscale = 10\n";
    for (channels, of, mean, std) in [("rgb", 0, 0.5, 0.25), ("rgb", 2, 0.3, 2.0), ("bgr", 0, 0.5, 0.25)] {
        let text = text.replace("range = 1\n", &format!("range = 1\nchannels = \"{channels}\"\n"));
        let folder = written(&of_channel(of, 3.0, &IMAGES), &text);
        let (image, model) = (image(9, 5), load(&folder).unwrap());
        let map = model.map(&[&image]).unwrap();
        let from = if channels == "bgr" { 2 - of } else { of } as usize;
        for (p, value) in map.values.iter().enumerate() {
            let wanted = 30.0 * (f32::from(image.data[3 * p + from]) / 255.0 - mean) / std;
            assert!((value - wanted).abs() < 1e-3, "{channels} {of}: {value} {wanted}");
        }
        assert_eq!((map.width, map.height, map.channels), (9, 5, 1));
    }
}

#[test]
fn windows_have_no_seams_where_a_network_treats_pixels_alone() {
    let network = of_channel(0, 1.0, &IMAGES);
    let (whole, image) = (written(&network, PLAIN), image(75, 50));
    let whole = load(&whole).unwrap().map(&[&image]).unwrap();
    assert_eq!(whole.values, red(&image));
    let windows =
        "version = 1\n[input]\nrange = 255\nsize = [32, 24]\noverlap = 8\n[output]\nkind = \"depth\"\nmetric = true\n";
    let joined = load(&written(&network, windows)).unwrap().map(&[&image]).unwrap();
    assert_eq!(joined, whole);
    // Without a unit each window is fitted to the whole image, which is resized.
    let fitted = load(&written(&network, &windows.replace("metric = true", ""))).unwrap().map(&[&image]).unwrap();
    assert_eq!((fitted.width, fitted.height), (75, 50));
    // In batches.
    let batched = of_channel(0, 1.0, &[None, Some(3), Some(24), Some(32)]);
    let folder = written(&batched, &windows.replace("overlap", "batch = 3\noverlap"));
    assert_eq!(
        load(&folder).map(|m| m.map(&[&image]).map(|m| m.values == whole.values)).unwrap().err().map(|e| e.to_string()),
        None
    );
}

#[test]
fn flow_is_in_pixels_of_the_images() {
    let text = "version = 1\n[input]\nnames = [\"a\", \"b\"]\nrange = 1\nsize = [20, 20]\n[output]\nkind = \"flow\"\n";
    let grey = |v: u8| Rgb8 { width: 40, height: 30, data: vec![v; 3 * 40 * 30] };
    let model = load(&written(&of_means(255.0), text)).unwrap();
    let map = model.map(&[&grey(100), &grey(103)]).unwrap();
    // Three pixels of twenty are six of forty.
    assert!(map.plane(0).iter().all(|u| (u - 6.0).abs() < 1e-3), "{:?}", &map.values[..3]);
    assert!(map.plane(1).iter().all(|v| *v == 0.0));
    assert!(model.map(&[&grey(1), &Rgb8 { width: 20, height: 60, ..grey(1) }]).is_err());
}

#[test]
fn networks_of_fixed_size_need_no_size_in_the_description() {
    let folder = written(&of_channel(1, 1.0, &[Some(1), Some(3), Some(12), Some(16)]), PLAIN);
    let map = load(&folder).unwrap().map(&[&image(64, 48)]).unwrap();
    assert_eq!((map.width, map.height), (16, 12));
    let other = PLAIN.replace("range = 255", "range = 255\nsize = [16, 16]");
    let text = error(&of_channel(1, 1.0, &[Some(1), Some(3), Some(12), Some(16)]), &other);
    assert!(text.contains("16x16") && text.contains("1x3x12x16") && text.contains("model.toml"), "{text}");
}

#[test]
fn sizes_follow_the_longest_side_and_the_multiple() {
    let text = PLAIN.replace("range = 255", "range = 255\nlongest = 518\nmultiple = 14");
    let model = load(&written(&of_channel(0, 1.0, &IMAGES), &text)).unwrap();
    assert_eq!(model.input_size([640, 480]), [518, 392]);
    assert_eq!(model.input_size([1080, 1920]), [294, 518]);
    assert_eq!(model.input_size([3, 3000]), [14, 518]);
}

#[test]
fn mistakes_in_descriptions_name_the_file_and_the_remedy() {
    let network = of_channel(0, 1.0, &IMAGES);
    let with = |from: &str, to: &str| PLAIN.replace(from, to);
    for (text, words) in [
        (String::new(), "missing field"),
        (with("version = 1", "version = 2"), "expected version = 1, found 2"),
        (with("range", "rang"), "rang"),
        (with("inverse-depth", "deep"), "deep"),
        (with("range = 255", "std = [0, 1, 1]"), "other than 0"),
        (with("range = 255", "size = [10, 10]\nlongest = 5"), "found both"),
        (with("range = 255", "size = [10, 10]\nmultiple = 4"), "multiple of 4"),
        (with("range = 255", "size = [0, 10]"), "found 0"),
        (with("range = 255", "overlap = 4"), "needs input.size"),
        (with("range = 255", "size = [8, 8]\noverlap = 5"), "more than half"),
        (with("range = 255", "batch = 0"), "input.batch"),
        (with("range = 255", "names = [\"picture\"]"), "\"picture\", but \"image\""),
        (with("range = 255", "channels = \"grey\""), "1 channels"),
        (with("kind", "names = [\"depth\"]\nkind"), "\"depth\", but \"map\""),
        (with("kind", "layout = \"hq\"\nkind"), "output.layout"),
        (with("kind", "metric = true\nkind"), "output.metric"),
        (with("kind", "scale = -1\nkind"), "output.scale"),
        (with("kind", "scale = nan\nkind"), "not finite"),
        (with("inverse-depth", "matches"), "expected 3 outputs"),
        (with("kind", "form = \"warp\"\nkind"), "output.form is for matches, not for inverse-depth"),
        (with("kind", "overlap = 2\nkind"), "output.overlap from 0 to 1"),
        (with("range = 255", "range = 255\npad = 114"), "input.pad is for matches and people"),
        (
            with("range = 255", "size = [8, 8]\noverlap = 2").replace("inverse-depth", "people"),
            "not supported for people",
        ),
    ] {
        let said = error(&network, &text);
        assert!(said.contains(words) && (said.contains("model.toml") || said.contains("net.onnx")), "{words}: {said}");
        assert!(said.contains("describe") || said.contains("description"), "{said}");
    }
    let folder = written(&network, PLAIN);
    std::fs::remove_file(folder.path().join("model.toml")).unwrap();
    let said = load(&folder).err().unwrap().to_string();
    assert!(said.contains("expected a description") && said.contains("--describe"), "{said}");
}

#[test]
fn outputs_that_are_not_as_described_are_errors() {
    let image = image(8, 6);
    let ran =
        |network: &[u8], text: &str| load(&written(network, text)).unwrap().map(&[&image]).unwrap_err().to_string();
    let text = ran(&of_channel(0, 1.0, &IMAGES), &PLAIN.replace("kind", "channel = 1\nkind"));
    assert!(text.contains("2 channels") && text.contains("[1, 1, 6, 8]") && text.contains("net.onnx"), "{text}");
    let text = ran(&of_channel(0, 1.0, &IMAGES), &PLAIN.replace("kind", "layout = \"nhw\"\nkind"));
    assert!(text.contains("\"nhw\""), "{text}");
    let mut two = Graph::default();
    two.input("a", &IMAGES);
    two.input("b", &IMAGES);
    two.named("Add", &["a", "b"], "sum", &[]);
    two.output("sum", &IMAGES);
    let text = ran(&two.file(), PLAIN);
    assert!(text.contains("1 inputs, found 2"), "{text}");
}

#[test]
fn positions_of_another_shape_than_described_are_errors() {
    let image = image(8, 6);
    let of = |outputs: &[(&str, &[usize], usize)]| {
        let mut graph = Graph::default();
        graph.input("image", &[None, Some(3), None, None]);
        let zero = zero_of(&mut graph, &["image"]);
        for (name, shape, numbers) in outputs {
            constant(&mut graph, &zero, name, shape, &vec![0.5; *numbers]);
        }
        graph.file()
    };
    let text = "version = 1\n[input]\npair = \"batch\"\n[output]\nkind = \"matches\"\nform = ";
    let matched = |network: &[u8], form: &str| {
        let model = load(&written(network, &format!("{text}\"{form}\"\n"))).unwrap();
        model.matches([&image, &image]).unwrap_err().to_string()
    };
    let said = matched(&of(&[("a", &[3, 2], 6), ("b", &[4, 2], 8), ("c", &[3], 3)]), "pairs");
    assert!(said.contains("positions [matches, 2]") && said.contains("[4, 2]") && said.contains("net.onnx"), "{said}");
    let said = matched(&of(&[("a", &[1, 2, 2, 4], 16), ("b", &[1, 2, 2], 4)]), "warp");
    assert!(said.contains("a warp [1, h, w, 2]") && said.contains("[1, 2, 2, 4]"), "{said}");
    let said = matched(&of(&[("a", &[1, 2, 2, 2], 8), ("b", &[1, 2, 3], 6)]), "warp");
    assert!(said.contains("scores [1, 2, 2]"), "{said}");
    let plain = "version = 1\n[output]\nkind = \"people\"\n[input]\n";
    let found = |network: &[u8], text: &str| load(&written(network, text)).unwrap().people(&image);
    let said = found(&of(&[("a", &[2, 17, 2], 68)]), plain).unwrap_err().to_string();
    assert!(said.contains("keypoints [people, keypoints, 3]") && said.contains("[2, 17, 2]"), "{said}");
    let boxes = plain.replace("kind", "names = [\"a\", \"b\"]\nkind");
    let said = found(&of(&[("a", &[2, 4, 3], 24), ("b", &[2, 4], 8)]), &boxes).unwrap_err().to_string();
    assert!(said.contains("boxes [2, 5]") && said.contains("[2, 4]"), "{said}");
    // Without boxes the keypoints' own: two people in one place are one.
    assert_eq!(found(&of(&[("a", &[2, 4, 3], 24)]), plain).unwrap().len(), 2, "boxes of no size share nothing");
    assert_eq!(found(&of(&[("a", &[0, 4, 3], 0)]), plain).unwrap(), Vec::<Person>::new());
}

#[test]
fn damaged_networks_and_missing_operators_are_errors() {
    let network = of_channel(0, 1.0, &IMAGES);
    for cut in [0, 1, network.len() / 3, network.len() / 2] {
        let text = error(&network[..cut], PLAIN);
        assert!(text.contains("net.onnx") && text.contains("Download or export it again"), "{cut}: {text}");
    }
    let mut graph = Graph::default();
    graph.input("image", &IMAGES);
    graph.named("Telepathy", &["image"], "map", &[]);
    graph.output("map", &IMAGES);
    let text = error(&graph.file(), PLAIN);
    assert!(text.contains("Telepathy") && text.contains("net.onnx"), "{text}");
    let folder = written(&network, PLAIN);
    let other = folder.path().join("net.bin");
    std::fs::write(&other, &network).unwrap();
    assert!(Model::load(&other, None).err().unwrap().to_string().contains(".onnx"));
    assert!(Model::load(&folder.path().join("gone.onnx"), None).is_err());
    assert!(Model::load(&folder.path().join("net.onnx"), Some("gone")).err().unwrap().to_string().contains("midas-v2"));
}

#[test]
fn cubic_interpolation_is_reported() {
    let mut graph = Graph::default();
    graph.input("image", &IMAGES);
    let red = channel(&mut graph, "image", 0, 1.0);
    let factors = graph.floats(&[4], &[1.0, 1.0, 1.0, 1.0]);
    graph.named("Resize", &[&red, "", &factors], "map", &[Attribute::Text("mode", "cubic")]);
    graph.output("map", &IMAGES);
    let folder = written(&graph.file(), PLAIN);
    assert!(load(&folder).unwrap().warning().is_some_and(|w| w.contains("cubically") && w.contains("net.onnx")));
    assert_eq!(load(&written(&of_channel(0, 1.0, &IMAGES), PLAIN)).unwrap().warning(), None);
}

/// Zero, which depends on inputs.
fn zero_of(graph: &mut Graph, inputs: &[&str]) -> String {
    let none = graph.floats(&[], &[0.0]);
    let mut sum = none.clone();
    for input in inputs {
        let largest = graph.node("ReduceMax", &[input], &[Attribute::Int("keepdims", 0)]);
        let zero = graph.node("Mul", &[&largest, &none], &[]);
        sum = graph.node("Add", &[&sum, &zero], &[]);
    }
    sum
}

/// An output of given numbers.
fn constant(graph: &mut Graph, zero: &str, name: &str, shape: &[usize], numbers: &[f32]) {
    let numbers = graph.floats(shape, numbers);
    graph.named("Add", &[&numbers, zero], name, &[]);
    graph.output(name, &vec![None; shape.len()]);
}

/// A stand-in of a published export: its inputs and outputs, and arithmetic that can be checked.
fn stand_in(name: &str) -> Vec<u8> {
    let mut graph = Graph::default();
    match name {
        "depth-anything-v2" | "depth-anything-v2-hf" | "midas-v2" => {
            let (input, output, size) = match name {
                "depth-anything-v2" => ("image", "depth", None),
                "depth-anything-v2-hf" => ("pixel_values", "predicted_depth", None),
                _ => ("0", "797", Some(384)),
            };
            graph.input(input, &[Some(1), Some(3), size, size]);
            let red = channel(&mut graph, input, 0, 1.0);
            let axis = graph.ints(&[1], &[1]);
            graph.named("Squeeze", &[&red, &axis], output, &[]);
            graph.output(output, &[Some(1), size, size]);
        }
        "raft" => {
            for input in ["0", "1"] {
                graph.input(input, &[Some(1), Some(3), Some(360), Some(480)]);
            }
            // Coarse flow first, then that in full resolution.
            let difference = graph.node("Sub", &["1", "0"], &[]);
            let two = graph.ints(&[2], &[0, 1]);
            graph.named("Gather", &["0", &two], "12006", &[Attribute::Int("axis", 1)]);
            graph.named("Gather", &[&difference, &two], "12007", &[Attribute::Int("axis", 1)]);
            graph.output("12006", &[Some(1), Some(2), Some(360), Some(480)]);
            graph.output("12007", &[Some(1), Some(2), Some(360), Some(480)]);
        }
        "pphumanseg" | "u2net-human-seg" => {
            let (side, channels) = if name == "pphumanseg" { (192, 2) } else { (320, 1) };
            graph.input("x", &[Some(1), Some(3), Some(side), Some(side)]);
            let which = graph.ints(&[channels], &[0, 1][..channels]);
            graph.named("Gather", &["x", &which], "y", &[Attribute::Int("axis", 1)]);
            graph.output("y", &[Some(1), Some(channels), Some(side), Some(side)]);
        }
        "superpoint-lightglue" => {
            let points = [0.0, 0.0, 511.5, 255.5, 1.0, 2.0, 3.0, 4.0];
            return of_points(&points, &[0, 0, 1, 0, 1, 0, 0, 1, 1], &[0.9, 0.5, 0.1]);
        }
        "efficient-loftr" => {
            graph.input("image0", &[Some(1), Some(1), Some(480), Some(640)]);
            graph.input("image1", &[Some(1), Some(1), Some(480), Some(640)]);
            let zero = zero_of(&mut graph, &["image0", "image1"]);
            constant(&mut graph, &zero, "keypoints0", &[2, 2], &[9.5, 19.5, 0.0, 0.0]);
            constant(&mut graph, &zero, "keypoints1", &[2, 2], &[39.5, 29.5, 1.0, 1.0]);
            constant(&mut graph, &zero, "confidence", &[2], &[0.9, 0.1]);
        }
        "roma-v2" => {
            for input in ["img_A", "img_B"] {
                graph.input(input, &[None, Some(3), Some(96), Some(96)]);
            }
            let zero = zero_of(&mut graph, &["img_A", "img_B"]);
            // Everything is at the middle of the second image; one pixel of the first is sure.
            let mut sure = vec![0.0; 96 * 96];
            sure[96 * 10 + 21] = 0.8;
            constant(&mut graph, &zero, "warp_AB", &[1, 96, 96, 2], &[0.0; 2 * 96 * 96]);
            constant(&mut graph, &zero, "overlap_AB", &[1, 96, 96, 1], &sure);
        }
        "rtmo" => {
            graph.input("input", &[Some(1), Some(3), Some(640), Some(640)]);
            let zero = zero_of(&mut graph, &["input"]);
            let mut people = vec![[100.0, 50.0, 0.9]; 3 * 17];
            people[17] = [639.0, 639.0, 0.8];
            // Twice the same person, one of them less sure; a third without a score.
            let boxes = [10.0, 10.0, 200.0, 300.0, 0.8, 12.0, 10.0, 202.0, 300.0, 0.9, 400.0, 10.0, 500.0, 90.0, 0.2];
            constant(&mut graph, &zero, "dets", &[1, 3, 5], &boxes);
            constant(&mut graph, &zero, "keypoints", &[1, 3, 17, 3], people.as_flattened());
        }
        other => panic!("{other} has no stand-in"),
    }
    graph.file()
}

#[test]
fn published_descriptions_fit_stand_ins_of_their_exports() {
    for (name, text) in PUBLISHED {
        let described = Description::parse(text).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert!(
            described.source.starts_with("https://") && !described.licence.is_empty() && !described.name.is_empty(),
            "{name}"
        );
        assert!(text.starts_with("# ") && text.contains(&format!("--described {name}`")), "{name}");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("net.onnx");
        std::fs::write(&path, stand_in(name)).unwrap();
        let model = Model::load(&path, Some(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        let grey = |v: u8| Rgb8 { width: 960, height: 480, data: vec![v; 3 * 960 * 480] };
        let near =
            |value: f32, wanted: f32| assert!((value - wanted).abs() < 1e-3, "{name}: {value}, expected {wanted}");
        match name {
            "depth-anything-v2" | "depth-anything-v2-hf" => {
                let image = Rgb8 { width: 960, height: 500, data: vec![51; 3 * 960 * 500] };
                let map = model.map(&[&image]).unwrap();
                assert_eq!((map.width, map.height), (518, 266), "{name}: multiples of 14");
                near(map.values[7], (0.2 - 0.485) / 0.229);
            }
            "midas-v2" => {
                let map = model.map(&[&grey(51)]).unwrap();
                assert_eq!((map.width, map.height), (384, 384));
                near(map.values[7], 0.2);
            }
            "raft" => {
                let map = model.map(&[&grey(51), &grey(54)]).unwrap();
                // Three pixels of 480 are six of 960; of 360, four of 480.
                near(map.plane(0)[9], 6.0);
                near(map.plane(1)[9], 4.0);
            }
            "pphumanseg" => near(model.map(&[&grey(51)]).unwrap().values[3], 0.0),
            "u2net-human-seg" => near(model.map(&[&grey(51)]).unwrap().values[3], (0.2 - 0.485) / 0.229),
            "efficient-loftr" => {
                // 960x480 are stretched to 640x480; the second match is not sure.
                let matches = model.matches([&grey(51), &grey(51)]).unwrap();
                assert_eq!(matches, [[[15.0, 20.0], [60.0, 30.0]]]);
            }
            "roma-v2" => {
                let matches = model.matches([&grey(51), &grey(51)]).unwrap();
                assert_eq!(matches, [[[215.0, 52.5], [480.0, 240.0]]]);
            }
            "rtmo" => {
                // 960x480 become 640x320 above 320 rows of grey, where no keypoint is seen.
                let people = model.people(&grey(51)).unwrap();
                assert_eq!((people.len(), people[0].len()), (1, 17), "of two boxes that overlap the surer one");
                assert_eq!(people[0][0], [0.0; 3]);
                people[0][1].iter().zip([150.75, 75.75, 0.9]).for_each(|(found, wanted)| near(*found, wanted));
            }
            _ => {
                let matches = model.matches([&grey(51), &grey(51)]).unwrap();
                // 960x480 become 1024x512; the third score is too low.
                let f = 960.0 / 1024.0;
                let wanted = [[[0.5 * f, 0.5 * f], [3.5 * f, 4.5 * f]], [[512.0 * f, 256.0 * f], [1.5 * f, 2.5 * f]]];
                assert_eq!(matches.len(), 2);
                for (found, wanted) in matches.iter().flatten().flatten().zip(wanted.iter().flatten().flatten()) {
                    near(*found, *wanted);
                }
            }
        }
    }
}
