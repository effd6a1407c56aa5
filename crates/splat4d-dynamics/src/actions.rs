//! Actions: external inputs to a scene, a row of named numbers per frame.
//!
//! Columns `NAME.x`, `NAME.y`, `NAME.z` that follow each other are one vector in the world, which turns with it; other
//! columns are scalars. Row t acts between frame t and the next.

use splat4d::{Error, Result};

/// Most columns.
pub const MAX_COLUMNS: usize = 8;

/// Rows of named numbers, one per frame from the first observed one on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Actions {
    /// Names of the columns.
    pub names: Vec<String>,
    /// \[frames]\[columns].
    pub rows: Vec<Vec<f64>>,
}

impl Actions {
    /// Reads a table as CSV: a header of names, then a row per frame.
    ///
    /// Errors: no header, too many columns, a duplicate name, a part of a vector without the others, a row of another
    /// length, a number that is none.
    pub fn parse(text: &str) -> Result<Self> {
        let bad = |what: String| {
            Error::input(what).remedy("Write a header of column names, then one row of numbers a frame, commas between")
        };
        let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
        let (_, header) = lines.next().ok_or_else(|| bad("the actions are empty".into()))?;
        let names: Vec<String> = header.split(',').map(|n| n.trim().to_owned()).collect();
        if names.len() > MAX_COLUMNS {
            return Err(bad(format!("{} columns of actions are too many: {MAX_COLUMNS} are possible", names.len())));
        }
        if let Some(name) = names.iter().find(|n| n.is_empty() || n.parse::<f64>().is_ok()) {
            return Err(bad(format!("invalid column of actions \"{name}\"")));
        }
        if let Some(name) = names.iter().enumerate().find_map(|(i, n)| names[..i].contains(n).then_some(n)) {
            return Err(bad(format!("two columns of actions are called {name}")));
        }
        if let Some(name) = stray(&names) {
            return Err(bad(format!("column {name} belongs to a vector whose other columns are not adjacent"))
                .remedy("Name three columns in a row NAME.x, NAME.y and NAME.z, or no column so"));
        }
        let row = |(number, line): (usize, &str)| {
            let cells: Vec<Option<f64>> =
                line.split(',').map(|c| c.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
            let numbers: Option<Vec<f64>> = cells.iter().copied().collect();
            numbers.filter(|n| n.len() == names.len()).ok_or_else(|| {
                bad(format!("invalid line {} of the actions: expected a row of {} numbers", number + 1, names.len()))
            })
        };
        let rows = lines.map(row).collect::<Result<_>>()?;
        Ok(Self { names, rows })
    }

    /// As [`parse`](Self::parse) reads it.
    pub fn to_csv(&self) -> String {
        let line = |row: &Vec<f64>| row.iter().map(f64::to_string).collect::<Vec<_>>().join(",") + "\n";
        self.names.join(",") + "\n" + &self.rows.iter().map(line).collect::<String>()
    }

    /// Errors: fewer rows than observed frames and the horizon need (the last frame needs none).
    pub fn check(&self, observed: usize, horizon: usize) -> Result<()> {
        let need = observed + horizon - 1;
        if self.rows.len() < need {
            return Err(Error::input(format!(
                "the actions have {} rows, and {observed} observed frames with a horizon of {horizon} need {need}",
                self.rows.len()
            ))
            .remedy("Give one row a frame from the first observed one on, or a smaller --horizon"));
        }
        Ok(())
    }

    /// First columns of vectors, and columns of scalars.
    pub fn columns(&self) -> (Vec<usize>, Vec<usize>) {
        let (mut vectors, mut scalars) = (Vec::new(), Vec::new());
        let mut i = 0;
        while i < self.names.len() {
            let stem = self.names[i].strip_suffix(".x");
            let is = |at: usize, end: &str| stem.is_some_and(|s| self.names.get(at) == Some(&format!("{s}.{end}")));
            if is(i + 1, "y") && is(i + 2, "z") {
                vectors.push(i);
                i += 3;
            } else {
                scalars.push(i);
                i += 1;
            }
        }
        (vectors, scalars)
    }
}

/// A column that is called like a part of a vector and belongs to none.
fn stray(names: &[String]) -> Option<&String> {
    let all = Actions { names: names.to_vec(), rows: Vec::new() };
    let is_part = |name: &str| [".x", ".y", ".z"].iter().any(|end| name.ends_with(end));
    all.columns().1.into_iter().map(|c| &names[c]).find(|name| is_part(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_are_read_or_explained() {
        let text = "push.x, push.y,push.z,grip\n1,2,3,0\n\n4,5,6,1\n";
        let a = Actions::parse(text).unwrap();
        assert_eq!((a.columns(), a.rows[1][2]), ((vec![0], vec![3]), 6.0));
        assert_eq!(Actions::parse(&a.to_csv()).unwrap(), a);
        assert!(a.check(2, 1).is_ok() && a.check(2, 2).unwrap_err().to_string().contains("need 3"));
        for (bad, word) in [
            ("", "empty"),
            ("1,2\n3,4\n", "invalid column"),
            ("a,a\n1,2\n", "two columns"),
            ("a,b\n1\n", "line 2"),
            ("a\nNaN\n", "line 2"),
            ("push.x,push.z\n1,2\n", "push.x"),
            ("a,b,c,d,e,f,g,h,i\n", "too many"),
        ] {
            let message = Actions::parse(bad).unwrap_err().to_string();
            assert!(message.contains(word), "{bad}: {message}");
        }
    }
}
