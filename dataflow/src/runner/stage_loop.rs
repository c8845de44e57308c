//! The loop of a stage or a sink: it takes a message, steps and sends the output, until its input or the run ends.

use super::side_ports;
use super::stage_place::{MessageOf, StagePlace, item_of, open_input};
use super::takeover::{made_early, take_place};
use super::untyped::{AnyStage, Made, NewStage};
use super::{MemoryTrim, RunError, StageRuntime, guarded, is_stopped};
use crate::clock::monotonic_ns;
use crate::item_type::{AnyMessage, ItemType};
use crate::ports::{Received, Transport};
use conicflow_messages::AnyByte;
use std::time::Instant;

struct StageLoop<'a, T: Transport> {
    stage: Box<dyn AnyStage + 'a>,
    output: &'a ItemType,
    place: StagePlace<T>,
    memory_trim: MemoryTrim,
}

/// Runs a stage until its input ends.
pub(crate) fn run_stage<T: Transport>(new: &NewStage<'_>, mut runtime: StageRuntime<T>) -> Result<(), RunError> {
    // A successor never counts as the first process, even if it is ready before a message was processed.
    runtime.context.resume_at = runtime.record.status.steps.max(u64::from(runtime.successor.is_some()));
    let topic = runtime.wiring.input.take().ok_or_else(|| RunError::Refused("a stage needs an `input`".into()))?;
    let NewStage { side_inputs, input, output, .. } = new;
    let item = if input.is::<AnyByte>() { item_of(&topic)? } else { input.clone() };
    let open = |runtime: &StageRuntime<T>| Ok((runtime.side_inputs(side_inputs)?, open_input(runtime, &item, &topic)?));
    let inputs = open(&runtime)?;
    let output_port = runtime.output_port(output)?;
    runtime.context.input = Some(item.clone());
    runtime.context.delivery = Some(topic.delivery_to(&runtime.context.stage));
    let early = if runtime.successor.is_some() { made_early(new, &runtime.context)? } else { None };
    let Some(inputs) = take_place(inputs, open, &mut runtime, &topic)? else { return Ok(()) };
    runtime.context.resume_at = runtime.context.resume_at.max(runtime.record.status.steps);
    let stage = match early {
        Some(stage) => stage,
        None => new.make(&runtime.context)?,
    };
    let memory_trim = MemoryTrim::of(&runtime);
    let place = StagePlace::begin(runtime, topic, inputs, output_port)?;
    let mut running = StageLoop { stage, output, place, memory_trim };
    while let Some(message) = running.place.next_message()? {
        if !running.work_on(message)? {
            break;
        }
    }
    let StageLoop { mut stage, place, .. } = running;
    place.end(|| stage.finish())
}

impl<T: Transport> StageLoop<'_, T> {
    /// Makes one step and sends its output; `false` if the run ended meanwhile.
    fn work_on(&mut self, message: MessageOf<T>) -> Result<bool, RunError> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        let place = &mut self.place;
        place.find_side_inputs(&header)?;
        let started = Instant::now();
        let side_inputs = side_ports::found(&place.side_inputs);
        let output = place.output_port.untyped_output(header);
        let step = || self.stage.step((&header, message.bytes()), &side_inputs, output);
        let Made { header: made, list } = guarded(&mut place.record, header.sequence, step)?;
        drop(message);
        place.keep_times(&header, received_ns, started.elapsed());
        let stopped = is_stopped(place.output_port.send(made, received_ns, list))?;
        let made = AnyMessage { header: &made, item: self.output, bytes: list.unwrap_or_default() };
        made.each_label(|label| place.record.status.count_found(label));
        place.keep_counts(header.sequence);
        self.memory_trim.step();
        Ok(!stopped)
    }
}
