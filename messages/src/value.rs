//! The fields of an item, as names and values, from which its JSON and its ROS 2 message are derived.

use crate::Item;
use bytemuck::{bytes_of, pod_read_unaligned};
use serde::{Serialize, Serializer};
use std::borrow::Cow;

/// Marks a number that this item lacks, though others of its type have it. JSON omits it.
pub const ABSENT: f64 = f64::NAN;

/// The type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    /// Unsigned, 8 bits.
    U8,
    /// Unsigned, 16 bits.
    U16,
    /// Unsigned, 32 bits.
    U32,
    /// Unsigned, 64 bits.
    U64,
    /// Signed, 8 bits.
    I8,
    /// Signed, 16 bits.
    I16,
    /// Signed, 32 bits.
    I32,
    /// Signed, 64 bits.
    I64,
    /// Single precision.
    F32,
    /// Double precision.
    F64,
}

impl Element {
    /// All number types, with their names and their sizes in bytes.
    pub const ALL: [(&'static str, Self, usize); 10] = [
        ("u8", Self::U8, 1),
        ("u16", Self::U16, 2),
        ("u32", Self::U32, 4),
        ("u64", Self::U64, 8),
        ("i8", Self::I8, 1),
        ("i16", Self::I16, 2),
        ("i32", Self::I32, 4),
        ("i64", Self::I64, 8),
        ("f32", Self::F32, 4),
        ("f64", Self::F64, 8),
    ];

    /// The size in bytes.
    pub fn size(self) -> usize {
        Self::ALL[self as usize].2
    }
}

/// The value of a field.
#[derive(Clone, Debug, PartialEq)]
pub enum Value<'a> {
    /// A text.
    Text(&'a str),
    /// A number, or an array of numbers, as in memory.
    Numbers {
        /// The type of the numbers.
        element: Element,
        /// Whether it is an array, which may have a single number.
        is_list: bool,
        /// The numbers.
        bytes: Cow<'a, [u8]>,
    },
    /// Nested fields.
    Below(Fields<'a>),
}

/// Names and values in order; the names are the same for all items of a type.
#[derive(Clone, Debug, PartialEq)]
pub struct Fields<'a>(pub Vec<(&'a str, Value<'a>)>);

/// An item that can list its fields.
pub trait Named: Item {
    /// Returns the fields.
    fn fields(&self) -> Fields<'static>;
}

macro_rules! from_numbers {
    ($($number:ty => $element:ident),*) => {$(
        impl From<$number> for Value<'_> {
            fn from(number: $number) -> Self {
                Self::Numbers { element: Element::$element, is_list: false, bytes: bytes_of(&number).to_vec().into() }
            }
        }
    )*};
}

from_numbers!(u32 => U32, u64 => U64, f32 => F32, f64 => F64);

impl<const N: usize> From<[f64; N]> for Value<'_> {
    fn from(vector: [f64; N]) -> Self {
        Self::Numbers { element: Element::F64, is_list: true, bytes: bytes_of(&vector).to_vec().into() }
    }
}

impl<'a> From<&'a str> for Value<'a> {
    fn from(text: &'a str) -> Self {
        Self::Text(text)
    }
}

impl Value<'_> {
    fn is_absent(&self) -> bool {
        match self {
            Self::Numbers { element: Element::F32, bytes, .. } => pod_read_unaligned::<f32>(&bytes[..4]).is_nan(),
            Self::Numbers { element: Element::F64, bytes, .. } => pod_read_unaligned::<f64>(&bytes[..8]).is_nan(),
            _ => false,
        }
    }
}

impl Serialize for Fields<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().filter(|(_, value)| !value.is_absent()).map(|(name, value)| (name, value)))
    }
}

impl Serialize for Value<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Text(text) => serializer.serialize_str(text),
            Self::Below(fields) => fields.serialize(serializer),
            Self::Numbers { element, is_list: false, bytes } => Number(*element, bytes).serialize(serializer),
            Self::Numbers { element, is_list: true, bytes } => {
                serializer.collect_seq(bytes.chunks_exact(element.size()).map(|number| Number(*element, number)))
            }
        }
    }
}

struct Number<'a>(Element, &'a [u8]);

impl Serialize for Number<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let bytes = self.1;
        match self.0 {
            Element::U8 => serializer.serialize_u8(bytes[0]),
            Element::U16 => serializer.serialize_u16(pod_read_unaligned(bytes)),
            Element::U32 => serializer.serialize_u32(pod_read_unaligned(bytes)),
            Element::U64 => serializer.serialize_u64(pod_read_unaligned(bytes)),
            Element::I8 => serializer.serialize_i8(pod_read_unaligned(bytes)),
            Element::I16 => serializer.serialize_i16(pod_read_unaligned(bytes)),
            Element::I32 => serializer.serialize_i32(pod_read_unaligned(bytes)),
            Element::I64 => serializer.serialize_i64(pod_read_unaligned(bytes)),
            Element::F32 => serializer.serialize_f32(pod_read_unaligned(bytes)),
            Element::F64 => serializer.serialize_f64(pod_read_unaligned(bytes)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_each_kind_are_written_exactly_and_absent_values_are_left_out() {
        let value =
            |element: Element, bytes: &[u8]| Value::Numbers { element, is_list: false, bytes: bytes.to_vec().into() };
        let fields = Fields(vec![
            ("u8", value(Element::U8, &[200])),
            ("u16", value(Element::U16, bytes_of(&60_000_u16))),
            ("u32", 4_000_000_000_u32.into()),
            ("u64", u64::MAX.into()),
            ("i8", value(Element::I8, bytes_of(&-100_i8))),
            ("i16", value(Element::I16, bytes_of(&-30_000_i16))),
            ("i32", value(Element::I32, bytes_of(&-2_000_000_000_i32))),
            ("i64", value(Element::I64, bytes_of(&i64::MIN))),
            ("f32", 0.5_f32.into()),
            ("f64", [0.25, 4.0].into()),
            ("no f32", f32::NAN.into()),
            ("no f64", ABSENT.into()),
        ]);
        let expected = r#"{"u8":200,"u16":60000,"u32":4000000000,"u64":18446744073709551615,"i8":-100,"i16":-30000,"#
            .to_owned()
            + r#""i32":-2000000000,"i64":-9223372036854775808,"f32":0.5,"f64":[0.25,4.0]}"#;
        assert_eq!(serde_json::to_string(&fields).unwrap(), expected);
    }
}
