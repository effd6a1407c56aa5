//! Recipes as text: TOML files, `--set key=value`, and the text that a run's fingerprint hashes.

use super::Recipe;
use super::flat::FLAT;
use crate::settings::{Setting, When, is_off, nearest};
use crate::{Error, Result};

impl Recipe {
    /// Reads TOML: tables, or names without a table. Errors: syntax, an unknown key (with the nearest known one), a
    /// wrong type or range.
    pub fn from_toml(text: &str) -> Result<Self> {
        let file: toml::Table = toml::from_str(text).map_err(|e| {
            let before = e.span().and_then(|span| text.as_bytes().get(..span.start)).unwrap_or_default();
            let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
            Error::input(format!("the recipe is not valid TOML in line {line}: {}", e.message()))
                .remedy("Write lines such as `iterations = 3000`; `splat4d train --help-knobs` lists the settings")
        })?;
        let mut recipe = Self::default();
        for (key, value) in &file {
            match value {
                // `life` is a table now and was a setting before.
                toml::Value::Table(table) if recipe.table_mut(key).is_some() => {
                    table.iter().try_for_each(|(field, value)| recipe.put(&recipe.inside(key, field), value))?;
                }
                _ => recipe.put(key, value)?,
            }
        }
        Ok(recipe)
    }

    /// As TOML; reading it back gives the same recipe.
    pub fn to_toml(&self) -> String {
        let mut text = String::new();
        for (name, table) in self.tables() {
            if !text.is_empty() {
                text.push('\n');
            }
            text += &format!("[{name}]\n");
            for setting in table.settings(name) {
                text += &line(setting.field, &table.get(setting.field).expect("a setting has a value"));
            }
        }
        text
    }

    /// The default recipe, changed by these `key=value`s.
    #[cfg(test)]
    pub(crate) fn of(assignments: &[&str]) -> Result<Self> {
        let mut recipe = Self::default();
        assignments.iter().try_for_each(|a| recipe.set(a))?;
        Ok(recipe)
    }

    /// Applies one `key=value`, as `--set` takes it. Strings need no quotes. Errors do not change the recipe.
    pub fn set(&mut self, assignment: &str) -> Result<()> {
        let (key, text) = assignment.split_once('=').ok_or_else(|| {
            Error::input(format!("`{assignment}` is not of the form key=value"))
                .remedy("For instance --set iterations=300")
        })?;
        let text = text.trim();
        let value = toml::from_str::<toml::Table>(&format!("v = {text}"))
            .ok()
            .and_then(|mut t| t.remove("v"))
            .unwrap_or_else(|| toml::Value::String(text.to_owned()));
        self.put(key.trim(), &value)
    }

    /// Every setting, table by table.
    pub fn settings() -> Vec<Setting> {
        Self::default().tables().into_iter().flat_map(|(name, table)| table.settings(name)).collect()
    }

    /// The subject of a table.
    pub fn about(table: &str) -> &'static str {
        Self::default().tables().into_iter().find(|(name, _)| *name == table).map_or("", |(_, t)| t.about())
    }

    /// The condition under which a table's settings have an effect; `None`: always.
    pub fn needs(table: &str) -> Option<String> {
        let when = Self::default().tables().into_iter().find(|(name, _)| *name == table)?.1.when();
        (when != When::Always).then(|| when.to_string())
    }

    /// The name that the setting `table.field` has without its table, if recipes knew it before they had tables.
    pub fn flat_name(key: &str) -> Option<&'static str> {
        FLAT.iter().find(|(_, k)| *k == key).map(|(flat, _)| *flat)
    }

    /// The value of the setting `table.field`.
    pub fn get(&self, key: &str) -> Option<toml::Value> {
        let (name, field) = key.split_once('.')?;
        self.tables().into_iter().find(|(n, _)| *n == name)?.1.get(field)
    }

    /// Settings that were chosen, with their values: neither at their default nor as they follow from others.
    pub fn choices(&self) -> Vec<(String, toml::Value)> {
        let defaults = Self::default();
        let follows = Self::default().with(|r| r.run.iterations = self.run.iterations).resolve();
        let mut out = Vec::new();
        for key in Self::settings().iter().map(Setting::key) {
            let value = self.get(&key).expect("it is a setting");
            let follows = key != "run.iterations" && follows.get(&key).as_ref() == Some(&value);
            if defaults.get(&key).as_ref() != Some(&value) && !follows {
                out.push((key, value));
            }
        }
        out
    }

    /// Settings that were chosen and do nothing in this recipe.
    pub(crate) fn without_effect(&self) -> Vec<UnusedSetting> {
        let get = |key: &str| self.get(key).expect("conditions name settings");
        let chosen: Vec<String> = self.choices().into_iter().map(|(key, _)| key).collect();
        let mut out = Vec::new();
        for (name, table) in self.tables() {
            for setting in table.settings(name).iter().filter(|setting| chosen.contains(&setting.key())) {
                let both = [if setting.rule.switch { When::Always } else { table.when() }, setting.rule.when];
                let missing: Vec<String> =
                    both.into_iter().filter(|when| !when.holds(&get)).map(|when| when.to_string()).collect();
                if !missing.is_empty() {
                    let (key, off) = (setting.key(), is_off(&get(&setting.key())));
                    out.push(UnusedSetting { key, off, needs: missing.join(" and ") });
                }
            }
        }
        out
    }

    /// Errors: one of these settings, by either of its names, does nothing in this recipe. Where it states that
    /// something is not
    /// to be, training warns.
    pub fn refuse_unused<'a>(&self, set: impl Iterator<Item = &'a str>) -> Result<()> {
        let set: Vec<&str> = set.map(|name| Self::key_of(name.trim())).collect();
        match self.without_effect().into_iter().find(|idle| !idle.off && set.contains(&idle.key.as_str())) {
            Some(idle) => Err(Error::input(idle.to_string()).remedy("Set what it needs as well, or leave it out")),
            None => Ok(()),
        }
    }

    /// The key of a setting by either of its names, `table.field` or without a table.
    pub fn key_of(name: &str) -> &str {
        FLAT.iter().find(|(flat, _)| *flat == name).map_or(name, |(_, key)| key)
    }

    /// Ranges. Errors name the setting.
    pub fn check(&self) -> Result<()> {
        for (name, table) in self.tables() {
            table.check().map_err(|(field, need)| {
                let key = format!("{name}.{field}");
                let value = table.get(field).expect("a setting has a value");
                wrong(&key, &value, &need)
            })?;
        }
        Ok(())
    }

    /// The recipe in the names and the order that it had before it had tables, byte for byte: the identity that
    /// checkpoints store so that old runs continue. Settings that came later count where they are not at their default.
    pub fn flat_toml(&self) -> String {
        let mut text: String =
            FLAT.iter().map(|(flat, key)| line(flat, &self.get(key).expect("FLAT names settings"))).collect();
        let defaults = Self::default();
        for key in Self::settings().iter().map(Setting::key).filter(|key| FLAT.iter().all(|(_, k)| k != key)) {
            if self.get(&key) != defaults.get(&key) {
                text += &line(&format!("\"{key}\""), &self.get(&key).expect("it is a setting"));
            }
        }
        text
    }

    /// The key of what is in a table: its field, or a setting of it by its name without a table.
    fn inside(&self, table: &str, field: &str) -> String {
        let home = FLAT.iter().find(|(flat, key)| *flat == field && key.split('.').next() == Some(table));
        let key = format!("{table}.{field}");
        match home {
            Some((_, home)) if self.get(&key).is_none() => (*home).to_owned(),
            _ => key,
        }
    }

    /// Sets the setting `table.field`, or one by its name without a table.
    fn put(&mut self, name: &str, value: &toml::Value) -> Result<()> {
        let key = Self::key_of(name);
        if self.get(key).is_none() {
            return Err(unknown(name));
        }
        let (table, field) = key.split_once('.').expect("it was looked up");
        let table = self.table_mut(table).expect("it was looked up");
        table.put(field, value).map_err(|need| wrong(name, value, &need))
    }
}

/// A setting that was chosen and has no effect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct UnusedSetting {
    /// `table.field`.
    pub key: String,
    /// Whether it states that something is not to be, which it is not anyhow.
    pub off: bool,
    /// The condition that is not met.
    pub needs: String,
}

impl std::fmt::Display for UnusedSetting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "`{}` has no effect in this recipe: it needs {}", self.key, self.needs)
    }
}

fn line(key: &str, value: &toml::Value) -> String {
    let mut table = toml::Table::new();
    table.insert("v".into(), value.clone());
    let text = toml::to_string(&table).expect("settings are plain numbers, flags and strings");
    format!("{key}{}", &text[1..])
}

fn wrong(name: &str, value: &toml::Value, need: &str) -> Error {
    Error::input(format!("setting `{name}` cannot be {value}")).remedy(format!("It must be {need}"))
}

fn unknown(name: &str) -> Error {
    let keys: Vec<String> = Recipe::settings().iter().map(Setting::key).collect();
    let known: Vec<&str> = FLAT.iter().map(|(flat, _)| *flat).chain(keys.iter().map(String::as_str)).collect();
    let near = nearest(name, &known);
    Error::input(format!("unknown setting `{name}`"))
        .remedy(near.map_or("`splat4d train --help-knobs` lists them".into(), |n| format!("Did you mean `{n}`?")))
}
