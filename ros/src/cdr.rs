//! Common data representation (CDR) as ROS 2 uses it: a header of four bytes with the byte order, then numbers aligned to their
//! size, text with its length and a zero byte, lists with their length.
//!
//! Source: OMG DDSI-RTPS 2.3, section 10 (encapsulation), and CORBA 3.0, chapter 15.3 (CDR).

/// Length of the encapsulation header; alignment counts from its end.
const HEADER_BYTES: usize = 4;
const NANOSECONDS: u64 = 1_000_000_000;

/// Reason why bytes are no message of the expected type, or one that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}{}", .hint.as_ref().map(|hint| format!("\n  hint: {hint}")).unwrap_or_default())]
pub struct Undecodable {
    /// What is wrong.
    pub what: String,
    /// What to do about it, where that is known.
    pub hint: Option<String>,
}

impl Undecodable {
    /// A fault without a hint.
    pub(crate) fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), hint: None }
    }

    /// A fault with a hint.
    pub(crate) fn hinted(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { hint: Some(hint.into()), ..Self::new(what) }
    }
}

/// Decodes the values of a message one by one.
#[derive(Clone, Debug)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    is_big_endian: bool,
}

/// The header of most messages: a time and a coordinate frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamped<'a> {
    /// Nanoseconds since the Unix epoch, or since the clock started.
    pub stamp_ns: u64,
    /// Name of the coordinate frame.
    pub frame_id: &'a str,
}

impl<'a> Reader<'a> {
    /// Starts to read a message.
    ///
    /// # Errors
    /// The message does not begin as one in plain CDR.
    pub fn new(message: &'a [u8]) -> Result<Self, Undecodable> {
        let is_big_endian = match message {
            [0, 0, _, _, ..] => true,
            [0, 1, _, _, ..] => false,
            [kind @ .., _, _] if kind.len() >= 2 => {
                return Err(Undecodable::new(format!(
                    "encapsulation {:#04x} {:#04x}, expected plain CDR (0x00 0x00 or 0x00 0x01)",
                    kind[0], kind[1]
                )));
            }
            _ => return Err(Undecodable::new(format!("{} bytes, which is no message", message.len()))),
        };
        Ok(Self { bytes: &message[HEADER_BYTES..], at: 0, is_big_endian })
    }

    /// Reads the next `N` bytes, aligned to `N`.
    fn number<const N: usize>(&mut self) -> Result<[u8; N], Undecodable> {
        self.at = self.at.next_multiple_of(N);
        let mut number = [0; N];
        number.copy_from_slice(self.take(N)?);
        if self.is_big_endian {
            number.reverse();
        }
        Ok(number)
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], Undecodable> {
        let end = self.at.checked_add(length).filter(|end| *end <= self.bytes.len());
        let Some(end) = end else {
            return Err(Undecodable::new(format!(
                "the message ends after {} bytes, expected {length} more from byte {}",
                self.bytes.len() + HEADER_BYTES,
                self.at + HEADER_BYTES
            )));
        };
        let taken = &self.bytes[self.at..end];
        self.at = end;
        Ok(taken)
    }

    /// Reads a byte.
    ///
    /// # Errors
    /// The message is too short.
    pub fn u8(&mut self) -> Result<u8, Undecodable> {
        Ok(self.number::<1>()?[0])
    }

    /// Reads a number of four bytes.
    ///
    /// # Errors
    /// The message is too short.
    pub fn u32(&mut self) -> Result<u32, Undecodable> {
        Ok(u32::from_le_bytes(self.number()?))
    }

    /// Reads a signed number of four bytes.
    ///
    /// # Errors
    /// The message is too short.
    pub fn i32(&mut self) -> Result<i32, Undecodable> {
        Ok(i32::from_le_bytes(self.number()?))
    }

    /// Reads a number of eight bytes.
    ///
    /// # Errors
    /// The message is too short.
    pub fn f64(&mut self) -> Result<f64, Undecodable> {
        Ok(f64::from_le_bytes(self.number()?))
    }

    /// Reads several numbers.
    ///
    /// # Errors
    /// The message is too short.
    pub fn f64s<const N: usize>(&mut self) -> Result<[f64; N], Undecodable> {
        let mut numbers = [0.0; N];
        numbers.iter_mut().try_for_each(|number| self.f64().map(|read| *number = read))?;
        Ok(numbers)
    }

    /// Reads bytes that are preceded by their number.
    ///
    /// # Errors
    /// The message is too short.
    pub fn bytes(&mut self) -> Result<&'a [u8], Undecodable> {
        let length = self.u32()?;
        self.take(length as usize)
    }

    /// Reads text that is preceded by its length.
    ///
    /// # Errors
    /// The message is too short, or the text is not UTF-8.
    pub fn text(&mut self) -> Result<&'a str, Undecodable> {
        let bytes = self.bytes()?;
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        std::str::from_utf8(text).map_err(|_| Undecodable::new("a text that is not UTF-8".to_owned()))
    }

    /// Reads a time, in nanoseconds.
    ///
    /// # Errors
    /// The message is too short, or the time is before its epoch.
    pub fn stamp_ns(&mut self) -> Result<u64, Undecodable> {
        let (seconds, nanoseconds) = (self.i32()?, self.u32()?);
        let seconds = u64::try_from(seconds);
        let seconds = seconds.map_err(|_| Undecodable::new("a time stamp before the year 1970".to_owned()))?;
        Ok(seconds * NANOSECONDS + u64::from(nanoseconds))
    }

    /// Reads the header of a message.
    ///
    /// # Errors
    /// The message is too short, or its header is faulty.
    pub fn stamped(&mut self) -> Result<Stamped<'a>, Undecodable> {
        Ok(Stamped { stamp_ns: self.stamp_ns()?, frame_id: self.text()? })
    }
}

/// Encodes the values of a message one by one, in little-endian order.
#[derive(Clone, Debug)]
pub struct Writer(Vec<u8>);

impl Writer {
    /// Starts a message in reused memory.
    pub fn new(mut memory: Vec<u8>) -> Self {
        memory.clear();
        memory.extend([0, 1, 0, 0]);
        Self(memory)
    }

    /// Returns the message.
    pub fn finish(self) -> Vec<u8> {
        self.0
    }

    fn number<const N: usize>(&mut self, number: [u8; N]) -> &mut Self {
        let end = (self.0.len() - HEADER_BYTES).next_multiple_of(N) + HEADER_BYTES;
        self.0.resize(end, 0);
        self.0.extend(number);
        self
    }

    /// Writes a byte.
    pub fn u8(&mut self, number: u8) -> &mut Self {
        self.number([number])
    }

    /// Writes a number of four bytes.
    pub fn u32(&mut self, number: u32) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    /// Writes a signed number of four bytes.
    pub fn i32(&mut self, number: i32) -> &mut Self {
        self.number(number.to_le_bytes())
    }

    /// Writes numbers of four bytes.
    pub fn f32s(&mut self, numbers: &[f32]) -> &mut Self {
        numbers.iter().fold(self, |writer, number| writer.number(number.to_le_bytes()))
    }

    /// Writes numbers of eight bytes.
    pub fn f64s(&mut self, numbers: &[f64]) -> &mut Self {
        numbers.iter().fold(self, |writer, number| writer.number(number.to_le_bytes()))
    }

    /// Writes numbers of `size` bytes each, given in this machine's byte order.
    pub fn numbers(&mut self, size: usize, bytes: &[u8]) -> &mut Self {
        let end = (self.0.len() - HEADER_BYTES).next_multiple_of(size) + HEADER_BYTES;
        self.0.resize(end, 0);
        self.0.extend(bytes);
        if cfg!(target_endian = "big") {
            self.0[end..].chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
        self
    }

    /// Writes bytes, preceded by their number.
    pub fn bytes(&mut self, length: usize, bytes: impl Iterator<Item = u8>) -> &mut Self {
        self.length(length);
        self.0.extend(bytes);
        self
    }

    /// Writes the number of items of a list, which follow.
    pub fn length(&mut self, length: usize) -> &mut Self {
        // No list is longer: an image has 2^26 pixels at most.
        self.u32(u32::try_from(length).unwrap_or(u32::MAX))
    }

    /// Writes text, preceded by its length.
    pub fn text(&mut self, text: &str) -> &mut Self {
        self.length(text.len() + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
        self
    }

    /// Writes a time. ROS 2 has seconds of 32 bits: times after 2038 become the last one.
    pub fn stamp_ns(&mut self, stamp_ns: u64) -> &mut Self {
        let seconds = i32::try_from(stamp_ns / NANOSECONDS).unwrap_or(i32::MAX);
        self.i32(seconds).u32((stamp_ns % NANOSECONDS) as u32)
    }

    /// Writes the header of a message.
    pub fn stamped(&mut self, stamped: Stamped<'_>) -> &mut Self {
        self.stamp_ns(stamped.stamp_ns).text(stamped.frame_id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_values_are_read_in_both_byte_orders() {
        let mut writer = Writer::new(vec![7; 3]);
        writer.stamped(Stamped { stamp_ns: 5_000_000_006, frame_id: "camera" }).u8(9).f64s(&[1.5]).u32(3).i32(-2);
        writer.bytes(3, [1, 2, 3].into_iter()).text("");
        let little = writer.finish();
        // The same values, encoded by hand in big-endian order.
        let mut big = vec![0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 6, 0, 0, 0, 7];
        big.extend(b"camera\0\x09\0\0\0\0");
        big.extend(1.5_f64.to_be_bytes());
        big.extend([0, 0, 0, 3, 0xff, 0xff, 0xff, 0xfe, 0, 0, 0, 3, 1, 2, 3, 0, 0, 0, 0, 1, 0]);
        for message in [little, big] {
            let mut reader = Reader::new(&message).unwrap();
            assert_eq!(reader.stamped().unwrap(), Stamped { stamp_ns: 5_000_000_006, frame_id: "camera" });
            assert_eq!((reader.u8().unwrap(), reader.f64().unwrap()), (9, 1.5));
            assert_eq!((reader.u32().unwrap(), reader.i32().unwrap()), (3, -2));
            assert_eq!((reader.bytes().unwrap(), reader.text().unwrap()), (&[1, 2, 3][..], ""));
            assert!(reader.u8().is_err());
        }
    }

    #[test]
    fn impossible_lengths_are_refused() {
        let error = |message: &[u8]| {
            Reader::new(message).and_then(|mut reader| reader.text().map(str::to_owned)).unwrap_err().to_string()
        };
        assert_eq!(error(&[0, 1]), "2 bytes, which is no message");
        assert_eq!(error(&[0, 7, 0, 0, 1]), "encapsulation 0x00 0x07, expected plain CDR (0x00 0x00 or 0x00 0x01)");
        assert_eq!(
            error(&[0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff]),
            "the message ends after 8 bytes, expected 4294967295 more from byte 8"
        );
        assert_eq!(error(&[0, 1, 0, 0, 2, 0, 0, 0, 0xff, 0]), "a text that is not UTF-8");
    }
}
