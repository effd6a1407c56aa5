//! `cfg_args`: the text of a Python `Namespace(name=value, ...)`. Only flags and words are looked up; nothing is evaluated.

/// The text.
#[derive(Clone, Copy, Debug)]
pub(super) struct Settings<'a>(pub(super) &'a str);

impl<'a> Settings<'a> {
    /// The text of a value, up to the next comma or bracket. `None`: there is no such name.
    pub(super) fn value(&self, name: &str) -> Option<&'a str> {
        let starts = |at: usize| self.0[..at].ends_with(['(', ',', ' ']);
        let (at, _) =
            self.0.match_indices(name).find(|(at, _)| starts(*at) && self.0[at + name.len()..].starts_with('='))?;
        let rest = &self.0[at + name.len() + 1..];
        let end = rest.find([',', ')', '\n']).unwrap_or(rest.len());
        Some(rest[..end].trim().trim_matches(['\'', '"']))
    }

    /// Whether a flag is set.
    pub(super) fn is(&self, name: &str, default: bool) -> bool {
        match self.value(name) {
            Some("True") => true,
            Some("False") => false,
            _ => default,
        }
    }

    /// A number.
    pub(super) fn number(&self, name: &str) -> Option<f64> {
        self.value(name)?.parse().ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_words_and_numbers_are_found_by_their_whole_name() {
        let text =
            "Namespace(K=3, no_ds=True, xno_do=True, deform_type='node', bounds=1.6, multires=[1, 2], no_dr=False)";
        let s = Settings(text);
        assert!(s.is("no_ds", false) && !s.is("no_dr", true) && !s.is("no_do", false) && s.is("no_do", true));
        assert_eq!((s.value("deform_type"), s.number("K"), s.number("bounds")), (Some("node"), Some(3.0), Some(1.6)));
        assert_eq!((s.value("missing"), s.number("deform_type")), (None, None));
        assert_eq!(Settings("").value("K"), None);
        assert_eq!(Settings("(K=").value("K"), Some(""));
    }
}
