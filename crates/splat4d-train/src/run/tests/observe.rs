//! Data after the observed part affects no number of a run.

use super::{MOMENTS, Place, recipe};
use crate::capture::{Capture, Split};
use crate::run::open_capture;

/// Share that leaves the last of three times out.
const SHARE: f64 = 0.6;

#[test]
fn other_images_of_the_future_make_the_same_tensors() {
    // Masks of motion, exposures, clocks, growth and pruning: everything that uses images is switched on.
    let settings = [
        "motion=spacetime init=auto densify.interval=5",
        "motion=control control_nodes=12 exposure=true refine.times=true",
        "motion=tracked",
        "motion=auto init=auto",
    ];
    for changes in settings {
        let mut sets: Vec<&str> = changes.split(' ').collect();
        let observe = format!("capture.observe={SHARE}");
        sets.push(&observe);
        let (place, mut recipe) = (Place::new(), recipe(&sets));
        recipe.run.iterations = 16;
        let train = |name: &str| {
            place.train(name, &recipe).unwrap();
            place.scene(name)
        };
        let first = train("first");
        let capture = place.open(&recipe);
        assert_eq!(capture.future.len(), capture.frames.len() / MOMENTS);
        for &i in &capture.future {
            let path = &capture.frames[i].image;
            let mut picture = image::open(path).unwrap().to_rgb8();
            picture.pixels_mut().for_each(|p| p.0 = [255 - p.0[1], p.0[0] / 2, 17]);
            picture.save(path).unwrap();
        }
        assert!(first == train("second"), "{changes}");
        // The test would see it: other images of the observed part make another scene.
        let seen = &capture.frames[capture.train[0]].image;
        let mut picture = image::open(seen).unwrap().to_rgb8();
        picture.pixels_mut().for_each(|p| p.0 = [255 - p.0[1], p.0[0] / 2, 17]);
        picture.save(seen).unwrap();
        assert!(first != train("third"), "{changes}");
    }
}

#[test]
fn a_capture_is_split_at_given_times() {
    let place = Place::new();
    let open = |share: &str| open_capture(place.capture.path(), &recipe(&[&format!("capture.observe={share}")]));
    let whole = open("1").unwrap();
    assert!(whole.future.is_empty());
    let cut = open("0.6").unwrap();
    let last = |c: &Capture, list: &[usize]| list.iter().map(|&i| c.frames[i].time.0).fold(0.0, f64::max);
    let [seen, held] = [&cut.train, &cut.held].map(|l| last(&cut, l));
    assert!(seen < 0.15 && held < 0.15, "{seen} {held}");
    assert_eq!(cut.train.len() + cut.held.len() + cut.future.len(), whole.frames.len());
    assert!(cut.future.iter().all(|&i| cut.split(i) == Split::Future && cut.frames[i].time.0 > 0.15));
    assert!(open("0").unwrap_err().to_string().contains("leaves nothing"));
    // The first time alone is enough for a scene; that it is not for motion, `predict` states.
    assert_eq!(last(&open("0.0001").unwrap(), &open("0.0001").unwrap().train), 0.0);
    let photos = recipe(&["capture.observe=0.5", "max_frames=1"]);
    let message = open_capture(place.capture.path(), &photos).unwrap_err().to_string();
    assert!(message.contains("the same time"), "{message}");
}
