//! A JSON Schema of recipes, from the same table of settings as the reference and the checks: editors complete and
//! check recipes with it.

use serde_json::{Map, Value, json};
use splat4d_train::recipe::Recipe;
use splat4d_train::settings::{Range, Setting, When};

/// The dialect that is written.
const DIALECT: &str = "https://json-schema.org/draft/2020-12/schema";

/// The schema: every table with its settings, and the older names without a table, marked as deprecated.
pub fn schema() -> Value {
    let mut tables = Map::new();
    let mut older = Map::new();
    for setting in Recipe::settings() {
        let setting = &setting;
        let entry = tables.entry(setting.table).or_insert_with(|| table(setting.table));
        entry["properties"][setting.field] = one(setting);
        if let Some(name) = Recipe::flat_name(&setting.key()) {
            let mut own = values(setting);
            own["description"] = json!(format!("Older name of {}", setting.key()));
            own["deprecated"] = json!(true);
            // Readers know it in the setting's own table too.
            if entry["properties"].get(name).is_none() {
                entry["properties"][name] = own.clone();
            }
            older.insert(name.to_owned(), own);
        }
    }
    for (name, own) in older {
        // `life` was a setting and is a table.
        let both = tables.remove(&name).map_or_else(|| own.clone(), |table| json!({"anyOf": [table, own.clone()]}));
        tables.insert(name, both);
    }
    json!({
        "$schema": DIALECT,
        "title": "Recipe of splat4d",
        "description": "All settings of a run (docs/recipe.md)",
        "type": "object",
        "additionalProperties": false,
        "properties": tables,
    })
}

fn table(name: &str) -> Value {
    let needs = Recipe::needs(name).map_or_else(String::new, |n| format!(" In effect with {n}."));
    json!({
        "type": "object",
        "description": format!("{}{needs}", Recipe::about(name)),
        "additionalProperties": false,
        "properties": {},
    })
}

/// A setting with its default and its description.
fn one(setting: &Setting) -> Value {
    let mut out = values(setting);
    let unit = if setting.rule.unit.is_empty() { String::new() } else { format!(" Unit: {}.", setting.rule.unit) };
    let needs = match setting.rule.when {
        When::Always => String::new(),
        when => format!(" In effect with {when}."),
    };
    out["description"] = json!(format!("{}{unit}{needs}", setting.doc));
    out["default"] = default(setting);
    out
}

fn default(setting: &Setting) -> Value {
    let value = Recipe::default().get(&setting.key()).expect("it is a setting");
    serde_json::to_value(value).expect("settings are plain numbers, flags and strings")
}

/// The permitted values. The default states the type; where that is text, a trial assignment finds out whether numbers are
/// permitted too.
fn values(setting: &Setting) -> Value {
    match default(setting) {
        Value::Bool(_) => json!({"type": "boolean"}),
        Value::Array(_) => json!({"type": "array"}),
        Value::Number(n) => {
            let mut out = json!({"type": if n.is_f64() { "number" } else { "integer" }});
            bound(&mut out, setting.rule.range);
            out
        }
        _ if !setting.choices.is_empty() => json!({"enum": setting.choices}),
        _ => {
            let text = json!({"type": "string"});
            let takes_numbers = Recipe::default().set(&format!("{}=0.5", setting.key())).is_ok();
            let mut number = json!({"type": "number"});
            bound(&mut number, setting.rule.range);
            if takes_numbers { json!({"anyOf": [number, text]}) } else { text }
        }
    }
}

fn bound(out: &mut Value, range: Range) {
    let bounds = match range {
        Range::NotNegative => json!({"minimum": 0}),
        Range::Finite => json!({}),
        Range::Positive => json!({"exclusiveMinimum": 0}),
        Range::Share => json!({"minimum": 0, "maximum": 1}),
        Range::InsideShare => json!({"exclusiveMinimum": 0, "exclusiveMaximum": 1}),
        Range::BelowOne => json!({"minimum": 0, "exclusiveMaximum": 1}),
        Range::AtLeast(low) => json!({"minimum": low}),
        Range::Within(low, high) => json!({"minimum": low, "maximum": high}),
    };
    for (name, value) in bounds.as_object().into_iter().flatten() {
        out[name] = value.clone();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether a value is valid, by the words of JSON Schema that are used here.
    fn accepts(schema: &Value, value: &Value) -> bool {
        let number = |word: &str| schema[word].as_f64();
        let is = |kind: &str| match kind {
            "boolean" => value.is_boolean(),
            "array" => value.is_array(),
            "string" => value.is_string(),
            "object" => value.is_object(),
            "number" => value.is_number(),
            "integer" => value.as_f64().is_some_and(|x| x.fract() == 0.0),
            other => panic!("{other} is not used"),
        };
        let within = value.as_f64().is_none_or(|x| {
            number("minimum").is_none_or(|low| x >= low)
                && number("maximum").is_none_or(|high| x <= high)
                && number("exclusiveMinimum").is_none_or(|low| x > low)
                && number("exclusiveMaximum").is_none_or(|high| x < high)
        });
        let known = |object: &Map<String, Value>| {
            object.iter().all(|(key, value)| schema["properties"].get(key).is_some_and(|own| accepts(own, value)))
        };
        schema["type"].as_str().is_none_or(is)
            && within
            && schema["enum"].as_array().is_none_or(|words| words.contains(value))
            && schema["anyOf"].as_array().is_none_or(|all| all.iter().any(|one| accepts(one, value)))
            && value.as_object().is_none_or(|object| schema.get("anyOf").is_some() || known(object))
    }

    fn of(recipe: &str) -> Value {
        serde_json::to_value(recipe.parse::<toml::Table>().unwrap()).unwrap()
    }

    #[test]
    fn recipes_are_valid_and_unknown_settings_are_not() {
        let schema = schema();
        assert!(accepts(&schema, &of(&Recipe::default().to_toml())), "all defaults");
        for (text, valid) in [
            ("[run]\niterations = 3000\n[densify]\nmax_cap = 60000\n", true),
            ("iterations = 300\nlife = \"infinite\"\n[life]\n", false), // the same key twice
            ("iterations = 300\n[densify]\ndensify_from_iter = 40\n", true),
            ("life = \"infinite\"\n", true),
            ("[life]\nkind = \"infinite\"\n", true),
            ("[life]\nkind = \"forever\"\n", false),
            ("[run]\niteratons = 3000\n", false),
            ("[run]\niterations = \"many\"\n", false),
            ("[loss]\ndssim = 1.5\n", false),
        ] {
            let value = text.parse::<toml::Table>().ok().map(|t| serde_json::to_value(t).unwrap());
            assert_eq!(value.is_some_and(|v| accepts(&schema, &v)), valid, "{text}");
        }
    }

    #[test]
    fn the_schema_and_the_reader_accept_the_same_values() {
        let schema = schema();
        for setting in Recipe::settings() {
            let table = &schema["properties"][setting.table];
            let table = table["anyOf"].get(0).unwrap_or(table);
            let own = &table["properties"][setting.field];
            assert!(accepts(own, &default(&setting)), "{}: {own}", setting.key());
            let exact = own["type"].as_str().is_some_and(|kind| ["boolean", "number", "integer"].contains(&kind));
            for text in ["true", "-1", "0", "0.5", "1", "7", "1e12", "\"nonsense\"", "[]"] {
                let reads = Recipe::default().set(&format!("{}={text}", setting.key())).is_ok();
                let value = of(&format!("v = {text}"))["v"].clone();
                let valid = accepts(own, &value);
                let agree = if exact || own.get("enum").is_some() { valid == reads } else { valid || !reads };
                assert!(agree, "{} = {text}: the reader says {reads}, the schema {valid}: {own}", setting.key());
            }
        }
    }
}
