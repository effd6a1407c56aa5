//! Words: documents, notebooks, help, messages and texts of pages use the field's terms.

use super::{documents, files, is_test, is_word, read, report, sources};

/// Phrases that texts do not use, because readers have to translate them into the field's terms; outside of code. A
/// phrase begins a word: `picture` also finds `pictures`. CONTRIBUTING.md, "Language", states what to write.
const EVERYWHERE: [&str; 24] = [
    "anew",
    "anybody",
    "are no numbers",
    "at last",
    "beside",
    "everybody",
    "goes back",
    "instants",
    "is no number",
    "knob",
    "made up",
    "made-up",
    "nobody",
    "of before",
    "once more",
    "picture",
    "somebody",
    "tell",
    "told",
    "upkeep",
    "way back",
    "what stands still",
    "whoever",
    "worth",
];

/// Phrases that only `studies/records` may use: records are not rewritten. A trailing space ends a word.
const EXCEPT_RECORDS: [&str; 40] = [
    "a look at",
    "asked for",
    "asks",
    "at hand",
    "by then",
    "came back",
    "come back",
    "comes back",
    "for good",
    "for want of",
    "forth and back",
    "go on ",
    "goes on",
    "going on",
    "hears of",
    "in one go",
    "in turns",
    "is said",
    "knows",
    "live for",
    "lives for",
    "looks for",
    "mends",
    "question",
    "says",
    "sees to it",
    "so far",
    "so many",
    "stand for",
    "stands",
    "taken back",
    "takes back",
    "the other way round",
    "there and back",
    "under way",
    "wanted",
    "wants",
    "was said",
    "went on",
    "without a word",
];

/// Scripts whose long literals are shaders.
const SHADERS: [&str; 2] = ["/glsl.js", "/shaders.js"];

/// Longest line of a notebook that is text: images are stored as longer ones.
const NOTEBOOK_LINE: usize = 1000;

/// A document's prose: fenced blocks, code spans and the targets of links are blank; lines stay where they are.
fn prose(text: &str) -> String {
    let mut out = String::new();
    let mut fenced = false;
    for line in text.lines() {
        let fence = line.trim_start().starts_with("```");
        fenced ^= fence;
        if !fenced && !fence {
            // Odd parts are code spans; a span ends on its line.
            let spoken: Vec<&str> = line.split('`').step_by(2).collect();
            let spoken = spoken.join(" ");
            let mut parts = spoken.split("](");
            out += parts.next().unwrap_or("");
            for part in parts {
                out += part.split_once(')').map_or("", |(_, rest)| rest);
            }
        }
        out.push('\n');
    }
    out
}

/// Where prose has one of the phrases: line and phrase.
fn forbidden(text: &str, phrases: &[&'static str]) -> Vec<(usize, &'static str)> {
    let mut found = Vec::new();
    for (at, line) in prose(text).lines().enumerate() {
        let line = line.to_lowercase();
        for &phrase in phrases {
            // After a point or an underscore it is a name.
            let begins =
                |(at, _): (usize, &str)| !line[..at].ends_with(|c: char| c.is_alphanumeric() || "-_.".contains(c));
            if line.match_indices(phrase).any(begins) {
                found.push((at + 1, phrase));
            }
        }
    }
    found
}

/// What outsiders read of a source file, at its lines: documentation of crates and modules, and the command's help.
fn spoken(path: &str, text: &str) -> String {
    let module = ["/lib.rs", "/mod.rs", "/main.rs"].iter().any(|name| path.ends_with(name));
    let command = path.starts_with("crates/splat4d-cli/src/");
    let lines: Vec<&str> = text.lines().collect();
    let mut help = false;
    let mut out = String::new();
    for (at, line) in lines.iter().enumerate() {
        help |= command && line.starts_with("const EXAMPLES");
        // A comment of an argument is above its attribute.
        let below = lines[at..].iter().find(|l| !l.trim().starts_with("///"));
        let argument = command && below.is_some_and(|l| ["#[arg", "#[command"].iter().any(|a| l.trim().starts_with(a)));
        if module && line.starts_with("//!") || argument && line.trim().starts_with("///") || help {
            out += line;
        }
        help &= !line.ends_with("\";");
        out.push('\n');
    }
    out
}

/// Doc comments of a source file, at their lines.
fn comments(text: &str) -> String {
    let doc = |line: &str| ["//!", "///"].iter().any(|mark| line.trim().starts_with(mark));
    text.lines().map(|l| if doc(l) { l } else { "" }.to_owned() + "\n").collect()
}

/// Messages of a program: its string literals of several words, each at the line of its start, without placeholders.
/// `ticks`: whether backticks quote too, as in JavaScript.
fn messages(text: &str, ticks: bool) -> String {
    let chars: Vec<char> = text.chars().collect();
    let mut lines = vec![String::new(); text.lines().count() + 1];
    let (mut at, mut line) = (0, 0);
    while at < chars.len() {
        let (c, next) = (chars[at], chars.get(at + 1).copied().unwrap_or('\n'));
        let quote = c == '"' || ticks && (c == '`' || c == '\'');
        if c == '/' && next == '/' {
            at += chars[at..].iter().position(|&c| c == '\n').unwrap_or(chars.len() - at);
            continue;
        }
        if c == '/' && next == '*' {
            let end = chars[at..].windows(2).position(|w| w == ['*', '/']).map_or(chars.len(), |n| at + n + 2);
            line += chars[at..end].iter().filter(|&&c| c == '\n').count();
            at = end;
            continue;
        }
        if c == '\'' && !ticks {
            // A character, or a lifetime.
            at += if next == '\\' {
                4
            } else if chars.get(at + 2) == Some(&'\'') {
                3
            } else {
                1
            };
            continue;
        }
        if !quote {
            line += usize::from(c == '\n');
            at += 1;
            continue;
        }
        let (start, mut literal) = (line, String::new());
        at += 1;
        while at < chars.len() && chars[at] != c {
            if chars[at] == '\\' {
                at += 1;
                literal.push(' ');
            } else {
                literal.push(if chars[at] == '`' { ' ' } else { chars[at] });
            }
            line += usize::from(chars.get(at) == Some(&'\n'));
            at += 1;
        }
        at += 1;
        lines[start] += &without_names(&literal);
        lines[start].push(' ');
    }
    lines.join("\n")
}

/// A literal without placeholders and without `name=value`; empty if it is no more than a word.
fn without_names(literal: &str) -> String {
    let mut out = String::new();
    let mut depth = 0usize;
    for c in literal.chars() {
        depth += usize::from(c == '{');
        if depth == 0 {
            out.push(if c == '\n' { ' ' } else { c });
        }
        depth = depth.saturating_sub(usize::from(c == '}'));
    }
    let words: Vec<&str> = out.split_whitespace().filter(|w| !w.contains(['=', '/'])).collect();
    if words.iter().filter(|w| w.starts_with(is_word)).count() > 1 { words.join(" ") } else { String::new() }
}

/// A notebook's cells: its JSON without the long lines, which are images.
fn notebook(text: &str) -> String {
    text.lines().map(|l| if l.len() > NOTEBOOK_LINE { "" } else { l }.to_owned() + "\n").collect()
}

#[test]
fn phrases_are_found_in_prose_and_only_there() {
    let sample = "A picture.\n`picture`, [a](knob.md)\n```\nknob\n```\nTells, retells, a.tells.\n";
    assert_eq!(forbidden(sample, &EVERYWHERE), [(1, "picture"), (6, "tell")]);
    let source =
        "let c = '\"'; // a knob\nfail(\"{picture} of a \\\n  picture\", \"picture\", \"set=picture here\");\n";
    assert_eq!(forbidden(&messages(source, false), &EVERYWHERE), [(2, "picture")]);
    let script = "say('no picture', `a ${picture} of`); // a knob\n/** It's a knob */ f('a');\n";
    assert_eq!(forbidden(&messages(script, true), &EVERYWHERE), [(1, "picture")]);
    assert_eq!(forbidden(&notebook("\"a knob\\n\",\n"), &EVERYWHERE), [(1, "knob")]);
}

#[test]
fn texts_use_the_terms_of_the_field() {
    let mut troubles = Vec::new();
    let mut check = |path: &str, text: &str| {
        let dated = path.starts_with("studies/records/");
        let lists: [&[&'static str]; 2] = [&EVERYWHERE, if dated { &[] } else { &EXCEPT_RECORDS }];
        let found = lists.into_iter().flat_map(|phrases| forbidden(text, phrases));
        troubles.extend(found.map(|(line, phrase)| format!("{path}:{line}: \"{phrase}\"")));
    };
    for doc in documents().into_iter().chain(files("studies/records", "md")) {
        check(&doc, &read(&doc));
    }
    for path in files("crates", "ipynb") {
        check(&path, &notebook(&read(&path)));
    }
    for path in sources() {
        let text = read(&path);
        check(&path, &spoken(&path, &text));
        check(&path, &comments(&text));
        if !is_test(&path) {
            let product = text.split("\n#[cfg(test)]\nmod ").next().unwrap_or("");
            check(&path, &messages(product, false));
        }
    }
    let scripts = [files("crates/splat4d-serve/player", "js"), files("crates/splat4d-serve/npm", "js")].concat();
    // `npm/player` is a copy of `player` that publishing makes.
    let own = |p: &String| !p.contains("/npm/player/") && !SHADERS.iter().any(|name| p.ends_with(name));
    for path in scripts.into_iter().filter(own) {
        check(&path, &messages(&read(&path), true));
    }
    report(troubles, "Use the term of the field: CONTRIBUTING.md, \"Language\".");
}
