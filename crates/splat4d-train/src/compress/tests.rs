//! A whole compression on a synthetic capture: rounds, the file, sizes.

use super::*;
use crate::run::tests::{Place, recipe};
use splat4d::format::playback::{WriteConfig, read, write_pages};
use splat4d::scene::Time;

struct Bed {
    place: Place,
    recipe: Recipe,
    source: Scene<f32>,
}

impl Bed {
    fn new() -> Self {
        let place = Place::new();
        // The source was pruned while it trained; its compression must not be.
        let recipe = recipe(&["prune_interval=5", "prune_ratio=0.05"]);
        place.train("source", &recipe).unwrap();
        let source = splat4d::format::scene::read(&place.scene("source")).unwrap();
        Self { place, recipe, source }
    }

    fn job<'a>(&'a self, settings: &'a Compression) -> Job<'a> {
        Job { source: &self.source, capture: self.place.open(&self.recipe), recipe: &self.recipe, settings, run: None }
    }

    fn compress(&self, name: &str, settings: &Compression) -> (Compressed, Scene<f32>) {
        let stop = AtomicBool::new(false);
        let job = self.job(settings);
        let done = compress(&job, &self.place.run(name), &TrainOptions::default(), &stop, &mut |_| {}).unwrap();
        let scene = splat4d::format::scene::read(&self.place.scene(name)).unwrap();
        (done, scene)
    }
}

#[test]
fn pruning_rounds_reach_the_target_and_keep_the_floats() {
    let bed = Bed::new();
    let n = bed.source.len();
    let settings = Compression { prune: 0.6, rounds: 3, fine_tune: 6, codec: false, ..Compression::default() };
    let (done, scene) = bed.compress("rounds", &settings);
    assert_eq!(done.outcome.iteration, 6);
    assert!(done.pages.is_none());
    assert_eq!(scene.len(), n - (0.6 * n as f64).round() as usize);
    assert_eq!(scene.layers[0].motion.spec(), bed.source.layers[0].motion.spec());
    assert!(scene.layers[0].masks.is_none());
    // The filter alone changes no number of the scene.
    let settings = Compression { mask_interval: 2, codec: false, ..Compression::default() };
    let (_, filtered) = bed.compress("filter", &settings);
    assert!(filtered.layers[0].params == bed.source.layers[0].params && filtered.layers[0].masks.is_some());
}

#[test]
fn the_file_equals_the_shown_scene_at_every_level() {
    let bed = Bed::new();
    for (name, level) in [("0", Level::Plain), ("1", Level::Tuned), ("2", Level::Pruned)] {
        let settings = Compression::level(level, 40);
        let (done, shown) = bed.compress(name, &settings);
        assert_eq!(done.outcome.iteration, settings.steps());
        let pages = done.pages.unwrap();
        let config = WriteConfig { depths: settings.depths, ..WriteConfig::default() };
        let mut bytes = Vec::new();
        write_pages(&pages.draft(None), &config, &mut bytes).unwrap();
        let file = read(&bytes).unwrap();
        assert_eq!(file.layers.len(), shown.layers.len());
        for (a, b) in file.layers.iter().zip(&shown.layers) {
            assert!(a.params == b.params && a.span == b.span && a.masks == b.masks, "level {name}");
        }
        let seen = |scene: &Scene<f32>| {
            let mut instant = splat4d::layers::Evaluation::default();
            scene.at(Time(scene.clip[0]), &mut instant);
            instant.tapes().map(|t| t.out().rows()).sum::<usize>()
        };
        assert!(seen(&file) > 0 && file.len() <= bed.source.len());
        assert_eq!(file.layers.iter().all(|l| l.masks.is_some()), level == Level::Pruned);
    }
}

#[test]
fn a_target_size_selects_the_gentlest_sufficient_settings() {
    let bed = Bed::new();
    let base = Compression::level(Level::Pruned, 40);
    let job = bed.job(&base);
    let scores = scores(&job, &mut |_, _| {}).unwrap();
    let cameras = cameras(&job.capture);
    let fit = |most: u64| fit(&bed.source, &scores, &base, true, &cameras, [most, 0], &mut |_, _| {});
    let (roomy, _) = fit(1 << 20).unwrap();
    assert_eq!((roomy.prune, roomy.depths), (0.0, Compression::default().depths), "nothing is taken that need not be");
    let (_, trials) = fit(1 << 20).unwrap();
    let whole = trials[0].bytes;
    let (half, trials) = fit(whole / 2).unwrap();
    assert!(half.prune > 0.0 && half.prune < MOST_PRUNED, "{half:?}");
    let chosen = trials.iter().filter(|t| t.prune == half.prune).map(|t| t.bytes).min().unwrap();
    assert!(chosen <= whole / 2, "{chosen} of {whole}");
    // A little less pruning would not do.
    let gentler = trials.iter().filter(|t| t.prune < half.prune && t.sh_degree == half.sh_degree);
    assert!(gentler.clone().count() > 0 && gentler.skip(1).all(|t| t.bytes > whole / 2 * 97 / 100), "{trials:?}");
    let error = fit(10).unwrap_err().to_string();
    assert!(error.contains("Give --max-mb at least"), "{error}");
    let nothing = Compression { codec: false, ..Compression::default() };
    let stop = AtomicBool::new(false);
    let refused = compress(&bed.job(&nothing), &bed.place.run("no"), &TrainOptions::default(), &stop, &mut |_| {});
    assert!(refused.unwrap_err().to_string().contains("no operation is selected"));
}
