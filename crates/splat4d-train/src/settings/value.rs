//! Types of settings, to and from TOML.

use super::nearest;

/// A type of value that a setting may hold.
pub(crate) trait Value: Sized {
    /// As TOML.
    fn to_toml(&self) -> toml::Value;
    /// Errors: what it must be, to follow "It must be".
    fn from_toml(value: &toml::Value) -> Result<Self, String>;
    /// The words that it may be, if it is one of a few.
    fn choices() -> Vec<&'static str> {
        Vec::new()
    }
    /// Its number, if it is one, for ranges.
    fn number(&self) -> Option<f64> {
        None
    }
}

impl Value for f64 {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Float(*self)
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        match value {
            toml::Value::Float(x) => Ok(*x),
            // Whole numbers are welcome where a fraction is expected.
            toml::Value::Integer(i) => Ok(*i as f64),
            _ => Err("a number (float)".into()),
        }
    }

    fn number(&self) -> Option<f64> {
        Some(*self)
    }
}

/// A whole number, also if it is written 3e3.
fn integer<T: TryFrom<i64>>(value: &toml::Value) -> Result<T, String> {
    let whole = match value {
        toml::Value::Integer(i) => Some(*i),
        toml::Value::Float(f) if f.fract() == 0.0 && f.abs() < 9e15 => Some(*f as i64),
        _ => None,
    };
    whole.and_then(|i| T::try_from(i).ok()).ok_or_else(|| "zero or a positive integer".into())
}

impl Value for usize {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Integer(i64::try_from(*self).expect("whole numbers of TOML end at 2^63"))
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        integer(value)
    }

    fn number(&self) -> Option<f64> {
        Some(*self as f64)
    }
}

impl Value for u64 {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Integer(i64::try_from(*self).expect("whole numbers of TOML end at 2^63"))
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        integer(value)
    }
}

impl Value for bool {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Boolean(*self)
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        value.as_bool().ok_or_else(|| "true or false (boolean)".into())
    }
}

impl Value for Vec<usize> {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Array(self.iter().map(Value::to_toml).collect())
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        let list = value.as_array().ok_or("a list of integers, such as [1, 2]")?;
        list.iter().map(integer).collect()
    }
}

/// A value named by one of a few words.
pub(crate) trait Choice: Copy + PartialEq + 'static {
    /// Every value with its word, in the order of help.
    const NAMES: &'static [(&'static str, Self)];

    /// Its word.
    fn word(self) -> &'static str {
        Self::NAMES.iter().find(|(_, value)| *value == self).map_or("", |(word, _)| word)
    }
}

impl<T: Choice> Value for T {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.word().to_owned())
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        let found = value.as_str().and_then(|word| T::NAMES.iter().find(|(name, _)| *name == word));
        found.map(|(_, value)| *value).ok_or_else(|| among(value, &T::choices()))
    }

    fn choices() -> Vec<&'static str> {
        T::NAMES.iter().map(|(word, _)| *word).collect()
    }
}

/// The permitted words, to follow "It must be": one of these, and the nearest.
pub(crate) fn among(value: &toml::Value, known: &[&str]) -> String {
    let near = value.as_str().and_then(|word| nearest(word, known));
    format!("one of {}{}", known.join(", "), near.map(|n| format!("; did you mean `{n}`?")).unwrap_or_default())
}

/// Empty: none.
impl Value for Option<f64> {
    fn to_toml(&self) -> toml::Value {
        toml::Value::String(self.map_or_else(String::new, |x| x.to_string()))
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        match value {
            toml::Value::String(s) if s.is_empty() => Ok(None),
            toml::Value::String(s) => s.parse().map(Some).map_err(|_| "a number, or nothing".into()),
            other => f64::from_toml(other).map(Some),
        }
    }

    fn number(&self) -> Option<f64> {
        *self
    }
}
