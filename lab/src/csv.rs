//! Cells of CSV as RFC 4180 has them: one with a comma, a quote or a line's end stands in quotes.

use std::borrow::Cow;
use std::mem::take;

/// A text as a cell.
pub fn cell(text: &str) -> Cow<'_, str> {
    if text.contains([',', '"', '\n', '\r']) {
        Cow::Owned(format!("\"{}\"", text.replace('"', "\"\"")))
    } else {
        Cow::Borrowed(text)
    }
}

/// The records of a file, cell by cell.
pub fn records(text: &str) -> Vec<Vec<String>> {
    let (mut records, mut record, mut cell, mut quoted) = (Vec::new(), Vec::new(), String::new(), false);
    let mut signs = text.chars().peekable();
    while let Some(sign) = signs.next() {
        match sign {
            '"' if quoted && signs.next_if_eq(&'"').is_some() => cell.push('"'),
            '"' => quoted = !quoted,
            ',' if !quoted => record.push(take(&mut cell)),
            '\n' if !quoted => {
                record.push(take(&mut cell));
                records.push(take(&mut record));
            }
            '\r' if !quoted => {}
            _ => cell.push(sign),
        }
    }
    if !(record.is_empty() && cell.is_empty()) {
        record.push(cell);
        records.push(record);
    }
    records
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_needs_quotes_has_them() {
        assert_eq!(["", "trash can", "a,b", "12\" ball"].map(cell), ["", "trash can", "\"a,b\"", "\"12\"\" ball\""]);
    }

    #[test]
    fn what_was_written_is_read_again() {
        let rows = [["time_s", "object"], ["", "ball, red"], ["\"", "two\r\nlines"], ["1", ""]];
        let text: String = rows.map(|[a, b]| format!("{},{}\n", cell(a), cell(b))).concat();
        assert_eq!(records(&text), rows);
        assert_eq!(records("a,b\r\n1,2"), [["a", "b"], ["1", "2"]], "the last line may have no end");
        assert!(records("").is_empty());
    }
}
