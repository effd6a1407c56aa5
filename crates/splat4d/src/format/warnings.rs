//! Warnings about what a file could not hold or what had to be assumed: collected while a dialect is read or written,
//! printed by the shell.

/// Sentences without a final full stop, in order of occurrence.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Warnings {
    lines: Vec<String>,
}

impl Warnings {
    /// Adds a sentence.
    pub fn add(&mut self, text: impl Into<String>) {
        self.lines.push(text.into());
    }

    /// Adds "`count` of `of` Gaussians `what`", unless the count is zero.
    pub fn counted(&mut self, count: usize, of: usize, what: &str) {
        if count > 0 {
            self.add(format!("{count} of {of} Gaussians {what}"));
        }
    }

    /// All sentences.
    pub fn lines(&self) -> &[String] {
        &self.lines
    }

    /// Removes sentences that contain `text`, because they were resolved.
    pub fn drop(&mut self, text: &str) {
        self.lines.retain(|line| !line.contains(text));
    }

    /// Adds those of another collection, leaving out repetitions.
    pub fn append(&mut self, other: Warnings) {
        for line in other.lines {
            if !self.lines.contains(&line) {
                self.lines.push(line);
            }
        }
    }
}
