//! Safe text for a terminal or a log. Text from outside, such as a file name, must not control a terminal, look like a separate
//! line, or fill a screen; so all errors and logs pass through here.

use std::fmt::Write;

/// A line that is longer than this, in characters, is shortened to its beginning and its end. None of our own lines is that long.
const LONGEST_LINE: usize = 1000;
/// Length of the end of a shortened line, in characters: the end says what is wrong.
const END: usize = 300;
/// Separates the lines of one message.
const FURTHER_LINE: &str = "\n  ";

/// Makes a text safe to print: escapes control characters and shortens long lines. A line feed stays if spaces follow, which show
/// that the message goes on.
pub fn plain(text: &str) -> String {
    let mut shown = String::with_capacity(text.len().min(2 * LONGEST_LINE));
    for (index, line) in text.split(FURTHER_LINE).enumerate() {
        shown.push_str(if index > 0 { FURTHER_LINE } else { "" });
        push_line(&mut shown, line);
    }
    shown
}

fn push_line(shown: &mut String, line: &str) {
    let is_long = line.char_indices().nth(LONGEST_LINE).is_some();
    let beginning_ends = line.char_indices().nth(LONGEST_LINE - END).filter(|_| is_long);
    let Some((beginning_ends, _)) = beginning_ends else { return push_written_out(shown, line) };
    let end_begins = line.char_indices().rev().nth(END - 1).map_or(line.len(), |(index, _)| index);
    push_written_out(shown, &line[..beginning_ends]);
    // Writing to a string cannot fail.
    write!(shown, " [{} bytes left out] ", end_begins - beginning_ends).ok();
    push_written_out(shown, &line[end_begins..]);
}

fn push_written_out(shown: &mut String, text: &str) {
    for letter in text.chars() {
        if is_harmless(letter) { shown.push(letter) } else { shown.extend(letter.escape_default()) }
    }
}

/// Whether a terminal prints a letter without side effects on its state or on the order of letters.
pub fn is_harmless(letter: char) -> bool {
    let turns = matches!(letter, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{2028}' | '\u{2029}');
    letter == '\t' || !(letter.is_control() || turns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_text_neither_controls_a_terminal_nor_adds_a_line() {
        assert_eq!(plain("a\u{1b}[2Jb\r\u{9b}c\u{7f}"), "a\\u{1b}[2Jb\\r\\u{9b}c\\u{7f}");
        assert_eq!(plain("`a\nERROR forged`: b\n  hint: c"), "`a\\nERROR forged`: b\n  hint: c");
        assert_eq!(plain("`gnp.\u{202e}a`"), "`gnp.\\u{202e}a`");
        assert_eq!(plain("Größe\t3 µm"), "Größe\t3 µm");
    }

    #[test]
    fn a_long_line_is_shortened_in_its_middle_and_later_lines_are_whole() {
        let shown = plain(&format!("file `{}` is wrong\n  hint: mend it", "ö".repeat(20_000_000)));
        let (line, hint) = shown.split_once('\n').unwrap();
        assert!(line.chars().count() < LONGEST_LINE + 50, "{}", line.len());
        assert!(line.starts_with("file `öö") && line.ends_with("ö` is wrong"), "{line}");
        assert!(line.contains(" bytes left out] "), "{line}");
        assert_eq!(hint, "  hint: mend it");
        let just = "a".repeat(LONGEST_LINE);
        assert_eq!(plain(&just), just);
        let (beginning, end) = ("a".repeat(LONGEST_LINE - END), "b".repeat(END));
        assert_eq!(plain(&format!("{beginning}five!{end}")), format!("{beginning} [5 bytes left out] {end}"));
    }
}
