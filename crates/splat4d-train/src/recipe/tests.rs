use super::flat::FLAT;
use super::*;
use crate::step::replans::ScheduleChange;

/// A recipe from before there were tables: all defaults, in order.
const FLAT_DEFAULTS: &str = include_str!("tests/flat-defaults.toml");
/// A resolved one with many settings changed.
const FLAT_CHANGED: &str = include_str!("tests/flat-changed.toml");

/// The default recipe of then: its number of Gaussians did not follow from the capture, nor anything else from that.
fn default_of_then() -> Recipe {
    Recipe::default().with(|r| {
        (r.densify.max_cap, r.init.count, r.adc.percent_dense) = (30_000, 10_000, 0.01);
        (r.rates.position_init, r.rates.position_final) = (2e-3, 5e-5);
        (r.rates.feature, r.rates.scaling, r.rates.rotation, r.rates.opacity) = (6e-3, 0.015, 1e-3, 0.05);
        (r.appearance.sh_degree, r.life.width_lr, r.spacetime.velocity_lr_final) = (1, 0.02, 1.6e-5);
    })
}

#[test]
fn every_setting_of_flat_recipes_exists_with_its_default() {
    assert_eq!(FLAT_DEFAULTS.lines().count(), FLAT.len());
    assert_eq!(Recipe::from_toml(FLAT_DEFAULTS).unwrap(), default_of_then());
    for (line, (flat, key)) in FLAT_DEFAULTS.lines().zip(FLAT) {
        assert_eq!(line.split(" = ").next(), Some(flat), "names and their order are those of then");
        assert!(Recipe::default().get(key).is_some(), "{flat} is no longer anywhere: {key}");
    }
}

#[test]
fn flat_recipes_are_unchanged_byte_for_byte() {
    assert_eq!(default_of_then().flat_toml(), FLAT_DEFAULTS);
    let changed = Recipe::from_toml(FLAT_CHANGED).unwrap();
    assert_eq!(changed.flat_toml(), FLAT_CHANGED);
    assert_eq!((changed.tracked.lr_init, changed.hexplane.multires.as_slice()), (3e-3, &[1, 2, 4][..]));
}

#[test]
fn names_are_distinct_and_all_are_known() {
    let mut keys: Vec<String> = Recipe::settings().iter().map(|k| k.key()).collect();
    let count = keys.len();
    keys.extend(FLAT.iter().map(|(flat, _)| (*flat).to_owned()));
    keys.sort_unstable();
    keys.dedup();
    assert_eq!(keys.len(), count + FLAT.len());
    let mut homes: Vec<&str> = FLAT.iter().map(|(_, key)| *key).collect();
    homes.sort_unstable();
    homes.dedup();
    assert_eq!(homes.len(), FLAT.len(), "two names of one knob");
}

#[test]
fn tables_flat_names_and_assignments_are_equivalent() {
    let tables = "[run]\niterations = 300\n[densify]\nfrom = 40\nmax_cap = 2e4\n[life]\nkind = \"interval\"\n";
    let mixed = "iterations = 300\nlife = \"interval\"\n[densify]\ndensify_from_iter = 40\nmax_cap = 20000\n";
    let set = ["run.iterations=300", "densify_from_iter = 40", "densify.max_cap=2e4", "life=interval"];
    let recipe = Recipe::from_toml(tables).unwrap();
    assert_eq!(Recipe::from_toml(mixed).unwrap(), recipe);
    assert_eq!(Recipe::of(&set).unwrap(), recipe);
    assert_eq!(Recipe::from_toml(&recipe.to_toml()).unwrap(), recipe);
}

#[test]
fn errors_of_syntax_name_the_line() {
    for (text, line) in [("[run]\niterations = 1__0\n", 2), ("a = 1\n\n[run\n", 3), ("key", 1)] {
        let error = Recipe::from_toml(text).unwrap_err().to_string();
        assert!(error.contains(&format!("in line {line}: ")), "{error}");
    }
}

#[test]
fn assignments_accept_exponents_and_spaces() {
    let r = Recipe::of(&["position_lr_init=1", "max_cap=2e4", "motion = still"]).unwrap();
    assert_eq!((r.rates.position_init, r.densify.max_cap, r.run.motion.as_str()), (1.0, 20_000, "still"));
}

#[test]
fn unknown_settings_get_a_suggestion_and_wrong_values_a_reason() {
    let mut r = Recipe::default();
    let error = |r: &mut Recipe, s: &str| r.set(s).unwrap_err().to_string();
    assert!(error(&mut r, "iteration=3").contains("`iterations`"));
    assert!(error(&mut r, "densify.form=3").contains("`densify.from`"));
    assert!(error(&mut r, "iterations=many").contains("integer"));
    assert!(error(&mut r, "iterations=-3").contains("integer"));
    assert!(error(&mut r, "iterations=0").contains("at least 1"));
    assert!(error(&mut r, "motion=spacetme").contains("`spacetime`"));
    assert!(error(&mut r, "iterations").contains("key=value"));
    assert!(error(&mut r, "opacity_lr=nan").contains("positive"));
    assert!(error(&mut r, "no_dx=1").contains("true or false"));
    assert!(Recipe::from_toml("densify_untl_iter = 3").unwrap_err().to_string().contains("densify_until_iter"));
    assert!(Recipe::from_toml("[densfy]\nfrom = 3").unwrap_err().to_string().contains("densfy"));
    assert!(Recipe::from_toml("[densify]\nform = 3").unwrap_err().to_string().contains("`densify.from`"));
    assert!(Recipe::from_toml("= 3").is_err());
    assert_eq!(r, Recipe::default(), "a refused setting changes nothing");
}

#[test]
fn resolve_sets_everything_and_every_setting_is_documented() {
    let r = Recipe::default().with(|r| r.run.iterations = 1000).resolve();
    assert_eq!((r.densify.from, r.densify.until, r.run.checkpoint_interval), (50, 750, 100));
    assert_eq!(r.resolve(), r);
    assert!(Recipe::settings().iter().all(|k| k.doc.len() > 8), "{:?}", Recipe::settings());
}

#[test]
fn choices_round_trip_and_wrong_ones_get_a_suggestion() {
    for setting in Recipe::settings() {
        for word in &setting.choices {
            let mut r = Recipe::default();
            r.set(&format!("{}={word}", setting.key())).unwrap();
            assert_eq!(r.get(&setting.key()).unwrap().as_str(), Some(*word), "{}", setting.key());
            assert_eq!(Recipe::from_toml(&r.to_toml()).unwrap(), r);
        }
        if let Some(first) = setting.choices.first() {
            let error = Recipe::of(&[&format!("{}={first}x", setting.key())]).unwrap_err().to_string();
            assert!(error.contains(&format!("did you mean `{first}`")), "{error}");
        }
    }
    assert_eq!(Recipe::settings().iter().filter(|k| !k.choices.is_empty()).count(), 21);
    for (set, back) in [("init=my/points.ply", "my/points.ply"), ("init=hull", "hull")] {
        assert_eq!(Recipe::of(&[set]).unwrap().get("init.source").unwrap().as_str(), Some(back));
    }
    for (set, back) in
        [("hold_out=camera=0, 10", "camera=0,10"), ("hold_out=every=8", "every=8"), ("hold_out=\"\"", "")]
    {
        assert_eq!(Recipe::of(&[set]).unwrap().get("capture.hold_out").unwrap().as_str(), Some(back));
    }
    for wrong in ["init=hul", "hold_out=eight", "floor_height=low", "filter=kalman", "motion=filtered"] {
        assert!(Recipe::of(&[wrong]).is_err(), "{wrong}");
    }
}

#[test]
fn conditions_name_settings_and_defaults_have_effect() {
    let recipe = Recipe::default();
    for (name, table) in recipe.tables() {
        let mut keys = table.when().keys();
        keys.extend(table.settings(name).iter().flat_map(|k| k.rule.when.keys()));
        for key in keys {
            assert!(recipe.get(key).is_some(), "[{name}] depends on {key}, which is no knob");
        }
    }
    for motion in <MotionName as crate::settings::Value>::choices() {
        let r = recipe.clone().with(|r| r.run.motion = MotionName::of(motion));
        assert_eq!(r.without_effect(), [], "{motion}");
        assert_eq!(r.resolve().without_effect(), [], "{motion}, resolved");
    }
}

#[test]
fn settings_without_effect_are_found_with_their_condition() {
    let idle = |sets: &[&str]| -> Vec<(String, bool, String)> {
        Recipe::of(sets).unwrap().without_effect().into_iter().map(|i| (i.key, i.off, i.needs)).collect()
    };
    let one = |key: &str, off, needs: &str| vec![(key.to_owned(), off, needs.to_owned())];
    assert_eq!(idle(&["opacity_reg=0"]), one("mcmc.opacity_reg", true, "densify.strategy=mcmc"));
    assert_eq!(idle(&["scale_reg=0.1"]), one("mcmc.scale_reg", false, "densify.strategy=mcmc"));
    assert_eq!(idle(&["scale_reg=0.1", "strategy=mcmc"]), []);
    assert_eq!(idle(&["filter_gain=0.3"]), one("filter.gain", false, "filter.fusion"));
    assert_eq!(idle(&["filter_gain=0.3", "filter=geodesic"]), []);
    assert_eq!(idle(&["filter_predictor=hold", "transport=linear"]), []);
    assert_eq!(idle(&["deform_rigid=true"]), one("deform.rigid", false, "run.motion=deform-mlp"));
    assert_eq!(idle(&["relocate_share=0.1"]), one("relocate.share", false, "relocate.interval"));
    assert_eq!(idle(&["relocate_gradient=0.1", "strategy=mcmc"]), []);
    assert_eq!(idle(&["growth=1.1"]), one("mcmc.growth", false, "densify.strategy=mcmc"));
    assert_eq!(idle(&["motion=control", "control_bases=4"]).len(), 1);
    assert_eq!(idle(&["motion=ssm", "control_nodes=40"]), []);
    assert_eq!(idle(&["motion=auto", "control_nodes=40", "motion_order=2"]), [], "the capture may choose either");
    assert_eq!(idle(&["motion=tracked", "life_width_lr=0.1"]).len(), 1, "nothing has a life");
    assert_eq!(idle(&["motion=tracked", "life_width_lr=0.1", "life=interval"]), []);
    assert_eq!(idle(&["motion=hexplane", "life_width_lr=0.1"]), [], "fixed cameras would give it one");
    assert_eq!(idle(&["motion=tracked", "floor=3", "floor_height=0"]), []);
}

#[test]
fn derived_settings_follow_a_new_length_and_chosen_ones_stay() {
    let saved = Recipe::of(&["densify_until_iter=777", "run.replans=[[5,90],[40,60]]"]).unwrap().resolve();
    let read = Recipe::from_toml(&saved.to_toml()).unwrap();
    assert_eq!(read, saved);
    assert_eq!(read.run.replans.rows(), [ScheduleChange { at: 5, total: 90 }, ScheduleChange { at: 40, total: 60 }]);
    let again = read.unresolved().with(|r| r.run.iterations = 3000).resolve();
    assert_eq!(again, Recipe::of(&["densify_until_iter=777", "iterations=3000"]).unwrap().resolve());
    for wrong in ["3", "[3]", "[[3]]", "[[3, 3]]", "[[3, 9], [3, 8]]", "[[3, 9], [2, 8]]", "[[-1, 9]]"] {
        let error = Recipe::of(&[&format!("run.replans={wrong}")]).unwrap_err().to_string();
        assert!(error.contains("[[700, 4200]]"), "{wrong}: {error}");
    }
}

#[test]
fn each_quality_costs_more_than_the_one_below() {
    let [draft, standard, best] = Quality::ALL.map(|q| Recipe::default().of_quality(q));
    assert_eq!(standard, Recipe::default());
    let takes = |r: &Recipe| (r.run.iterations, r.densify.max_cap);
    assert!(takes(&draft) < takes(&standard) && takes(&standard) < takes(&best));
    assert_eq!([&draft, &best].map(|r| r.capture.downscale), [2, 1]);
    // Of a recipe that a run saved, schedules are the quality's.
    let saved = Recipe::of(&["downscale=3"]).unwrap().resolve().of_quality(Quality::Draft);
    assert_eq!((saved.capture.downscale, saved.resolve().densify.until), (6, draft.run.iterations * 3 / 4));
    assert_eq!("best".parse::<Quality>().unwrap(), Quality::Best);
    assert!("bets".parse::<Quality>().unwrap_err().to_string().contains("draft, standard, best"));
}
