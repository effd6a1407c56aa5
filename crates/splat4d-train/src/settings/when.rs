//! When a setting has an effect, as data, so that checks, help and documents agree.

/// A condition on other settings, which are named `table.field`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum When {
    /// In every recipe.
    Always,
    /// The setting is one of these words.
    Is(&'static str, &'static [&'static str]),
    /// The setting is none of these words.
    IsNot(&'static str, &'static [&'static str]),
    /// The setting is on: see `is_off`.
    On(&'static str),
    /// All of these.
    All(&'static [Self]),
    /// One of these.
    Any(&'static [Self]),
}

impl When {
    /// Whether it holds; `get` looks a setting up.
    pub(crate) fn holds(self, get: &dyn Fn(&str) -> toml::Value) -> bool {
        match self {
            Self::Always => true,
            Self::Is(key, words) => get(key).as_str().is_some_and(|word| words.contains(&word) || is_open(key, word)),
            Self::IsNot(key, words) => !get(key).as_str().is_some_and(|word| words.contains(&word)),
            Self::On(key) => !is_off(&get(key)),
            Self::All(all) => all.iter().all(|when| when.holds(get)),
            Self::Any(any) => any.iter().any(|when| when.holds(get)),
        }
    }

    /// Every setting that it reads.
    #[cfg(test)]
    pub(crate) fn keys(self) -> Vec<&'static str> {
        match self {
            Self::Always => Vec::new(),
            Self::Is(key, _) | Self::IsNot(key, _) | Self::On(key) => vec![key],
            Self::All(parts) | Self::Any(parts) => parts.iter().flat_map(|when| when.keys()).collect(),
        }
    }
}

/// Whether a word may yet become any: the capture has not chosen the motion model.
fn is_open(key: &str, word: &str) -> bool {
    (key, word) == ("run.motion", "auto")
}

/// Whether a value disables something: 0, false, nothing, `none` or `off`.
pub(crate) fn is_off(value: &toml::Value) -> bool {
    match value {
        toml::Value::Boolean(on) => !on,
        toml::Value::Integer(i) => *i == 0,
        toml::Value::Float(x) => *x == 0.0,
        toml::Value::String(s) => ["", "none", "off"].contains(&s.as_str()),
        _ => false,
    }
}

impl std::fmt::Display for When {
    /// Follows "it needs".
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let joined = |parts: &[Self], by: &str| parts.iter().map(Self::to_string).collect::<Vec<_>>().join(by);
        match self {
            Self::Always => write!(f, "nothing"),
            Self::Is(key, words) => write!(f, "{key}={}", words.join("|")),
            Self::IsNot(key, words) => write!(f, "{key} other than {}", words.join("|")),
            Self::On(key) => write!(f, "{key}"),
            Self::All(parts) => f.write_str(&joined(parts, " and ")),
            Self::Any(parts) => f.write_str(&joined(parts, " or ")),
        }
    }
}
