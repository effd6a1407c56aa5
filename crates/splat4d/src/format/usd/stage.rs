//! The prims of a layer and what Gaussians need of them.

use super::lexer::{Lexer, Value};
use super::{COEFFICIENTS, DEGREE, OPACITIES, ORIENTATIONS, POSITIONS, SCALES, damaged};
use crate::Result;
use std::collections::BTreeMap;

/// Deepest nesting of prims that is followed.
const DEEPEST: usize = 64;
/// Time codes per second where the file does not state it (USD's fallback).
const CODES_PER_SECOND: f64 = 24.0;
/// Words that may be before the type of a property.
const QUALIFIERS: [&str; 7] = ["custom", "uniform", "varying", "config", "prepend", "append", "add"];

/// An attribute.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Attribute {
    pub(super) value: Option<Value>,
    /// Time codes, rising, and values.
    pub(super) samples: Vec<(f64, Value)>,
}

/// A prim.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Prim {
    pub(super) parent: Option<usize>,
    /// Type; empty where none is stated.
    pub(super) kind: String,
    pub(super) name: String,
    /// Whether it is defined and active.
    pub(super) shown: bool,
    /// Whether parts of it are in other files.
    pub(super) composed: bool,
    pub(super) attributes: BTreeMap<String, Attribute>,
}

/// A layer. Parents are before their children.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Stage {
    pub(super) z_up: bool,
    pub(super) meters_per_unit: f64,
    pub(super) codes_per_second: f64,
    pub(super) composed: bool,
    pub(super) prims: Vec<Prim>,
}

impl Default for Stage {
    fn default() -> Self {
        // The fallback of `metersPerUnit` is a centimetre; where it is not stated, the unit is not known.
        let (z_up, composed) = (false, false);
        Self { z_up, meters_per_unit: f64::NAN, codes_per_second: CODES_PER_SECOND, composed, prims: Vec::new() }
    }
}

/// Whether an attribute is one of a field of Gaussians or of a position.
fn is_needed(name: &str) -> bool {
    let name = name.strip_suffix('h').unwrap_or(name);
    [POSITIONS, ORIENTATIONS, SCALES, OPACITIES, DEGREE, COEFFICIENTS, "visibility"].contains(&name)
        || name.starts_with("xformOp")
}

impl Stage {
    /// Reads a layer as text. Errors: damaged.
    pub(super) fn read(text: &[u8]) -> Result<Self> {
        let (mut stage, mut l) = (Self::default(), Lexer::new(text));
        l.space();
        if l.eat(b'(') {
            stage.metadata(&mut l)?;
        }
        let mut open: Vec<usize> = Vec::new();
        loop {
            l.space();
            if l.peek() == 0 {
                break;
            }
            if l.eat(b'}') {
                open.pop().ok_or_else(|| l.error("a closing bracket has no opening one"))?;
                continue;
            }
            match l.word() {
                specifier @ ("def" | "over" | "class") => {
                    let above = open.last().copied();
                    let prim = stage.prim(&mut l, specifier, above)?;
                    stage.prims.push(prim);
                    open.push(stage.prims.len() - 1);
                    if open.len() > DEEPEST {
                        return Err(l.error("prims are nested too deeply"));
                    }
                }
                "variantSet" | "variants" | "reorder" => {
                    // Names, `=` and a block or a list.
                    loop {
                        l.line();
                        match l.peek() {
                            b'{' | b'[' => break l.skip()?,
                            b'=' => drop(l.eat(b'=')),
                            b'"' | b'\'' => drop(l.string()?),
                            _ if l.word().is_empty() => return Err(l.error("a list is missing")),
                            _ => {}
                        }
                    }
                }
                "" => return Err(l.error(format_args!("expected a name, found `{}`", char::from(l.peek())))),
                first => {
                    let Some(&prim) = open.last() else {
                        return Err(l.error(format_args!("`{first}` is outside all prims")));
                    };
                    stage.prims[prim].property(&mut l, first)?;
                }
            }
        }
        if open.is_empty() { Ok(stage) } else { Err(damaged("it is cut short")) }
    }

    /// The metadata of the layer, behind its bracket.
    fn metadata(&mut self, l: &mut Lexer<'_>) -> Result<()> {
        entries(l, |key, value| {
            let positive = value.number().filter(|x| x.is_finite() && *x > 0.0);
            match key {
                "upAxis" => self.z_up = value.word() == Some("Z"),
                "metersPerUnit" => self.meters_per_unit = positive.unwrap_or(f64::NAN),
                "timeCodesPerSecond" => self.codes_per_second = positive.unwrap_or(CODES_PER_SECOND),
                "subLayers" => self.composed = true,
                _ => {}
            }
        })
    }

    /// The head of a prim, up to its block.
    fn prim(&self, l: &mut Lexer<'_>, specifier: &str, parent: Option<usize>) -> Result<Prim> {
        l.space();
        let kind = l.word().to_owned();
        l.space();
        if !matches!(l.peek(), b'"' | b'\'') {
            return Err(l.error("a prim has no name"));
        }
        let name = l.string()?;
        let above = parent.is_none_or(|p| self.prims[p].shown);
        let mut prim = Prim { parent, kind, name, shown: above && specifier == "def", ..Prim::default() };
        l.space();
        if l.eat(b'(') {
            let mut active = true;
            entries(l, |key, value| match key {
                "active" => active = value.number() != Some(0.0),
                "references" | "payload" | "inherits" | "specializes" => prim.composed = true,
                _ => {}
            })?;
            prim.shown &= active;
            l.space();
        }
        l.expect(b'{')?;
        Ok(prim)
    }
}

/// Entries `key = value` up to the closing bracket.
fn entries(l: &mut Lexer<'_>, mut each: impl FnMut(&str, &Value)) -> Result<()> {
    loop {
        l.space();
        if l.eat(b')') {
            return Ok(());
        }
        if matches!(l.peek(), b'"' | b'\'') {
            l.string()?;
            continue;
        }
        let mut key = "";
        loop {
            l.line();
            match l.word() {
                "" => break,
                word => key = word,
            }
        }
        if key.is_empty() {
            return Err(l.error("metadata without a name"));
        }
        l.space();
        let mut value = Value::Nothing;
        if l.eat(b'=') {
            l.space();
            // Lists and dictionaries matter by their names alone.
            if matches!(l.peek(), b'[' | b'{' | b'@' | b'<') {
                l.skip()?;
                l.line();
                // @file@</Prim>, and what may follow in brackets.
                if l.peek() == b'<' {
                    l.skip()?;
                    l.line();
                }
                if l.peek() == b'(' {
                    l.skip()?;
                }
            } else {
                value = l.value().or_else(|_| {
                    // A word that is neither a number nor a text.
                    l.word();
                    Ok::<_, crate::Error>(Value::Nothing)
                })?;
            }
        }
        each(key, &value);
    }
}

impl Prim {
    /// A property, whose first word was read.
    fn property(&mut self, l: &mut Lexer<'_>, first: &str) -> Result<()> {
        let mut words = vec![first];
        loop {
            l.line();
            match l.word() {
                "" => break,
                word => words.push(word),
            }
        }
        let words: Vec<&str> = words.into_iter().filter(|w| !QUALIFIERS.contains(w)).collect();
        // Type and name; a relation's type is `rel`.
        let name = if words.len() == 2 { words[1] } else { "" };
        if l.eat(b'=') {
            let (name, part) = name.split_once('.').map_or((name, ""), |(name, part)| (name, part));
            if !is_needed(name) || !matches!(part, "" | "timeSamples") {
                l.skip()?;
                // `rel a = </b>, </c>` does not occur without brackets; strings may follow each other by commas only.
            } else if part.is_empty() {
                self.attributes.entry(name.to_owned()).or_default().value = Some(l.value()?);
            } else {
                let samples = &mut self.attributes.entry(name.to_owned()).or_default().samples;
                l.samples(|code, value| samples.push((code, value)))?;
                samples.sort_by(|a, b| a.0.total_cmp(&b.0));
                samples.dedup_by(|a, b| a.0 == b.0);
            }
        }
        l.line();
        if l.peek() == b'(' {
            l.skip()?;
        }
        Ok(())
    }
}
