//! The life of a stage or a sink: it takes a message, steps, sends what it made, until its input ends or the run does.

use super::handover::{Handover, Watermark};
use super::input_port::InputPort;
use super::output_port::OutputPort;
use super::peers::Peers;
use super::side_ports::{self, SidePort};
use super::takeover::{made_early, takes_place};
use super::{MemoryTrim, RunError, StageRuntime, guarded, is_stopped};
use crate::clock::monotonic_ns;
use crate::item_type::ItemType;
use crate::ports::{PortError, Reader, Received, Topic, Transport};
use crate::stage::{Stage, StageError, Stop};
use crate::status::{Life, StatusFile};
use conicflow_messages::{AnyByte, Header, Item, Message};
use std::time::{Duration, Instant};

/// A stage that nobody wakes looks around this often.
const TICK: Duration = Duration::from_millis(100);

type MessageOf<T> = <<T as Transport>::Reader as Reader>::Message;

struct StageLoop<S: Stage, T: Transport> {
    stage: S,
    input_port: InputPort<T::Reader>,
    side_inputs: Vec<Box<dyn SidePort>>,
    output_port: OutputPort<T::Writer>,
    list: Vec<S::Output>,
    record: StatusFile,
    stop: Stop,
    topic: Topic,
    peers: Peers,
    handover: Option<Handover>,
    memory_trim: MemoryTrim,
    /// Asked to leave its place: from there on its successor receives everything.
    leaves_at: Option<Watermark>,
}

/// Runs the stage `S` until its input ends.
pub(crate) fn run_stage<S: Stage, T: Transport + 'static>(
    config: S::Config,
    mut runtime: StageRuntime<T>,
) -> Result<(), RunError> {
    // A successor is not the first, even if it is ready before any message was worked on.
    runtime.context.resume_at = runtime.record.status.steps.max(u64::from(runtime.successor.is_some()));
    let topic = runtime.wiring.input.take().ok_or_else(|| RunError::Refused("a stage needs an `input`".into()))?;
    let item = input_of::<S>(&topic)?;
    let mut side_inputs = runtime.side_inputs(S::side_inputs())?;
    let mut input_port = InputPort::new(
        runtime.transport.reader_of(&item, &topic, &runtime.context.stage)?,
        topic.delivery_to(&runtime.context.stage),
        &topic.name,
        topic.writers.len(),
    );
    let mut output_port = runtime.output_port::<S::Output>()?;
    runtime.context.input = Some(item);
    let early = if runtime.successor.is_some() { Some(made_early::<S>(&config, &runtime)?) } else { None };
    if let Some(successor) = runtime.successor.take()
        && !takes_place(successor, &mut input_port, &mut side_inputs, &mut runtime, &topic)?
    {
        return Ok(());
    }
    runtime.context.resume_at = runtime.context.resume_at.max(runtime.record.status.steps);
    let stage = match early.flatten() {
        Some(stage) => stage,
        None => S::new(config, &runtime.context).map_err(RunError::Refused)?,
    };
    let (own, of_sides) = runtime.record.status.inputs.split_at(1);
    input_port.resume(own[0]);
    side_inputs.iter_mut().zip(of_sides).try_for_each(|(side, counts)| side.resume(*counts))?;
    output_port.resume(runtime.record.status.sent);
    runtime.begin(None);
    let memory_trim = MemoryTrim::of(&runtime);
    let StageRuntime { context, peers, record, handover, lock: _lock, .. } = runtime;
    let (stop, leaves_at, list) = (context.stop, None, Vec::new());
    let mut running = StageLoop::<S, T> {
        stage,
        input_port,
        side_inputs,
        output_port,
        list,
        record,
        stop,
        topic,
        peers,
        handover,
        memory_trim,
        leaves_at,
    };
    while let Some(message) = running.next_message()? {
        if !running.work_on(message)? {
            break;
        }
    }
    running.end()
}

/// What the items of a stage's input are: its own, or those of the topic, where it takes lists of any type.
fn input_of<S: Stage>(topic: &Topic) -> Result<ItemType, RunError> {
    if S::Input::TYPE_NAME != AnyByte::TYPE_NAME {
        return Ok(ItemType::of::<S::Input>());
    }
    let unknown = || RunError::Refused(format!("nothing tells what topic `{}` carries", topic.name).into());
    topic.item.clone().ok_or_else(unknown)
}

impl<S: Stage, T: Transport> StageLoop<S, T> {
    /// Waits for the next message; `None` when no more will come, or the run is to end.
    fn next_message(&mut self) -> Result<Option<MessageOf<T>>, PortError> {
        while !self.stop.requested() && !self.may_leave() {
            // The writers are looked at first: what they sent before they were gone is then sure to be found.
            let last_call = self.input_port.is_idle() && self.writers_are_gone();
            if let Some(message) = self.input_port.take()? {
                return Ok(Some(message));
            }
            if last_call || self.input_port.ended() {
                break;
            }
            self.input_port.wait(TICK)?;
        }
        Ok(None)
    }

    /// Whether it was asked to leave its place, and its successor has received all that it has not worked on.
    fn may_leave(&mut self) -> bool {
        let (true, Some(handover)) = (self.stop.leaving(), &self.handover) else { return false };
        let leaves_at = self.leaves_at.get_or_insert_with(|| handover.first());
        self.input_port.has_passed(leaves_at)
    }

    /// Whether all stages that write the input have ended for good, be it without a word.
    fn writers_are_gone(&self) -> bool {
        let is_gone = |writer: &String| {
            self.input_port.has_ended(writer) || matches!(self.peers.life(writer), Some(Life::Ended | Life::Gone))
        };
        !self.topic.writers.is_empty() && self.topic.writers.iter().all(is_gone)
    }

    /// Steps once and sends what came of it; false if the run ended meanwhile.
    fn work_on(&mut self, message: MessageOf<T>) -> Result<bool, RunError> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        for side in &mut self.side_inputs {
            side.find(Some(&header))?;
        }
        let started = Instant::now();
        let side_inputs = side_ports::found(&self.side_inputs);
        let mut output = self.output_port.place(header, &mut self.list);
        let input = Message { header: &header, items: message.items() };
        guarded(header.sequence, || self.stage.step(&input, &side_inputs, &mut output))?;
        let (made, is_image) = (output.header, output.is_image());
        drop(message);
        self.keep_times(&header, received_ns, started.elapsed());
        let list = (!is_image).then_some(&*self.list);
        let stopped = is_stopped(self.output_port.send(made, received_ns, list))?;
        self.keep_counts(header.sequence);
        self.memory_trim.step();
        Ok(!stopped)
    }

    fn keep_times(&mut self, header: &Header, received_ns: u64, step: Duration) {
        let status = &mut *self.record.status;
        status.compute.add(step.as_nanos() as u64);
        let trace = header.trace();
        if let (Some(source), Some(writer)) = (trace.first(), trace.last()) {
            status.hop.add(received_ns.saturating_sub(writer.sent_ns));
            status.latency.add(received_ns.saturating_sub(source.received_ns));
        }
    }

    fn keep_counts(&mut self, frame: u64) {
        let status = &mut *self.record.status;
        status.steps += 1;
        self.output_port.tally(status, frame, &self.list);
        let counts = std::iter::once(self.input_port.counts()).chain(self.side_inputs.iter().map(|side| side.counts()));
        status.inputs.iter_mut().zip(counts).for_each(|(slot, counts)| *slot = counts);
        self.record.write();
    }

    /// Ends the work, and the stream; a stage that was stopped at once leaves its readers waiting for its successor.
    fn end(mut self) -> Result<(), RunError> {
        let frame = self.record.status.steps;
        let left =
            self.stop.leaving() && !self.stop.requested() && self.leaves_at.is_some() && !self.input_port.ended();
        if let Err(error) = self.stage.finish() {
            return Err(self.unfinished(left, error));
        }
        if let (true, Some(handover)) = (left, &self.handover) {
            let told = handover.leave(self.input_port.worked_on());
            return told.map_err(|error| RunError::Failed { frame, error: error.into() });
        }
        drop((self.input_port, self.side_inputs));
        if !self.stop.forced() {
            self.output_port.end()?;
            self.record.status.set_life(Life::Ended);
        }
        self.record.write();
        Ok(())
    }

    /// What is told when the end of its work fails. There is nothing to be started anew for, but where a successor goes on.
    fn unfinished(&mut self, left: bool, error: StageError) -> RunError {
        if left {
            return RunError::Failed { frame: self.record.status.steps, error };
        }
        self.record.status.set_life(Life::Gone);
        self.record.write();
        RunError::Unfinished(error)
    }
}
