//! Metrics settings: an address, or a table with address and token.

use super::Reader;
use crate::pipeline::diagnostic::Diagnostic;
use crate::pipeline::metrics::Metrics;
use crate::pipeline::value::{Content, Entry};
use std::net::SocketAddr;

pub const METRICS_KEYS: [&str; 2] = ["listen", "token"];
const ADDRESS_HINT: &str = "such as \"127.0.0.1:9464\" for this machine alone, \"0.0.0.0:9464\" for its whole network";

impl Reader<'_> {
    pub(super) fn metrics(&mut self, entry: Entry) -> Option<Metrics> {
        let place = entry.value.place.clone();
        let metrics = match entry.value.content {
            Content::Table(_) => self.metrics_with_token(entry)?,
            _ => Metrics { listen: self.address(&entry)?, token: None },
        };
        if metrics.is_open_to_others() && !self.elsewhere {
            let what = format!("everyone who reaches {} may read the metrics", metrics.listen);
            let hint = format!("metrics = {{ listen = \"{}\", token = \"..\" }} asks for a token", metrics.listen);
            self.faults.push(Diagnostic::warning(&place, what, hint));
        }
        Some(metrics)
    }

    fn metrics_with_token(&mut self, entry: Entry) -> Option<Metrics> {
        let place = entry.key_place.clone();
        let mut table = self.table(entry, "metrics = { listen = \"127.0.0.1:9464\" }")?;
        let listen = table.take("listen");
        let token = table.take("token").and_then(|entry| self.string(&entry));
        self.unknown_keys(&table, &METRICS_KEYS, "`metrics`");
        if listen.is_none() {
            self.fault(&place, "`metrics` has no `listen`", ADDRESS_HINT);
        }
        Some(Metrics { listen: self.address(&listen?)?, token })
    }

    /// Reads an address of this machine with a port.
    fn address(&mut self, entry: &Entry) -> Option<SocketAddr> {
        let text = self.string(entry)?;
        let address = text.parse().ok();
        if address.is_none() {
            let what = format!("`{}` cannot be `{text}`, expected ADDRESS:PORT in numbers", entry.key);
            self.fault(&entry.value.place, what, ADDRESS_HINT);
        }
        address
    }
}
