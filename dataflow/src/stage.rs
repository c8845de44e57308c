//! The contract between a stage and its runner: one trait for sources, and one for all further stages.
//!
//! A [`Source`] makes messages, a [`Stage`] turns one message into another, and a sink is a [`Stage`] whose output is
//! [`Nothing`](conicflow_messages::Nothing). None of them knows its neighbours, the machines they run on, or whether it runs in a
//! test.

use crate::file_use::FileUse;
use crate::item_type::ItemType;
use crate::ports::Delivery;
use crate::side_inputs::{SideInput, SideInputs};
use crate::stop::Stop;
use bytemuck::try_cast_slice_mut;
use conicflow_messages::{ConfigFault, Header, Item, Message};
use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Error of a stage that could not start or go on; its text says what, where and, after `hint:`, what to do.
pub type StageError = Box<dyn std::error::Error + Send + Sync>;

/// The parameters of a node, as the pipeline file gives them.
///
/// Types, defaults, ranges and descriptions have one source, the struct itself: its field types, its `Default`, its
/// `#[schemars(range(..))]` attributes and its doc comments. Derive `Deserialize` with `#[serde(default, deny_unknown_fields)]`.
/// [`Stage::faults`] checks what types and ranges cannot express.
pub trait Config: DeserializeOwned + Serialize + JsonSchema + Default {}

impl<T: DeserializeOwned + Serialize + JsonSchema + Default> Config for T {}

/// Parameters of a node that has none.
#[derive(Clone, Debug, Default, serde::Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct NoConfig {}

/// Information for a stage at its start.
#[derive(Clone, Debug, Default)]
pub struct Context {
    /// Name of the stage in the pipeline file.
    pub stage: String,
    /// Folder of the pipeline file; relative paths are resolved against it.
    pub base: PathBuf,
    /// Unique number of the run; 0 for a stage that was started by itself.
    pub run: u64,
    /// Number of messages that this stage had sent or taken before its restart in the same run; 0 at first.
    pub resume_at: u64,
    /// Type of its input. A stage that takes items of any type, as [`AnyByte`](conicflow_messages::AnyByte), finds the actual one
    /// here.
    pub input: Option<ItemType>,
    /// Delivery of its input: [`Latest`](Delivery::Latest) for live work, [`Lossless`](Delivery::Lossless) where no message may
    /// be lost. A source has none.
    pub delivery: Option<Delivery>,
    /// Type of a source's output. A source that makes items of any type finds the actual one here.
    pub output: Option<ItemType>,
    /// Counters of this stage before its restart (see [`Output::count`]).
    pub counted: BTreeMap<String, u64>,
    /// Set when the run is to end.
    pub stop: Stop,
}

impl Context {
    /// Resolves a path of the pipeline file, which is relative to that file.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        self.base.join(path)
    }
}

/// First stage of a pipeline: it has no driving input and makes messages.
pub trait Source: Sized {
    /// Name of the node in the pipeline file.
    const NAME: &'static str;
    /// Summary in one sentence.
    const SUMMARY: &'static str;
    /// Its parameters.
    type Config: Config;
    /// Type of the items that it makes.
    type Output: Item;

    /// Creates the source.
    ///
    /// # Errors
    /// A parameter or a file cannot be used; the stage is not restarted.
    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError>;

    /// Finds faults of parameters that types and ranges cannot express: missing files, values that exclude each other. `base` is
    /// the folder of the pipeline file, against which relative paths are resolved.
    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it reads, as far as they are known before it is created. No stage of the run may write over them.
    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it writes.
    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// Inputs of which it reads the latest value.
    fn side_inputs() -> &'static [SideInput] {
        &[]
    }

    /// Number of items of a message (pixels of an image), where it is known before the source is created: a run does not start if
    /// shared memory has no room for them. `base` is the folder of the pipeline file.
    fn message_length(config: &Self::Config, base: &Path) -> Option<usize> {
        let _ = (config, base);
        None
    }

    /// Maximum rate in messages per second; 0: as fast as they are taken.
    fn rate_hz(&self) -> f64 {
        0.0
    }

    /// Whether to send its messages at the intervals of their stamps, whatever [`Source::rate_hz`] says.
    fn keeps_stamps(&self) -> bool {
        false
    }

    /// Total number of messages that it will make, where known.
    fn total(&self) -> Option<u64> {
        None
    }

    /// Whether it can stand still while its run is paused: a recording can, a camera cannot. By default a source with a known
    /// total can.
    fn can_pause(&self) -> bool {
        self.total().is_some()
    }

    /// Makes the next message: fills `output.header` (camera, scale, noise, stamp, source) and writes the items. While it waits
    /// for a device, the source has to query [`Context::stop`]. A source whose frames have their own numbers sets
    /// `output.header.sequence`; these must rise. Other frames are numbered from 0.
    ///
    /// # Errors
    /// A device or a file failed; the stage is restarted as the pipeline file says.
    fn next(&mut self, side_inputs: &SideInputs, output: &mut Output<Self::Output>) -> Result<Next, StageError>;

    /// Ends its work after the last message, also where the run ends before the source does.
    ///
    /// # Errors
    /// Pending data could not be sent; the stage is not restarted.
    fn finish(&mut self) -> Result<(), StageError> {
        Ok(())
    }
}

/// Result of asking a source for its next message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// A message was written.
    Message,
    /// There is no message yet. Counts are kept, and the source is asked again at once.
    Later,
    /// The source is exhausted.
    End,
}

/// A stage in the middle of a pipeline, or a sink at its end, driven by one input.
pub trait Stage: Sized {
    /// Name of the node in the pipeline file.
    const NAME: &'static str;
    /// Summary in one sentence.
    const SUMMARY: &'static str;
    /// Its parameters.
    type Config: Config;
    /// Type of the items that drive it.
    type Input: Item;
    /// Type of the items that it makes; [`Nothing`](conicflow_messages::Nothing) for a sink.
    type Output: Item;

    /// Creates the stage.
    ///
    /// # Errors
    /// A parameter or a file cannot be used; the stage is not restarted.
    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError>;

    /// Finds faults of parameters that types and ranges cannot express: missing files, values that exclude each other. `base` is
    /// the folder of the pipeline file, against which relative paths are resolved.
    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it reads, as far as they are known before it is created. No stage of the run may write over them.
    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it writes.
    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// Side inputs, which do not drive it.
    fn side_inputs() -> &'static [SideInput] {
        &[]
    }

    /// Turns one message into another. The output's header is a copy of the input's, which the stage may change.
    ///
    /// # Errors
    /// The stage cannot go on. "Nothing found in this frame" is an empty list, not an error.
    fn step(
        &mut self,
        input: &Message<Self::Input>,
        side_inputs: &SideInputs,
        output: &mut Output<Self::Output>,
    ) -> Result<(), StageError>;

    /// Ends its work after the last message: closes files, prints totals.
    ///
    /// # Errors
    /// Its work could not be ended; the stage is not restarted.
    fn finish(&mut self) -> Result<(), StageError> {
        Ok(())
    }
}

/// Output of a step.
///
/// Images are written directly into the memory that the next stage reads, by [`Output::loan`]. Lists, whose length is known only
/// at the end, are collected by [`Output::push`] and copied there once.
pub struct Output<'a, T: Item> {
    /// The header of the message.
    pub header: Header,
    memory: &'a mut dyn Memory,
    list: &'a mut Vec<T>,
    counts: &'a mut BTreeMap<&'static str, u64>,
    /// Whether the items were written in place.
    is_loaned: bool,
}

/// An [`Output`] without its item type.
pub(crate) struct UntypedOutput<'a> {
    pub(crate) header: Header,
    pub(crate) memory: &'a mut dyn Memory,
    pub(crate) counts: &'a mut BTreeMap<&'static str, u64>,
}

/// Memory that the next stage reads.
pub(crate) trait Memory {
    /// Loans bytes for `length` items, with arbitrary but valid content.
    fn loan(&mut self, length: usize) -> Result<&mut [u8], StageError>;
}

impl<'a, T: Item> Output<'a, T> {
    pub(crate) fn new<'p: 'a>(
        UntypedOutput { header, memory, counts }: UntypedOutput<'p>,
        list: &'a mut Vec<T>,
    ) -> Self {
        list.clear();
        Self { header, memory, list, counts, is_loaned: false }
    }

    /// Appends an item to the list that is sent.
    pub fn push(&mut self, item: T) {
        self.list.push(item);
    }

    /// Appends items to the list that is sent.
    pub fn extend(&mut self, items: &[T]) {
        self.list.extend_from_slice(items);
    }

    /// Loans memory for `length` items, which are written in place and then sent; usually they are the pixels of an image. Each
    /// item must be written: the memory holds the content of an earlier message. For items of any type `length` is in items of the
    /// actual type, and the memory is their bytes.
    ///
    /// # Errors
    /// Shared memory is exhausted.
    pub fn loan(&mut self, length: usize) -> Result<&mut [T], StageError> {
        self.is_loaned = true;
        let bytes = self.memory.loan(length)?;
        try_cast_slice_mut(bytes).map_err(|error| format!("the output has no place for {}: {error}", T::NAME).into())
    }

    /// Adds to a counter, such as a reason for rejected candidates. `top` shows all counters. The summary shows those of sources
    /// and sinks always, the others with `--log debug` or if nothing was found.
    pub fn count(&mut self, name: &'static str, times: u64) {
        if times > 0 {
            *self.counts.entry(name).or_default() += times;
        }
    }

    /// Adds to several counters.
    pub fn count_all(&mut self, counts: impl Iterator<Item = (&'static str, u64)>) {
        for (name, times) in counts {
            self.count(name, times);
        }
    }

    /// Whether the items were written in place, by [`Output::loan`].
    pub(crate) fn is_loaned(&self) -> bool {
        self.is_loaned
    }
}
