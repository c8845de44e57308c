//! The life of a stage or a sink: it takes a message, steps, sends what it made, until its input ends or the run does.

use super::handover::{Handover, Mark};
use super::inbox::Inbox;
use super::outlet::Outlet;
use super::peers::Peers;
use super::side_ports::{self, SidePort};
use super::succession::{made_early, takes_place};
use super::{RunError, Settling, StageRuntime, guarded, is_stopped};
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
    inbox: Inbox<T::Reader>,
    sides: Vec<Box<dyn SidePort>>,
    outlet: Outlet<T::Writer>,
    list: Vec<S::Output>,
    record: StatusFile,
    stop: Stop,
    topic: Topic,
    peers: Peers,
    handover: Option<Handover>,
    settling: Settling,
    /// Asked to leave its place: from there on its successor hears everything.
    leaves_at: Option<Mark>,
}

/// Runs the stage `S` until its input ends.
pub(crate) fn run_stage<S: Stage, T: Transport + 'static>(
    config: S::Config,
    mut around: StageRuntime<T>,
) -> Result<(), RunError> {
    // A successor is not the first, even if it is ready before any message was worked on.
    around.context.resume_at = around.record.status.steps.max(u64::from(around.successor.is_some()));
    let topic = around.wiring.input.take().ok_or_else(|| RunError::Refused("a stage needs an `input`".into()))?;
    let item = input_of::<S>(&topic)?;
    let mut sides = around.sides(S::sides())?;
    let mut inbox = Inbox::new(
        around.transport.reader_of(&item, &topic, &around.context.stage)?,
        topic.delivery_to(&around.context.stage),
        &topic.name,
        topic.writers.len(),
    );
    let mut outlet = around.outlet::<S::Output>()?;
    around.context.input = Some(item);
    let early = if around.successor.is_some() { Some(made_early::<S>(&config, &around)?) } else { None };
    if let Some(successor) = around.successor.take()
        && !takes_place(successor, &mut inbox, &mut sides, &mut around, &topic)?
    {
        return Ok(());
    }
    around.context.resume_at = around.context.resume_at.max(around.record.status.steps);
    let stage = match early.flatten() {
        Some(stage) => stage,
        None => S::new(config, &around.context).map_err(RunError::Refused)?,
    };
    let (own, of_sides) = around.record.status.inputs.split_at(1);
    inbox.resume(own[0]);
    sides.iter_mut().zip(of_sides).try_for_each(|(side, counts)| side.resume(*counts))?;
    outlet.resume(around.record.status.sent);
    around.begin(None);
    let settling = Settling::of(&around);
    let StageRuntime { context, peers, record, handover, lock: _lock, .. } = around;
    let (stop, leaves_at, list) = (context.stop, None, Vec::new());
    let mut running = StageLoop::<S, T> {
        stage,
        inbox,
        sides,
        outlet,
        list,
        record,
        stop,
        topic,
        peers,
        handover,
        settling,
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
            let last_call = self.inbox.is_idle() && self.writers_are_gone();
            if let Some(message) = self.inbox.take()? {
                return Ok(Some(message));
            }
            if last_call || self.inbox.ended() {
                break;
            }
            self.inbox.wait(TICK)?;
        }
        Ok(None)
    }

    /// Whether it was asked to leave its place, and its successor has heard all that it has not worked on.
    fn may_leave(&mut self) -> bool {
        let (true, Some(handover)) = (self.stop.leaving(), &self.handover) else { return false };
        let leaves_at = self.leaves_at.get_or_insert_with(|| handover.first());
        self.inbox.has_passed(leaves_at)
    }

    /// Whether all stages that write the input have ended for good, be it without a word.
    fn writers_are_gone(&self) -> bool {
        let is_gone = |writer: &String| {
            self.inbox.has_ended(writer) || matches!(self.peers.life(writer), Some(Life::Ended | Life::Gone))
        };
        !self.topic.writers.is_empty() && self.topic.writers.iter().all(is_gone)
    }

    /// Steps once and sends what came of it; false if the run ended meanwhile.
    fn work_on(&mut self, message: MessageOf<T>) -> Result<bool, RunError> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        for side in &mut self.sides {
            side.find(Some(&header))?;
        }
        let started = Instant::now();
        let sides = side_ports::found(&self.sides);
        let mut output = self.outlet.place(header, &mut self.list);
        let input = Message { header: &header, items: message.items() };
        guarded(header.sequence, || self.stage.step(&input, &sides, &mut output))?;
        let (made, is_image) = (output.header, output.is_image());
        drop(message);
        self.keep_times(&header, received_ns, started.elapsed());
        let list = (!is_image).then_some(&*self.list);
        let stopped = is_stopped(self.outlet.send(made, received_ns, list))?;
        self.keep_counts(header.sequence);
        self.settling.step();
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
        self.outlet.tally(status, frame, &self.list);
        let counts = std::iter::once(self.inbox.counts()).chain(self.sides.iter().map(|side| side.counts()));
        status.inputs.iter_mut().zip(counts).for_each(|(slot, counts)| *slot = counts);
        self.record.write();
    }

    /// Ends the work, and the stream; a stage that was stopped at once leaves its readers waiting for its successor.
    fn end(mut self) -> Result<(), RunError> {
        let frame = self.record.status.steps;
        let left = self.stop.leaving() && !self.stop.requested() && self.leaves_at.is_some() && !self.inbox.ended();
        if let Err(error) = self.stage.finish() {
            return Err(self.unfinished(left, error));
        }
        if let (true, Some(handover)) = (left, &self.handover) {
            let told = handover.leave(self.inbox.worked_on());
            return told.map_err(|error| RunError::Failed { frame, error: error.into() });
        }
        drop((self.inbox, self.sides));
        if !self.stop.forced() {
            self.outlet.end()?;
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
