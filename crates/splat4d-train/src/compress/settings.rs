//! Settings of compression, and the three levels.

use crate::maintenance::importance::{Combine, Spatial, Temporal};
use crate::settings::nearest;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use splat4d::format::playback::{Depths, MAX_PALETTE, WriteConfig};

/// Largest share that may be pruned: beyond it fine-tuning cannot recover the scene.
pub const MOST_PRUNED: f64 = 0.98;
/// Most rounds of pruning.
const MOST_ROUNDS: usize = 20;

/// Largest share that is pruned in one round, and the rounds for more. The bundled scene at 80 %: one round 29.41 dB, four 31.18, eight 31.28
/// (studies/records/2026-11-27-rounds.md).
const ONE_ROUND: f64 = 0.25;
/// See [`ONE_ROUND`].
const ROUNDS: usize = 4;

macro_rules! settings {
    ($($(#[$doc:meta])* $name:ident: $type:ty = $default:expr),* $(,)?) => {
        /// All settings of compression.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Compression {
            $($(#[$doc])* pub $name: $type,)*
        }

        impl Default for Compression {
            /// [`Level::Tuned`](Level): nothing is pruned, codes are full, all is fine-tuned.
            fn default() -> Self {
                Self { $($name: $default,)* }
            }
        }

        /// Names of all settings.
        const NAMES: &[&str] = &[$(stringify!($name)),*];
    };
}

settings! {
    /// Share of the Gaussians to remove, 0 to 0.98.
    prune: f64 = 0.0,
    /// Rounds of pruning, each followed by its part of the fine-tuning; 0: 4 if more than a quarter is pruned, else 1.
    rounds: usize = 0,
    /// Score of a view: share of the image, change by removal, both, opacity, light-gaussian, pup or speedy.
    spatial: String = "change".into(),
    /// Temporal score: instant-abs, literal-signed-clamped, first-derivative, width, active-fraction, none.
    temporal: String = "instant-abs".into(),
    /// Combination of spatial and temporal score: product, sum or temporal-alone.
    combine: String = "product".into(),
    /// Whether large Gaussians have a slightly higher score.
    volume: bool = false,
    /// Exponent of the mean share that a Gaussian has of the pixels it touches: above 0, costly Gaussians are removed
    /// first.
    cost: f64 = 0.0,
    /// Every how many training views scores use.
    every: usize = 1,
    /// Total steps of fine-tuning in floats after pruning.
    fine_tune: usize = 0,
    /// Share of the training's rates at which fine-tuning starts; 0: 0.3 if up to a half is pruned, 1 from four fifths
    /// on.
    rates: f64 = 0.0,
    /// Weight of the mean opacity during fine-tuning: Gaussians that no view needs fade and do not veil novel views.
    opacity_reg: f64 = 0.01,
    /// Whether the scene is quantised; false only for studies of the other parts.
    codec: bool = true,
    /// Steps of fine-tuning through the quantised scene.
    quantise: usize = 0,
    /// Frames between the key times of the visibility masks; 0: no masks.
    mask_interval: usize = 0,
    /// Highest degree of the spherical harmonics to keep.
    sh_degree: usize = 3,
    /// Largest number of palette entries.
    palette: usize = WriteConfig::default().palette,
    /// Bits of the codes.
    depths: Depths = Depths::default(),
}

/// The levels that `--level` names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// The plain playback file: quantised, not tuned.
    Plain,
    /// Quantised and fine-tuned so.
    Tuned,
    /// Pruned, filtered, with coarser codes and a smaller palette, and fine-tuned.
    Pruned,
}

impl Level {
    /// The level behind 0, 1, 2. Errors: another number.
    pub fn new(level: u8) -> Result<Self> {
        match level {
            0 => Ok(Self::Plain),
            1 => Ok(Self::Tuned),
            2 => Ok(Self::Pruned),
            _ => Err(Error::input(format!("there is no level {level}")).remedy("Give 0, 1 or 2.")),
        }
    }
}

impl Compression {
    /// A level's settings for a scene that was trained for `iterations` steps.
    pub fn level(level: Level, iterations: usize) -> Self {
        let share = |part: f64| ((iterations as f64 * part) as usize).max(1);
        let tuned = Self { quantise: share(TUNED_SHARE), ..Self::default() };
        match level {
            Level::Plain => Self::default(),
            Level::Tuned => tuned,
            Level::Pruned => Self {
                prune: PRUNED_SHARE,
                fine_tune: share(FINE_TUNED_SHARE),
                mask_interval: MASK_INTERVAL,
                palette: SMALL_PALETTE,
                depths: COARSE,
                ..tuned
            },
        }
    }

    /// Steps of all stages.
    pub fn steps(&self) -> usize {
        self.fine_tune + if self.codec { self.quantise } else { 0 }
    }

    /// The share of the training's rates at which fine-tuning begins. The more is pruned, the further the remaining
    /// Gaussians have to move; if little is pruned, high rates only let unseen Gaussians drift (docs/benchmarks.md,
    /// "Compression").
    pub(crate) fn first_rates(&self) -> f64 {
        if self.rates > 0.0 {
            return self.rates;
        }
        let [(least, low), (most, high)] = RATES_BY_PRUNING;
        let t = ((self.prune - least) / (most - least)).clamp(0.0, 1.0);
        low * f64::powf(high / low, t)
    }

    /// The number of rounds. Scores of Gaussians change once others are removed.
    pub(crate) fn pruning_rounds(&self) -> usize {
        match self.rounds {
            0 if self.prune > ONE_ROUND => ROUNDS,
            0 => 1,
            rounds => rounds,
        }
    }

    /// Reads TOML. Errors: syntax, unknown names (with the nearest known one), ranges.
    pub(crate) fn from_toml(text: &str) -> Result<Self> {
        let table: toml::Table = toml::from_str(text)
            .map_err(|e| Error::input(format!("the settings are not valid TOML: {}", e.message())))?;
        if let Some(key) = table.keys().find(|k| !NAMES.contains(&k.as_str())) {
            return Err(unknown(key));
        }
        let all: Self = table
            .try_into()
            .map_err(|e: toml::de::Error| Error::input(format!("a setting has a wrong value: {}", e.message())))?;
        all.check()?;
        Ok(all)
    }

    /// As TOML; reading it back gives the same settings.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("settings are plain numbers, flags and strings")
    }

    /// Applies one `key=value`. Errors: as `from_toml`.
    pub fn set(&mut self, assignment: &str) -> Result<()> {
        let Some((key, text)) = assignment.split_once('=') else {
            return Err(Error::input(format!("`{assignment}` is not of the form key=value"))
                .remedy("For instance --set mask_interval=10"));
        };
        let (key, text) = (key.trim(), text.trim());
        let value = toml::from_str::<toml::Table>(&format!("v = {text}"))
            .ok()
            .and_then(|mut t| t.remove("v"))
            .unwrap_or_else(|| toml::Value::String(text.to_owned()));
        let mut table = toml::Table::try_from(&*self).expect("settings are a TOML table");
        // Whole numbers are welcome where a fraction is expected.
        let value = match (table.get(key), value) {
            (Some(toml::Value::Float(_)), toml::Value::Integer(i)) => toml::Value::Float(i as f64),
            (_, v) => v,
        };
        match key.split_once('.') {
            Some((group, name)) => {
                let inner = table.get_mut(group).and_then(toml::Value::as_table_mut);
                let inner = inner.filter(|t| t.contains_key(name)).ok_or_else(|| unknown(key))?;
                inner.insert(name.to_owned(), value);
            }
            None => {
                table.insert(key.to_owned(), value);
            }
        }
        *self = Self::from_toml(&table.to_string())?;
        Ok(())
    }

    /// Ranges. Errors name the setting.
    pub fn check(&self) -> Result<()> {
        let bad = |name: &str, value: String, need: &str| {
            Err(Error::input(format!("setting `{name}` cannot be {value}")).remedy(format!("It must be {need}.")))
        };
        if !(0.0..=MOST_PRUNED).contains(&self.prune) {
            return bad("prune", self.prune.to_string(), &format!("a share between 0 and {MOST_PRUNED}"));
        }
        if self.rounds > MOST_ROUNDS {
            return bad("rounds", self.rounds.to_string(), &format!("0 to {MOST_ROUNDS}"));
        }
        if self.every == 0 {
            return bad("every", "0".into(), "at least 1");
        }
        if self.sh_degree > 3 {
            return bad("sh_degree", self.sh_degree.to_string(), "0, 1, 2 or 3");
        }
        if !(1..=MAX_PALETTE).contains(&self.palette) {
            return bad("palette", self.palette.to_string(), &format!("1 to {MAX_PALETTE}"));
        }
        if !(0.0..=10.0).contains(&self.cost) {
            return bad("cost", self.cost.to_string(), "between 0 and 10");
        }
        if !(0.0..=10.0).contains(&self.rates) {
            return bad("rates", self.rates.to_string(), "between 0 and 10");
        }
        if !(0.0..=10.0).contains(&self.opacity_reg) {
            return bad("opacity_reg", self.opacity_reg.to_string(), "between 0 and 10");
        }
        self.depths.check()?;
        self.spatial.parse::<Spatial>()?;
        self.temporal.parse::<Temporal>()?;
        self.combine.parse::<Combine>()?;
        Ok(())
    }
}

fn unknown(key: &str) -> Error {
    let hint = nearest(key, NAMES).map_or(String::new(), |n| format!("Did you mean `{n}`? "));
    Error::input(format!("`{key}` is not a setting of compression"))
        .remedy(format!("{hint}They are: {}.", NAMES.join(", ")))
}

/// Share that is pruned, and share of the training's rates that suited it; between them log-linear (measured).
const RATES_BY_PRUNING: [(f64, f64); 2] = [(0.5, 0.3), (0.8, 1.0)];
/// Share of a scene's training steps that fine-tuning through the quantised scene takes.
const TUNED_SHARE: f64 = 0.15;
/// Level 2: share of the training steps that fine-tuning in floats takes.
const FINE_TUNED_SHARE: f64 = 0.25;
/// Level 2: share of the Gaussians to prune.
const PRUNED_SHARE: f64 = 0.5;
/// Frames between key times (4DGS-1K, N3V).
const MASK_INTERVAL: usize = 20;
/// Level 2: bits of the codes.
const COARSE: Depths =
    Depths { position: 12, center: 10, scale: 6, opacity: 6, rotation: 7, shift: 7, turn: 7, color: 6, life: 6 };
/// Level 2: entries of the palette.
const SMALL_PALETTE: usize = 2048;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_round_trip_and_mistakes_are_named() {
        for level in [Level::Plain, Level::Tuned, Level::Pruned] {
            let all = Compression::level(level, 7000);
            all.check().unwrap();
            assert_eq!(Compression::from_toml(&all.to_toml()).unwrap(), all);
        }
        let mut c = Compression::default();
        c.set("prune=0.5").unwrap();
        c.set("temporal = width").unwrap();
        c.set("rounds=2").unwrap();
        c.set("depths.color=5").unwrap();
        assert_eq!((c.prune, c.temporal.as_str(), c.rounds, c.depths.color), (0.5, "width", 2, 5));
        let mut wrong = |s: &str| c.set(s).unwrap_err().to_string();
        assert!(wrong("prun=0.5").contains("`prune`"));
        assert!(wrong("prune=1.5").contains("0.98"));
        assert!(wrong("prune=much").contains("prune") || wrong("prune=much").contains("wrong value"));
        assert!(wrong("temporal=now").contains("now"));
        assert!(wrong("rounds=21").contains("0 to"));
        assert!(wrong("palette").contains("key=value"));
        assert!(wrong("depths.colour=5").contains("depths.colour"));
        assert!(wrong("depths.color=9").contains("color"));
        assert_eq!(c.prune, 0.5, "a refused setting changes nothing");
        assert!(Level::new(3).is_err());
        let rates = |prune| Compression { prune, ..Compression::default() }.first_rates();
        assert_eq!((rates(0.0), rates(0.5), rates(0.9)), (0.3, 0.3, 1.0));
        assert!((rates(0.65) - 0.3f64.sqrt()).abs() < 1e-12);
        assert_eq!(Compression { rates: 2.0, ..Compression::default() }.first_rates(), 2.0);
    }
}
