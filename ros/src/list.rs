//! A list of items as a ROS 2 message of a special type, with named fields: the definition and the bytes are derived from the
//! same names and values as the list's JSON.
//!
//! No package provides these types; a recording contains their definitions.

use crate::{Stamped, Writer};
use conicflow_messages::{Element, Fields, Value};
use std::fmt::Write as _;

const PACKAGE: &str = "conicflow_msgs";
/// Precedes the definition of each nested type.
const SEPARATOR: &str = "================================================================================\n";
/// The definition of the header of each message.
const HEADER: &str = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";
/// The definition of the time in a header.
const TIME: &str = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// Returns the name and the definition of the message type of the list `list`: besides the list it has the fields of `head`, and
/// each item has the fields of `item`.
pub fn list_definition(list: &str, head: &Fields<'_>, item: &Fields<'_>) -> (String, String) {
    let name = upper_camel(list);
    let of_item = format!("{name}Item");
    let mut text = "std_msgs/Header header\n".to_owned();
    let mut below = String::new();
    define(head, &name, &mut text, &mut below);
    // Writing to a string cannot fail.
    writeln!(text, "{PACKAGE}/{of_item}[] items\n{SEPARATOR}MSG: {PACKAGE}/{of_item}").ok();
    define(item, &of_item, &mut text, &mut below);
    (format!("{PACKAGE}/msg/{name}"), format!("{text}{below}{SEPARATOR}{HEADER}{SEPARATOR}{TIME}"))
}

/// Encodes a message with the fields of `head` and a list of items.
pub fn write_list(stamped: Stamped<'_>, head: &Fields<'_>, items: &[Fields<'_>], memory: Vec<u8>) -> Vec<u8> {
    let mut writer = Writer::new(memory);
    write(head, writer.stamped(stamped));
    writer.length(items.len());
    items.iter().for_each(|item| write(item, &mut writer));
    writer.finish()
}

/// Appends a line for each field of type `owner` to `text`, and the definitions of nested types to `below`.
fn define(fields: &Fields<'_>, owner: &str, text: &mut String, below: &mut String) {
    for (name, value) in &fields.0 {
        let kind = match value {
            Value::Text(_) => "string".to_owned(),
            Value::Numbers { element, is_list: false, .. } => word(*element).to_owned(),
            Value::Numbers { element, is_list: true, bytes } => {
                format!("{}[{}]", word(*element), bytes.len() / element.size())
            }
            Value::Below(inner) => {
                let kind = format!("{owner}{}", upper_camel(name));
                let (mut own, mut deeper) = (String::new(), String::new());
                define(inner, &kind, &mut own, &mut deeper);
                write!(below, "{SEPARATOR}MSG: {PACKAGE}/{kind}\n{own}{deeper}").ok();
                format!("{PACKAGE}/{kind}")
            }
        };
        writeln!(text, "{kind} {name}").ok();
    }
}

fn write(fields: &Fields<'_>, writer: &mut Writer) {
    for (_, value) in &fields.0 {
        match value {
            Value::Text(text) => drop(writer.text(text)),
            Value::Numbers { element, bytes, .. } => drop(writer.numbers(element.size(), bytes)),
            Value::Below(inner) => write(inner, writer),
        }
    }
}

/// The ROS 2 name of a number type.
fn word(element: Element) -> &'static str {
    match element {
        Element::U8 => "uint8",
        Element::U16 => "uint16",
        Element::U32 => "uint32",
        Element::U64 => "uint64",
        Element::I8 => "int8",
        Element::I16 => "int16",
        Element::I32 => "int32",
        Element::I64 => "int64",
        Element::F32 => "float32",
        Element::F64 => "float64",
    }
}

/// Converts `own_grasps` to `OwnGrasps`, the form of type names, which begin with a letter.
fn upper_camel(name: &str) -> String {
    let upper = |word: &str| word.chars().take(1).flat_map(char::to_uppercase).chain(word.chars().skip(1)).collect();
    let words: Vec<String> = name.split('_').map(upper).collect();
    let prefix = if name.starts_with(|first: char| first.is_ascii_digit()) { "List" } else { "" };
    format!("{prefix}{}", words.concat())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reader;
    use conicflow_messages::{Layout, Named, Object, ObjectKind, Track};

    #[test]
    fn the_definition_describes_the_bytes() {
        let head = Fields(vec![("sequence", 7_u64.into()), ("source", "a.png".into())]);
        let track = Track { id: 3, object: Object { radius: 0.5, ..Object::default() }, ..Track::default() };
        let (name, text) = list_definition("tracks", &head, &track.fields());
        assert_eq!(name, "conicflow_msgs/msg/Tracks");
        let [list, item, sigma, header, time] = &text.split(SEPARATOR).collect::<Vec<_>>()[..] else {
            panic!("{text}")
        };
        assert_eq!(
            *list,
            "std_msgs/Header header\nuint64 sequence\nstring source\nconicflow_msgs/TracksItem[] items\n"
        );
        let of_track =
            "string kind\nfloat64[3] apex\nfloat64[3] center\nfloat64[3] axis\nfloat64 half_angle\nfloat64 radius\n";
        assert!(item.starts_with(&format!("MSG: conicflow_msgs/TracksItem\n{of_track}")), "{item}");
        assert!(item.contains("\nconicflow_msgs/TracksItemSigma sigma\nfloat64 rms\nuint32 points\n"), "{item}");
        assert!(item.ends_with(
            "\nfloat32 confidence\nuint64 id\nfloat64[3] velocity\nuint32 age\nuint32 misses\nstring state\n"
        ));
        let of_sigma = "float64[3] center\nfloat64 axis\nfloat64 half_angle\nfloat64 radius\nfloat64 length\n\
                        float64[3] velocity\n";
        assert_eq!(*sigma, format!("MSG: conicflow_msgs/TracksItemSigma\n{of_sigma}"));
        assert_eq!((*header, *time), (HEADER, TIME));

        let stamped = Stamped { stamp_ns: 5, frame_id: "camera" };
        let message = write_list(stamped, &head, &[track.fields()], vec![9; 3]);
        let mut reader = Reader::new(&message).unwrap();
        assert_eq!(reader.stamped().unwrap(), stamped);
        assert_eq!(reader.f64().unwrap().to_bits(), 7);
        assert_eq!((reader.text().unwrap(), reader.u32().unwrap(), reader.text().unwrap()), ("a.png", 1, "sphere"));
        let [apex, center, axis] = [(); 3].map(|()| reader.f64s::<3>().unwrap());
        assert!(apex[0].is_nan() && axis[0].is_nan() && center == [0.0; 3], "a sphere has a centre alone");
        assert!(reader.f64().unwrap().is_nan() && reader.f64().unwrap() == 0.5);
    }

    #[test]
    fn the_definition_is_the_same_for_all_shapes() {
        let kinds = ObjectKind::ALL.map(|kind| Object { kind: kind.code(), ..Object::default() }.fields());
        let [sphere, others @ ..] = kinds.map(|item| list_definition("objects", &Fields(Vec::new()), &item));
        assert!(others.iter().all(|other| *other == sphere));
    }

    #[test]
    fn types_described_in_the_pipeline_file_have_their_fields() {
        let fields = [("at", "f64[2]"), ("id", "i16"), ("flags", "u8[2]"), ("name", "text[3]"), ("_hole", "u8[1]")];
        let layout = Layout::new(&fields.map(|(name, kind)| (name.to_owned(), kind.to_owned()))).unwrap();
        let mut item: Vec<u8> = [0.5_f64, 1.5].iter().flat_map(|number| number.to_ne_bytes()).collect();
        item.extend((-2_i16).to_ne_bytes().into_iter().chain([3, 4]).chain(*b"ab\0\0"));
        let items = layout.items(&item);
        let (name, text) = list_definition("2_own_grasps", &Fields(Vec::new()), &items[0]);
        assert_eq!(name, "conicflow_msgs/msg/List2OwnGrasps");
        assert!(text.contains("Item\nfloat64[2] at\nint16 id\nuint8[2] flags\nstring name\n===="), "{text}");
        let message = write_list(Stamped::default(), &Fields(Vec::new()), &items, Vec::new());
        let mut reader = Reader::new(&message).unwrap();
        assert!(reader.stamped().is_ok());
        assert_eq!((reader.u32().unwrap(), reader.f64s().unwrap()), (1, [0.5, 1.5]));
        assert_eq!([(); 4].map(|()| reader.u8().unwrap()), [0xfe, 0xff, 3, 4]);
        assert_eq!((reader.text().unwrap(), reader.u8().is_err()), ("ab", true));
    }
}
