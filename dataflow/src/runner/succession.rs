//! How a stage takes the place of another process of the same stage: made ready beside it, it hears each writer, with all
//! that goes with a message in its further inputs, and begins when the other is gone.

use super::handover::Successor;
use super::inbox::Inbox;
use super::side_ports::SidePort;
use super::{RunError, StageRuntime, is_nothing};
use crate::ports::{Delivery, Topic, Transport};
use crate::stage::Stage;
use crate::status::Life;
use std::time::{Duration, Instant};

/// A successor waits so long for the first message of writers whose loss of one would be no fault.
const PATIENCE_WITH_WRITERS: Duration = Duration::from_secs(1);

/// Makes the stage ready while the one that it replaces is at work, so that what cannot begin never takes a place. A sink
/// is made on trial, and anew in its place: two that are at work on one file would spoil it.
pub(crate) fn made_early<S: Stage>(
    config: &S::Config,
    around: &StageRuntime<impl Transport>,
) -> Result<Option<S>, RunError> {
    let copied = serde_json::to_value(config).and_then(serde_json::from_value);
    let copy = copied.map_err(|error| RunError::Refused(error.into()))?;
    let stage = S::new(copy, &around.context).map_err(RunError::Refused)?;
    Ok(Some(stage).filter(|_| !is_nothing::<S::Output>()))
}

/// Hears each writer once, says so, and waits until the process that it replaces is gone; whether its turn came.
pub(crate) fn takes_place<T: Transport + 'static>(
    mut successor: Successor,
    inbox: &mut Inbox<T::Reader>,
    sides: &mut [Box<dyn SidePort>],
    around: &mut StageRuntime<T>,
    topic: &Topic,
) -> Result<bool, RunError> {
    if !hears_all(&mut successor, inbox, sides, around, topic)? {
        return Ok(false);
    }
    let fault = |error: std::io::Error| RunError::Refused(error.into());
    successor.is_ready(&inbox.first_heard()).map_err(fault)?;
    let stop = around.context.stop.clone();
    if !successor.await_turn(|| stop.forced()) {
        return Ok(false);
    }
    around.enter();
    inbox.begin_after(successor.handover.last().unwrap_or_default());
    Ok(true)
}

/// Waits until each writer was heard once, and the further inputs with it; false if that is not wanted any more.
fn hears_all<T: Transport>(
    successor: &mut Successor,
    inbox: &mut Inbox<T::Reader>,
    sides: &mut [Box<dyn SidePort>],
    around: &StageRuntime<T>,
    topic: &Topic,
) -> Result<bool, RunError> {
    let deadline = Instant::now() + PATIENCE_WITH_WRITERS;
    let lossless = |topic: &Topic| topic.delivery_to(&around.context.stage) == Delivery::Lossless;
    let is_over = |writer: &String| matches!(around.peers.life(writer), Some(Life::Ended | Life::Gone));
    loop {
        // The further inputs last: what a message was made of came before it.
        inbox.hear_on()?;
        sides.iter_mut().try_for_each(|side| side.overhear())?;
        let late = Instant::now() > deadline;
        let needed = |side: &dyn SidePort| {
            let wired = around.wiring.sides.iter().find(|(name, _)| name == side.name()).map(|(_, topic)| topic);
            wired.is_some_and(|topic| (lossless(topic) || !late) && !topic.writers.iter().all(is_over))
        };
        let needed: Vec<_> = sides.iter().filter(|side| needed(side.as_ref())).collect();
        inbox.forget_overheard(|header| !needed.iter().all(|side| side.hears(header)));
        if topic.writers.iter().all(|writer| inbox.has_heard(writer) || is_over(writer)) || (late && !lossless(topic)) {
            return Ok(true);
        }
        if successor.is_dismissed() || around.context.stop.forced() {
            return Ok(false);
        }
    }
}
