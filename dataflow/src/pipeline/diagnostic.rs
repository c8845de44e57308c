//! Faults of a pipeline file, with position and hint.

use conicflow_messages::{is_harmless, plain};
use serde::{Deserialize, Serialize};
use std::fmt::{self, Display};
use std::ops::Range;
use std::sync::Arc;

/// A text that a pipeline is read from: the file, or one `--set`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SourceText {
    /// Its name in messages.
    pub name: String,
    /// The text itself.
    pub text: String,
}

/// A range of a [`SourceText`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SourceSpan {
    pub(crate) source: Arc<SourceText>,
    pub(crate) span: Range<usize>,
}

impl SourceSpan {
    /// Line and column, both from 1, and the text of the line.
    fn position(&self) -> (usize, usize, &str) {
        let text = &self.source.text;
        let start = text.floor_char_boundary(self.span.start.min(text.len()));
        let line_start = text[..start].rfind('\n').map_or(0, |newline| newline + 1);
        let line = text[line_start..].lines().next().unwrap_or("");
        let number = text[..start].matches('\n').count() + 1;
        (number, text[line_start..start].chars().count() + 1, line)
    }
}

/// Maximum number of characters of a line that are shown.
const WIDEST_LINE: usize = 300;

/// Severity of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    /// The pipeline cannot start.
    Error,
    /// The pipeline works, but perhaps not as intended.
    Warning,
}

/// One fault.
#[derive(Clone, Debug)]
pub struct Diagnostic {
    /// Its severity.
    pub severity: Severity,
    pub(crate) place: SourceSpan,
    pub(crate) what: String,
    pub(crate) hint: String,
}

impl Diagnostic {
    pub(crate) fn error(place: &SourceSpan, what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { severity: Severity::Error, place: place.clone(), what: what.into(), hint: hint.into() }
    }

    pub(crate) fn warning(place: &SourceSpan, what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { severity: Severity::Warning, ..Self::error(place, what, hint) }
    }

    fn is_error(&self) -> bool {
        self.severity == Severity::Error
    }
}

impl Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (line, column, text) = self.place.position();
        let severity = if self.is_error() { "error" } else { "warning" };
        let length = self.place.source.text.get(self.place.span.clone()).map_or(1, |piece| {
            let first_line = piece.lines().next().unwrap_or("");
            first_line.chars().count().max(1)
        });
        writeln!(f, "{severity}: {}:{line}:{column}: {}", plain(&self.place.source.name), plain(&self.what))?;
        // Of a very long line only the part around the fault is shown. A control character is replaced, so that it is seen.
        let first = (column - 1).saturating_sub(WIDEST_LINE / 2);
        let shown = |letter| if is_harmless(letter) { letter } else { char::REPLACEMENT_CHARACTER };
        let text: String = text.chars().skip(first).take(WIDEST_LINE).map(shown).collect();
        writeln!(f, "{}", format!("{line:>5} | {text}").trim_end())?;
        let blank = |letter| if letter == '\t' { '\t' } else { ' ' };
        let before: String = text.chars().take(column - 1 - first).map(blank).collect();
        write!(f, "      | {before}{}", "^".repeat(length.min(WIDEST_LINE / 2)))?;
        if self.hint.is_empty() { Ok(()) } else { write!(f, "\n  hint: {}", plain(&self.hint)) }
    }
}

/// All faults of a pipeline file, in the order of its lines.
#[derive(Clone, Debug, Default)]
pub struct Report(pub Vec<Diagnostic>);

impl Report {
    /// Sorts faults by position. Warnings are dropped if there are errors, of which they may be consequences.
    pub(crate) fn in_order(mut found: Vec<Diagnostic>) -> Self {
        let errors = found.iter().any(Diagnostic::is_error);
        found.retain(|diagnostic| diagnostic.is_error() || !errors);
        found.sort_by_key(|diagnostic| diagnostic.place.span.start);
        Self(found)
    }

    /// Whether the pipeline cannot start.
    pub fn has_errors(&self) -> bool {
        self.0.iter().any(Diagnostic::is_error)
    }
}

impl Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, diagnostic) in self.0.iter().enumerate() {
            write!(f, "{}{diagnostic}", if index == 0 { "" } else { "\n\n" })?;
        }
        Ok(())
    }
}

impl std::error::Error for Report {}

/// The candidate that a misspelt word most likely means.
pub(crate) fn closest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let scored = candidates.into_iter().map(|candidate| (strsim::damerau_levenshtein(word, candidate), candidate));
    let best = scored.min_by_key(|(distance, _)| *distance)?;
    (best.0 <= 1 + word.chars().count() / 3).then_some(best.1)
}

/// "did you mean `x`?", or else a list of the candidates.
pub fn suggestion<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str> + Clone, plural: &str) -> String {
    match closest(word, candidates.clone()) {
        Some(candidate) => format!("did you mean `{candidate}`?"),
        None => {
            let names: Vec<_> = candidates.into_iter().map(|name| format!("`{name}`")).collect();
            if names.is_empty() { format!("there are no {plural}") } else { format!("{plural}: {}", names.join(", ")) }
        }
    }
}
