//! A progress bar in the last line of a terminal, without escape sequences: a carriage return and spaces erase it.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};
use terminal_size::{Width, terminal_size_of};

/// Least time between two redraws: frequent enough for a terminal, cheap over slow remote shells.
const INTERVAL: Duration = Duration::from_millis(125);
/// Columns of the bar itself.
const CELLS: usize = 28;
/// Eighths of a cell, from empty to full.
const EIGHTHS: [char; 9] = [' ', '▏', '▎', '▍', '▌', '▋', '▊', '▉', '█'];
/// Columns of a terminal whose size is unknown.
const COLUMNS: usize = 80;

/// The bar of one phase.
#[derive(Debug, Default)]
pub(crate) struct Bar {
    /// Columns that the line on the screen has; 0: there is none.
    shown: usize,
    drawn: Option<Instant>,
    line: String,
}

impl Bar {
    /// Shows how far the phase is, if the last redraw was long enough ago.
    pub(crate) fn show(&mut self, name: &str, done: usize, total: usize, words: &str) {
        let ends = total > 0 && done >= total;
        if !ends && self.drawn.is_some_and(|t| t.elapsed() < INTERVAL) {
            return;
        }
        self.line = if total == 0 { format!("{name} ...") } else { line(name, done, total, words) };
        self.draw();
    }

    /// Runs `print` where the bar was, and draws the bar again below its lines.
    pub(crate) fn suspend<T>(&mut self, print: impl FnOnce() -> T) -> T {
        self.erase();
        let out = print();
        self.draw();
        out
    }

    /// Removes the bar from the screen.
    pub(crate) fn erase(&mut self) {
        if self.shown > 0 {
            write(&format!("\r{}\r", " ".repeat(self.shown)));
            self.shown = 0;
        }
    }

    fn draw(&mut self) {
        // The last column stays free: some terminals start a line after it.
        let room = columns().saturating_sub(1);
        let (text, width) = cut(&self.line, room);
        let rest = " ".repeat(self.shown.saturating_sub(width).min(room - width));
        write(&format!("\r{text}{rest}"));
        (self.shown, self.drawn) = (width, Some(Instant::now()));
    }
}

/// Writes to the terminal; nothing happens if it is closed.
fn write(text: &str) {
    let mut out = std::io::stderr().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

fn columns() -> usize {
    let err = std::io::stderr();
    let size = if err.is_terminal() { terminal_size_of(&err) } else { None };
    size.map_or(COLUMNS, |(Width(w), _)| usize::from(w)).max(1)
}

fn line(name: &str, done: usize, total: usize, words: &str) -> String {
    let eighths = (done.min(total) as f64 / total as f64 * (CELLS * 8) as f64).floor() as usize;
    let cells: String = (0..CELLS).map(|cell| EIGHTHS[eighths.saturating_sub(8 * cell).min(8)]).collect();
    format!("{name} {cells} {done}/{total}  {words}").trim_end().to_owned()
}

/// As much of a text as fits into `room` columns, and its columns.
fn cut(text: &str, room: usize) -> (&str, usize) {
    let mut width = 0;
    for (i, c) in text.char_indices() {
        // Names of cameras may be in scripts whose letters take two columns.
        let own = if c < '\u{1100}' || ('\u{2500}'..='\u{25ff}').contains(&c) { 1 } else { 2 };
        if width + own > room {
            return (&text[..i], width);
        }
        width += own;
    }
    (text, width)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_is_filled_in_eighths_of_a_cell() {
        assert_eq!(line("baking", 0, 8, ""), format!("baking {} 0/8", " ".repeat(28)));
        assert_eq!(line("baking", 8, 8, "done"), format!("baking {} 8/8  done", "█".repeat(28)));
        let part = line("x", 1, 64, "");
        assert!(part.starts_with("x ▍ "), "1/64 of 224 eighths are 3: {part}");
    }

    #[test]
    fn a_line_ends_before_the_edge_of_the_terminal() {
        assert_eq!(cut("abc", 3), ("abc", 3));
        assert_eq!(cut("abc", 2), ("ab", 2));
        assert_eq!(cut("a摄像机", 4), ("a摄", 3));
        assert_eq!(cut("██x", 2), ("██", 2));
    }

    #[test]
    fn a_bar_that_was_never_drawn_erases_nothing() {
        let mut bar = Bar::default();
        bar.erase();
        assert_eq!((bar.shown, bar.drawn), (0, None));
    }
}
