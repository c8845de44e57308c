//! NPY, the format of NumPy's arrays: a header that is written like a Python dictionary, followed by the numbers.
//!
//! It has its own reader because a header may claim any shape, and the crates for it multiply the lengths unchecked.
//!
//! Source: NumPy's `numpy/lib/format.py`, versions 1 to 3.

use anyhow::{Context as _, Result, ensure};
use std::io::Read;

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header; NumPy itself refuses longer ones by default.
const MOST_BYTES: u64 = 10_000;

/// The description of an array.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Array {
    /// Type of its numbers, such as `<u2`.
    pub(super) number: String,
    /// Whether it is stored column by column.
    pub(super) is_by_columns: bool,
    /// Length of each axis.
    pub(super) shape: Vec<u64>,
}

impl Array {
    /// Reads the header, up to the first number.
    ///
    /// # Errors
    /// There is no header of an array of numbers.
    pub(super) fn read(file: &mut impl Read) -> Result<Self> {
        let mut begin = [0; 8];
        file.read_exact(&mut begin)?;
        ensure!(begin.starts_with(MAGIC), "it does not begin as one");
        let length = if begin[6] == 1 {
            let mut length = [0; 2];
            file.read_exact(&mut length)?;
            u64::from(u16::from_le_bytes(length))
        } else {
            let mut length = [0; 4];
            file.read_exact(&mut length)?;
            u64::from(u32::from_le_bytes(length))
        };
        ensure!(length <= MOST_BYTES, "it has {length} bytes, expected at most {MOST_BYTES}");
        let mut text = String::new();
        file.take(length).read_to_string(&mut text)?;
        ensure!(text.len() as u64 == length, "it ends after {} of {length} bytes", text.len());
        Self::of(&text).with_context(|| format!("it is `{}`", text.trim_end()))
    }

    /// Parses the text of a header, if it describes an array of numbers.
    fn of(text: &str) -> Option<Self> {
        let value = |key: &str| Some(text.split_once(&format!("'{key}':"))?.1.trim_start());
        let (number, _) = value("descr")?.strip_prefix('\'')?.split_once('\'')?;
        let order = value("fortran_order")?;
        let is_by_columns = order.starts_with("True");
        let (shape, _) = value("shape")?.strip_prefix('(')?.split_once(')')?;
        let lengths = shape.split(',').map(str::trim).filter(|length| !length.is_empty());
        let shape = lengths.map(|length| length.parse().ok()).collect::<Option<_>>()?;
        (is_by_columns || order.starts_with("False")).then(|| Self { number: number.to_owned(), is_by_columns, shape })
    }

    /// Returns all numbers after the header, each of `N` bytes in the byte order of the header; incomplete ones at the end are
    /// left out.
    pub(super) fn numbers<T, const N: usize>(&self, bytes: &[u8], of: fn([u8; N]) -> T) -> Vec<T> {
        let is_big_endian =
            self.number.starts_with('>') || cfg!(target_endian = "big") && !self.number.starts_with('<');
        let turned = |mut number: [u8; N]| {
            if is_big_endian {
                number.reverse();
            }
            of(number)
        };
        bytes.as_chunks().0.iter().copied().map(turned).collect()
    }
}
