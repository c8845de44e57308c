//! The life of a stage or a sink: it takes a message, steps, sends what it made, until its input ends or the run does.

use super::side_ports;
use super::stage_place::{MessageOf, StagePlace, item_of, open_input};
use super::takeover::{made_early, take_place};
use super::{MemoryTrim, RunError, StageRuntime, guarded, is_stopped};
use crate::clock::monotonic_ns;
use crate::item_type::ItemType;
use crate::ports::{Received, Transport};
use crate::stage::Stage;
use conicflow_messages::{AnyByte, Item, Message};
use std::time::Instant;

struct StageLoop<S: Stage, T: Transport> {
    stage: S,
    place: StagePlace<T>,
    list: Vec<S::Output>,
    memory_trim: MemoryTrim,
}

/// Runs the stage `S` until its input ends.
pub(crate) fn run_stage<S: Stage, T: Transport>(
    config: S::Config,
    mut runtime: StageRuntime<T>,
) -> Result<(), RunError> {
    // A successor is not the first, even if it is ready before any message was worked on.
    runtime.context.resume_at = runtime.record.status.steps.max(u64::from(runtime.successor.is_some()));
    let topic = runtime.wiring.input.take().ok_or_else(|| RunError::Refused("a stage needs an `input`".into()))?;
    let item = if S::Input::TYPE_NAME == AnyByte::TYPE_NAME { item_of(&topic)? } else { ItemType::of::<S::Input>() };
    let open =
        |runtime: &StageRuntime<T>| Ok((runtime.side_inputs(S::side_inputs())?, open_input(runtime, &item, &topic)?));
    let inputs = open(&runtime)?;
    let output_port = runtime.output_port::<S::Output>()?;
    runtime.context.input = Some(item.clone());
    runtime.context.delivery = Some(topic.delivery_to(&runtime.context.stage));
    let early = if runtime.successor.is_some() { made_early::<S>(&config, &runtime)? } else { None };
    let Some(inputs) = take_place(inputs, open, &mut runtime, &topic)? else { return Ok(()) };
    runtime.context.resume_at = runtime.context.resume_at.max(runtime.record.status.steps);
    let stage = match early {
        Some(stage) => stage,
        None => S::new(config, &runtime.context).map_err(RunError::Refused)?,
    };
    let memory_trim = MemoryTrim::of(&runtime);
    let place = StagePlace::begin(runtime, topic, inputs, output_port)?;
    let mut running = StageLoop::<S, T> { stage, place, list: Vec::new(), memory_trim };
    while let Some(message) = running.place.next_message()? {
        if !running.work_on(message)? {
            break;
        }
    }
    let StageLoop { mut stage, place, .. } = running;
    place.end(|| stage.finish())
}

impl<S: Stage, T: Transport> StageLoop<S, T> {
    /// Steps once and sends what came of it; false if the run ended meanwhile.
    fn work_on(&mut self, message: MessageOf<T>) -> Result<bool, RunError> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        let place = &mut self.place;
        place.find_side_inputs(&header)?;
        let started = Instant::now();
        let side_inputs = side_ports::found(&place.side_inputs);
        let mut output = place.output_port.place(header, &mut self.list);
        let input = Message { header: &header, items: message.items() };
        guarded(&mut place.record, header.sequence, || self.stage.step(&input, &side_inputs, &mut output))?;
        let (made, is_image) = (output.header, output.is_image());
        drop(message);
        place.keep_times(&header, received_ns, started.elapsed());
        let list = (!is_image).then_some(&*self.list);
        let stopped = is_stopped(place.output_port.send(made, received_ns, list))?;
        place.output_port.tally(&mut place.record.status, header.sequence, &self.list);
        place.keep_counts();
        self.memory_trim.step();
        Ok(!stopped)
    }
}
