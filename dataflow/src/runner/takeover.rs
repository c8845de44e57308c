//! Replacement of a running process by another one of the same stage. The successor is created beside it, buffers the messages of
//! each writer with those of its side inputs that belong to them, and begins when the predecessor is gone.

use super::handover::Successor;
use super::side_ports::{Inputs, SidePort};
use super::untyped::{AnyStage, NewStage};
use super::{RunError, StageRuntime};
use crate::ports::{Delivery, Topic, Transport};
use crate::stage::Context;
use conicflow_messages::Nothing;
use std::time::Instant;

/// Creates the stage while its predecessor works, so that a stage that cannot start never takes its place. A sink is dropped and
/// created again in its place: two sinks that write one file would damage it.
pub(crate) fn made_early<'a>(
    new: &NewStage<'a>,
    context: &Context,
) -> Result<Option<Box<dyn AnyStage + 'a>>, RunError> {
    let stage = new.make(context)?;
    Ok(Some(stage).filter(|_| !new.output.is::<Nothing>()))
}

/// If this process is a successor: buffers a message of each writer, reports that it is ready, and waits until the predecessor is
/// gone. Returns the inputs to continue with; `None` if the successor is no longer wanted.
pub(crate) fn take_place<T: Transport>(
    mut inputs: Inputs<T::Reader>,
    open: impl Fn(&StageRuntime<T>) -> Result<Inputs<T::Reader>, RunError>,
    runtime: &mut StageRuntime<T>,
    topic: &Topic,
) -> Result<Option<Inputs<T::Reader>>, RunError> {
    let Some(mut successor) = runtime.successor.take() else { return Ok(Some(inputs)) };
    if !await_first_messages(&mut successor, &mut inputs, runtime, topic)? {
        return Ok(None);
    }
    let (_, input_port) = &mut inputs;
    let fault = |error: std::io::Error| RunError::Refused(error.into());
    successor.report_ready(&input_port.first_buffered()).map_err(fault)?;
    let stop = runtime.context.stop.clone();
    if !successor.await_turn(|| stop.forced()) {
        return Ok(None);
    }
    runtime.enter();
    match successor.handover.last() {
        // The predecessor was killed, so this process acts as a restarted stage, for which the writers keep messages. It has
        // dropped messages that the predecessor was to process, and therefore opens its inputs again.
        None if input_port.is_kept() => return open(runtime).map(Some),
        last => input_port.resume_from_handover(last.unwrap_or_default()),
    }
    Ok(Some(inputs))
}

/// Waits until a message of each writer is buffered, with those of the side inputs that belong to it; `false` if the successor is
/// no longer wanted.
fn await_first_messages<T: Transport>(
    successor: &mut Successor,
    (side_inputs, input_port): &mut Inputs<T::Reader>,
    runtime: &StageRuntime<T>,
    topic: &Topic,
) -> Result<bool, RunError> {
    let deadline = Instant::now() + successor.patience;
    let lossless = |topic: &Topic| topic.delivery_to(&runtime.context.stage) == Delivery::Lossless;
    let is_over = |writer: &String| runtime.peers.is_over(writer);
    loop {
        // The side inputs last, as their messages for a driving message were sent before it.
        input_port.buffer_newest()?;
        side_inputs.iter_mut().try_for_each(|side| side.buffer_ahead())?;
        let late = Instant::now() > deadline;
        let needed = |side: &&SidePort<T::Reader>| {
            let wired = runtime.wiring.side_inputs.iter().find(|(name, _)| name == side.name()).map(|(_, topic)| topic);
            wired.is_some_and(|topic| (lossless(topic) || !late) && !topic.writers.iter().all(is_over))
        };
        let needed: Vec<_> = side_inputs.iter().filter(needed).collect();
        input_port.drop_buffered(|header| !needed.iter().all(|side| side.covers(header)));
        if topic.writers.iter().all(|writer| input_port.has_buffered(writer) || is_over(writer))
            || (late && !lossless(topic))
        {
            return Ok(true);
        }
        if successor.wait_for_dismissal() || runtime.context.stop.forced() {
            return Ok(false);
        }
    }
}
