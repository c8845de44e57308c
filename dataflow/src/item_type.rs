//! Item types at run time, for code that carries items of unknown type: name, size, and functions to check and show the bytes.
//!
//! A type that this program knows has a row in [`BUILT_IN`]: the row makes it available to the pipeline file, the service keeper,
//! `topic`, `json_sink`, recordings and the bridge. Any other type is described in the pipeline file, under `[item.NAME]`.

use bytemuck::{cast_slice_mut, try_cast_slice};
use conicflow_messages::{
    AnyByte, Ellipse, Fields, Header, Item, Layout, LayoutFault, Line, Malformed, Message, Named, Object, ToJson,
    Track, Velocity,
};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fmt::{self, Display, Formatter};
use std::sync::Arc;

/// The item types that every program knows, in the order of the pipeline.
pub static BUILT_IN: [ItemType; 5] = [
    ItemType::shown::<u16>(),
    ItemType::shown::<Ellipse>(),
    ItemType::named::<Object>(),
    ItemType::named::<Track>(),
    ItemType::named::<Velocity>(),
];

/// Maximum alignment of items, in bytes; shared memory and buffers are aligned to it.
pub(crate) const MAX_ALIGN: usize = align_of::<u64>();
/// A list that is usually no longer than this, in bytes, counts as short: it crosses a network in a few packets.
const SHORT_LIST: usize = 64 * 1024;

type Check = fn(&Header, &[u8]) -> Result<(), Malformed>;
type Json = fn(&AnyMessage<'_>, Option<f64>, &mut Vec<u8>) -> serde_json::Result<()>;
type FieldsOf = fn(&AnyMessage<'_>) -> Option<Vec<Fields<'static>>>;
type Labels = fn(&AnyMessage<'_>, &mut dyn FnMut(&'static str));

/// An item type.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(try_from = "SerializedItemType", into = "SerializedItemType")]
pub struct ItemType {
    name: Cow<'static, str>,
    type_name: Cow<'static, str>,
    size: usize,
    align: usize,
    usual_length: usize,
    is_image: bool,
    is_counted: bool,
    form: Form,
}

/// How the bytes of items are checked and shown.
#[derive(Clone, Debug)]
enum Form {
    /// By code for a Rust type; JSON and named fields are optional.
    Known(Check, Labels, Option<Json>, Option<FieldsOf>),
    /// By the description in the pipeline file.
    Described(Arc<Layout>),
}

impl ItemType {
    /// Item type of a Rust type.
    pub const fn of<T: Item>() -> Self {
        Self::known::<T>(None, None)
    }

    /// Item type of a Rust type that can be shown as JSON.
    pub const fn shown<T: ToJson>() -> Self {
        Self::known::<T>(Some(json::<T>), None)
    }

    /// Item type of a Rust type whose fields have names, by which it can be shown as JSON and recorded as a list.
    pub const fn named<T: Named>() -> Self {
        Self::known::<T>(Some(json::<T>), Some(fields::<T>))
    }

    const fn known<T: Item>(json: Option<Json>, fields: Option<FieldsOf>) -> Self {
        const {
            assert!(align_of::<T>() <= MAX_ALIGN, "items are aligned to 8 bytes at most");
            assert!(size_of::<T>() > 0 || T::USUAL_LENGTH == 0, "an item has at least one byte");
        }
        Self {
            name: Cow::Borrowed(T::NAME),
            type_name: Cow::Borrowed(T::TYPE_NAME),
            size: size_of::<T>(),
            align: align_of::<T>(),
            usual_length: T::USUAL_LENGTH,
            is_image: T::IS_IMAGE,
            is_counted: T::IS_COUNTED,
            form: Form::Known(check::<T>, each_label::<T>, json, fields),
        }
    }

    /// Item type described by its fields, unknown to the program; few messages have more than `usual_length` items.
    pub fn described(name: &str, type_name: &str, layout: Layout, usual_length: usize) -> Self {
        Self {
            name: Cow::Owned(name.to_owned()),
            type_name: Cow::Owned(type_name.to_owned()),
            size: layout.size(),
            align: layout.align(),
            usual_length,
            is_image: false,
            is_counted: false,
            form: Form::Described(Arc::new(layout)),
        }
    }

    /// Name of the item type in the pipeline file, in JSON and in errors.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Name and version of the memory layout.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Size of an item in bytes.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Alignment of an item in bytes.
    pub fn align(&self) -> usize {
        self.align
    }

    /// Usual maximum number of items of a message; few have more.
    pub fn usual_length(&self) -> usize {
        self.usual_length
    }

    /// Whether a message is an image, with one item per pixel of the header's camera.
    pub fn is_image(&self) -> bool {
        self.is_image
    }

    /// Whether a run counts and reports the items, even when there are none.
    pub fn is_counted(&self) -> bool {
        self.is_counted
    }

    /// Whether this is the type `T`, by its name.
    pub(crate) fn is<T: Item>(&self) -> bool {
        self.type_name == T::TYPE_NAME
    }

    /// The fields, for a type that the pipeline file describes.
    pub fn described_layout(&self) -> Option<&Layout> {
        match &self.form {
            Form::Known(..) => None,
            Form::Described(layout) => Some(layout),
        }
    }

    /// Whether messages are mostly short lists, not worth compressing; most of them get through a network that loses some
    /// packets.
    pub fn is_short(&self) -> bool {
        !self.is_image && self.size * self.usual_length <= SHORT_LIST
    }

    /// Whether this is one of the [`BUILT_IN`] types, by its type name.
    pub fn is_built_in(&self) -> bool {
        BUILT_IN.iter().any(|row| row.type_name == self.type_name)
    }

    /// The layout as text, for two machines to compare: the type's name, and the fields of a type that the pipeline file
    /// describes.
    pub fn layout(&self) -> String {
        match &self.form {
            Form::Known(..) => self.type_name.clone().into_owned(),
            Form::Described(layout) => format!("{}{{{layout}}}", self.type_name),
        }
    }

    /// Whether two processes with these types can exchange items.
    pub fn fits(&self, other: &Self) -> bool {
        (&self.type_name, self.size, self.align) == (&other.type_name, other.size, other.align)
    }

    /// Checks a message from another process. Of the end of a stream only the header is checked.
    ///
    /// # Errors
    /// Describes the fault of the header, or of the first faulty item.
    pub fn check(&self, header: &Header, bytes: &[u8]) -> Result<(), Malformed> {
        header.check(&self.name)?;
        if header.ends_stream() {
            return Ok(());
        }
        match &self.form {
            Form::Known(check, ..) => check(header, bytes),
            Form::Described(layout) => layout.check(&self.name, bytes),
        }
    }
}

impl PartialEq for ItemType {
    fn eq(&self, other: &Self) -> bool {
        let told = |item: &Self| (item.name.clone(), item.layout(), item.size, item.align, item.usual_length);
        told(self) == told(other)
    }
}

impl Eq for ItemType {}

/// "`acme.Grasp.v1`, 40 bytes, aligned to 8".
impl Display for ItemType {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`, {} bytes, aligned to {}", self.type_name, self.size, self.align)
    }
}

fn check<T: Item>(header: &Header, bytes: &[u8]) -> Result<(), Malformed> {
    match try_cast_slice(bytes) {
        Ok(items) => T::check(header, items),
        // Bytes from a network may be unaligned.
        Err(_) if bytes.len().is_multiple_of(size_of::<T>()) => {
            let mut items = vec![T::zeroed(); bytes.len() / size_of::<T>()];
            cast_slice_mut(&mut items).copy_from_slice(bytes);
            T::check(header, &items)
        }
        Err(_) => {
            let what = format!("{} bytes, an item has {}", bytes.len(), size_of::<T>());
            Err(Malformed::new(T::NAME, what))
        }
    }
}

fn each_label<T: Item>(message: &AnyMessage<'_>, visit: &mut dyn FnMut(&'static str)) {
    message.items::<T>().unwrap_or_default().iter().filter_map(Item::label).for_each(visit);
}

fn json<T: ToJson>(message: &AnyMessage<'_>, latency_ms: Option<f64>, line: &mut Vec<u8>) -> serde_json::Result<()> {
    let items = message.items::<T>().unwrap_or_default();
    let typed = Message { header: message.header, items };
    let content = T::message_to_json(&typed);
    serde_json::to_writer(line, &Line { header: message.header, latency_ms, kind: T::NAME, content })
}

fn fields<T: Named>(message: &AnyMessage<'_>) -> Option<Vec<Fields<'static>>> {
    Some(message.items::<T>()?.iter().map(Named::fields).collect())
}

/// A message whose item type is known only at run time.
#[derive(Clone, Copy, Debug)]
pub struct AnyMessage<'a> {
    /// Frame, camera and times.
    pub header: &'a Header,
    /// Type of its items.
    pub item: &'a ItemType,
    /// Its items, as bytes.
    pub bytes: &'a [u8],
}

impl<'a> AnyMessage<'a> {
    /// The items as `T`, or as bytes for [`AnyByte`]; `None` if they are of another type.
    pub fn items<T: Item>(&self) -> Option<&'a [T]> {
        let same = self.item.fits(const { &ItemType::of::<T>() }) || T::TYPE_NAME == AnyByte::TYPE_NAME;
        if same { try_cast_slice(self.bytes).ok() } else { None }
    }

    /// The message with items of type `T`; `None` if they are of another type.
    pub fn typed<T: Item>(&self) -> Option<Message<'a, T>> {
        Some(Message { header: self.header, items: self.items()? })
    }

    /// Calls `visit` with the label under which each item is counted.
    pub(crate) fn each_label(&self, mut visit: impl FnMut(&'static str)) {
        if let Form::Known(_, labels, ..) = &self.item.form
            && self.item.is_counted
        {
            labels(self, &mut visit);
        }
    }

    /// Returns the named fields of each item; `None` if the type has none.
    pub fn fields(&self) -> Option<Vec<Fields<'a>>> {
        let row = BUILT_IN.iter().find(|row| row.fits(self.item));
        let named = row.and_then(|row| if let Form::Known(.., Some(fields)) = row.form { fields(self) } else { None });
        named.or_else(|| Some(self.item.described_layout()?.items(self.bytes)))
    }

    /// Appends the message as JSON; of an image, a summary.
    ///
    /// # Errors
    /// It cannot be expressed, or it has a Rust type that cannot be shown.
    pub fn write_json(&self, latency_ms: Option<f64>, line: &mut Vec<u8>) -> serde_json::Result<()> {
        match &self.item.form {
            Form::Known(_, _, Some(json), _) => json(self, latency_ms, line),
            Form::Known(_, _, None, _) => {
                Err(serde::ser::Error::custom(format_args!("items of {} have no form in JSON", self.item)))
            }
            Form::Described(layout) => {
                let content = layout.items(self.bytes);
                let line_of = Line { header: self.header, latency_ms, kind: &self.item.name, content };
                serde_json::to_writer(line, &line_of)
            }
        }
    }
}

/// Serialised form of an item type in a plan: the name for a built-in one, else also the description of the pipeline file.
#[derive(Serialize, Deserialize)]
struct SerializedItemType {
    name: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    described: Option<Description>,
}

#[derive(Serialize, Deserialize)]
struct Description {
    type_name: String,
    fields: Vec<(String, String)>,
    usual_length: usize,
}

impl From<ItemType> for SerializedItemType {
    fn from(item: ItemType) -> Self {
        let described = match &item.form {
            Form::Known(..) => None,
            Form::Described(layout) => {
                let fields = layout.fields().iter().map(|field| (field.name.clone(), field.type_text.clone()));
                let (type_name, usual_length) = (item.type_name.into_owned(), item.usual_length);
                Some(Description { type_name, fields: fields.collect(), usual_length })
            }
        };
        Self { name: item.name.into_owned(), described }
    }
}

/// Reason why an item type of a plan cannot be used.
#[derive(Debug, thiserror::Error)]
enum ItemTypeFault {
    #[error("no item type is called `{0}`")]
    Unknown(String),
    #[error(transparent)]
    Layout(#[from] LayoutFault),
}

impl TryFrom<SerializedItemType> for ItemType {
    type Error = ItemTypeFault;

    fn try_from(told: SerializedItemType) -> Result<Self, ItemTypeFault> {
        let Some(Description { type_name, fields, usual_length }) = told.described else {
            let row = BUILT_IN.iter().find(|row| row.name == told.name);
            return row.cloned().ok_or(ItemTypeFault::Unknown(told.name));
        };
        Ok(Self::described(&told.name, &type_name, Layout::new(&fields)?, usual_length))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Camera, ObjectKind};

    fn grasps() -> ItemType {
        let fields = [("position", "f64[3]"), ("id", "u64")].map(|(name, text)| (name.to_owned(), text.to_owned()));
        ItemType::described("grasps", "acme.Grasp.v1", Layout::new(&fields).unwrap(), 16)
    }

    fn header() -> Header {
        let camera = Camera { width: 2, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        Header { camera, depth_scale: 0.001, ..Header::default() }
    }

    #[test]
    fn names_of_rows_differ() {
        for (index, row) in BUILT_IN.iter().enumerate() {
            let others = BUILT_IN[..index].iter();
            assert!(others.into_iter().all(|other| other.name != row.name && other.type_name != row.type_name));
        }
    }

    #[test]
    fn a_plan_tells_rows_by_name_and_others_by_their_fields() {
        let text = serde_json::to_string(&BUILT_IN[2]).unwrap();
        assert_eq!(text, r#"{"name":"objects"}"#);
        for item in BUILT_IN.iter().cloned().chain([grasps()]) {
            let back: ItemType = serde_json::from_str(&serde_json::to_string(&item).unwrap()).unwrap();
            assert_eq!(back, item);
        }
        let unknown = serde_json::from_str::<ItemType>(r#"{"name":"things"}"#).unwrap_err();
        assert!(unknown.to_string().contains("no item type is called `things`"), "{unknown}");
    }

    #[test]
    fn bytes_are_items_of_their_own_type_only() {
        let (header, objects) = (header(), [Object::default(); 2]);
        let message = AnyMessage { header: &header, item: &BUILT_IN[2], bytes: bytemuck::cast_slice(&objects) };
        assert_eq!(message.items::<Object>(), Some(&objects[..]));
        assert!(message.items::<Velocity>().is_none() && message.typed::<Track>().is_none());
        assert_eq!(message.typed::<Object>().map(|typed| typed.items.len()), Some(2));
        assert_eq!(message.items::<AnyByte>().map(<[_]>::len), Some(2 * size_of::<Object>()), "all are bytes");
        let mut labels = Vec::new();
        message.each_label(|label| labels.push(label));
        assert_eq!(labels, [ObjectKind::Sphere.name(); 2]);
        let depth = AnyMessage { item: &BUILT_IN[0], ..message };
        depth.each_label(|label| panic!("a pixel is counted as {label}"));
        let mut line = Vec::new();
        message.write_json(None, &mut line).unwrap();
        let told: serde_json::Value = serde_json::from_slice(&line).unwrap();
        assert_eq!(told["objects"].as_array().map(Vec::len), Some(2), "{told}");
    }

    #[test]
    fn lists_of_named_and_described_types_have_fields_and_other_items_have_none() {
        let (header, bytes) = (header(), vec![0_u64; 64]);
        let length = |item: &ItemType| {
            let bytes = &bytemuck::cast_slice(&bytes)[..item.size()];
            AnyMessage { header: &header, item, bytes }.fields().map(|items| items.len())
        };
        let lists: Vec<_> = BUILT_IN.iter().map(length).collect();
        assert_eq!(lists, [None, None, Some(1), Some(1), Some(1)]);
        assert_eq!([length(&ItemType::of::<Object>()), length(&grasps())], [Some(1); 2]);
    }

    #[test]
    fn two_types_fit_if_their_items_lie_alike_and_are_equal_if_they_are_called_alike_too() {
        let (objects, grasps) = (&BUILT_IN[2], grasps());
        assert_eq!((grasps.name(), grasps.type_name(), grasps.usual_length()), ("grasps", "acme.Grasp.v1", 16));
        assert_eq!(grasps.to_string(), "`acme.Grasp.v1`, 32 bytes, aligned to 8");
        assert_eq!([&BUILT_IN[0], objects, &grasps].map(ItemType::align), [2, 8, 8]);
        assert_eq!([&BUILT_IN[0], objects, &grasps].map(ItemType::is_image), [true, false, false]);
        assert_eq!([&BUILT_IN[0], objects, &grasps].map(ItemType::is_built_in), [true, true, false]);
        let fields = [("grip".to_owned(), "f64[4]".to_owned())];
        let other = ItemType::described("grips", "acme.Grasp.v1", Layout::new(&fields).unwrap(), 16);
        let longer = ItemType { usual_length: 17, ..grasps.clone() };
        assert_eq!([&grasps, &other, &longer, objects].map(|item| item.fits(&grasps)), [true, true, true, false]);
        assert_eq!([&grasps, &other, &longer, objects].map(|item| *item == grasps), [true, false, false, false]);
        assert_eq!(objects.layout(), Object::TYPE_NAME);
        assert!(
            grasps.layout().starts_with("acme.Grasp.v1{") && grasps.layout() != other.layout(),
            "{}",
            grasps.layout()
        );
    }

    #[test]
    fn items_from_a_network_may_lie_anywhere() {
        for before in [0, 1] {
            let bytes = [vec![0; before], bytemuck::bytes_of(&Object::default()).to_vec()].concat();
            assert_eq!(BUILT_IN[2].check(&header(), &bytes[before..]), Ok(()), "after {before} bytes");
        }
    }

    #[test]
    fn what_is_cut_within_an_item_is_refused() {
        let object = Object::default();
        let bytes = bytemuck::bytes_of(&object);
        assert_eq!(BUILT_IN[2].check(&header(), bytes), Ok(()));
        for bytes in [&bytes[..bytes.len() - 1], &bytes[..bytes.len() - 8]] {
            assert!(BUILT_IN[2].check(&header(), bytes).is_err());
        }
        assert!(grasps().check(&header(), &[0; 33]).is_err());
    }

    #[test]
    fn types_of_the_file_are_shown_with_their_fields() {
        let (header, mut line) = (header(), Vec::new());
        let bytes: Vec<u8> =
            [1.0_f64, 2.0, 3.0].iter().flat_map(|x| x.to_le_bytes()).chain(7_u64.to_le_bytes()).collect();
        AnyMessage { header: &header, item: &grasps(), bytes: &bytes }.write_json(None, &mut line).unwrap();
        let expected = r#""latency_ms":null,"grasps":[{"position":[1.0,2.0,3.0],"id":7}]}"#;
        assert!(String::from_utf8(line).unwrap().ends_with(expected));
    }

    #[test]
    fn long_lists_and_images_are_not_short() {
        let short: Vec<_> = BUILT_IN.iter().filter(|row| row.is_short()).map(ItemType::name).collect();
        assert_eq!(short, ["objects", "tracks", "velocities"]);
        assert!(grasps().is_short());
    }
}
