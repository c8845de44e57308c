//! The attachment of each message of `rmw_zenoh_cpp`: the message's number, its time, and its publisher. A ROS 2 node crashes on
//! a message without it.
//!
//! It has 33 bytes: two little-endian 64-bit integers, the length 16, and the publisher's id. In Jazzy's versions 0.2.0 to 0.2.3
//! each field is preceded by its name, with the name's length.

const NAMES: [&[u8]; 3] = [b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid"];
const END_BYTES: usize = 16;

/// The attachment of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Attachment {
    /// Number of the message, from 1.
    pub sequence: i64,
    /// When it was sent, in nanoseconds since the Unix epoch.
    pub sent_ns: i64,
    /// The unique id of the publisher.
    pub end: [u8; END_BYTES],
}

impl Attachment {
    pub(super) fn to_bytes(self) -> Vec<u8> {
        let numbers = [self.sequence, self.sent_ns].map(i64::to_le_bytes);
        [numbers.as_flattened(), &[END_BYTES as u8], &self.end].concat()
    }

    /// Decodes either form; returns `None` if it is neither.
    pub(super) fn read(bytes: &[u8]) -> Option<Self> {
        let is_named = bytes.starts_with(NAMES[0]);
        let name = |bytes: &mut &[u8], name| {
            *bytes = if is_named { bytes.strip_prefix(name)? } else { bytes };
            Some(())
        };
        let number = |bytes: &mut &[u8]| {
            let (number, rest) = bytes.split_first_chunk()?;
            *bytes = rest;
            Some(i64::from_le_bytes(*number))
        };
        let rest = &mut { bytes };
        name(rest, NAMES[0])?;
        let sequence = number(rest)?;
        name(rest, NAMES[1])?;
        let sent_ns = number(rest)?;
        name(rest, NAMES[2])?;
        let (&length, end) = rest.split_first()?;
        let end = end.try_into().ok().filter(|_| usize::from(length) == END_BYTES)?;
        Some(Self { sequence, sent_ns, end })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ATTACHMENT: Attachment = Attachment { sequence: 2, sent_ns: 0x0102_0304, end: [9; 16] };

    #[test]
    fn an_attachment_has_33_bytes() {
        let bytes = ATTACHMENT.to_bytes();
        let expected = [&[2, 0, 0, 0, 0, 0, 0, 0, 4, 3, 2, 1, 0, 0, 0, 0, 16][..], &[9; 16]].concat();
        assert_eq!((bytes.len(), &bytes), (33, &expected));
        assert_eq!(Attachment::read(&bytes), Some(ATTACHMENT));
    }

    #[test]
    fn an_attachment_of_jazzy_has_77_bytes_with_names() {
        let bytes = ATTACHMENT.to_bytes();
        let named = [NAMES[0], &bytes[..8], NAMES[1], &bytes[8..16], NAMES[2], &bytes[16..]].concat();
        assert_eq!(named.len(), 77);
        assert_eq!(Attachment::read(&named), Some(ATTACHMENT));
    }

    #[test]
    fn bytes_that_are_no_attachment_are_refused() {
        let bytes = ATTACHMENT.to_bytes();
        for length in [0, 1, 16, 17, 32] {
            assert_eq!(Attachment::read(&bytes[..length]), None, "{length} bytes");
        }
        assert_eq!(Attachment::read(&[&bytes[..], &[0]].concat()), None, "a byte more");
        assert_eq!(Attachment::read(&[&bytes[..16], &[15], &bytes[17..]].concat()), None);
        assert_eq!(Attachment::read(NAMES[0]), None);
    }
}
