//! Writes one JSON object per message and line, for scripts, plots and other programs.

use crate::faults::stage_error;
use crate::sinks::json_lines::{JsonLines, Wrote};
use conicflow_dataflow::{
    AnyMessage, ConfigFault, Context, FileUse, ItemType, Output, SideInputs, Stage, StageError, Stop, monotonic_ns,
};
use conicflow_messages::{AnyByte, Header, Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::path::{Path, PathBuf};

/// Parameters of `json_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct JsonSinkConfig {
    /// File to write, relative to the pipeline file; "-" is standard output. What an earlier run has left there stays until the
    /// first message.
    pub path: PathBuf,
}

impl Default for JsonSinkConfig {
    fn default() -> Self {
        Self { path: PathBuf::from("-") }
    }
}

fn is_standard_output(path: &Path) -> bool {
    path == Path::new("-")
}

/// Writes messages with lists of any type as lines of JSON.
pub struct JsonSink {
    lines: JsonLines,
    stop: Stop,
    /// Type of the lists' items.
    item: ItemType,
    /// The last line of an earlier process, which may have been killed before it acknowledged that message.
    last: Option<Json>,
}

impl Stage for JsonSink {
    const NAME: &'static str = "json_sink";
    const SUMMARY: &'static str = "Writes ellipses, objects, tracks or other lists as JSON, one line per message";
    type Config = JsonSinkConfig;
    type Input = AnyByte;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let path = base.join(&config.path);
        let what = if config.path.as_os_str().is_empty() {
            "is empty".to_owned()
        } else if !is_standard_output(&config.path) && path.is_dir() {
            format!("`{}` is a folder, expected a file", path.display())
        } else {
            return Vec::new();
        };
        let hint = "give the name of a file, such as \"objects.jsonl\", or \"-\" for standard output";
        vec![ConfigFault::new("path", what, hint)]
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let file = Some(&config.path).filter(|path| !is_standard_output(path));
        file.map(|path| FileUse::one("path", base.join(path))).into_iter().collect()
    }

    fn new(config: JsonSinkConfig, context: &Context) -> Result<Self, StageError> {
        let lines = if is_standard_output(&config.path) {
            JsonLines::standard_output()
        } else {
            JsonLines::open(&context.resolve(&config.path), context.resume_at > 0)?
        };
        let item = context.input.clone().ok_or("nothing tells what this sink is to write")?;
        let last = if context.resume_at > 0 { lines.last()? } else { None };
        let last = last.and_then(|line| serde_json::from_slice(&line).ok());
        Ok(Self { lines, stop: context.stop.clone(), item, last })
    }

    fn step(&mut self, input: &Message<AnyByte>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.write(input.header, bytemuck::cast_slice(input.items), input.header.latency_ms(monotonic_ns()))
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.lines.warn_if_earlier();
        Ok(())
    }
}

impl JsonSink {
    /// Writes a message as a line, unless an earlier process has written it.
    fn write(&mut self, header: &Header, bytes: &[u8], latency_ms: Option<f64>) -> Result<(), StageError> {
        let message = AnyMessage { header, item: &self.item, bytes };
        if self.last.take_if(|last| describes(last, &message)).is_some() {
            return Ok(());
        }
        let wrote = self.lines.write_with(|line| message.write_json(latency_ms, line)).map_err(stage_error)?;
        if wrote == Wrote::ReaderGone {
            self.stop.request();
        }
        Ok(())
    }
}

/// Whether a line describes this message; its latency is not compared.
fn describes(line: &Json, message: &AnyMessage) -> bool {
    if line["sequence"] != message.header.sequence {
        return false;
    }
    let (mut own, mut line) = (Vec::new(), line.clone());
    line["latency_ms"] = Json::Null;
    message.write_json(None, &mut own).is_ok() && serde_json::from_slice::<Json>(&own).is_ok_and(|own| own == line)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Object, ObjectKind};

    #[test]
    fn a_folder_in_place_of_a_file_is_reported_before_the_start() {
        let folder = tempfile::tempdir().unwrap();
        let config = JsonSinkConfig { path: PathBuf::from(".") };
        assert!(JsonSink::faults(&config, folder.path())[0].what.contains("is a folder"));
        let config = JsonSinkConfig { path: PathBuf::new() };
        assert_eq!(JsonSink::faults(&config, folder.path())[0].what, "is empty");
        assert!(JsonSink::faults(&JsonSinkConfig::default(), folder.path()).is_empty());
    }

    /// The path is relative to the pipeline file.
    #[test]
    fn a_line_that_a_killed_process_wrote_is_not_repeated() {
        let folder = tempfile::tempdir().unwrap();
        let item = ItemType::shown::<Object>();
        let write = |resume_at, frames: &[(u64, f64)]| {
            let (base, input) = (folder.path().to_owned(), Some(item.clone()));
            let config = JsonSinkConfig { path: PathBuf::from("results/objects.jsonl") };
            let mut sink = JsonSink::new(config, &Context { base, input, resume_at, ..Context::default() }).unwrap();
            for &(sequence, radius) in frames {
                let object = Object { kind: ObjectKind::Sphere.code(), radius, ..Object::default() };
                let (header, bytes) = (&Header { sequence, ..Header::default() }, bytemuck::bytes_of(&object));
                sink.write(header, bytes, Some(radius * 7.0)).unwrap();
            }
        };
        write(0, &[(0, 0.1), (1, 0.2)]);
        write(1, &[(1, 0.2), (2, 0.3)]);
        write(3, &[(2, 0.4)]);
        let text = std::fs::read_to_string(folder.path().join("results/objects.jsonl")).unwrap();
        let radius = |line| serde_json::from_str::<Json>(line).unwrap()["objects"][0]["radius"].as_f64();
        assert_eq!(text.lines().map(radius).collect::<Vec<_>>(), [0.1, 0.2, 0.3, 0.4].map(Some), "{text}");
    }
}
