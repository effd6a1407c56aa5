//! Words, numbers and brackets of USD as text.

use super::damaged;
use crate::Result;

/// Deepest nesting of brackets that is followed.
const DEEPEST: usize = 128;

/// A value as far as Gaussians and their positions need it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    /// A number, a truth or a tuple (of tuples).
    Numbers(Vec<f64>),
    /// An array of numbers or tuples, one after the other.
    Array(Vec<f32>),
    /// Texts, tokens, paths or assets.
    Words(Vec<String>),
    /// `None`, or what is not examined.
    Nothing,
}

impl Value {
    /// The first number.
    pub(super) fn number(&self) -> Option<f64> {
        match self {
            Value::Numbers(all) => all.first().copied(),
            _ => None,
        }
    }

    /// The first text.
    pub(super) fn word(&self) -> Option<&str> {
        match self {
            Value::Words(all) => all.first().map(String::as_str),
            _ => None,
        }
    }
}

/// A position in the text.
pub(super) struct Lexer<'a> {
    text: &'a [u8],
    at: usize,
}

impl<'a> Lexer<'a> {
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0 }
    }

    /// The next byte; 0 at the end.
    pub(super) fn peek(&self) -> u8 {
        self.text.get(self.at).copied().unwrap_or(0)
    }

    /// An error at this place.
    pub(super) fn error(&self, what: impl std::fmt::Display) -> crate::Error {
        damaged(format!("{what}, at byte {}", self.at))
    }

    /// Passes over spaces and tabs: what follows on the line.
    pub(super) fn line(&mut self) {
        while matches!(self.peek(), b' ' | b'\t') {
            self.at += 1;
        }
    }

    /// Passes over spaces, ends of lines, separators and comments.
    pub(super) fn space(&mut self) {
        loop {
            match self.peek() {
                b' ' | b'\t' | b'\r' | b'\n' | b';' => self.at += 1,
                b'#' => self.until(b"\n"),
                b'/' if self.text[self.at..].starts_with(b"/*") => self.until(b"*/"),
                b'/' if self.text[self.at..].starts_with(b"//") => self.until(b"\n"),
                _ => return,
            }
        }
    }

    /// Moves behind the next `end`, or to the end of the text.
    fn until(&mut self, end: &[u8]) {
        let rest = &self.text[self.at..];
        let found = rest.windows(end.len()).position(|w| w == end);
        self.at += found.map_or(rest.len(), |i| i + end.len());
    }

    /// Skips a byte if it is the next one.
    pub(super) fn eat(&mut self, byte: u8) -> bool {
        let is = self.peek() == byte && self.at < self.text.len();
        self.at += usize::from(is);
        is
    }

    /// Skips a byte that must be the next one.
    pub(super) fn expect(&mut self, byte: u8) -> Result<()> {
        if self.eat(byte) { Ok(()) } else { Err(self.error(format_args!("`{}` is missing", char::from(byte)))) }
    }

    /// Letters up to a space, a bracket, `=`, a comma or a quote; may be empty. `[]` belongs to a type's name.
    pub(super) fn word(&mut self) -> &'a str {
        let rest = &self.text[self.at..];
        let ends = |i: usize| match rest[i] {
            b'[' => rest.get(i + 1) != Some(&b']'),
            b']' => i == 0 || rest[i - 1] != b'[',
            b => b.is_ascii_whitespace() || b"=(){},;\"'#@<>".contains(&b),
        };
        let end = (0..rest.len()).find(|i| ends(*i)).unwrap_or(rest.len());
        self.at += end;
        std::str::from_utf8(&rest[..end]).unwrap_or("?")
    }

    /// A quoted text: ' or ", or three of them.
    pub(super) fn string(&mut self) -> Result<String> {
        let quote = self.peek();
        let long = self.text[self.at..].starts_with(&[quote; 3]);
        let width = if long { 3 } else { 1 };
        let begin = self.at + width;
        let mut i = begin;
        loop {
            let rest = self.text.get(i..).unwrap_or_default();
            match rest.first() {
                None => return Err(self.error("a text does not end")),
                Some(b'\\') => i += 2,
                Some(b'\n') if !long => return Err(self.error("a text does not end on its line")),
                Some(_) if rest.starts_with(&[quote; 3][..width]) => break,
                Some(_) => i += 1,
            }
        }
        self.at = i + width;
        Ok(String::from_utf8_lossy(&self.text[begin..i]).into_owned())
    }

    /// Passes over a value or a block, whatever it is.
    pub(super) fn skip(&mut self) -> Result<()> {
        let mut open = Vec::new();
        loop {
            self.space();
            match self.peek() {
                0 if self.at >= self.text.len() => return Err(self.error("the file ends in a value")),
                b'(' | b'[' | b'{' => {
                    open.push(self.peek());
                    self.at += 1;
                }
                b')' | b']' | b'}' => {
                    let pair = [open.pop().unwrap_or(0), self.peek()];
                    if ![*b"()", *b"[]", *b"{}"].contains(&pair) {
                        return Err(self.error("brackets do not match"));
                    }
                    self.at += 1;
                }
                b'"' | b'\'' => drop(self.string()?),
                b'@' => self.asset(),
                b'<' => self.until(b">"),
                b',' | b'=' | b':' => self.at += 1,
                _ => {
                    if self.word().is_empty() {
                        self.at += 1;
                    }
                }
            }
            if open.len() > DEEPEST {
                return Err(self.error("brackets are nested too deeply"));
            }
            if open.is_empty() {
                return Ok(());
            }
        }
    }

    /// Passes over @asset@ or @@@asset@@@.
    fn asset(&mut self) {
        let end: &[u8] = if self.text[self.at..].starts_with(b"@@@") { b"@@@" } else { b"@" };
        self.at += end.len();
        self.until(end);
    }

    /// A number: decimal, `inf`, `nan`, `true`, `false`.
    fn number(&mut self) -> Result<f64> {
        let begin = self.at;
        let rest = &self.text[begin..];
        let is = |b: &u8| b.is_ascii_alphanumeric() || b"+-.".contains(b);
        let length = rest.iter().position(|b| !is(b)).unwrap_or(rest.len());
        let word = std::str::from_utf8(&rest[..length]).unwrap_or_default();
        let value = match word {
            "true" | "True" => 1.0,
            "false" | "False" => 0.0,
            _ => word.parse().map_err(|_| self.error(format_args!("`{word}` is not a number")))?,
        };
        self.at += length;
        Ok(value)
    }

    /// A value.
    pub(super) fn value(&mut self) -> Result<Value> {
        self.space();
        match self.peek() {
            b'[' => self.array(),
            b'(' => {
                let mut all = Vec::new();
                self.numbers(b'(', b')', &mut |x| all.push(x))?;
                Ok(Value::Numbers(all))
            }
            b'"' | b'\'' => Ok(Value::Words(vec![self.string()?])),
            b'@' | b'<' | b'{' => self.skip().map(|()| Value::Nothing),
            _ if self.text[self.at..].starts_with(b"None") => {
                self.word();
                Ok(Value::Nothing)
            }
            _ => Ok(Value::Numbers(vec![self.number()?])),
        }
    }

    fn array(&mut self) -> Result<Value> {
        let begin = self.at;
        self.expect(b'[')?;
        self.space();
        if matches!(self.peek(), b'"' | b'\'') {
            let mut words = Vec::new();
            while !self.eat(b']') {
                words.push(self.string()?);
                self.space();
                self.eat(b',');
                self.space();
                if !matches!(self.peek(), b'"' | b'\'' | b']') {
                    return Err(self.error("an array of texts holds something else"));
                }
            }
            return Ok(Value::Words(words));
        }
        self.at = begin;
        if matches!(self.text.get(begin + 1), Some(b'@' | b'<')) {
            return self.skip().map(|()| Value::Nothing);
        }
        let mut all = Vec::new();
        self.numbers(b'[', b']', &mut |x| all.push(x as f32))?;
        Ok(Value::Array(all))
    }

    /// All numbers between two brackets, tuples inside flattened.
    fn numbers(&mut self, first: u8, last: u8, each: &mut impl FnMut(f64)) -> Result<()> {
        self.expect(first)?;
        let mut depth = 0;
        loop {
            self.space();
            match self.peek() {
                b if b == last && depth == 0 => {
                    self.at += 1;
                    return Ok(());
                }
                b'(' => {
                    depth += 1;
                    self.at += 1;
                }
                b')' if depth > 0 => {
                    depth -= 1;
                    self.at += 1;
                }
                b',' => self.at += 1,
                _ => each(self.number()?),
            }
        }
    }

    /// Time samples: code and value, passed to `keep` in order. Codes that are not numbers are an error.
    pub(super) fn samples(&mut self, mut keep: impl FnMut(f64, Value)) -> Result<()> {
        self.space();
        self.expect(b'{')?;
        loop {
            self.space();
            if self.eat(b'}') {
                return Ok(());
            }
            let code = self.number()?;
            self.space();
            self.expect(b':')?;
            let value = self.value()?;
            keep(code, value);
            self.space();
            self.eat(b',');
        }
    }
}
