//! The item types that a pipeline file describes, for messages between programs.

use super::Reader;
use crate::item_type::{BUILT_IN, ItemType};
use crate::pipeline::diagnostic::SourceSpan;
use crate::pipeline::value::{Content, Entry};
use conicflow_messages::{AnyByte, Item, LINE_KEYS, Layout, Nothing};
use std::ops::RangeInclusive;

pub const ITEM_KEYS: [&str; 3] = ["type", "fields", "usual_length"];
const MAX_NAME: usize = 31;
const MAX_TYPE_NAME: usize = 127;
pub const USUAL_LENGTH: RangeInclusive<i64> = 1..=1 << 24;
/// Maximum usual size of a list in bytes; more would be an image or a file.
const MAX_USUAL_BYTES: usize = 256 << 20;
const EXAMPLE: &str = "fields = { position = \"f64[3]\", width = \"f64\", id = \"u64\" }";
/// Prefix of the built-in types' names.
const OWN: &str = "conicflow.";

impl Reader<'_> {
    pub(super) fn items(&mut self, entry: Entry) -> Vec<ItemType> {
        let table = self.table(entry, "[item.grasps]").unwrap_or_default();
        let mut items: Vec<ItemType> = Vec::new();
        for entry in table.0 {
            let place = entry.key_place.clone();
            let Some(item) = self.item(entry) else { continue };
            if let Some(other) = items.iter().find(|other| other.type_name() == item.type_name()) {
                let what = format!("`{}` and `{}` have the same `type`", other.name(), item.name());
                self.fault(&place, what, "one item type has one name; several topics may carry it");
                continue;
            }
            items.push(item);
        }
        items
    }

    fn item(&mut self, entry: Entry) -> Option<ItemType> {
        let (name, place) = (entry.key.clone(), entry.key_place.clone());
        let owner = format!("item `{name}`");
        let faults = self.faults.len();
        self.check_name(&name, &place, "type of item", MAX_NAME, "_");
        if BUILT_IN.iter().any(|row| row.name() == name) {
            self.fault(&place, format!("`{name}` is a built-in item type"), "choose another name");
        }
        if LINE_KEYS.contains(&name.as_str()) || [Nothing::NAME, AnyByte::NAME].contains(&name.as_str()) {
            self.fault(&place, format!("`{name}` has another meaning"), "choose another name");
        }
        let is_name = self.faults.len() == faults;
        let mut table = self.table(entry, "[item.grasps]")?;
        let type_name = table.take("type").map(|entry| self.type_name(&entry));
        let layout = table.take("fields").map(|entry| self.layout(entry));
        let usual_length = table.take("usual_length").map(|entry| self.usual_length(&entry));
        self.unknown_keys(&table, &ITEM_KEYS, &owner);
        if type_name.is_none() {
            let hint = "name and version of the layout, such as type = \"acme.Grasp.v1\"";
            self.fault(&place, format!("{owner} has no `type`"), hint);
        }
        if layout.is_none() {
            self.fault(&place, format!("{owner} has no `fields`"), format!("for example {EXAMPLE}"));
        }
        let (type_name, layout) = (type_name??, layout??);
        let usual_length = usual_length.unwrap_or(Some(Nothing::USUAL_LENGTH))?;
        if layout.size() * usual_length > MAX_USUAL_BYTES {
            let what = format!("a message of {owner} has {usual_length} items of {} bytes each", layout.size());
            self.fault(&place, what, format!("{MAX_USUAL_BYTES} bytes are allowed: lower `usual_length`"));
            return None;
        }
        if is_name { Some(ItemType::described(&name, &type_name, layout, usual_length)) } else { None }
    }

    fn type_name(&mut self, entry: &Entry) -> Option<String> {
        let name = self.string(entry)?;
        self.check_name(&name, &entry.value.place, "type", MAX_TYPE_NAME, "._-");
        if name.starts_with(OWN) {
            let what = format!("`{name}`: names that begin with `{OWN}` are those of built-in types");
            self.fault(&entry.value.place, what, "for example type = \"acme.Grasp.v1\"");
            return None;
        }
        Some(name)
    }

    fn layout(&mut self, entry: Entry) -> Option<Layout> {
        let whole = entry.value.place.clone();
        let table = self.table(entry, EXAMPLE)?;
        let mut fields = Vec::new();
        for entry in &table.0 {
            fields.push((entry.key.clone(), self.string(entry)?));
        }
        let fault = match Layout::new(&fields) {
            Ok(layout) => return Some(layout),
            Err(fault) => fault,
        };
        let place = table.0.get(fault.field).map_or(&whole, |entry| &entry.value.place);
        self.fault(&SourceSpan::clone(place), fault.what, fault.hint);
        None
    }

    fn usual_length(&mut self, entry: &Entry) -> Option<usize> {
        if let Content::Integer(length) = entry.value.content
            && USUAL_LENGTH.contains(&length)
        {
            return usize::try_from(length).ok();
        }
        let what = format!("`usual_length` wants an integer from {} to {}", USUAL_LENGTH.start(), USUAL_LENGTH.end());
        self.fault(
            &entry.value.place,
            what,
            "items of a message, which few exceed; shared memory has room for as many",
        );
        None
    }
}
