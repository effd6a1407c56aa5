//! This test writes `docs/cli*.md` from the command line itself, so the reference cannot lag behind the code.

use clap::{Arg, Command};
use std::path::Path;

/// A page of the reference: its file in docs/, its beginning, and the commands on it.
struct Page {
    file: &'static str,
    head: &'static str,
    commands: &'static [&'static str],
}

/// Pages stay below 250 lines. Every command is on exactly one of them.
const PAGES: [Page; 4] = [
    Page {
        file: "cli.md",
        head: "# Command line: captures and training\n\nEvery option, as `splat4d COMMAND --help` prints it. Tasks and \
               examples of all commands: [commands](verbs.md).\n\n| page | commands |\n|---|---|\n\
               | this page | import, info, train |\n\
               | [results](cli-results.md) | status, eval, compare, render, predict, localise |\n\
               | [scenes and files](cli-scenes.md) | join, bake, compress, view, export |\n\
               | [conversion and edits](cli-edits.md) | convert, edit, label, priors, recipe, completions |\n\n\
               Every command also accepts these options:\n",
        commands: &["import", "info", "train"],
    },
    Page {
        file: "cli-results.md",
        head: "# Command line: results\n\nOptions of `status`, `eval`, `compare`, `render`, `predict` and `localise`. Options that \
               every command accepts: [captures and training](cli.md).\n",
        commands: &["status", "eval", "compare", "render", "predict", "localise"],
    },
    Page {
        file: "cli-scenes.md",
        head: "# Command line: scenes and files\n\nOptions of `join`, `bake`, `compress`, `view` and `export`. Options that every \
               command accepts: [captures and training](cli.md).\n",
        commands: &["join", "bake", "compress", "view", "export"],
    },
    Page {
        file: "cli-edits.md",
        head: "# Command line: conversion and edits\n\nOptions of `convert`, `edit`, `label`, `priors`, `recipe` and \
               `completions`. Options that every command accepts: [captures and training](cli.md).\n",
        commands: &["convert", "edit", "label", "priors", "recipe", "completions"],
    },
];

const AGAIN: &str = "UPDATE_GOLDEN=1 cargo test -p splat4d --test cli_doc";

fn text(page: &Page, all: &Command) -> String {
    let mut text = page.head.to_owned();
    if page.file == PAGES[0].file {
        text += &table(&all.get_arguments().filter(|a| a.is_global_set()).collect::<Vec<_>>());
    }
    text += &format!("\nThis file is generated: `{AGAIN}`.\n");
    for name in page.commands {
        let command = all.find_subcommand(name).unwrap_or_else(|| panic!("{}: there is no {name}", page.file));
        text += &section(command.clone());
    }
    text
}

/// A command: its purpose, usage, options by heading, its examples.
fn section(mut command: Command) -> String {
    let about = command.get_about().map(ToString::to_string).unwrap_or_default();
    let usage = command.render_usage().to_string();
    let usage = usage.trim_start_matches("Usage: ");
    let mut text = format!("\n## {0}\n\n{about}.\n\n```text\n{usage}\n```\n", command.get_name());
    let own = |a: &&Arg| !a.is_global_set() && !a.is_hide_set() && !["help", "version"].contains(&a.get_id().as_str());
    let arguments: Vec<&Arg> = command.get_arguments().filter(own).collect();
    let mut headings = Vec::new();
    for argument in &arguments {
        if !headings.contains(&argument.get_help_heading()) {
            headings.push(argument.get_help_heading());
        }
    }
    for heading in headings {
        if let Some(heading) = heading {
            text += &format!("\n**{heading}**\n");
        }
        let rows: Vec<&Arg> = arguments.iter().copied().filter(|a| a.get_help_heading() == heading).collect();
        text += &table(&rows);
    }
    if let Some(after) = command.get_after_long_help().or(command.get_after_help()) {
        text += &format!("\n```text\n{after}\n```\n");
    }
    text
}

fn table(arguments: &[&Arg]) -> String {
    let mut text = "\n| option | meaning | default |\n|---|---|---|\n".to_owned();
    for argument in arguments {
        text += &row(argument);
    }
    text
}

fn row(argument: &Arg) -> String {
    let values = argument.get_value_names().unwrap_or_default().join(" ");
    let mut names: Vec<String> = argument.get_short().map(|s| format!("-{s}")).into_iter().collect();
    names.extend(argument.get_long().map(|l| format!("--{l}")));
    let flag = argument.get_action().takes_values();
    let option = match (names.is_empty(), flag) {
        (true, _) => values,
        (false, true) => format!("{} {values}", names.join(", ")),
        (false, false) => names.join(", "),
    };
    let mut meaning = argument.get_help().map(ToString::to_string).unwrap_or_default();
    let choices = if flag { argument.get_possible_values() } else { Vec::new() };
    if !choices.is_empty() {
        let choice = |c: &clap::builder::PossibleValue| match c.get_help() {
            Some(help) => format!("`{}`: {help}", c.get_name()),
            None => format!("`{}`", c.get_name()),
        };
        meaning += &format!(". Values: {}", choices.iter().map(choice).collect::<Vec<_>>().join("; "));
    }
    // Help states a default in words where it depends on something.
    let stated = meaning.find(" [default: ").and_then(|at| Some((at, at + meaning[at..].find(']')?)));
    let values = if flag { argument.get_default_values() } else { &[] };
    let mut default = values.iter().map(|v| v.to_string_lossy()).collect::<Vec<_>>().join(" ");
    if let Some((from, to)) = stated {
        default = meaning[from + " [default: ".len()..to].to_owned();
        meaning.replace_range(from..=to, "");
    }
    format!("| `{}` | {} | {} |\n", option.replace('|', "\\|"), cell(&meaning), cell(&default))
}

/// Text in a cell of a table: without line breaks, and neither HTML nor a new cell; code spans stay as they are.
fn cell(text: &str) -> String {
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|");
    let part = |(i, part): (usize, &str)| if i % 2 == 0 { part.replace('<', "&lt;") } else { part.to_owned() };
    text.split('`').enumerate().map(part).collect::<Vec<_>>().join("`")
}

#[test]
fn the_reference_equals_the_options_of_the_command() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    let mut all = splat4d_cli::command();
    all.build();
    for page in &PAGES {
        let (path, text) = (folder.join(page.file), text(page, &all));
        if std::env::var_os("UPDATE_GOLDEN").is_some() {
            std::fs::write(&path, &text).expect("docs/ can be written");
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        let differs = text.lines().zip(found.lines()).find(|(new, old)| new != old).map(|(new, _)| new.to_owned());
        assert!(
            found == text,
            "docs/{} is out of date (first difference: {}). Write it again with\n    {AGAIN}",
            page.file,
            differs.unwrap_or_else(|| "its length".into())
        );
    }
}

#[test]
fn every_command_is_on_one_page() {
    let mut listed: Vec<&str> = PAGES.iter().flat_map(|p| p.commands).copied().collect();
    listed.sort_unstable();
    let all = splat4d_cli::command();
    let mut there: Vec<&str> = all.get_subcommands().filter(|c| !c.is_hide_set()).map(Command::get_name).collect();
    there.sort_unstable();
    assert_eq!(listed, there, "commands of PAGES (left) and of the command line (right)");
}
