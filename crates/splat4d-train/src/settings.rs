//! Settings: typed settings, each declared once and next to what it sets.
//!
//! `settings!` makes a struct of one table of the recipe, and from the same lines its
//! defaults, documentation, ranges and units; [`Recipe`](crate::recipe::Recipe) puts the tables together.

mod value;
mod when;

pub(crate) use value::{Choice, Value, among};
pub use when::When;
pub(crate) use when::is_off;

/// One setting, for help, documents and checks.
#[derive(Clone, Debug)]
pub struct Setting {
    /// The table that it is in.
    pub table: &'static str,
    /// Its name in that table.
    pub field: &'static str,
    /// Its default, as TOML.
    pub default: String,
    /// Its effect.
    pub doc: String,
    /// The permitted values and their unit.
    pub rule: Rule,
    /// The words that it may be; none: it is not a word.
    pub choices: Vec<&'static str>,
}

impl Setting {
    /// `table.field`.
    pub fn key(&self) -> String {
        format!("{}.{}", self.table, self.field)
    }
}

/// The numbers that a setting may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Range {
    /// Zero or above: the rule, for few settings mean anything below zero.
    NotNegative,
    /// Any finite number.
    Finite,
    /// Above zero.
    Positive,
    /// From 0 to 1.
    Share,
    /// Above 0 and below 1.
    InsideShare,
    /// From 0 to below 1.
    BelowOne,
    /// Whole numbers from here on.
    AtLeast(usize),
    /// Whole numbers from the first to the second.
    Within(usize, usize),
}

impl Range {
    /// Whether a number is in it.
    pub(crate) fn holds(self, x: f64) -> bool {
        x.is_finite()
            && match self {
                Self::NotNegative => x >= 0.0,
                Self::Finite => true,
                Self::Positive => x > 0.0,
                Self::Share => (0.0..=1.0).contains(&x),
                Self::InsideShare => x > 0.0 && x < 1.0,
                Self::BelowOne => (0.0..1.0).contains(&x),
                Self::AtLeast(low) => x >= low as f64,
                Self::Within(low, high) => x >= low as f64 && x <= high as f64,
            }
    }
}

impl std::fmt::Display for Range {
    /// Follows "It must be".
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotNegative => write!(f, "zero or a positive number"),
            Self::Finite => write!(f, "a finite number"),
            Self::Positive => write!(f, "a positive number"),
            Self::Share => write!(f, "between 0 and 1"),
            Self::InsideShare => write!(f, "above 0 and below 1"),
            Self::BelowOne => write!(f, "from 0 to below 1"),
            Self::AtLeast(low) => write!(f, "at least {low}"),
            Self::Within(low, high) => write!(f, "{low} to {high}"),
        }
    }
}

/// The permitted values of a setting, its unit, and when it has an effect.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    /// Numbers that it takes.
    pub range: Range,
    /// Unit of its number; empty: none.
    pub unit: &'static str,
    /// When it has an effect, next to its table's condition.
    pub when: When,
    /// Whether its table's condition does not count: it is what switches the table on.
    pub switch: bool,
}

impl Rule {
    const fn of(range: Range) -> Self {
        Self { range, unit: "", when: When::Always, switch: false }
    }

    /// With an effect only then.
    pub const fn when(mut self, when: When) -> Self {
        self.when = when;
        self
    }

    /// Whatever its table's condition states.
    pub(crate) const fn switch(mut self) -> Self {
        self.switch = true;
        self
    }

    /// With this unit.
    pub(crate) const fn unit(mut self, unit: &'static str) -> Self {
        self.unit = unit;
        self
    }
}

/// Zero or above, or no number.
pub(crate) const fn any() -> Rule {
    Rule::of(Range::NotNegative)
}

/// Any finite number.
pub(crate) const fn finite() -> Rule {
    Rule::of(Range::Finite)
}

/// Above zero.
pub(crate) const fn positive() -> Rule {
    Rule::of(Range::Positive)
}

/// From 0 to 1.
pub(crate) const fn share() -> Rule {
    Rule::of(Range::Share)
}

/// Above 0 and below 1.
pub(crate) const fn inside_share() -> Rule {
    Rule::of(Range::InsideShare)
}

/// From 0 to below 1.
pub(crate) const fn below_one() -> Rule {
    Rule::of(Range::BelowOne)
}

/// From `low` on.
pub(crate) const fn at_least(low: usize) -> Rule {
    Rule::of(Range::AtLeast(low))
}

/// From `low` to `high`.
pub(crate) const fn within(low: usize, high: usize) -> Rule {
    Rule::of(Range::Within(low, high))
}

/// One table of settings; `settings!` writes it.
pub(crate) trait Table {
    /// Its subject, in a sentence.
    fn about(&self) -> &'static str;
    /// When its settings have an effect.
    fn when(&self) -> When;
    /// Its settings, in order. `table`: the name that the recipe gives it.
    fn settings(&self, table: &'static str) -> Vec<Setting>;
    /// The value of a setting; `None`: it has no such setting.
    fn get(&self, field: &str) -> Option<toml::Value>;
    /// Sets a setting. Errors: what its value must be, to follow "It must be"; an unknown name is our bug.
    fn put(&mut self, field: &str, value: &toml::Value) -> Result<(), String>;
    /// Whether every number is in its range. Errors: the field, and what it must be.
    fn check(&self) -> Result<(), (&'static str, String)>;
}

/// Reads a value and holds it against its rule.
pub(crate) fn read<T: Value>(value: &toml::Value, rule: Rule) -> Result<T, String> {
    let read = T::from_toml(value)?;
    hold(&read, rule)?;
    Ok(read)
}

/// Errors: a number out of its range.
pub(crate) fn hold<T: Value>(value: &T, rule: Rule) -> Result<(), String> {
    match value.number() {
        Some(x) if !rule.range.holds(x) => Err(rule.range.to_string()),
        _ => Ok(()),
    }
}

/// Declares a table of settings: `field: type = default;`, or `field: type = default => rule;` where it has a range of
/// its own, a unit or a condition. `when (…)` behind the table's name is a condition on all that has no `switch()`.
macro_rules! settings {
    (
        $(#[doc = $about:literal])*
        $(#[derive($derived:ident)])?
        pub struct $name:ident $(when ($when:expr))? {
            $($(#[doc = $doc:literal])* $field:ident : $t:ty = $default:expr $(=> $rule:expr)?;)*
        }
    ) => {
        $(#[doc = $about])*
        #[derive(Clone, Debug, PartialEq)]
        $(#[derive($derived)])?
        pub struct $name {
            $($(#[doc = $doc])* pub $field: $t,)*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }

        impl $crate::settings::Table for $name {
            fn about(&self) -> &'static str {
                concat!($($about),*).trim()
            }

            fn when(&self) -> $crate::settings::When {
                $crate::settings::settings!(@when $($when)?)
            }

            fn settings(&self, table: &'static str) -> Vec<$crate::settings::Setting> {
                vec![$($crate::settings::Setting {
                    table,
                    field: stringify!($field),
                    default: $crate::settings::Value::to_toml(&Self::default().$field).to_string(),
                    doc: [$($doc),*].concat().trim().to_owned(),
                    rule: $crate::settings::settings!(@rule $($rule)?),
                    choices: <$t as $crate::settings::Value>::choices(),
                }),*]
            }

            fn get(&self, field: &str) -> Option<toml::Value> {
                match field {
                    $(stringify!($field) => Some($crate::settings::Value::to_toml(&self.$field)),)*
                    _ => None,
                }
            }

            fn put(&mut self, field: &str, value: &toml::Value) -> Result<(), String> {
                match field {
                    $(stringify!($field) => {
                        self.$field = $crate::settings::read(value, $crate::settings::settings!(@rule $($rule)?))?;
                    })*
                    other => unreachable!("{} has no setting `{other}`: it was looked up", stringify!($name)),
                }
                Ok(())
            }

            fn check(&self) -> Result<(), (&'static str, String)> {
                $($crate::settings::hold(&self.$field, $crate::settings::settings!(@rule $($rule)?))
                    .map_err(|need| (stringify!($field), need))?;)*
                Ok(())
            }
        }
    };
    (@rule) => { $crate::settings::any() };
    (@rule $rule:expr) => {{
        #[allow(unused_imports)]
        use $crate::settings::When::{All, Any, Is, IsNot, On};
        #[allow(unused_imports)]
        use $crate::settings::{any, at_least, below_one, finite, inside_share, positive, share, within};
        const RULE: $crate::settings::Rule = $rule;
        RULE
    }};
    (@when) => { $crate::settings::When::Always };
    (@when $when:expr) => {{
        #[allow(unused_imports)]
        use $crate::settings::When::{All, Any, Is, IsNot, On};
        $when
    }};
}
pub(crate) use settings;

/// Declares what a setting may be called: `Variant = "name",`.
macro_rules! choices {
    ($(#[$meta:meta])* pub enum $name:ident { $($(#[doc = $doc:literal])* $variant:ident = $word:literal,)* }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {
            $($(#[doc = $doc])* $variant,)*
        }

        impl $crate::settings::Choice for $name {
            const NAMES: &'static [(&'static str, Self)] = &[$(($word, Self::$variant)),*];
        }
    };
}
pub(crate) use choices;

/// The known name closest to `name` (Damerau-free Levenshtein), if it is close enough to be meant.
pub fn nearest<'a>(name: &str, known: &[&'a str]) -> Option<&'a str> {
    let distance = |a: &str, b: &str| {
        let b: Vec<char> = b.chars().collect();
        let mut row: Vec<usize> = (0..=b.len()).collect();
        for (i, ca) in a.chars().enumerate() {
            let mut diagonal = row[0];
            row[0] = i + 1;
            for (j, cb) in b.iter().enumerate() {
                let next = (diagonal + usize::from(ca != *cb)).min(row[j] + 1).min(row[j + 1] + 1);
                diagonal = std::mem::replace(&mut row[j + 1], next);
            }
        }
        row[b.len()]
    };
    let best = known.iter().map(|k| (distance(&name.to_lowercase(), k), *k)).min()?;
    (best.0 <= 2.max(name.len() / 3)).then_some(best.1)
}
