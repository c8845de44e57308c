//! Connections and state of a stage in its run: its inputs and output, its record, and whether it is to leave.

use super::handover::{Handover, Watermark};
use super::input_port::{InputPort, Step};
use super::output_port::OutputPort;
use super::peers::Peers;
use super::side_ports::{Inputs, SidePort};
use super::{RunError, StageRuntime};
use crate::item_type::ItemType;
use crate::ports::{Polled, PortError, Reader, Topic, Transport};
use crate::stage::StageError;
use crate::status::{Life, StatusFile};
use crate::stop::Stop;
use conicflow_messages::Header;
use std::fs::File;
use std::time::{Duration, Instant};

/// After this long without a message, a stage acknowledges the buffered messages of its side inputs: the driving messages that
/// belong to them may be lost, and the run would be blocked.
const SILENCE_BEFORE_LETTING_GO: Duration = Duration::from_secs(5);
/// Poll period of a stage that is not woken.
const IDLE_CHECK_PERIOD: Duration = Duration::from_millis(100);

pub(crate) type MessageOf<T> = <<T as Transport>::Reader as Reader>::Message;

/// Everything that a stage's loop works with, except the stage itself.
pub(crate) struct StagePlace<T: Transport> {
    input_port: InputPort<T::Reader>,
    pub(crate) side_inputs: Vec<SidePort<T::Reader>>,
    pub(crate) output_port: OutputPort<T::Writer>,
    pub(crate) record: StatusFile,
    pub(crate) stop: Stop,
    topic: Topic,
    peers: Peers,
    handover: Option<Handover>,
    /// Set once it was asked to leave: from this position on its successor receives every message.
    leaves_at: Option<Watermark>,
    /// Time of the last message, or of the last release of kept messages.
    last_came: Instant,
    /// Lock of the run's folder, held as long as the stage runs.
    _lock: Option<File>,
}

/// Item type of a topic, for a stage that reads or writes any type.
pub(crate) fn item_of(topic: &Topic) -> Result<ItemType, RunError> {
    topic.expect_item().cloned().map_err(|error| RunError::Refused(error.into()))
}

/// Opens the driving input of a stage.
pub(crate) fn open_input<T: Transport>(
    runtime: &StageRuntime<T>,
    item: &ItemType,
    topic: &Topic,
) -> Result<InputPort<T::Reader>, PortError> {
    let stage = &runtime.context.stage;
    let reader = runtime.transport.reader_of(item, topic, stage)?;
    Ok(InputPort::new(reader, topic.delivery_to(stage), &topic.name, topic.writers.len()))
}

impl<T: Transport> StagePlace<T> {
    /// Starts work where an earlier process of the same stage left off.
    pub(crate) fn begin(
        mut runtime: StageRuntime<T>,
        topic: Topic,
        (mut side_inputs, mut input_port): Inputs<T::Reader>,
        mut output_port: OutputPort<T::Writer>,
    ) -> Result<Self, PortError> {
        let (own, of_sides) = runtime.record.status.inputs.split_at(1);
        input_port.drive(&runtime.context.stage);
        // The state of stages on another machine is unknown: they may have been at work long before this run.
        if topic.writers.iter().all(|writer| runtime.peers.life(writer).is_some()) {
            input_port.expect_from_first();
        }
        input_port.resume(own[0]);
        side_inputs.iter_mut().zip(of_sides).try_for_each(|(side, counts)| side.resume(*counts))?;
        output_port.resume(runtime.record.status.sent);
        runtime.begin(None);
        let StageRuntime { context, peers, record, handover, lock, .. } = runtime;
        let mut place = Self {
            input_port,
            side_inputs,
            output_port,
            record,
            stop: context.stop,
            topic,
            peers,
            handover,
            leaves_at: None,
            last_came: Instant::now(),
            _lock: lock,
        };
        // Writes the record early, so that it shows the inputs even of a stage that dies on its first message.
        place.keep_inputs();
        Ok(place)
    }

    /// Waits for the next message; `None` when no more will come, or the run is to end.
    pub(crate) fn next_message(&mut self) -> Result<Option<MessageOf<T>>, PortError> {
        loop {
            match self.poll(IDLE_CHECK_PERIOD)? {
                Polled::Message(message) => return Ok(Some(message)),
                Polled::Over => return Ok(None),
                Polled::Pending => {}
            }
        }
    }

    /// Returns the next message; without one it waits at most for `patience`. `Over` if no more will come, or the run is to end.
    pub(crate) fn poll(&mut self, patience: Duration) -> Result<Polled<MessageOf<T>>, PortError> {
        if self.stop.requested() || self.may_leave() {
            return Ok(Polled::Over);
        }
        // The writers are checked first: all messages that they sent before they were gone are then found.
        let last_call = self.input_port.is_idle() && self.writers_are_gone();
        match self.input_port.take_step()? {
            Step::Message(message) => {
                self.last_came = Instant::now();
                return Ok(Polled::Message(message));
            }
            // Acknowledged at once, so that the message does not come again if this stage dies on the next one.
            Step::LeftOut => {
                self.keep_inputs();
                self.input_port.acknowledge();
                return Ok(Polled::Pending);
            }
            Step::Nothing => {}
        }
        self.input_port.acknowledge();
        self.output_port.catch_up();
        if self.last_came.elapsed() > SILENCE_BEFORE_LETTING_GO {
            self.last_came = Instant::now();
            self.side_inputs.iter_mut().try_for_each(|side| side.let_go())?;
        }
        if last_call || self.input_port.ended() {
            return Ok(Polled::Over);
        }
        self.input_port.wait(patience)?;
        Ok(Polled::Pending)
    }

    /// Item type of its input.
    pub(crate) fn input_item(&self) -> &ItemType {
        self.input_port.item()
    }

    /// Name of its driving topic.
    pub(crate) fn input_topic(&self) -> &str {
        &self.topic.name
    }

    /// Whether it was asked to leave, and has processed all messages that its successor does not receive.
    fn may_leave(&mut self) -> bool {
        let (true, Some(handover)) = (self.stop.leaving(), &self.handover) else { return false };
        let leaves_at = self.leaves_at.get_or_insert_with(|| handover.first());
        self.input_port.has_passed(leaves_at)
    }

    /// Whether all writers of the input have ended for good, with or without an end of stream.
    fn writers_are_gone(&self) -> bool {
        let is_gone = |writer: &String| self.input_port.has_ended(writer) || self.peers.is_over(writer);
        !self.topic.writers.is_empty() && self.topic.writers.iter().all(is_gone)
    }

    /// Finds the messages of the side inputs that belong to a step.
    pub(crate) fn find_side_inputs(&mut self, step: &Header) -> Result<(), PortError> {
        self.side_inputs.iter_mut().try_for_each(|side| side.find(Some(step)))
    }

    /// Records the time of a step, and the hop and latency of its message.
    pub(crate) fn keep_times(&mut self, header: &Header, received_ns: u64, step: Duration) {
        let status = &mut *self.record.status;
        status.compute.add(step.as_nanos() as u64);
        let trace = header.trace();
        if let (Some(source), Some(writer)) = (trace.first(), trace.last()) {
            status.hop.add(received_ns.saturating_sub(writer.sent_ns));
            status.latency.add(received_ns.saturating_sub(source.received_ns));
        }
    }

    /// Counts a step on the frame `frame`, records the counts, and acknowledges its messages. The record is written first: it has
    /// in one piece what was processed and what was sent, so that a restarted process repeats the rest under the same numbers.
    pub(crate) fn keep_counts(&mut self, frame: u64) {
        self.last_came = Instant::now();
        self.output_port.tally(&mut self.record.status, frame);
        self.record.status.steps += 1;
        self.keep_inputs();
        self.side_inputs.iter_mut().for_each(|side| side.acknowledge());
        self.input_port.acknowledge();
    }

    /// Records the counts of the inputs.
    fn keep_inputs(&mut self) {
        let status = &mut *self.record.status;
        let counts = std::iter::once(self.input_port.counts()).chain(self.side_inputs.iter().map(|side| side.counts()));
        status.inputs.iter_mut().zip(counts).for_each(|(slot, counts)| *slot = counts);
        self.record.write();
    }

    /// Ends the work by `finish`, and the stream. A stage that was stopped at once sends no end of stream, so that its readers
    /// wait for its successor.
    pub(crate) fn end(mut self, finish: impl FnOnce() -> Result<(), StageError>) -> Result<(), RunError> {
        let frame = self.record.status.steps;
        let left =
            self.stop.leaving() && !self.stop.requested() && self.leaves_at.is_some() && !self.input_port.ended();
        if let Err(error) = finish() {
            return Err(self.unfinished(left, error));
        }
        if let (true, Some(handover)) = (left, &self.handover) {
            let result = handover.leave(self.input_port.position());
            self.output_port.await_finish();
            return result.map_err(|error| RunError::Failed { frame, error: error.into() });
        }
        self.record.status.had_enough = u64::from(self.stop.requested() && !self.input_port.ended());
        self.keep_inputs();
        drop((self.input_port, self.side_inputs));
        if !self.stop.forced() {
            self.output_port.end()?;
            self.record.status.set_life(Life::Ended);
        }
        self.record.write();
        Ok(())
    }

    /// Error of a failed `finish`. A restart is pointless, unless a successor goes on.
    fn unfinished(&mut self, left: bool, error: StageError) -> RunError {
        if left {
            return RunError::Failed { frame: self.record.status.steps, error };
        }
        self.record.status.set_life(Life::Gone);
        self.record.write();
        RunError::Unfinished(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::{Delivery, Wiring, Writer};
    use crate::runner::place_trial::{Passing, Trial, ball, from, send_items, topic};
    use crate::stage::Stage;
    use conicflow_messages::{Nothing, Object};

    #[test]
    fn where_nothing_has_come_for_long_writers_of_side_inputs_need_not_keep_what_came() {
        let (trial, side) = (Trial::of("stage"), topic("side", &["side"], "stage", Delivery::Lossless));
        let (input, mut writer) = (trial.input(Delivery::Lossless), trial.writer(&side));
        let wiring = Wiring { side_inputs: vec![("partner".to_owned(), side)], ..Wiring::default() };
        let mut runtime = trial.runtime(wiring);
        let side_inputs = runtime.side_inputs(Passing::side_inputs()).unwrap();
        let input_port = open_input(&runtime, &ItemType::of::<Object>(), &input).unwrap();
        let output_port = runtime.output_port(&ItemType::of::<Nothing>()).unwrap();
        let mut place = StagePlace::begin(runtime, input, (side_inputs, input_port), output_port).unwrap();
        send_items(&mut writer, from("side", 0), &[ball()]);
        assert!(matches!(place.poll(Duration::ZERO).unwrap(), Polled::Pending));
        assert_eq!(writer.unfinished("stage"), 1);
        place.last_came = Instant::now().checked_sub(SILENCE_BEFORE_LETTING_GO + IDLE_CHECK_PERIOD).unwrap();
        assert!(matches!(place.poll(Duration::ZERO).unwrap(), Polled::Pending));
        assert_eq!(writer.unfinished("stage"), 0);
    }
}
