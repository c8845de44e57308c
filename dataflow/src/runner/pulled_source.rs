//! A source whose program makes its messages in a loop of its own, instead of being called for them: the base of bindings to
//! other languages. It has the rights and duties of a [`Source`](crate::Source).

use super::pace::Rhythm;
use super::side_ports::{RetainedMessage, retained};
use super::source_loop::{SourcePlace, resume, takes_place};
use super::{RunError, StageRuntime};
use crate::item_type::{AnyMessage, ItemType};
use crate::ports::shared_memory::SharedMemory;
use crate::stage::Context;
use conicflow_messages::{AnyByte, Header};
use serde_json::Value as Json;
use std::time::{Duration, Instant};

/// A source that drives its own loop.
pub struct PulledSource {
    place: SourcePlace<SharedMemory>,
    context: Context,
    parameters: Json,
    /// Time at which work on the current frame began.
    started: Option<Instant>,
    /// Whether the run ended while a message was to be sent.
    is_over: bool,
}

impl PulledSource {
    /// Opens a source. `total` is the number of its messages, where known; its parameter `rate_hz`, where it has one, limits the
    /// rate. A source without a total goes on while the run is paused. `None`: this process is a successor that is no longer
    /// wanted.
    pub(crate) fn open(
        mut runtime: StageRuntime<SharedMemory>,
        parameters: Json,
        total: Option<u64>,
    ) -> Result<Option<Self>, RunError> {
        if runtime.wiring.input.is_some() {
            let what = "this stage has an `input` in the pipeline file";
            return Err(RunError::refused(what, "let the program be a stage, not a source"));
        }
        runtime.context.output = runtime.output_of_any()?;
        if runtime.context.output.is_none() {
            return Err(RunError::refused("this source has no `output` in the pipeline file", "name a topic there"));
        }
        let (side_inputs, output_port) =
            (runtime.side_inputs_of(&[])?, runtime.output_port(&ItemType::of::<AnyByte>())?);
        if !takes_place(&mut runtime)? {
            return Ok(None);
        }
        resume(&mut runtime);
        let context = runtime.context.clone();
        let rate_hz = parameters.get("rate_hz").and_then(Json::as_f64).unwrap_or(0.0);
        let rhythm = Rhythm { rate_hz, keeps_stamps: false, can_pause: total.is_some() };
        let place = SourcePlace::begin(runtime, side_inputs, output_port, total, rhythm)?;
        Ok(Some(Self { place, context, parameters, started: None, is_over: false }))
    }

    /// Information for the source at its start.
    pub fn context(&self) -> &Context {
        &self.context
    }

    /// Its parameters from the pipeline file.
    pub fn parameters(&self) -> &Json {
        &self.parameters
    }

    /// Waits until the next message is due, and returns its number; `None`: the source is to end.
    ///
    /// # Errors
    /// Its ports failed.
    pub fn next_number(&mut self) -> Result<Option<u64>, RunError> {
        if self.is_over || !self.place.wait_until_due() {
            return Ok(None);
        }
        self.place.find_side_inputs()?;
        self.started = Some(Instant::now());
        Ok(Some(self.place.sequence))
    }

    /// The latest messages of the side inputs, by name; each may be missing.
    pub fn side_inputs(&self) -> impl Iterator<Item = (&str, RetainedMessage, &ItemType)> {
        retained(&self.place.side_inputs)
    }

    /// Sends a message; the sequence number of its header is kept if it rises.
    ///
    /// # Errors
    /// No reader would take the items, or its ports failed.
    pub fn send(&mut self, header: Header, bytes: &[u8]) -> Result<(), RunError> {
        let place = &mut self.place;
        let Some(item) = place.output_port.item().cloned() else { return Ok(()) };
        let header = place.numbered(header);
        item.check(&header, bytes).map_err(RunError::of_malformed)?;
        place.output_port.write(bytes)?;
        let making = self.started.replace(Instant::now()).map_or(Duration::ZERO, |started| started.elapsed());
        self.is_over |= !place.send(header, making, None)?;
        let message = AnyMessage { header: &header, item: &item, bytes };
        message.each_label(|label| place.record.status.count_found(label));
        place.keep_counts(header.sequence);
        Ok(())
    }

    /// Smallest sequence number that the next message can have.
    pub fn sequence(&self) -> u64 {
        self.place.sequence
    }

    /// Sequence number of the current frame, if there is one.
    pub fn frame(&self) -> Option<u64> {
        self.started.map(|_| self.place.sequence)
    }

    /// Whether it has asked for a number: errors before that are errors of its start.
    pub fn has_begun(&self) -> bool {
        self.started.is_some()
    }

    /// Adds to a counter that the summary and `top` show.
    pub fn count(&mut self, name: &str, times: u64) {
        if times > 0 {
            self.place.record.status.count(name, times);
            // The source may count for a long time before it sends a message.
            self.place.record.write();
        }
    }

    /// Ends the work and the stream.
    ///
    /// # Errors
    /// Its ports failed.
    pub fn end(self) -> Result<(), RunError> {
        self.place.end(|| Ok(()))
    }
}
