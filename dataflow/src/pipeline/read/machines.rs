//! The machines of a pipeline file, and the connections between them.

use super::{MAX_STAGE_NAME, Reader};
use crate::network::{NO_NETWORK, NO_NETWORK_HINT};
use crate::pipeline::diagnostic::{Diagnostic, SourceSpan};
use crate::pipeline::machine::Machine;
use crate::pipeline::value::Entry;
use conicflow_messages::Hinted;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::PathBuf;

pub const MACHINE_KEYS: [&str; 7] = ["listen", "connect", "zenoh", "key", "insecure", "outage_s", "metrics"];
pub const OUTAGE_S: RangeInclusive<f64> = 0.0..=86_400.0;
const OUTAGE_HINT: &str = "how long lossless edges wait for a machine that has gone";

impl Reader<'_> {
    pub(super) fn machines(&mut self, entry: Entry) -> BTreeMap<String, Machine> {
        let table = self.table(entry, "[machine.robot]").unwrap_or_default();
        if let (None, Some(first)) = (&self.context.registry.network, table.0.first()) {
            self.fault(&first.key_place, NO_NETWORK, NO_NETWORK_HINT);
        }
        let places: Vec<_> = table.0.iter().map(|entry| (entry.key.clone(), entry.key_place.clone())).collect();
        let machines = table.0.into_iter().map(|entry| (entry.key.clone(), self.machine(entry))).collect();
        self.check_keys(&machines, &places);
        machines
    }

    /// Checks that all machines have a key, or none has: a machine with a key and one without refuse each other's messages.
    fn check_keys(&mut self, machines: &BTreeMap<String, Machine>, places: &[(String, SourceSpan)]) {
        let Some((with, _)) = machines.iter().find(|(_, machine)| machine.key.is_some()) else { return };
        let without = |name: &str| machines.get(name).is_some_and(|machine| machine.key.is_none());
        for (name, place) in places.iter().filter(|(name, _)| without(name)) {
            let what = format!("machine `{name}` has no `key`, but machine `{with}` has one");
            self.fault(place, what, "give all machines the same key, each in its own table");
        }
    }

    fn machine(&mut self, entry: Entry) -> Machine {
        let (owner, place) = (format!("machine `{}`", entry.key), entry.key_place.clone());
        self.check_name(&entry.key, &place, "machine", MAX_STAGE_NAME, "_-");
        self.go_to(Some(&entry.key));
        let mut table = self.table(entry, "[machine.robot]").unwrap_or_default();
        let mut endpoints = |reader: &mut Self, key| table.take(key).and_then(|entry| reader.strings(&entry));
        let listen = endpoints(self, "listen").unwrap_or_default();
        let connect = endpoints(self, "connect").unwrap_or_default();
        let zenoh = table.take("zenoh").and_then(|entry| self.existing_file(&entry));
        let key = table.take("key").and_then(|entry| self.existing_file(&entry));
        let insecure = table.take("insecure").and_then(|entry| self.boolean(&entry)).unwrap_or_default();
        let outage_s = table.take("outage_s").and_then(|entry| self.seconds(&entry, OUTAGE_S, OUTAGE_HINT));
        let metrics = table.take("metrics").and_then(|entry| self.metrics(entry));
        self.unknown_keys(&table, &MACHINE_KEYS, &owner);
        let machine = Machine { listen, connect, zenoh, key, insecure, outage_s, metrics };
        let Some(network) = &self.context.registry.network else { return machine };
        if let Err(error) = (network.check)(&machine) {
            self.fault(&place, format!("{owner}: {}", error.what), error.hint);
        } else if !self.elsewhere {
            let warnings = (network.warnings)(&machine).into_iter();
            let warning = |Hinted { what, hint, .. }| Diagnostic::warning(&place, format!("{owner}: {what}"), hint);
            self.faults.extend(warnings.map(warning));
        }
        machine
    }

    fn existing_file(&mut self, entry: &Entry) -> Option<PathBuf> {
        let path = self.context.base.join(self.string(entry)?);
        if !path.is_file() && !self.elsewhere {
            let hint = "paths are relative to the pipeline file";
            self.fault(&entry.value.place, format!("there is no file `{}`", path.display()), hint);
        }
        Some(path)
    }
}
