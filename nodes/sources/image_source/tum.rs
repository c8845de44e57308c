//! The list of depth frames of a TUM RGB-D folder: `depth.txt`, a time stamp in seconds and a relative name per line.
//!
//! Format: <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>.

use super::faulty::excerpt;
use anyhow::{Context as _, Result, ensure};

/// Name of the list.
pub(super) const LIST: &str = "depth.txt";

/// Largest text file that is read: ten times the list of a day at 30 Hz.
pub(super) const MAX_BYTES: u64 = 1 << 30;
/// Metres per unit of a depth pixel.
pub(super) const DEPTH_SCALE: f64 = 1.0 / 5000.0;

/// Hint of the errors: the expected format of the list.
pub(super) const HINT: &str = "one line for each frame, such as `1305031102.160407 depth/1305031102.160407.png`";

/// One line of the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry<'a> {
    pub(super) stamp_ns: u64,
    /// File name, relative to the list's folder.
    pub(super) name: &'a str,
}

/// Reads the entries in their order.
///
/// # Errors
/// A line is no entry (the error gives its number), or the list is empty.
pub(super) fn parse(text: &str) -> Result<Vec<Entry<'_>>> {
    let entry = |(number, line)| entry(line).with_context(|| line_fault(number, line));
    let entries: Vec<_> = lines(text).map(entry).collect::<Result<_>>()?;
    ensure!(!entries.is_empty(), "the list names no frames");
    Ok(entries)
}

/// Returns the lines that are neither empty nor comments, with their numbers.
pub(super) fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let lines = (1..).zip(text.lines().map(str::trim));
    lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn line_fault(number: usize, line: &str) -> String {
    format!("line {number}, `{}`: expected a time stamp in seconds and a file name", excerpt(line))
}

fn entry(line: &str) -> Result<Entry<'_>> {
    let (stamp, name) = line.split_once(char::is_whitespace).context("there is no file name")?;
    let stamp_ns = nanoseconds(stamp).with_context(|| format!("`{stamp}` is no number of seconds"))?;
    Ok(Entry { stamp_ns, name: name.trim() })
}

/// Converts decimal seconds to nanoseconds, without rounding to a double; digits beyond the ninth are dropped.
pub(super) fn nanoseconds(text: &str) -> Option<u64> {
    let (seconds, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = fraction.get(..fraction.len().min(9))?;
    let all_digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    if !all_digits(seconds) || !all_digits(fraction) {
        return None;
    }
    let nanoseconds: u64 = format!("{digits:0<9}").parse().ok()?;
    seconds.parse::<u64>().ok()?.checked_mul(1_000_000_000)?.checked_add(nanoseconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_exact() {
        let text = "# depth maps\n# timestamp filename\n1305031102.160407 depth/1305031102.160407.png\r\n\n\
                    1305031103 depth/b.png\n";
        let entries = parse(text).unwrap();
        let first = Entry { stamp_ns: 1_305_031_102_160_407_000, name: "depth/1305031102.160407.png" };
        assert_eq!(entries, [first, Entry { stamp_ns: 1_305_031_103_000_000_000, name: "depth/b.png" }]);
    }

    #[test]
    fn faults_are_reported_with_their_line() {
        let error = |text: &str| format!("{:#}", parse(text).unwrap_err());
        let expected = "expected a time stamp in seconds and a file name";
        assert_eq!(error("1.0 a\n1.5"), format!("line 2, `1.5`: {expected}: there is no file name"));
        assert_eq!(error("#\nx1 a"), format!("line 2, `x1 a`: {expected}: `x1` is no number of seconds"));
        assert_eq!(error("-1 a"), format!("line 1, `-1 a`: {expected}: `-1` is no number of seconds"));
        assert_eq!(error("99999999999999 a").split(": ").last(), Some("`99999999999999` is no number of seconds"));
        assert_eq!(error("# nothing\n"), "the list names no frames");
    }
}
