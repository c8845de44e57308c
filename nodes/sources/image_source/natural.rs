//! Natural order of file names: runs of digits compare as numbers, so that `img2` comes before `img10`.

use std::cmp::Ordering;

/// Orders two names; numbers of any length are compared without overflow, and equal numbers by their leading zeros.
pub(crate) fn compare(left: &str, right: &str) -> Ordering {
    let (mut a, mut b) = (left.as_bytes(), right.as_bytes());
    while !a.is_empty() && !b.is_empty() {
        let (head_a, rest_a) = split_run(a);
        let (head_b, rest_b) = split_run(b);
        match compare_runs(head_a, head_b) {
            Ordering::Equal => (a, b) = (rest_a, rest_b),
            decided => return decided,
        }
    }
    a.len().cmp(&b.len()).then_with(|| left.cmp(right))
}

/// The leading run of digits, or of anything else, and what follows it.
fn split_run(bytes: &[u8]) -> (&[u8], &[u8]) {
    let digits = bytes.first().is_some_and(u8::is_ascii_digit);
    let length = bytes.iter().position(|byte| byte.is_ascii_digit() != digits).unwrap_or(bytes.len());
    bytes.split_at(length)
}

fn compare_runs(a: &[u8], b: &[u8]) -> Ordering {
    let number = |run: &[u8]| run.first().is_some_and(u8::is_ascii_digit);
    if !(number(a) && number(b)) {
        return a.cmp(b);
    }
    let (a, b) = (significant(a), significant(b));
    a.len().cmp(&b.len()).then_with(|| a.cmp(b))
}

fn significant(digits: &[u8]) -> &[u8] {
    let zeros = digits.iter().take_while(|&&digit| digit == b'0').count();
    &digits[zeros..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_as_numbers() {
        let sorted = ["a", "img1.png", "img02.depth.png", "img2.png", "img010.png", "img10.png", "jmg1.png"];
        let mut names = sorted;
        names.reverse();
        names.sort_by(|a, b| compare(a, b));
        assert_eq!(names, sorted);
    }

    #[test]
    fn long_numbers_do_not_overflow_and_equal_names_are_equal() {
        let (short, long) = ("f99999999999999999999999999999", "f100000000000000000000000000000");
        assert_eq!(compare(short, long), Ordering::Less);
        assert_eq!(compare(long, short), Ordering::Greater);
        assert_eq!(compare(long, long), Ordering::Equal);
        assert_eq!(compare("f1", "f1b"), Ordering::Less);
    }
}
