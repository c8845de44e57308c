//! The inputs of a stage in a pipeline file.

use super::Reader;
use crate::pipeline::diagnostic::{SourceSpan, suggestion};
use crate::pipeline::machine::Compression;
use crate::pipeline::spec::{Input, Program};
use crate::pipeline::value::{Content, Entry, Table, Value};
use crate::ports::Delivery;
use crate::side_inputs::Pairing;

pub const INPUT_KEYS: [&str; 5] = ["topic", "delivery", "queue", "kind", "compression"];
pub const COMPRESSIONS: [(&str, Compression); 3] =
    [("none", Compression::None), ("lz4", Compression::Lz4), ("zstd", Compression::Zstd)];
pub const DELIVERIES: [(&str, Delivery); 2] = [("latest", Delivery::Latest), ("lossless", Delivery::Lossless)];

const QUEUE_LATEST: usize = 2;
const QUEUE_SAME_FRAME: usize = 8;
const QUEUE_LOSSLESS: usize = 4;
pub const MAX_QUEUE: i64 = 64;

/// An input as the file gives it.
#[derive(Default)]
struct DeclaredInput {
    topic: String,
    delivery: Option<Delivery>,
    queue: Option<usize>,
    kind: Option<String>,
    compression: Option<Compression>,
}

impl Reader<'_> {
    /// Reads an input in its short or its long form; `pairing` and `delivery` determine the defaults.
    pub(super) fn input(&mut self, value: &Value, pairing: Pairing, delivery: Delivery) -> Option<Input> {
        let place = value.place.clone();
        let declared = match &value.content {
            Content::String(topic) => DeclaredInput { topic: topic.clone(), ..DeclaredInput::default() },
            Content::Table(table) => self.long_input(table.clone(), &place)?,
            _ => {
                let what = format!("an input is a topic or a table, this is {}", value.type_name());
                self.fault(&place, what, "\"depth\" or { topic = \"depth\", delivery = \"lossless\", queue = 4 }");
                return None;
            }
        };
        let delivery = declared.delivery.unwrap_or(delivery);
        let default_queue = match (delivery, pairing) {
            (Delivery::Lossless, _) => QUEUE_LOSSLESS,
            (Delivery::Latest, Pairing::SameFrame) => QUEUE_SAME_FRAME,
            (Delivery::Latest, Pairing::Latest) => QUEUE_LATEST,
        };
        // At least two, so that the end of the stream does not displace the last frame.
        let queue = declared.queue.unwrap_or(default_queue).max(2);
        let DeclaredInput { topic, kind, compression, .. } = declared;
        Some(Input { topic, delivery, queue, kind, compression, place })
    }

    fn long_input(&mut self, mut table: Table, place: &SourceSpan) -> Option<DeclaredInput> {
        let topic = table.take("topic").and_then(|entry| self.string(&entry));
        let delivery = table.take("delivery").and_then(|entry| self.word(&entry, DELIVERIES));
        let queue = table.take("queue").and_then(|entry| self.queue(&entry));
        let kind = table.take("kind").and_then(|entry| self.kind(&entry));
        let compression = table.take("compression").and_then(|entry| self.word(&entry, COMPRESSIONS));
        self.unknown_keys(&table, &INPUT_KEYS, "the input");
        if topic.is_none() {
            self.fault(place, "the input has no topic", "for example { topic = \"depth\", delivery = \"lossless\" }");
        }
        Some(DeclaredInput { topic: topic?, delivery, queue, kind, compression })
    }

    fn queue(&mut self, entry: &Entry) -> Option<usize> {
        match entry.value.content {
            Content::Integer(length @ 1..=MAX_QUEUE) => usize::try_from(length).ok(),
            _ => {
                let what = match entry.value.content {
                    Content::Integer(length) => format!("`queue` is {length}, allowed is from 1 to {MAX_QUEUE}"),
                    _ => format!("`queue` wants an integer, this is {}", entry.value.type_name()),
                };
                self.fault(&entry.value.place, what, "how many messages wait for this input at most");
                None
            }
        }
    }

    pub(super) fn inputs(&mut self, entry: Entry, program: &Program, driving: Delivery) -> Vec<(String, Input)> {
        let table = self.table(entry, "inputs = { depth = \"depth\" }").unwrap_or_default();
        let mut inputs = Vec::new();
        for entry in table.0 {
            let pairing = self.pick_of(&entry, program);
            let default = if pairing == Pairing::SameFrame { driving } else { Delivery::Latest };
            inputs.extend(self.input(&entry.value, pairing, default).map(|input| (entry.key, input)));
        }
        inputs
    }

    /// Returns which message of a side input a node reads; reports an unknown side input.
    fn pick_of(&mut self, entry: &Entry, program: &Program) -> Pairing {
        let Program::Node(node) = program else { return Pairing::Latest };
        if let Some(side) = node.side_inputs().iter().find(|side| side.name == entry.key) {
            return side.pairing;
        }
        let hint = suggestion(&entry.key, node.side_inputs().iter().map(|side| side.name), "side inputs");
        self.fault(&entry.key_place, format!("node `{}` has no side input `{}`", node.name, entry.key), hint);
        Pairing::Latest
    }
}
