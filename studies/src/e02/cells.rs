//! The variants that are compared: what each sets in the recipe.

use splat4d::Result;
use splat4d_train::recipe::Recipe;

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Variant {
    /// In files.
    pub key: &'static str,
    /// For people.
    pub name: &'static str,
    settings: &'static [&'static str],
    /// Whether the quick study includes it.
    quick: bool,
}

const fn variant(key: &'static str, name: &'static str, settings: &'static [&'static str], quick: bool) -> Variant {
    Variant { key, name, settings, quick }
}

/// The first is what all are compared with.
const ALL: [Variant; 16] = [
    variant("alone", "the motion alone", &[], true),
    variant(
        "filter-euclidean",
        "filter, Euclidean predictor",
        &["filter=geodesic", "filter_predictor=euclidean"],
        false,
    ),
    variant("filter-hold", "filter, without log and exp", &["filter=geodesic", "filter_predictor=hold"], false),
    variant("filter", "filter, Wasserstein predictor", &["filter=geodesic"], true),
    variant("filter-literal", "filter, Kalman's formulas", &["filter=literal"], false),
    variant("kept", "filter, drawn with", &["filter=geodesic", "filter_keep=true"], true),
    variant("literal-kept", "filter, Kalman's formulas, drawn with", &["filter=literal", "filter_keep=true"], false),
    variant("retuned", "filter, off for the last quarter", &["filter=geodesic", "filter.until=0.75"], true),
    variant(
        "history",
        "filter through four frames, drawn with",
        &["filter=geodesic", "filter_keep=true", "filter_history=4"],
        false,
    ),
    variant(
        "history-learnt",
        "the same, gradients through time",
        &["filter=geodesic", "filter_keep=true", "filter_history=4", "filter_stop_gradient=false"],
        false,
    ),
    variant(
        "published",
        "filter, small motion and alignment, drawn with",
        &[
            "filter=geodesic",
            "filter_keep=true",
            "transport=wasserstein",
            "transport_second=0",
            "transport_temporal=0.1",
            "transport_align=0.1",
        ],
        false,
    ),
    variant("linear", "linear regulariser", &["transport=linear"], true),
    variant(
        "w2-hold",
        "W2 regulariser, without log and exp",
        &["transport=wasserstein", "filter_predictor=hold"],
        false,
    ),
    variant("w2", "W2 regulariser", &["transport=wasserstein"], true),
    variant(
        "both-euclidean",
        "both, Euclidean",
        &["filter=geodesic", "transport=linear", "filter_predictor=euclidean"],
        false,
    ),
    variant("both", "filter and W2 regulariser", &["filter=geodesic", "transport=wasserstein"], true),
];

/// All, or those of a glance.
pub(crate) fn variants(quick: bool) -> Vec<Variant> {
    ALL.into_iter().filter(|v| v.quick || !quick).collect()
}

impl Variant {
    /// The recipe with what the variant sets, and the seed.
    pub(crate) fn recipe(&self, base: &Recipe, seed: u64) -> Result<Recipe> {
        let off = ["filter=off", "transport=off", "filter_predictor=wasserstein"];
        let mut recipe = base.clone().with(|r| r.run.seed = seed);
        off.iter().chain(self.settings).try_for_each(|setting| recipe.set(setting))?;
        Ok(recipe)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_differ_only_in_their_settings() {
        use splat4d::motion::filtered::Fusion;
        let base = Recipe::default().with(|r| r.filter.fusion = Fusion::Literal);
        let all = variants(false);
        for (i, a) in all.iter().enumerate() {
            let recipe = a.recipe(&base, 3).unwrap();
            assert_eq!(recipe.run.seed, 3);
            assert!(all[..i].iter().all(|b| b.key != a.key && b.recipe(&base, 3).unwrap() != recipe), "{}", a.key);
        }
        let alone = all[0].recipe(&base, base.run.seed).unwrap();
        assert_eq!(alone, Recipe::default(), "what the base has of a filter does not count");
        assert!(variants(true).len() >= 5 && variants(true)[0] == all[0]);
    }
}
