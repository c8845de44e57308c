//! Short text of fixed size, as shared memory needs it: UTF-8, padded with zero bytes, no pointer.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de, ser};
use std::fmt;

/// UTF-8 text of at most `N` bytes; longer text is cut at a character boundary.
#[repr(transparent)]
#[derive(Clone, Copy, Pod, Zeroable, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Text<const N: usize>([u8; N]);

impl<const N: usize> Text<N> {
    /// The text, cut to `N` bytes.
    pub fn new(text: &str) -> Self {
        let mut bytes = [0; N];
        let length = text.floor_char_boundary(N);
        bytes[..length].copy_from_slice(&text.as_bytes()[..length]);
        Self(bytes)
    }

    /// The text up to the first zero byte; `None` if these bytes are not UTF-8.
    pub fn as_str(&self) -> Option<&str> {
        let length = self.0.iter().position(|&byte| byte == 0).unwrap_or(N);
        std::str::from_utf8(&self.0[..length]).ok()
    }
}

impl<const N: usize> Serialize for Text<N> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str().ok_or_else(|| ser::Error::custom("bytes that are not UTF-8"))?)
    }
}

impl<'de, const N: usize> Deserialize<'de> for Text<N> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = <&str>::deserialize(deserializer)?;
        if text.len() > N || text.contains('\0') {
            return Err(de::Error::custom(format_args!("a text of more than {N} bytes, or with a zero byte")));
        }
        Ok(Self::new(text))
    }
}

impl<const N: usize> Default for Text<N> {
    fn default() -> Self {
        Self([0; N])
    }
}

impl<const N: usize> fmt::Display for Text<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str().unwrap_or("(not text)"))
    }
}

impl<const N: usize> fmt::Debug for Text<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str().unwrap_or("(not text)"), f)
    }
}

#[cfg(test)]
mod tests {
    use super::Text;

    #[test]
    fn long_text_is_cut_at_a_character() {
        assert_eq!(Text::<4>::new("abcdef").as_str(), Some("abcd"));
        assert_eq!(Text::<4>::new("abcö").as_str(), Some("abc"));
        assert_eq!(Text::<4>::new("").as_str(), Some(""));
    }

    #[test]
    fn bytes_that_are_no_text_are_shown_as_such() {
        let text: Text<2> = bytemuck::cast([0xff_u8, 0xfe]);
        assert_eq!(text.as_str(), None);
        assert_eq!([format!("{text}"), format!("{text:?}")], ["(not text)", "\"(not text)\""]);
        let text = Text::<4>::new("a\n");
        assert_eq!([format!("{text}"), format!("{text:?}")], ["a\n", "\"a\\n\""]);
    }

    #[test]
    fn a_text_that_does_not_fit_is_not_read_from_json() {
        let read = |json: &str| serde_json::from_str::<Text<4>>(json).ok();
        assert_eq!((read(r#""abc""#), read(r#""abcd""#)), (Some(Text::new("abc")), Some(Text::new("abcd"))));
        assert_eq!((read(r#""abcde""#), read(r#""abcdef""#)), (None, None));
    }
}
