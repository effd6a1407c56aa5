//! Text from files, made safe to display: titles, notes, names of cameras, labels and files.
//!
//! Terminals execute control characters: an escape sequence in a title could set the clipboard or clear the screen, and
//! formatting characters for bidirectional text could reorder the output. All printed text passes through this module.

use std::borrow::Cow;

/// Formatting characters that change the direction of text (Unicode 15, UAX #9): embeddings, overrides and isolates,
/// marks; and the separators of lines and paragraphs.
const DIRECTIONS: [std::ops::RangeInclusive<char>; 4] =
    ['\u{200E}'..='\u{200F}', '\u{2028}'..='\u{202E}', '\u{2066}'..='\u{2069}', '\u{061C}'..='\u{061C}'];

/// Whether showing the character does something else than showing a character.
pub fn acts(c: char) -> bool {
    c.is_control() || DIRECTIONS.iter().any(|range| range.contains(&c))
}

/// The text with such characters spelt out (`\u{1b}`); line breaks and tabs stay.
pub fn shown(text: &str) -> Cow<'_, str> {
    spelt(text, |c| acts(c) && !matches!(c, '\n' | '\t'))
}

/// The same in one line: line breaks and tabs are spelt out as well.
pub fn in_line(text: &str) -> Cow<'_, str> {
    spelt(text, acts)
}

fn spelt(text: &str, which: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&which) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if which(c) { out.extend(c.escape_default()) } else { out.push(c) }
    }
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terminal_control_characters_are_escaped() {
        let title = "knight\u{1b}]52;c;ZXZpbA==\u{7}\u{9b}2J\rname\u{202e}gpj.exe";
        let shown = shown(title);
        assert!(!shown.chars().any(acts), "{shown}");
        assert_eq!(shown, r"knight\u{1b}]52;c;ZXZpbA==\u{7}\u{9b}2J\rname\u{202e}gpj.exe");
        assert_eq!((super::shown("a\n\tb"), in_line("a\n\tb")), ("a\n\tb".into(), r"a\n\tb".into()));
        for plain in ["", "Größe 3×4 µm — 日本語 🦀", "\\u{1b}"] {
            assert!(matches!(in_line(plain), Cow::Borrowed(same) if same == plain));
        }
    }
}
