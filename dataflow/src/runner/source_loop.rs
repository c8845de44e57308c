//! The loop of a source: it makes messages at its pace, until it is exhausted, has made enough, or the run ends.

use super::handover::Watermark;
use super::output_port::OutputPort;
use super::pace::{Pace, Rhythm};
use super::side_ports::{self, SidePort};
use super::untyped::{AnySource, Made, NewSource};
use super::{MemoryTrim, RunError, StageRuntime, guarded, is_stopped};
use crate::clock::{monotonic_ns, unix_ns};
use crate::item_type::{AnyMessage, ItemType};
use crate::ports::{PortError, Transport};
use crate::stage::{Next, StageError};
use crate::status::{Life, Pausing, Status, StatusFile, used};
use crate::stop::Stop;
use conicflow_messages::{END_OF_STREAM, Header};
use std::collections::BTreeMap;
use std::fs::File;
use std::time::{Duration, Instant};

/// Everything that a source's loop works with, except the source itself.
pub(crate) struct SourcePlace<T: Transport> {
    pub(crate) side_inputs: Vec<SidePort<T::Reader>>,
    pub(crate) output_port: OutputPort<T::Writer>,
    pub(crate) record: StatusFile,
    pub(crate) stop: Stop,
    epoch: u64,
    /// Number of messages that were made, also before a restart.
    made: u64,
    /// Sequence number of the next frame, if the source does not set it.
    pub(crate) sequence: u64,
    /// Number of messages after which the source ends.
    frames: Option<u64>,
    pace: Pace,
    /// Lock of the run's folder, held as long as the source runs.
    _lock: Option<File>,
}

struct SourceLoop<'a, T: Transport> {
    source: Box<dyn AnySource + 'a>,
    output: &'a ItemType,
    place: SourcePlace<T>,
    memory_trim: MemoryTrim,
}

/// Runs a source to its end.
pub(crate) fn run_source<T: Transport>(new: &NewSource<'_>, mut runtime: StageRuntime<T>) -> Result<(), RunError> {
    let output = &new.output;
    runtime.context.output = runtime.wiring.output.as_ref().and_then(|topic| topic.item.clone());
    let (side_inputs, output_port) = (runtime.side_inputs(new.side_inputs)?, runtime.output_port(output)?);
    if !takes_place(&mut runtime)? {
        return Ok(());
    }
    resume(&mut runtime);
    let source = new.make(&runtime.context)?;
    let memory_trim = MemoryTrim::of(&runtime);
    let (stage, resumed_at) = (runtime.context.stage.clone(), runtime.context.resume_at);
    let place = SourcePlace::begin(runtime, side_inputs, output_port, source.total(), source.rhythm())?;
    let mut running = SourceLoop { source, output, place, memory_trim };
    while running.place.wait_until_due() && running.make_one()? {}
    let SourceLoop { mut source, place, .. } = running;
    place.tell_if_nothing_was_left(&stage, resumed_at);
    place.end(|| source.finish())
}

/// Gives the source the progress of an earlier process.
pub(crate) fn resume<T>(runtime: &mut StageRuntime<T>) {
    runtime.context.resume_at = runtime.record.status.sent;
    runtime.context.counted = counted(&runtime.record.status);
}

fn counted(status: &Status) -> BTreeMap<String, u64> {
    used(&status.counters).map(|(name, times)| (name.to_owned(), times)).collect()
}

/// Waits, if this process replaces another, until that is gone, so that a device is never opened twice. Returns whether its turn
/// came.
pub(crate) fn takes_place<T: Transport>(runtime: &mut StageRuntime<T>) -> Result<bool, RunError> {
    let Some(mut successor) = runtime.successor.take() else { return Ok(true) };
    successor.report_ready(&Watermark::default()).map_err(|error| RunError::Refused(error.into()))?;
    let stop = runtime.context.stop.clone();
    let turn = successor.await_turn(|| stop.forced());
    if turn {
        runtime.enter();
    }
    Ok(turn)
}

impl<T: Transport> SourcePlace<T> {
    /// Starts work where an earlier process of the same source left off.
    pub(crate) fn begin(
        mut runtime: StageRuntime<T>,
        mut side_inputs: Vec<SidePort<T::Reader>>,
        mut output_port: OutputPort<T::Writer>,
        total: Option<u64>,
        rhythm: Rhythm,
    ) -> Result<Self, PortError> {
        let status = &runtime.record.status;
        output_port.resume(status.sent);
        side_inputs.iter_mut().zip(status.inputs).try_for_each(|(side, counts)| side.resume(counts))?;
        runtime.record.status.set_pausing(if rhythm.can_pause { Pausing::Goes } else { Pausing::Cannot });
        runtime.begin(total);
        let StageRuntime { context, wiring, record, pause, lock, .. } = runtime;
        let (stop, made) = (context.stop, context.resume_at);
        let pace = Pace::new(rhythm, stop.clone(), pause);
        // Unique number of this start of the source.
        let (epoch, frames) = (unix_ns(), wiring.frames);
        Ok(Self { side_inputs, output_port, record, stop, epoch, made, sequence: made, frames, pace, _lock: lock })
    }

    /// Waits until the next message is due; `false` if the source is to end.
    pub(crate) fn wait_until_due(&mut self) -> bool {
        if self.frames.is_some_and(|frames| self.made >= frames) {
            return false;
        }
        self.pace.wait_to_make(&mut self.record, || self.output_port.catch_up());
        !self.stop.requested()
    }

    /// Warns if a replaced or restarted source has made no message because all of them were sent before.
    fn tell_if_nothing_was_left(&self, stage: &str, resumed_at: u64) {
        let is_due = !self.stop.requested() && self.frames.is_none_or(|frames| self.made < frames);
        if is_due && resumed_at > 0 && self.made == resumed_at {
            tracing::warn!(
                "stage `{stage}` ends with nothing made: {resumed_at} messages of it were sent before, and it has no more\n  \
                 hint: a source that takes another's place goes on behind what that has sent"
            );
        }
    }

    /// Waits until the message is due by its stamp; `false` if it is not to be sent any more.
    fn wait_to_send(&mut self, stamp_ns: Option<u64>) -> bool {
        self.pace.wait_to_send(stamp_ns, &mut self.record, || self.output_port.catch_up());
        !self.stop.requested()
    }

    /// Finds the latest messages of the side inputs.
    pub(crate) fn find_side_inputs(&mut self) -> Result<(), PortError> {
        self.side_inputs.iter_mut().try_for_each(|side| side.find(None))
    }

    /// Sets epoch and sequence number of a frame's header. Frames of a recording keep their numbers, as long as these rise and
    /// leave room for further frames.
    pub(crate) fn numbered(&self, header: Header) -> Header {
        let own = header.sequence.min(u64::MAX / 2);
        let flags = header.flags & !END_OF_STREAM;
        Header { epoch: self.epoch, sequence: self.sequence.max(own), flags, ..header }
    }

    /// Sends the output: a list, or without one an image; `false` if the run ended meanwhile.
    pub(crate) fn send(&mut self, header: Header, making: Duration, list: Option<&[u8]>) -> Result<bool, PortError> {
        self.record.status.compute.add(making.as_nanos() as u64);
        if is_stopped(self.output_port.send(header, monotonic_ns(), list))? {
            return Ok(false);
        }
        (self.made, self.sequence) = (self.made + 1, header.sequence.saturating_add(1));
        self.record.status.steps += 1;
        Ok(true)
    }

    /// Records the counts of making the frame `frame`.
    pub(crate) fn keep_counts(&mut self, frame: u64) {
        self.output_port.tally(&mut self.record.status, frame);
        for (slot, side) in self.record.status.inputs.iter_mut().zip(&self.side_inputs) {
            *slot = side.counts();
        }
        self.record.write();
        self.side_inputs.iter_mut().for_each(|side| side.acknowledge());
    }

    /// Ends the work by `finish`, and the stream. A source that was stopped at once, or replaced, sends no end of stream, so that
    /// its readers wait for its successor.
    pub(crate) fn end(mut self, finish: impl FnOnce() -> Result<(), StageError>) -> Result<(), RunError> {
        let finished = finish();
        drop(self.side_inputs);
        if !self.stop.forced() && !self.stop.leaving() {
            self.output_port.end()?;
            // A restart is pointless if it could not end its work.
            self.record.status.set_life(if finished.is_ok() { Life::Ended } else { Life::Gone });
        }
        self.output_port.await_finish();
        self.record.write();
        finished.map_err(RunError::Unfinished)
    }
}

impl<T: Transport> SourceLoop<'_, T> {
    /// Makes and sends a message if there is one; `false` if the source is exhausted.
    fn make_one(&mut self) -> Result<bool, RunError> {
        let place = &mut self.place;
        place.find_side_inputs()?;
        let started = Instant::now();
        let side_inputs = side_ports::found(&place.side_inputs);
        let output = place.output_port.untyped_output(Header::default());
        let make = || self.source.next(&side_inputs, output);
        let (next, Made { header, list }) = guarded(&mut place.record, place.sequence, make)?;
        let header = place.numbered(header);
        let making = started.elapsed();
        let goes_on = match next {
            Next::Message => {
                if !(place.wait_to_send(Some(header.stamp_ns)) && place.send(header, making, list)?) {
                    return Ok(false);
                }
                let message = AnyMessage { header: &header, item: self.output, bytes: list.unwrap_or_default() };
                message.each_label(|label| place.record.status.count_found(label));
                true
            }
            Next::Later => true,
            Next::End => {
                place.wait_to_send(None);
                false
            }
        };
        place.keep_counts(header.sequence);
        self.memory_trim.step();
        Ok(goes_on)
    }
}
