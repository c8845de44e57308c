//! The life of a source: it makes messages at its pace, until it has no more, has made enough, or the run ends.

use super::handover::Mark;
use super::outlet::Outlet;
use super::side_ports::{self, SidePort};
use super::{RunError, Settling, StageRuntime, guarded, is_stopped};
use crate::clock::monotonic_ns;
use crate::ports::Transport;
use crate::stage::{Next, Pace, Source, Stop};
use crate::status::{Life, Status, StatusFile, used};
use conicflow_messages::Header;
use std::collections::BTreeMap;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

struct SourceLoop<S: Source, T: Transport> {
    source: S,
    sides: Vec<Box<dyn SidePort>>,
    outlet: Outlet<T::Writer>,
    list: Vec<S::Output>,
    record: StatusFile,
    stop: Stop,
    epoch: u64,
    /// Messages that were made, also before it was started anew.
    made: u64,
    /// Number of the next frame, where the source has none of its own.
    sequence: u64,
    settling: Settling,
}

/// Runs the source `S` to its end.
pub(crate) fn run_source<S: Source, T: Transport + 'static>(
    config: S::Config,
    mut around: StageRuntime<T>,
) -> Result<(), RunError> {
    around.context.output = around.wiring.output.as_ref().and_then(|topic| topic.item.clone());
    let (mut sides, mut outlet) = (around.sides(S::sides())?, around.outlet::<S::Output>()?);
    if !takes_place(&mut around)? {
        return Ok(());
    }
    around.context.resume_at = around.record.status.sent;
    around.context.counted = counted(&around.record.status);
    outlet.resume(around.record.status.sent);
    sides.iter_mut().zip(around.record.status.inputs).try_for_each(|(side, counts)| side.resume(counts))?;
    let source = S::new(config, &around.context).map_err(RunError::Refused)?;
    around.begin(source.total());
    let (stop, made) = (around.context.stop.clone(), around.context.resume_at);
    let (frames, settling) = (around.wiring.frames, Settling::of(&around));
    let mut pace = Pace::new(source.rate_hz(), stop.clone());
    let (record, epoch) = (around.record, new_epoch());
    let list = Vec::new();
    let mut running =
        SourceLoop::<S, T> { source, sides, outlet, list, record, stop, epoch, made, sequence: made, settling };
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
fn takes_place<T: Transport + 'static>(around: &mut StageRuntime<T>) -> Result<bool, RunError> {
    let Some(mut successor) = around.successor.take() else { return Ok(true) };
    successor.is_ready(&Mark::default()).map_err(|error| RunError::Refused(error.into()))?;
    let stop = around.context.stop.clone();
    let turn = successor.await_turn(|| stop.forced());
    if turn {
        around.enter();
    }
    Ok(turn)
}

impl<S: Source, T: Transport> SourceLoop<S, T> {
    /// Makes and sends one message; false if there is none any more.
    fn make_one(&mut self) -> Result<bool, RunError> {
        for side in &mut self.sides {
            side.find(None)?;
        }
        let started = Instant::now();
        let sides = side_ports::found(&self.sides);
        let mut output = self.outlet.place(Header::default(), &mut self.list);
        let next = guarded(self.sequence, || self.source.next(&sides, &mut output))?;
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
        if is_stopped(self.outlet.send(header, monotonic_ns(), list))? {
            return Ok(false);
        }
        (self.made, self.sequence) = (self.made + 1, sequence.saturating_add(1));
        self.record.status.steps += 1;
        self.keep_record(header.sequence);
        self.settling.step();
        Ok(true)
    }

    fn keep_record(&mut self, frame: u64) {
        let status = &mut *self.record.status;
        self.outlet.tally(status, frame, &self.list);
        for (slot, side) in status.inputs.iter_mut().zip(&self.sides) {
            *slot = side.counts();
        }
        self.record.write();
    }

    /// Ends the stream; a source that was stopped at once, or replaced, leaves its readers waiting for its successor.
    fn end(mut self) -> Result<(), RunError> {
        drop(self.sides);
        if !self.stop.forced() && !self.stop.leaving() {
            self.outlet.end()?;
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
