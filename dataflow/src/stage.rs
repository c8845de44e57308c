//! The contract between a stage and what runs it: one trait for what begins a pipeline, and one for all that follows.
//!
//! A [`Source`] makes messages, a [`Stage`] turns one message into another, and a sink is a [`Stage`] whose output is
//! [`Nothing`](conicflow_messages::Nothing). None of them knows who is up- or downstream, on which machine, or whether it
//! is a test.

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

/// Why a stage could not start or go on; its text says what, where and, after `hint:`, what to do.
pub type StageError = Box<dyn std::error::Error + Send + Sync>;

/// The parameters of a node, as they stand in the pipeline file.
///
/// Types, defaults, ranges and descriptions come from one place, the struct itself: its field types, its `Default`, its
/// `#[schemars(range(..))]` attributes and its doc comments. Derive `Deserialize` with
/// `#[serde(default, deny_unknown_fields)]`. What types and ranges cannot tell is told by [`Stage::faults`].
pub trait Config: DeserializeOwned + Serialize + JsonSchema + Default {}

impl<T: DeserializeOwned + Serialize + JsonSchema + Default> Config for T {}

/// A node without parameters.
#[derive(Clone, Debug, Default, serde::Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct NoConfig {}

/// What a stage is told when it starts.
#[derive(Clone, Debug, Default)]
pub struct Context {
    /// Name of the stage in the pipeline file.
    pub stage: String,
    /// Folder of the pipeline file; relative paths are resolved against it.
    pub base: PathBuf,
    /// A number that no other run has; 0 where the stage was started by itself.
    pub run: u64,
    /// Number of messages that this stage sent or took before it was started anew in the same run; 0 at first.
    pub resume_at: u64,
    /// What drives it. A stage that takes lists of any type, as [`AnyByte`](conicflow_messages::AnyByte), learns it here.
    pub input: Option<ItemType>,
    /// Which of the messages that drive it it gets: with the newest it works live, with each no message may be lost. A source has
    /// none.
    pub delivery: Option<Delivery>,
    /// What a source makes. One that makes lists of any type learns it here.
    pub output: Option<ItemType>,
    /// What this stage had counted by then (see [`Output::count`]).
    pub counted: BTreeMap<String, u64>,
    /// Raised when the run is to end.
    pub stop: Stop,
}

impl Context {
    /// A path from the pipeline file, relative to that file.
    pub fn resolve(&self, path: &Path) -> PathBuf {
        self.base.join(path)
    }
}

/// The first stage of a pipeline: it has no input and makes messages of its own.
pub trait Source: Sized {
    /// Name of the node in the pipeline file.
    const NAME: &'static str;
    /// What it does, in one sentence.
    const SUMMARY: &'static str;
    /// Its parameters.
    type Config: Config;
    /// What it makes.
    type Output: Item;

    /// Makes it ready.
    ///
    /// # Errors
    /// A parameter or a file that cannot be used; the stage is not started anew.
    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError>;

    /// What is wrong with parameters that types and ranges let pass: files that are missing, values that exclude each other.
    /// `base` is the folder of the pipeline file, against which relative paths are resolved.
    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it reads, as far as they are known before it is made ready: nothing in the run may write over them.
    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it writes.
    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        let _ = (config, base);
        Vec::new()
    }

    /// Inputs whose latest value it reads.
    fn side_inputs() -> &'static [SideInput] {
        &[]
    }

    /// Number of items of a message (of an image its pixels), where that is known before it is made ready: the run does not
    /// start where shared memory has no room for them. `base` is the folder of the pipeline file.
    fn message_length(config: &Self::Config, base: &Path) -> Option<usize> {
        let _ = (config, base);
        None
    }

    /// Messages per second that it is to be kept to; 0: as fast as they are taken.
    fn rate_hz(&self) -> f64 {
        0.0
    }

    /// Whether its messages are to be sent as far apart as their stamps are, whatever [`Source::rate_hz`] says.
    fn keeps_stamps(&self) -> bool {
        false
    }

    /// Number of messages that it will make in all, where that is known.
    fn total(&self) -> Option<u64> {
        None
    }

    /// Whether it can stand still while its run is paused: a recording can, a camera cannot. Default: what has an end can.
    fn can_pause(&self) -> bool {
        self.total().is_some()
    }

    /// Makes the next message: fills `output.header` (camera, scale, noise, stamp, source) and writes the items. A
    /// source that waits for a device looks at [`Context::stop`] meanwhile. Frames that have numbers of their own keep them by
    /// `output.header.sequence`, as long as these rise; others are numbered from 0.
    ///
    /// # Errors
    /// A device or a file that failed; the stage is started anew, as the pipeline file says.
    fn next(&mut self, side_inputs: &SideInputs, output: &mut Output<Self::Output>) -> Result<Next, StageError>;

    /// Ends its work, after the last message, also where the run ends before it has no more.
    ///
    /// # Errors
    /// What it was to send and could not; the stage is not started anew.
    fn finish(&mut self) -> Result<(), StageError> {
        Ok(())
    }
}

/// What a source has to offer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// A message was written.
    Message,
    /// There is none yet; what was counted is kept, and the source is asked again at once.
    Later,
    /// There is none, and there will be no more.
    End,
}

/// A stage in the middle of a pipeline, or a sink at its end: driven by one input.
pub trait Stage: Sized {
    /// Name of the node in the pipeline file.
    const NAME: &'static str;
    /// What it does, in one sentence.
    const SUMMARY: &'static str;
    /// Its parameters.
    type Config: Config;
    /// What drives it.
    type Input: Item;
    /// What it makes; [`Nothing`](conicflow_messages::Nothing) for a sink.
    type Output: Item;

    /// Makes it ready.
    ///
    /// # Errors
    /// A parameter or a file that cannot be used; the stage is not started anew.
    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError>;

    /// What is wrong with parameters that types and ranges let pass: files that are missing, values that exclude each other.
    /// `base` is the folder of the pipeline file, against which relative paths are resolved.
    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let _ = (config, base);
        Vec::new()
    }

    /// The files that it reads, as far as they are known before it is made ready: nothing in the run may write over them.
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

    /// Turns one message into one of its own. The output's header is the input's, to be changed where need be.
    ///
    /// # Errors
    /// What cannot be gone on from; "nothing found in this frame" is an empty list, not an error.
    fn step(
        &mut self,
        input: &Message<Self::Input>,
        side_inputs: &SideInputs,
        output: &mut Output<Self::Output>,
    ) -> Result<(), StageError>;

    /// Ends its work, after the last message: closes files, prints sums.
    ///
    /// # Errors
    /// What could not be ended; the stage is not started anew.
    fn finish(&mut self) -> Result<(), StageError> {
        Ok(())
    }
}

/// The place where a step writes its message.
///
/// Images are written straight into the memory that the next stage reads, by [`Output::image`]. Lists, whose length is
/// known only at the end, are gathered by [`Output::push`] and copied there once.
pub struct Output<'a, T: Item> {
    /// The header of the message.
    pub header: Header,
    memory: &'a mut dyn Memory,
    list: &'a mut Vec<T>,
    counts: &'a mut BTreeMap<&'static str, u64>,
    image: bool,
}

/// An [`Output`] whatever its items.
pub(crate) struct UntypedOutput<'a> {
    pub(crate) header: Header,
    pub(crate) memory: &'a mut dyn Memory,
    pub(crate) counts: &'a mut BTreeMap<&'static str, u64>,
}

/// Memory that the next stage reads.
pub(crate) trait Memory {
    /// The bytes of a place for `length` items, with undefined but valid content.
    fn loan(&mut self, length: usize) -> Result<&mut [u8], StageError>;
}

impl<'a, T: Item> Output<'a, T> {
    pub(crate) fn new<'p: 'a>(
        UntypedOutput { header, memory, counts }: UntypedOutput<'p>,
        list: &'a mut Vec<T>,
    ) -> Self {
        list.clear();
        Self { header, memory, list, counts, image: false }
    }

    /// Adds an item to the list that is sent.
    pub fn push(&mut self, item: T) {
        self.list.push(item);
    }

    /// Adds items to the list that is sent.
    pub fn extend(&mut self, items: &[T]) {
        self.list.extend_from_slice(items);
    }

    /// Memory for `length` items, to be written in place; each must be written, the content before is left over from an
    /// earlier message. Where these are of any type, it is the bytes of so many.
    ///
    /// # Errors
    /// There is no memory left.
    pub fn image(&mut self, length: usize) -> Result<&mut [T], StageError> {
        self.image = true;
        let bytes = self.memory.loan(length)?;
        try_cast_slice_mut(bytes).map_err(|error| format!("the output has no place for {}: {error}", T::NAME).into())
    }

    /// Adds to a counter that the summary and `top` show, such as why candidates were turned down.
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

    pub(crate) fn is_image(&self) -> bool {
        self.image
    }
}
