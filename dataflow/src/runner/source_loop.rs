//! The life of a source: it makes messages at its pace, until it has no more, has made enough, or the run ends.

use super::handover::Watermark;
use super::output_port::OutputPort;
use super::side_ports::{self, SidePort};
use super::{MemoryTrim, RunError, StageRuntime, guarded, is_stopped};
use crate::clock::monotonic_ns;
use crate::ports::Transport;
use crate::stage::{Next, Pace, Source, Stop};
use crate::status::{Life, Status, StatusFile, used};
use conicflow_messages::Header;
use std::collections::BTreeMap;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

struct SourceLoop<S: Source, T: Transport> {
    source: S,
    side_inputs: Vec<Box<dyn SidePort>>,
    output_port: OutputPort<T::Writer>,
    list: Vec<S::Output>,
    record: StatusFile,
    stop: Stop,
    epoch: u64,
    /// Messages that were made, also before it was started anew.
    made: u64,
    /// Number of the next frame, where the source has none of its own.
    sequence: u64,
    memory_trim: MemoryTrim,
}

/// Runs the source `S` to its end.
pub(crate) fn run_source<S: Source, T: Transport + 'static>(
    config: S::Config,
    mut runtime: StageRuntime<T>,
) -> Result<(), RunError> {
    runtime.context.output = runtime.wiring.output.as_ref().and_then(|topic| topic.item.clone());
    let (mut side_inputs, mut output_port) =
        (runtime.side_inputs(S::side_inputs())?, runtime.output_port::<S::Output>()?);
    if !takes_place(&mut runtime)? {
        return Ok(());
    }
    runtime.context.resume_at = runtime.record.status.sent;
    runtime.context.counted = counted(&runtime.record.status);
    output_port.resume(runtime.record.status.sent);
    side_inputs.iter_mut().zip(runtime.record.status.inputs).try_for_each(|(side, counts)| side.resume(counts))?;
    let source = S::new(config, &runtime.context).map_err(RunError::Refused)?;
    runtime.begin(source.total());
    let (stop, made) = (runtime.context.stop.clone(), runtime.context.resume_at);
    let (frames, memory_trim) = (runtime.wiring.frames, MemoryTrim::of(&runtime));
    let mut pace = Pace::new(source.rate_hz(), stop.clone());
    let (record, epoch) = (runtime.record, new_epoch());
    let list = Vec::new();
    let mut running = SourceLoop::<S, T> {
        source,
        side_inputs,
        output_port,
        list,
        record,
        stop,
        epoch,
        made,
        sequence: made,
        memory_trim,
    };
    while frames.is_none_or(|frames| running.made < frames) {
        pace.wait();
        if running.stop.requested() || !running.make_one()? {
            break;
        }
    }
    running.end()
}

fn counted(status: &Status) -> BTreeMap<String, u64> {
    used(&status.counters).map(|(name, times)| (name.to_owned(), times)).collect()
}

/// Waits, where this process replaces another, until that is gone: a device is never opened twice. Whether its turn came.
fn takes_place<T: Transport + 'static>(runtime: &mut StageRuntime<T>) -> Result<bool, RunError> {
    let Some(mut successor) = runtime.successor.take() else { return Ok(true) };
    successor.is_ready(&Watermark::default()).map_err(|error| RunError::Refused(error.into()))?;
    let stop = runtime.context.stop.clone();
    let turn = successor.await_turn(|| stop.forced());
    if turn {
        runtime.enter();
    }
    Ok(turn)
}

impl<S: Source, T: Transport> SourceLoop<S, T> {
    /// Makes and sends one message; false if there is none any more.
    fn make_one(&mut self) -> Result<bool, RunError> {
        for side in &mut self.side_inputs {
            side.find(None)?;
        }
        let started = Instant::now();
        let side_inputs = side_ports::found(&self.side_inputs);
        let mut output = self.output_port.place(Header::default(), &mut self.list);
        let next = guarded(self.sequence, || self.source.next(&side_inputs, &mut output))?;
        // Frames of a recording keep their numbers, as long as these rise.
        let sequence = self.sequence.max(output.header.sequence);
        let header = Header { epoch: self.epoch, sequence, ..output.header };
        let is_image = output.is_image();
        if next == Next::End {
            self.keep_record(header.sequence);
            return Ok(false);
        }
        self.record.status.compute.add(started.elapsed().as_nanos() as u64);
        let list = (!is_image).then_some(&*self.list);
        if is_stopped(self.output_port.send(header, monotonic_ns(), list))? {
            return Ok(false);
        }
        (self.made, self.sequence) = (self.made + 1, sequence.saturating_add(1));
        self.record.status.steps += 1;
        self.keep_record(header.sequence);
        self.memory_trim.step();
        Ok(true)
    }

    fn keep_record(&mut self, frame: u64) {
        let status = &mut *self.record.status;
        self.output_port.tally(status, frame, &self.list);
        for (slot, side) in status.inputs.iter_mut().zip(&self.side_inputs) {
            *slot = side.counts();
        }
        self.record.write();
    }

    /// Ends the stream; a source that was stopped at once, or replaced, leaves its readers waiting for its successor.
    fn end(mut self) -> Result<(), RunError> {
        drop(self.side_inputs);
        if !self.stop.forced() && !self.stop.leaving() {
            self.output_port.end()?;
            self.record.status.set_life(Life::Ended);
        }
        self.record.write();
        Ok(())
    }
}

/// A number that no earlier start of a source had.
fn new_epoch() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as u64)
}
