//! Runs, and results of other programs, in one table.

use crate::comparing::{self, Entry};
use crate::events::Listener;
use crate::files;
use crate::report::compare as page;
use serde_json::{Value, json};
use splat4d::{Error, Result};
use splat4d_train::output::{Input, check_file};
use std::path::{Path, PathBuf};

/// Forms of the table.
#[derive(Clone, Copy)]
enum Form {
    Csv,
    Markdown,
    Html,
}

impl Form {
    fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match ending.as_deref() {
            Some("csv") => Ok(Self::Csv),
            Some("md") => Ok(Self::Markdown),
            Some("html" | "htm") => Ok(Self::Html),
            _ => Err(Error::input("unknown kind of table")
                .at(path.display())
                .remedy("Use option `output` NAME.csv, .md or .html")),
        }
    }
}

/// Compares runs, and results of other programs, by their scores of held-out views: reports a table, and writes it to
/// each of `outputs` (.csv, .md, or .html with images side by side and curves).
///
/// Errors: nothing of that kind, no scores, an output of another ending or in the place of what is compared.
///
/// ```no_run
/// # fn main() -> splat4d::Result<()> {
/// let listen = &splat4d_workflow::events::ignore;
/// splat4d_workflow::comparison::compare(&["runs/a".into(), "runs/b".into()], &["table.csv".into()], listen)
/// # }
/// ```
pub fn compare(runs: &[PathBuf], outputs: &[PathBuf], console: &dyn Listener) -> Result<()> {
    // Unwritable outputs are reported before the work.
    let inputs: Vec<Input<'_>> =
        runs.iter().map(|run| Input { may_hold: run.is_dir(), ..Input::new(run, "what is compared,") }).collect();
    let mut forms = Vec::new();
    for output in outputs {
        forms.push(Form::of(output)?);
        check_file(output, &inputs)?;
    }
    let entries = comparing::open(runs)?;
    for difference in comparing::differences(&entries) {
        console.warn(&format!("{difference}: their scores cannot be compared."));
    }
    let (head, rows) = comparing::table(&entries);
    let (_, to_read) = comparing::table_to_read(&entries);
    text(&head, &to_read).iter().for_each(|line| console.result(line));
    console.emit(&objects(&entries));
    for (output, form) in outputs.iter().zip(forms) {
        let bytes = match form {
            Form::Csv => csv(&head, &rows)?,
            Form::Markdown => markdown(&entries).into_bytes(),
            Form::Html => page::page(&entries).into_bytes(),
        };
        files::write(output, &bytes)?;
        console.written(output);
    }
    Ok(())
}

fn objects(entries: &[Entry]) -> Value {
    let row = |e: &Entry| {
        let score = |(i, (key, ..)): (usize, &(&str, usize, bool))| Some(((*key).to_owned(), json!(e.score(i)?)));
        let scores: serde_json::Map<String, Value> = comparing::SCORES.iter().enumerate().filter_map(score).collect();
        json!({"name": e.name, "motion": e.motion, "steps": e.steps, "gaussians": e.gaussians, "seconds": e.seconds,
            "bytes": e.bytes, "views": e.views.len(), "scores": scores})
    };
    json!({"type": "compared", "runs": entries.iter().map(row).collect::<Vec<_>>()})
}

/// Lines in columns.
fn text(head: &[String], rows: &[Vec<String>]) -> Vec<String> {
    let width = |k: usize| rows.iter().map(|r| &r[k]).chain([&head[k]]).map(|c| c.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    let line = |cells: &Vec<String>| {
        let cell = |(k, c): (usize, &String)| match k {
            0 => format!("{c:<0$}", widths[k]),
            _ => format!("{c:>0$}", widths[k]),
        };
        cells.iter().enumerate().map(cell).collect::<Vec<_>>().join("  ").trim_end().to_owned()
    };
    std::iter::once(&head.to_vec()).chain(rows).map(line).collect()
}

fn csv(head: &[String], rows: &[Vec<String>]) -> Result<Vec<u8>> {
    let mut table = csv::Writer::from_writer(Vec::new());
    let failed = |e: csv::Error| Error::environment("the table could not be written", std::io::Error::other(e));
    std::iter::once(head)
        .chain(rows.iter().map(Vec::as_slice))
        .try_for_each(|row| table.write_record(row))
        .map_err(failed)?;
    Ok(table.into_inner().expect("a vector takes everything"))
}

/// A table whose best scores are bold.
fn markdown(entries: &[Entry]) -> String {
    let ((head, rows), best) = (comparing::table_to_read(entries), comparing::best(entries));
    let safe = |text: &str| splat4d::text::in_line(text).replace('|', "\\|");
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    let mut out = line(head.iter().map(|h| safe(h)).collect());
    out += &line(head.iter().enumerate().map(|(k, _)| if k == 0 { "---" } else { "---:" }.to_owned()).collect());
    for (e, row) in rows.iter().enumerate() {
        let cell = |(k, c): (usize, &String)| match comparing::score_of(&head[k]) {
            Some(i) if best[i] == Some(e) => format!("**{c}**"),
            _ => safe(c),
        };
        out += &line(row.iter().enumerate().map(cell).collect());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries() -> Vec<Entry> {
        let of = |name: &str, psnr: f64| Entry {
            name: name.into(),
            scores: std::iter::once(Some(psnr)).chain(vec![None; comparing::SCORES.len() - 1]).collect(),
            ..Entry::default()
        };
        vec![of("one, \"quoted\"", 30.123), of("two|three", 31.5)]
    }

    #[test]
    fn tables_survive_names_that_hold_their_signs() {
        let (head, rows) = comparing::table(&entries());
        assert_eq!(text(&head, &rows)[1], "one, \"quoted\"  30.12");
        let bytes = csv(&head, &rows).unwrap();
        let mut read = csv::Reader::from_reader(&bytes[..]);
        assert_eq!(
            read.records().map(|r| r.unwrap()[0].to_owned()).collect::<Vec<_>>(),
            ["one, \"quoted\"", "two|three"]
        );
        let table = markdown(&entries());
        assert!(
            table.contains("| two\\|three | **31.50** |") && table.lines().nth(1) == Some("| --- | ---: |"),
            "{table}"
        );
    }
}
