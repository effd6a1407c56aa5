use super::*;
use serde_json::json;

/// Writes files below a folder.
fn folder(files: &[(&str, String)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    folder
}

fn openpose(people: &[&[f64]]) -> String {
    let people: Vec<Value> =
        people.iter().map(|p| json!({ "pose_keypoints_2d": p, "face_keypoints_2d": [] })).collect();
    json!({ "version": 1.3, "people": people }).to_string()
}

#[test]
fn files_of_frames_and_lists_of_results_are_read() {
    let list = json!([
        {"image_id": 1, "category_id": 1, "keypoints": [3, 4, 0.5, 5, 6, 2], "score": 0.9},
        {"image_id": 3, "category_id": 1, "keypoints": [7, 8, 0.25], "score": 0.8},
    ]);
    let named = json!({
        "images": [{"id": 70, "file_name": "frames/000000.jpg"}, {"id": 71, "file_name": "frames/000002.jpg"}],
        "annotations": [{"image_id": 71, "keypoints": [1, 2, 1]}, {"image_id": 70, "keypoints": [0, 0, 0]}],
    });
    let alphapose = json!([{"image_id": "12.jpg", "keypoints": [1, 1, 0.5]}]);
    let place = folder(&[
        ("a_json/a.0000_keypoints.json", openpose(&[&[10.0, 20.0, 0.75], &[1.0, 2.0, 0.5]])),
        ("a_json/a.0002_keypoints.json", openpose(&[])),
        ("b.json", list.to_string()),
        ("c_keypoints.json", named.to_string()),
        ("d.json", alphapose.to_string()),
    ]);
    let read = read_keypoints(place.path(), &["a", "b", "c", "d"]).unwrap();
    assert_eq!(read[0], Frames::from([(0, vec![vec![[10.5, 20.5, 0.75]], vec![[1.5, 2.5, 0.5]]]), (2, Vec::new())]));
    // Frames from 1 on begin at 0; a visibility of 2 is certain.
    assert_eq!(read[1][&0], [vec![[3.5, 4.5, 0.5], [5.5, 6.5, 1.0]]]);
    assert_eq!(read[1].keys().copied().collect::<Vec<_>>(), [0, 2]);
    assert_eq!(read[2].keys().copied().collect::<Vec<_>>(), [0, 2]);
    assert_eq!(read[3].keys().copied().collect::<Vec<_>>(), [12]);
}

#[test]
fn wrong_files_are_refused_with_a_reason() {
    let files = |name: &str, text: &str| {
        let place = folder(&[(name, text.to_owned())]);
        read_keypoints(place.path(), &["a"]).unwrap_err().to_string()
    };
    let wrong = [
        ("b.json", "[]", "no keypoints of camera a"),
        ("a.json", "{", "invalid keypoints"),
        ("a.json", r#"{"people": 3}"#, "expected a list of people"),
        ("a.json", r#"[{"keypoints": [1, 2, 1]}]"#, "image_id"),
        ("a.json", r#"[{"image_id": 1, "keypoints": [1, 2]}]"#, "found 2 numbers"),
        ("a.json", r#"[{"image_id": 1, "keypoints": ["x", 2, 1]}]"#, "is not a number"),
        ("a.json", r#"[{"image_id": -1, "keypoints": [1, 2, 1]}]"#, "image_id"),
        ("a/none.json", r#"{"people": []}"#, "no frame number"),
        ("a/01.json", "[]", "expected a list `people`"),
    ];
    for (name, text, why) in wrong {
        let error = files(name, text);
        assert!(error.contains(why), "{name} {text}: {error}");
    }
    let twice = folder(&[("a/1.json", openpose(&[])), ("a/01.json", openpose(&[]))]);
    assert!(read_keypoints(twice.path(), &["a"]).unwrap_err().to_string().contains("two files contain frame 1"));
}
