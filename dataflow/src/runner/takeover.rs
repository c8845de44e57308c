//! How a stage takes the place of another process of the same stage: made ready beside it, it buffers what each writer sends,
//! with all that goes with a message in its side inputs, and begins when the other is gone.

use super::handover::Successor;
use super::side_ports::{Inputs, SidePort};
use super::untyped::{AnyStage, NewStage};
use super::{RunError, StageRuntime};
use crate::ports::{Delivery, Topic, Transport};
use crate::stage::Context;
use conicflow_messages::Nothing;
use std::time::Instant;

/// Makes the stage ready while the one that it replaces is at work, so that what cannot begin never takes a place. A sink
/// is made on trial, and anew in its place: two that are at work on one file would spoil it.
pub(crate) fn made_early<'a>(
    new: &NewStage<'a>,
    context: &Context,
) -> Result<Option<Box<dyn AnyStage + 'a>>, RunError> {
    let stage = new.make(context)?;
    Ok(Some(stage).filter(|_| !new.output.is::<Nothing>()))
}

/// Where this process replaces another, buffers a message of each writer, says so, and waits until that is gone. The inputs from
/// there on; `None`: it is not wanted any more.
pub(crate) fn take_place<T: Transport>(
    mut inputs: Inputs<T::Reader>,
    open: impl Fn(&StageRuntime<T>) -> Result<Inputs<T::Reader>, RunError>,
    runtime: &mut StageRuntime<T>,
    topic: &Topic,
) -> Result<Option<Inputs<T::Reader>>, RunError> {
    let Some(mut successor) = runtime.successor.take() else { return Ok(Some(inputs)) };
    if !buffers_all(&mut successor, &mut inputs, runtime, topic)? {
        return Ok(None);
    }
    let (_, input_port) = &mut inputs;
    let fault = |error: std::io::Error| RunError::Refused(error.into());
    successor.is_ready(&input_port.first_buffered()).map_err(fault)?;
    let stop = runtime.context.stop.clone();
    if !successor.await_turn(|| stop.forced()) {
        return Ok(None);
    }
    runtime.enter();
    match successor.handover.last() {
        // The other was killed: this is a stage that is started anew, with what the writers keep for it. It has left messages to
        // that one, and opens its inputs again.
        None if input_port.is_kept() => return open(runtime).map(Some),
        last => input_port.begin_after(last.unwrap_or_default()),
    }
    Ok(Some(inputs))
}

/// Waits until a message of each writer is buffered, and what goes with it; false if that is not wanted any more.
fn buffers_all<T: Transport>(
    successor: &mut Successor,
    (side_inputs, input_port): &mut Inputs<T::Reader>,
    runtime: &StageRuntime<T>,
    topic: &Topic,
) -> Result<bool, RunError> {
    let deadline = Instant::now() + successor.patience;
    let lossless = |topic: &Topic| topic.delivery_to(&runtime.context.stage) == Delivery::Lossless;
    let is_over = |writer: &String| runtime.peers.is_over(writer);
    loop {
        // The side inputs last: what a message was made of came before it.
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
        if successor.is_dismissed() || runtime.context.stop.forced() {
            return Ok(false);
        }
    }
}
