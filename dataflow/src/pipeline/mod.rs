//! The pipeline file: its stages, their machines, and the topics between them.
//!
//! Reading takes three steps, each of which reports all its faults before the next begins: TOML into a tree with positions
//! ([`value`]), the tree into stages ([`read`]), and checks of the stages against each other ([`check`]).

mod check;
mod diagnostic;
mod file_schema;
mod files;
mod graph;
mod machine;
mod metrics;
mod read;
mod schema;
mod spec;
mod value;

pub use diagnostic::{Diagnostic, Report, Severity, SourceText, suggestion};
pub use file_schema::file_schema;
pub use machine::{BRIDGE, Compression, Machine, check_endpoint, check_host, split_endpoint};
pub use metrics::Metrics;
pub use read::MAX_STAGE_NAME;
pub(crate) use read::stages::TIME_TO_JOIN_S;
pub use schema::value_fault;
pub(crate) use schema::{fault_by, schema_of};
pub use spec::{Input, Pipeline, Program, Restart, StageSpec};

use crate::registry::Registry;
use read::ReadContext;
use std::path::Path;
use std::sync::Arc;

impl Pipeline {
    /// Reads and checks a pipeline.
    ///
    /// `base` is the folder against which its paths are resolved, `overrides` are `STAGE.KEY=VALUE`, `registry` has the nodes and
    /// the network part that it may use. The returned report holds only warnings.
    ///
    /// # Errors
    /// All faults of it, at once.
    pub fn read(
        source: SourceText,
        base: &Path,
        overrides: &[String],
        registry: &Registry,
    ) -> Result<(Self, Report), Report> {
        Self::read_on(None, source, base, overrides, registry)
    }

    /// Reads and checks a pipeline for one of its machines: files and programs of the others may be missing here.
    ///
    /// # Errors
    /// All faults of it, at once.
    pub fn read_on(
        machine: Option<&str>,
        source: SourceText,
        base: &Path,
        overrides: &[String],
        registry: &Registry,
    ) -> Result<(Self, Report), Report> {
        let source = Arc::new(source);
        let mut faults = Vec::new();
        let mut document = value::parse(&source, &mut faults);
        if !faults.is_empty() {
            return Err(Report::in_order(faults));
        }
        for text in overrides {
            value::apply_override(&mut document, text, &mut faults);
        }
        let mut pipeline = read::pipeline(document, &source, &ReadContext { base, machine, registry }, &mut faults);
        pipeline.source = (SourceText::clone(&source), overrides.to_vec());
        check::connections(&pipeline, &mut faults);
        files::overwritten(&pipeline, machine, &mut faults);
        let report = Report::in_order(faults);
        if report.has_errors() { Err(report) } else { Ok((pipeline, report)) }
    }
}

#[cfg(test)]
pub(crate) mod tests;
