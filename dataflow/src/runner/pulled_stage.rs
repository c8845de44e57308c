//! A stage whose program pulls its messages, instead of being called with them: the base of bindings to other languages. It has
//! the rights and duties of a [`Stage`](crate::Stage), and sends exactly one message for each that it takes.

use super::side_ports::{RetainedMessage, retained};
use super::stage_place::{StagePlace, item_of, open_input};
use super::takeover::take_place;
use super::untyped::of_same_frame;
use super::{RunError, StageRuntime, is_stopped};
use crate::clock::monotonic_ns;
use crate::item_type::{AnyMessage, ItemType};
use crate::ports::shared_memory::SharedMemory;
use crate::ports::{Polled, Received};
use crate::stage::Context;
use conicflow_messages::{AnyByte, Header};
use serde_json::Value as Json;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A stage or sink that pulls its messages.
pub struct PulledStage {
    place: StagePlace<SharedMemory>,
    context: Context,
    parameters: Json,
    step: Option<Step>,
    /// Whether the run ended while a message was to be sent.
    is_over: bool,
    has_begun: bool,
}

/// Work on one message.
struct Step {
    header: Header,
    received_ns: u64,
    started: Instant,
    /// Time for which sending was blocked by its readers.
    waited: Duration,
    has_sent: bool,
}

impl PulledStage {
    /// Opens a stage. Side inputs in `same_frame` deliver the message of each step's frame, the others the latest one. `None`:
    /// this process is a successor that is no longer wanted.
    pub(crate) fn open(
        mut runtime: StageRuntime<SharedMemory>,
        parameters: Json,
        same_frame: &[String],
    ) -> Result<Option<Self>, RunError> {
        runtime.context.resume_at = runtime.record.status.steps.max(u64::from(runtime.successor.is_some()));
        let topic = runtime.wiring.input.take().ok_or_else(|| {
            let what = "this stage has no `input` in the pipeline file";
            RunError::refused(what, "give it one, or let the program be a source")
        })?;
        let item = item_of(&topic)?;
        let open = |runtime: &StageRuntime<SharedMemory>| {
            Ok((runtime.side_inputs_of(same_frame)?, open_input(runtime, &item, &topic)?))
        };
        let inputs = open(&runtime)?;
        runtime.context.output = runtime.output_of_any()?;
        let output_port = runtime.output_port(&ItemType::of::<AnyByte>())?;
        runtime.context.input = Some(item.clone());
        runtime.context.delivery = Some(topic.delivery_to(&runtime.context.stage));
        let Some(inputs) = take_place(inputs, open, &mut runtime, &topic)? else { return Ok(None) };
        runtime.context.resume_at = runtime.context.resume_at.max(runtime.record.status.steps);
        let context = runtime.context.clone();
        let place = StagePlace::begin(runtime, topic, inputs, output_port)?;
        Ok(Some(Self { place, context, parameters, step: None, is_over: false, has_begun: false }))
    }

    /// Information for the stage at its start.
    pub fn context(&self) -> &Context {
        &self.context
    }

    /// Its parameters from the pipeline file.
    pub fn parameters(&self) -> &Json {
        &self.parameters
    }

    /// Name and item type of the driving topic.
    pub fn input(&self) -> (&str, &ItemType) {
        (self.place.input_topic(), self.place.input_item())
    }

    /// Ends the step on the last message, and takes the next one, with the time of its receipt (see [`monotonic_ns`]). Waits for
    /// it, at most for `patience`. `Over`: the stage is to end.
    ///
    /// # Errors
    /// Its ports failed.
    pub fn pull(&mut self, patience: Duration) -> Result<Polled<(RetainedMessage, u64)>, RunError> {
        self.has_begun = true;
        self.end_step()?;
        if self.is_over {
            return Ok(Polled::Over);
        }
        match self.place.poll(patience)? {
            Polled::Over => Ok(Polled::Over),
            Polled::Pending => Ok(Polled::Pending),
            Polled::Message(message) => {
                let (header, received_ns) = (*message.header(), monotonic_ns());
                self.place.find_side_inputs(&header)?;
                let (started, waited) = (Instant::now(), Duration::ZERO);
                self.step = Some(Step { header, received_ns, started, waited, has_sent: false });
                Ok(Polled::Message((Arc::new(message), received_ns)))
            }
        }
    }

    /// The messages of the side inputs that belong to the step, by name; each may be missing.
    pub fn side_inputs(&self) -> impl Iterator<Item = (&str, RetainedMessage, &ItemType)> {
        retained(&self.place.side_inputs)
    }

    /// Sequence number of the step's frame, if there is a step.
    pub fn frame(&self) -> Option<u64> {
        self.step.as_ref().map(|step| step.header.sequence)
    }

    /// Whether it has pulled a message: errors before that are errors of its start.
    pub fn has_begun(&self) -> bool {
        self.has_begun
    }

    /// Sends the output of the step. Its header is that of the input, which `change` may change.
    ///
    /// # Errors
    /// There is no step, it has already sent, there is no output, or its ports failed; or no reader would take the items.
    pub fn send(&mut self, change: impl FnOnce(&mut Header), bytes: &[u8]) -> Result<(), RunError> {
        let fault = |what: &str, hint: &str| RunError::refused(what, hint);
        let Some(item) = self.place.output_port.item().cloned() else {
            return Err(fault(
                "this stage has no `output` in the pipeline file",
                "name a topic there, with what it carries",
            ));
        };
        let step = self.step.as_mut().ok_or_else(|| {
            let hint = "send within the loop over its messages; what begins by itself is a source";
            fault("a stage sends in answer to a message, and it has none", hint)
        })?;
        if step.has_sent {
            let hint = "send all items of a frame as one list";
            return Err(fault("a stage sends one message for each that it takes", hint));
        }
        let mut header = step.header;
        change(&mut header);
        let header = of_same_frame(header, &step.header);
        item.check(&header, bytes).map_err(RunError::of_malformed)?;
        let started = Instant::now();
        self.place.output_port.write(bytes)?;
        self.is_over |= is_stopped(self.place.output_port.send(header, step.received_ns, None))?;
        step.waited = started.elapsed();
        step.has_sent = true;
        let message = AnyMessage { header: &header, item: &item, bytes };
        message.each_label(|label| self.place.record.status.count_found(label));
        Ok(())
    }

    /// Adds to a counter. `top` shows it, and the summary as for [`crate::Output::count`].
    pub fn count(&mut self, name: &str, times: u64) {
        if times > 0 {
            self.place.record.status.count(name, times);
        }
    }

    /// Ends and counts the step; if it has sent nothing, sends an empty list.
    fn end_step(&mut self) -> Result<(), RunError> {
        if self.step.as_ref().is_some_and(|step| !step.has_sent)
            && self.place.output_port.item().is_some_and(|item| !item.is_image())
        {
            self.send(|_| {}, &[])?;
        }
        let Some(step) = self.step.take() else { return Ok(()) };
        self.place.keep_times(&step.header, step.received_ns, step.started.elapsed().saturating_sub(step.waited));
        self.place.keep_counts(step.header.sequence);
        Ok(())
    }

    /// Ends the last step, the work, and the stream.
    ///
    /// # Errors
    /// Its ports failed.
    pub fn end(mut self) -> Result<(), RunError> {
        self.end_step()?;
        self.place.end(|| Ok(()))
    }
}
