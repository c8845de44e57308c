//! The memory layout of item types that programs from outside define, as described in the pipeline file.
//!
//! A field has a name and a type: a number (`f64`, `u32`, ..), an array of numbers (`f64[3]`), or UTF-8 text with a fixed number
//! of bytes, padded with zeros (`text[32]`). Fields follow each other as in a `#[repr(C)]` struct, each aligned. A description
//! for which C would insert padding is refused, because padding bytes are never written. A field whose name begins with `_` fills
//! such a gap and is not shown.

use crate::Malformed;
use crate::value::{Element, Fields, Value};
use bytemuck::pod_read_unaligned;
use std::fmt::{self, Display, Formatter};

/// Maximum size of an item in bytes.
pub const MAX_ITEM_BYTES: usize = 64 * 1024;
/// Maximum number of fields.
const MAX_FIELDS: usize = 256;
/// The type name of text.
const TEXT: &str = "text";

/// One field of a [`Layout`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Field {
    /// The name of the field.
    pub name: String,
    /// The type as written.
    pub type_text: String,
    /// The number type; `None` for text.
    element: Option<Element>,
    /// Size of an element in bytes, which is also its alignment.
    size: usize,
    /// Length of an array or text; `None` for a single number.
    count: Option<usize>,
    /// Offset in bytes.
    at: usize,
}

/// The fields of an item with their offsets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    fields: Vec<Field>,
    size: usize,
    align: usize,
}

/// The reason why a list of fields is no layout.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}")]
pub struct LayoutFault {
    /// Index of the faulty field; the last one if the fault is in all of them.
    pub field: usize,
    /// The fault.
    pub what: String,
    /// What to do about it.
    pub hint: String,
}

impl Layout {
    /// Builds the layout of fields, each a name and a type.
    ///
    /// # Errors
    /// The first field with an invalid name or type, or before or after which C would insert padding.
    pub fn new(fields: &[(String, String)]) -> Result<Self, LayoutFault> {
        let mut layout = Self { fields: Vec::new(), size: 0, align: 1 };
        for (index, (name, type_text)) in fields.iter().take(MAX_FIELDS + 1).enumerate() {
            let fault = |(what, hint)| LayoutFault { field: index, what, hint };
            layout.check_name(name).map_err(fault)?;
            layout.add(name, type_text).map_err(fault)?;
        }
        let last = layout.fields.len().saturating_sub(1);
        let fault = |what: &str, hint: String| LayoutFault { field: last, what: what.to_owned(), hint };
        if layout.fields.is_empty() {
            return Err(fault(
                "an item without fields",
                "for example fields = { width = \"f64\", id = \"u64\" }".into(),
            ));
        }
        if layout.fields.len() > MAX_FIELDS {
            return Err(fault("an item with too many fields", format!("{MAX_FIELDS} are allowed: use arrays")));
        }
        let hole = layout.size.next_multiple_of(layout.align) - layout.size;
        if hole > 0 {
            let what = format!("the fields end at byte {}, C would leave {hole} bytes of padding there", layout.size);
            return Err(fault(
                &what,
                format!("add a field such as _padding = \"u8[{hole}]\", here and in the program"),
            ));
        }
        Ok(layout)
    }

    fn check_name(&self, name: &str) -> Result<(), (String, String)> {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        let begins = name.starts_with(|c: char| c.is_ascii_lowercase() || c == '_');
        if !begins || name.len() > 63 || !name.chars().all(good) {
            let hint = "up to 63 of a to z, 0 to 9 and `_`, the first no digit".to_owned();
            return Err((format!("`{name}` cannot be the name of a field"), hint));
        }
        if self.fields.iter().any(|field| field.name == name) {
            return Err((format!("there are two fields `{name}`"), "give one of them another name".to_owned()));
        }
        Ok(())
    }

    fn add(&mut self, name: &str, type_text: &str) -> Result<(), (String, String)> {
        let Some((element, size, count)) = parse(type_text) else {
            let names: Vec<_> = Element::ALL.iter().map(|(name, ..)| *name).chain([TEXT]).collect();
            let hint =
                format!("{}, or so many of them, such as f64[3]; text needs its bytes: text[32]", names.join(", "));
            return Err((format!("`{type_text}` cannot be the type of a field"), hint));
        };
        let hole = self.size.next_multiple_of(size) - self.size;
        if hole > 0 {
            let at = self.size;
            let what = format!("`{name}` would begin at byte {at}, C would leave {hole} bytes of padding before it");
            let hint = format!(
                "order the fields by falling size, or add one such as _padding = \"u8[{hole}]\", here and in the program"
            );
            return Err((what, hint));
        }
        let end = size.checked_mul(count.unwrap_or(1)).and_then(|bytes| bytes.checked_add(self.size));
        let Some(end) = end.filter(|end| *end <= MAX_ITEM_BYTES) else {
            let what = format!("an item of more than {MAX_ITEM_BYTES} bytes");
            return Err((what, "what is longer goes as several items of a list".to_owned()));
        };
        let field =
            Field { name: name.to_owned(), type_text: type_text.to_owned(), element, size, count, at: self.size };
        self.fields.push(field);
        self.size = end;
        self.align = self.align.max(size);
        Ok(())
    }

    /// The fields, in order.
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// Size of an item in bytes.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Alignment of an item in bytes.
    pub fn align(&self) -> usize {
        self.align
    }

    /// Checks items that came from another process: complete items, finite numbers and valid text.
    ///
    /// # Errors
    /// The fault of the first faulty item; `kind` names the message in the error.
    pub fn check(&self, kind: &str, bytes: &[u8]) -> Result<(), Malformed> {
        if !bytes.len().is_multiple_of(self.size) {
            let what = format!("{} bytes, an item has {}", bytes.len(), self.size);
            return Err(Malformed::new(kind, what));
        }
        for (index, item) in bytes.chunks_exact(self.size).enumerate() {
            if let Some(field) = self.fields.iter().find(|field| !field.is_sound(item)) {
                let fault = if field.element.is_none() { "is no text" } else { "is not finite" };
                return Err(Malformed::new(kind, format!("item {index} has a `{}` that {fault}", field.name)));
            }
        }
        Ok(())
    }

    /// Returns the fields of each item in `bytes`, without those that fill gaps.
    pub fn items<'a>(&'a self, bytes: &'a [u8]) -> Vec<Fields<'a>> {
        let shown = || self.fields.iter().filter(|field| !field.name.starts_with('_'));
        let item = |item| Fields(shown().map(|field| (field.name.as_str(), field.value(item))).collect());
        bytes.chunks_exact(self.size).map(item).collect()
    }
}

impl Display for Layout {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        for (index, field) in self.fields.iter().enumerate() {
            write!(f, "{}{}:{}", if index == 0 { "" } else { "," }, field.name, field.type_text)?;
        }
        Ok(())
    }
}

/// Parses a type such as `f64`, `f64[3]` or `text[32]`.
fn parse(text: &str) -> Option<(Option<Element>, usize, Option<usize>)> {
    let (name, count) = match text.split_once('[') {
        Some((name, rest)) => {
            let digits = rest.strip_suffix(']').filter(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()))?;
            (name, Some(digits.parse::<usize>().ok().filter(|count| *count > 0)?))
        }
        None => (text, None),
    };
    if name == TEXT {
        return Some((None, 1, Some(count?)));
    }
    let &(_, element, size) = Element::ALL.iter().find(|(known, ..)| *known == name)?;
    Some((Some(element), size, count))
}

impl Field {
    fn bytes<'a>(&self, item: &'a [u8]) -> &'a [u8] {
        &item[self.at..self.at + self.size * self.count.unwrap_or(1)]
    }

    fn value<'a>(&self, item: &'a [u8]) -> Value<'a> {
        let bytes = self.bytes(item);
        match self.element {
            None => Value::Text(text(bytes).unwrap_or_default()),
            Some(element) => Value::Numbers { element, is_list: self.count.is_some(), bytes: bytes.into() },
        }
    }

    fn is_sound(&self, item: &[u8]) -> bool {
        let bytes = self.bytes(item);
        match self.element {
            Some(Element::F32) => bytes.chunks_exact(4).all(|number| pod_read_unaligned::<f32>(number).is_finite()),
            Some(Element::F64) => bytes.chunks_exact(8).all(|number| pod_read_unaligned::<f64>(number).is_finite()),
            None => text(bytes).is_some(),
            _ => true,
        }
    }
}

/// Returns the text up to the first zero byte, if it is UTF-8.
fn text(bytes: &[u8]) -> Option<&str> {
    let length = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
    std::str::from_utf8(&bytes[..length]).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Text;
    use bytemuck::{Pod, Zeroable, bytes_of, cast_slice};
    use std::mem::offset_of;

    #[repr(C)]
    #[derive(Clone, Copy, Pod, Zeroable)]
    struct Grasp {
        position: [f64; 3],
        width: f32,
        id: u32,
        label: Text<6>,
        fingers: [i16; 3],
        flags: u8,
        _padding: [u8; 3],
    }

    const GRASP: [(&str, &str); 7] = [
        ("position", "f64[3]"),
        ("width", "f32"),
        ("id", "u32"),
        ("label", "text[6]"),
        ("fingers", "i16[3]"),
        ("flags", "u8"),
        ("_padding", "u8[3]"),
    ];

    fn layout(fields: &[(&str, &str)]) -> Result<Layout, LayoutFault> {
        let owned: Vec<_> = fields.iter().map(|(name, text)| ((*name).to_owned(), (*text).to_owned())).collect();
        Layout::new(&owned)
    }

    fn grasp() -> Grasp {
        Grasp {
            position: [0.5, -1.0, 2.0],
            width: 0.25,
            id: 7,
            label: Text::new("left"),
            fingers: [-1, 2, -3],
            flags: 9,
            _padding: [0; 3],
        }
    }

    #[test]
    fn fields_lie_as_in_a_struct_of_c() {
        let layout = layout(&GRASP).unwrap();
        assert_eq!((layout.size(), layout.align()), (size_of::<Grasp>(), align_of::<Grasp>()));
        let places: Vec<_> = layout.fields().iter().map(|field| field.at).collect();
        let expected = [
            offset_of!(Grasp, position),
            offset_of!(Grasp, width),
            offset_of!(Grasp, id),
            offset_of!(Grasp, label),
            offset_of!(Grasp, fingers),
            offset_of!(Grasp, flags),
            offset_of!(Grasp, _padding),
        ];
        assert_eq!(places, expected);
    }

    #[test]
    fn each_type_is_as_large_and_aligned_as_in_c() {
        macro_rules! same {
            ($($name:literal $type:ty),*) => {$(
                for (text, size) in [($name.to_owned(), size_of::<$type>()), (format!("{}[5]", $name), size_of::<[$type; 5]>())] {
                    let layout = layout(&[("field", &text)]).unwrap();
                    assert_eq!((layout.size(), layout.align()), (size, align_of::<$type>()), "{text}");
                }
            )*};
        }
        same!("u8" u8, "u16" u16, "u32" u32, "u64" u64, "i8" i8, "i16" i16, "i32" i32, "i64" i64, "f32" f32, "f64" f64);
    }

    #[test]
    fn a_layout_with_padding_is_refused() {
        let before = layout(&[("id", "u32"), ("width", "f64")]).unwrap_err();
        assert_eq!(before.field, 1);
        assert_eq!(before.what, "`width` would begin at byte 4, C would leave 4 bytes of padding before it");
        let behind = layout(&[("width", "f64"), ("id", "u16")]).unwrap_err();
        assert_eq!(behind.field, 1);
        assert_eq!(behind.what, "the fields end at byte 10, C would leave 6 bytes of padding there");
        assert!(layout(&[("width", "f64"), ("id", "u16"), ("_padding", "u8[6]")]).is_ok());
    }

    #[test]
    fn unknown_types_invalid_names_and_long_layouts_are_refused() {
        let types = [
            "",
            "f16",
            "f64[]",
            "f64[0]",
            "f64[-1]",
            "f64[+1]",
            "f64[3",
            "f64 [3]",
            "f64[3][3]",
            "text",
            "F64",
            "u128",
            "bool",
            "[3]",
            "f64[99999999999999999999]",
        ];
        for text in types {
            let fault = layout(&[("id", "u64"), ("field", text)]).unwrap_err();
            assert_eq!((fault.field, fault.what), (1, format!("`{text}` cannot be the type of a field")));
        }
        for text in ["f64[8193]", "u8[65537]", "f64[2305843009213693952]"] {
            assert_eq!(layout(&[("field", text)]).unwrap_err().what, "an item of more than 65536 bytes", "{text}");
        }
        for name in ["", "Width", "2nd", "a-b", "a b", &"a".repeat(64)] {
            let fault = layout(&[(name, "f64")]).unwrap_err().what;
            assert_eq!(fault, format!("`{name}` cannot be the name of a field"));
        }
        assert!(layout(&[(&"a".repeat(63), "f64")]).is_ok());
        assert_eq!(layout(&[("a", "f64"), ("a", "f64")]).unwrap_err().what, "there are two fields `a`");
        assert_eq!(layout(&[]).unwrap_err().what, "an item without fields");
        let many: Vec<_> = (0..257).map(|index| (format!("f{index}"), "u8".to_owned())).collect();
        assert_eq!(Layout::new(&many).unwrap_err().what, "an item with too many fields");
    }

    #[test]
    fn an_item_in_json_has_its_fields_in_order_and_no_padding() {
        let layout = layout(&GRASP).unwrap();
        let text = serde_json::to_string(&layout.items(bytes_of(&grasp()))).unwrap();
        let expected =
            r#"[{"position":[0.5,-1.0,2.0],"width":0.25,"id":7,"label":"left","fingers":[-1,2,-3],"flags":9}]"#;
        assert_eq!(text, expected);
        assert_eq!(serde_json::to_string(&layout.items(&[])).unwrap(), "[]");
    }

    #[test]
    fn infinite_numbers_and_bytes_that_are_no_text_are_refused() {
        let layout = layout(&GRASP).unwrap();
        let check = |spoil: fn(&mut Grasp)| {
            let mut items = [grasp(); 3];
            spoil(&mut items[1]);
            let checked = layout.check("grasps", cast_slice(&items));
            checked.map_err(|error| error.to_string())
        };
        assert_eq!(check(|_| {}), Ok(()));
        let refused = |fault: &str| Err(format!("malformed grasps: item 1 has a `{fault}"));
        assert_eq!(check(|item| item.position[2] = f64::NAN), refused("position` that is not finite"));
        assert_eq!(check(|item| item.width = f32::INFINITY), refused("width` that is not finite"));
        assert_eq!(check(|item| item.label = bytemuck::cast([0xff_u8; 6])), refused("label` that is no text"));
        let cut = layout.check("grasps", &bytes_of(&grasp())[1..]);
        assert_eq!(cut.unwrap_err().to_string(), "malformed grasps: 47 bytes, an item has 48");
    }
}
