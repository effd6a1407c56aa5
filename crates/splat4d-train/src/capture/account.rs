//! Content that a reader did not find, did not read, assumed or could not check: `info` prints it in one block.

/// Severity of a [`Finding`](super::Finding).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// For information.
    Note,
    /// The result will probably suffer.
    Warning,
}

/// Kind of a `Remark`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Aspect {
    /// Files or lines that the capture names and that are not there.
    NotFound,
    /// Files, keys or lines that are there and not used.
    NotRead,
    /// Assumptions about what the capture does not state.
    Assumed,
    /// A check that could not run, and why.
    NotChecked,
}

impl Aspect {
    /// All of them with their names, in the order in which they are listed.
    pub const ALL: [(&'static str, Self); 4] = [
        ("not found", Self::NotFound),
        ("not read", Self::NotRead),
        ("assumed", Self::Assumed),
        ("not checked", Self::NotChecked),
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, aspect)| *aspect == self).map_or("", |(name, _)| name)
    }
}

/// One sentence or two, with numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remark {
    /// Its subject.
    pub aspect: Aspect,
    /// Severity.
    pub severity: Severity,
    /// The sentence.
    pub what: String,
}

/// The remarks of a reader.
#[derive(Clone, Debug, Default)]
pub(super) struct Account {
    pub(super) remarks: Vec<Remark>,
}

impl Account {
    /// Adds a remark.
    pub(super) fn add(&mut self, aspect: Aspect, severity: Severity, what: String) {
        self.remarks.push(Remark { aspect, severity, what });
    }
}

/// The first names of a list, and how many more there are.
pub(super) fn first_names<S: AsRef<str>>(names: &[S]) -> String {
    /// Names that are listed.
    const LISTED: usize = 5;
    let first: Vec<&str> = names.iter().take(LISTED).map(AsRef::as_ref).collect();
    match names.len().saturating_sub(LISTED) {
        0 => first.join(", "),
        more => format!("{} and {more} more", first.join(", ")),
    }
}
