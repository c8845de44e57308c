//! The sink that writes JSON: one object per message and line, for scripts, plots and other programs.

use crate::sinks::json_lines::{JsonLines, Wrote};
use crate::stage_error::stage_error;
use conicflow_dataflow::{
    AnyMessage, ConfigFault, Context, ItemType, Output, SideInputs, Stage, StageError, Stop, monotonic_ns,
};
use conicflow_messages::{AnyByte, Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Parameters of `json_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct JsonSinkConfig {
    /// File to write, relative to the pipeline file; "-" is standard output.
    pub path: PathBuf,
}

impl Default for JsonSinkConfig {
    fn default() -> Self {
        Self { path: PathBuf::from("-") }
    }
}

impl JsonSinkConfig {
    /// What types and ranges cannot tell: values that exclude each other, files that are missing.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let path = base.join(&self.path);
        let what = if self.path.as_os_str().is_empty() {
            "is empty".to_owned()
        } else if !is_standard_output(&self.path) && path.is_dir() {
            format!("`{}` is a folder, expected a file", path.display())
        } else {
            return Vec::new();
        };
        let hint = "give the name of a file, such as \"objects.jsonl\", or \"-\" for standard output".to_owned();
        vec![ConfigFault { key: "path", what, hint }]
    }
}

fn is_standard_output(path: &Path) -> bool {
    path == Path::new("-")
}

/// Writes messages with lists of any type as lines of JSON.
pub struct JsonSink {
    lines: JsonLines,
    stop: Stop,
    /// What the lists consist of.
    item: ItemType,
}

impl Stage for JsonSink {
    const NAME: &'static str = "json_sink";
    const SUMMARY: &'static str = "Writes ellipses, objects, tracks or other lists as JSON, one line per message";
    type Config = JsonSinkConfig;
    type Input = AnyByte;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn new(config: JsonSinkConfig, context: &Context) -> Result<Self, StageError> {
        let lines = if is_standard_output(&config.path) {
            JsonLines::standard_output()
        } else {
            JsonLines::open(&context.resolve(&config.path), context.resume_at > 0)?
        };
        let item = context.input.clone().ok_or("nothing tells what this sink is to write")?;
        Ok(Self { lines, stop: context.stop.clone(), item })
    }

    fn step(&mut self, input: &Message<AnyByte>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        let message = AnyMessage { header: input.header, item: &self.item, bytes: bytemuck::cast_slice(input.items) };
        let latency_ms = input.header.latency_ms(monotonic_ns());
        let wrote = self.lines.write_with(|line| message.write_json(latency_ms, line)).map_err(stage_error)?;
        if wrote == Wrote::ReaderGone {
            self.stop.request();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Object;

    #[test]
    fn a_folder_in_place_of_a_file_is_told_before_the_start() {
        let folder = tempfile::tempdir().unwrap();
        let config = JsonSinkConfig { path: PathBuf::from(".") };
        assert!(config.faults(folder.path())[0].what.contains("is a folder"));
        let config = JsonSinkConfig { path: PathBuf::new() };
        assert_eq!(config.faults(folder.path())[0].what, "is empty");
        assert!(JsonSinkConfig::default().faults(folder.path()).is_empty());
    }

    #[test]
    fn the_file_stands_relative_to_the_pipeline_file() {
        let folder = tempfile::tempdir().unwrap();
        let input = Some(ItemType::of::<Object>());
        let context = Context { base: folder.path().to_owned(), input, ..Context::default() };
        let config = JsonSinkConfig { path: PathBuf::from("results/objects.jsonl") };
        JsonSink::new(config, &context).unwrap();
        assert!(folder.path().join("results/objects.jsonl").is_file());
    }
}
