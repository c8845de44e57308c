//! Records the input and side inputs into an MCAP file that other programs can read and that `mcap_source` replays.

use crate::faults::stage_error;
use crate::recording::recorder::{Limits, Recorded, Recorder, further_files};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{
    AnyMessage, BUILT_IN, ConfigFault, Context, FileUse, ItemType, Output, SideInput, SideInputs, Stage, StageError,
    monotonic_ns,
};
use conicflow_messages::{Ellipse, Hinted, Item, Message, Nothing, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Parameters of [`McapSink`].
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The file to write, relative to the pipeline file; those that follow it are called `run_1.mcap`, `run_2.mcap`, ..
    pub path: Option<PathBuf>,
    /// Begin another file after so many megabytes; default: never.
    #[schemars(range(min = 1.0))]
    pub split_mb: Option<f64>,
    /// Begin another file after so many seconds, by the stamps of the frames; default: never.
    #[schemars(range(min = 1.0))]
    pub split_s: Option<f64>,
    /// Most megabytes of all files together: the oldest is removed, or where there is but one the recording ends; default: as
    /// much as the disk holds.
    #[schemars(range(min = 1.0))]
    pub limit_mb: Option<f64>,
}

impl Config {
    /// The limits in bytes and nanoseconds.
    pub fn limits(&self) -> Limits {
        let bytes = |megabytes: f64| (megabytes * 1e6) as u64;
        Limits {
            split_bytes: self.split_mb.map(bytes),
            split_ns: self.split_s.map(|seconds| (seconds * 1e9) as u64),
            total_bytes: self.limit_mb.map(bytes),
        }
    }
}

/// Writes messages with items of type `T` into a recording, with the side inputs of the same frames.
pub struct McapSink<T> {
    recorder: Recorder,
    /// Whether no message may be lost, even if this process is killed.
    is_lossless: bool,
    /// Type of the items.
    item: ItemType,
    is_reported: bool,
    items: PhantomData<T>,
}

impl<T: Item> Stage for McapSink<T> {
    const NAME: &'static str = "mcap_sink";
    const SUMMARY: &'static str =
        "Records into an MCAP file, which Foxglove, Rerun and ROS 2 read and mcap_source replays";
    type Config = Config;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let what = match &config.path {
            None => "is missing".to_owned(),
            Some(path) if base.join(path).is_dir() => {
                format!("`{}` is a folder, expected a file", base.join(path).display())
            }
            Some(_) => return Vec::new(),
        };
        vec![ConfigFault::new("path", what, "write `path = \"run.mcap\"`")]
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let Some(path) = config.path.as_ref().map(|path| base.join(path)) else { return Vec::new() };
        let is_split = config.split_mb.is_some() || config.split_s.is_some();
        let further = is_split.then(|| further_files("path", &path));
        further.into_iter().chain([FileUse::one("path", path)]).collect()
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        let path = config.path.as_ref();
        let path = path.ok_or_else(|| Hinted::new("`path` is missing", "write `path = \"run.mcap\"`"))?;
        let path = context.resolve(path);
        let recorder = Recorder::create(&path, config.limits(), context.run, context.resume_at > 0)?;
        let is_lossless = context.delivery == Some(Delivery::Lossless);
        let item = context.input.clone().unwrap_or(const { ItemType::of::<T>() });
        Ok(Self { recorder, is_lossless, item: shown(item), is_reported: false, items: PhantomData })
    }

    fn side_inputs() -> &'static [SideInput] {
        const {
            &[
                SideInput::same_frame::<u16>("depth"),
                SideInput::same_frame::<Ellipse>("ellipses"),
                SideInput::same_frame::<Object>("objects"),
            ]
        }
    }

    fn step(&mut self, input: &Message<T>, sides: &SideInputs, output: &mut Output<Nothing>) -> Result<(), StageError> {
        let mut recorded = self.side::<u16>(sides, "depth")?;
        recorded.extend(self.side::<Ellipse>(sides, "ellipses")?);
        recorded.extend(self.side::<Object>(sides, "objects")?);
        let message = AnyMessage { header: input.header, item: &self.item, bytes: bytemuck::cast_slice(input.items) };
        recorded.push(self.record(self.item.name(), &message)?);
        let left_out = recorded.iter().filter(|recorded| **recorded == Recorded::Full).count();
        if left_out > 0 && !self.is_reported {
            self.is_reported = true;
            tracing::warn!("the recording has reached `limit_mb`: no more is recorded");
        }
        if self.is_lossless {
            // The writers of these messages do not keep them after this step.
            self.recorder.flush().map_err(stage_error)?;
        }
        output.count("messages recorded", (recorded.len() - left_out) as u64);
        output.count("messages beyond the limit", left_out as u64);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.recorder.finish()?;
        Ok(())
    }
}

impl<T> McapSink<T> {
    /// Records the message of a side input, if there is one.
    fn side<S: Item>(&self, sides: &SideInputs, name: &'static str) -> Result<Vec<Recorded>, StageError> {
        let Some(message) = sides.get::<S>(name) else { return Ok(Vec::new()) };
        let item = shown(const { ItemType::of::<S>() });
        let message = AnyMessage { header: message.header, item: &item, bytes: bytemuck::cast_slice(message.items) };
        Ok(vec![self.record(name, &message)?])
    }

    fn record(&self, topic: &str, message: &AnyMessage<'_>) -> Result<Recorded, StageError> {
        self.recorder.write(topic, message, message.header.latency_ms(monotonic_ns())).map_err(stage_error)
    }
}

/// Returns the item type as in the table of built-in types, which can be shown; or else unchanged.
fn shown(item: ItemType) -> ItemType {
    BUILT_IN.iter().find(|row| row.fits(&item)).cloned().unwrap_or(item)
}
