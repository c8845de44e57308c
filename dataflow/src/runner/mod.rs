//! Runs one stage: reads messages, calls its step, sends the output, and updates its record, until the stream ends.
//!
//! The two loops are [`source_loop`] and [`stage_loop`]; this module has their common state and error handling.

pub(crate) mod alone;
#[cfg(test)]
mod finishing_tests;
pub(crate) mod handover;
pub(crate) mod input_port;
#[cfg(test)]
mod input_port_tests;
#[cfg(test)]
mod model;
pub(crate) mod output_port;
#[cfg(test)]
mod output_port_tests;
mod pace;
pub(crate) mod peers;
#[cfg(test)]
mod place_tests;
#[cfg(test)]
mod place_trial;
pub(crate) mod pulled_source;
pub(crate) mod pulled_stage;
#[cfg(test)]
mod pulled_tests;
pub(crate) mod side_ports;
pub(crate) mod source_loop;
#[cfg(test)]
mod source_tests;
mod source_warnings;
pub(crate) mod stage_loop;
mod stage_place;
#[cfg(test)]
mod successor_tests;
mod takeover;
#[cfg(test)]
mod tests;
pub(crate) mod untyped;

use crate::item_type::ItemType;
use crate::pause::Pause;
use crate::pipeline::suggestion;
use crate::ports::shared_memory::trim_rss;
use crate::ports::{PortError, Topic, Transport, Wiring};
use crate::side_inputs::{Pairing, SideInput};
use crate::stage::{Context, StageError};
use crate::status::{Life, StatusFile};
use conicflow_messages::{AnyByte, Hinted, Malformed, Nothing, Text, lasts};
use handover::{Handover, Successor};
use output_port::OutputPort;
use peers::Peers;
use side_ports::SidePort;
use std::any::Any;
use std::error::Error;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Everything that a stage needs to run.
pub struct StageRuntime<T> {
    /// Access to the topics.
    pub transport: T,
    pub(crate) wiring: Wiring,
    /// Information for the stage at its start.
    pub context: Context,
    /// The other stages of the run.
    pub peers: Peers,
    /// Record of the stage.
    pub record: StatusFile,
    /// Handover of the stage's place to another process; `None` where it runs alone.
    pub(crate) handover: Option<Handover>,
    /// Set in a process that replaces another one of the same stage.
    pub(crate) successor: Option<Successor>,
    /// Pause switch of the run, which a source obeys.
    pub(crate) pause: Pause,
    /// Lock of the run's folder, held while the stage lives; `None` where the stage is not a process of its own.
    pub(crate) lock: Option<File>,
}

/// Reason why a stage ended before its stream did.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The stage could not be started; a restart would not help.
    #[error("{}", with_causes(&**.0))]
    Refused(StageError),
    /// The stage failed at a frame.
    #[error("at frame {frame}: {}", with_causes(&**.error))]
    Failed {
        /// The frame's sequence number.
        frame: u64,
        /// Error of the stage.
        error: StageError,
    },
    /// The stage failed on a frame, and would fail on the next one; a restart would not help.
    #[error("at frame {frame}: {}", with_causes(&**.error))]
    Lasting {
        /// The frame's sequence number.
        frame: u64,
        /// Error of the stage.
        error: StageError,
    },
    /// The stage could not end its work after the last message; a restart would not help.
    #[error("{}", with_causes(&**.0))]
    Unfinished(StageError),
    /// The ports of the stage failed.
    #[error(transparent)]
    Port(#[from] PortError),
}

impl RunError {
    /// A program tried to send a message that every reader would refuse.
    fn of_malformed(error: Malformed) -> Self {
        let hint = "readers would refuse the message: mend what is named, or leave it out";
        Self::Refused(Hinted::new(error.to_string(), hint).into())
    }
}

/// Text of an error with its causes, except those that the text contains already.
fn with_causes(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let message = error.to_string();
        text = if text.contains(&message) { text } else { format!("{text}: {message}") };
        cause = error.source();
    }
    text
}

impl RunError {
    /// Error of a stage whose inputs or outputs are wrong, with a hint.
    pub(crate) fn refused(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Refused(Hinted::new(what, hint).into())
    }
}

impl<T: Transport> StageRuntime<T> {
    /// Opens the output topic, if the stage has one and makes items.
    pub(crate) fn output_port(&mut self, item: &ItemType) -> Result<OutputPort<T::Writer>, PortError> {
        let wired = self.wiring.output.take().filter(|_| !item.is::<Nothing>());
        let port = wired.map(|topic| Ok::<_, PortError>((self.writer_of(item, &topic)?, topic))).transpose()?;
        let (stop, sent) = (self.context.stop.clone(), self.record.status.sent);
        Ok(OutputPort::new(port, &self.context.stage, sent, self.peers.clone(), stop))
    }

    /// Opens a topic to write, with items of this type, or of the topic's own where the stage writes any type.
    fn writer_of(&self, item: &ItemType, topic: &Topic) -> Result<T::Writer, PortError> {
        let own = topic.item.as_ref().filter(|_| item.is::<AnyByte>());
        self.transport.writer_of(own.unwrap_or(item), topic)
    }

    pub(crate) fn side_inputs(&self, declared: &'static [SideInput]) -> Result<Vec<SidePort<T::Reader>>, PortError> {
        let mut ports = Vec::new();
        for side in declared {
            if let Some((_, topic)) = self.wiring.side_inputs.iter().find(|(name, _)| name == side.name) {
                let (named, item) = ((side.name, side.pairing), (side.item)());
                ports.push(side_ports::open(&self.transport, named, &item, topic, &self.context.stage)?);
            }
        }
        Ok(ports)
    }

    /// Opens all side inputs of the pipeline file, of whatever type. Those in `same_frame` deliver the message of each step's
    /// frame, the others the latest one.
    pub(crate) fn side_inputs_of(&self, same_frame: &[String]) -> Result<Vec<SidePort<T::Reader>>, RunError> {
        let wired = &self.wiring.side_inputs;
        if let Some(missing) = same_frame.iter().find(|name| wired.iter().all(|(wired, _)| wired != *name)) {
            let what = format!("this stage has no `{missing}` among its `inputs` in the pipeline file");
            let hint = suggestion(missing, wired.iter().map(|(name, _)| name.as_str()), "further inputs");
            return Err(RunError::refused(what, hint));
        }
        let open = |(name, topic): &(String, Topic)| {
            let pairing = if same_frame.contains(name) { Pairing::SameFrame } else { Pairing::Latest };
            let item = stage_place::item_of(topic)?;
            Ok(side_ports::open(&self.transport, (name, pairing), &item, topic, &self.context.stage)?)
        };
        wired.iter().map(open).collect()
    }

    /// Item type of the output by the pipeline file; `None` where there is no output.
    pub(crate) fn output_of_any(&self) -> Result<Option<ItemType>, RunError> {
        self.wiring.output.as_ref().map(stage_place::item_of).transpose()
    }

    /// Enters this process into the stage's record, which continues that of an earlier process in the same run.
    pub(crate) fn enter(&mut self) {
        self.record.reload();
        let status = &mut self.record.status;
        status.process = std::process::id();
        status.stage = Text::new(&self.context.stage);
        status.starts += 1;
        status.waits_for = Text::default();
        status.set_life(Life::Starting);
        self.record.write();
        self.record.heartbeat().into_iter().for_each(|heartbeat| self.context.stop.show_life_by(heartbeat));
    }

    pub(crate) fn begin(&mut self, total: Option<u64>) {
        let status = &mut self.record.status;
        status.total = self.wiring.frames.or(total).unwrap_or(0);
        status.set_life(Life::Running);
        self.record.write();
    }
}

/// Returns memory that only the start needed to the system, once a process is at work. The default does nothing.
#[derive(Default)]
pub struct MemoryTrim(Option<u64>);

impl MemoryTrim {
    /// Steps after which memory is returned: early, and once more when rare work has been done, too.
    const STEPS: [u64; 2] = [10, 100];

    /// For a stage that is a process of its own; for others it does nothing.
    pub fn of<T>(runtime: &StageRuntime<T>) -> Self {
        Self(runtime.lock.as_ref().map(|_| 0))
    }

    /// Counts a step.
    pub fn step(&mut self) {
        self.0 = self.0.map(|steps| steps + 1);
        if self.0.is_some_and(|steps| Self::STEPS.contains(&steps)) {
            trim_rss::trim();
        }
    }
}

/// Calls a step; an error or a panic is returned with the number of its frame. An error that would recur is noted in the record,
/// so that the stage is not restarted.
pub(crate) fn guarded<R>(
    record: &mut StatusFile,
    frame: u64,
    step: impl FnOnce() -> Result<R, StageError>,
) -> Result<R, RunError> {
    let failed = |error| RunError::Failed { frame, error };
    match catch_unwind(AssertUnwindSafe(step)) {
        Ok(Err(error)) if lasts(&*error) => {
            record.status.set_life(Life::Gone);
            record.write();
            Err(RunError::Lasting { frame, error })
        }
        Ok(result) => result.map_err(failed),
        Err(panic) => Err(failed(format!("panicked: {}", panic_text(&*panic)).into())),
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("without a text")
}

/// Whether sending stopped because the run ended; other errors are returned.
pub(crate) fn is_stopped(sent: Result<(), PortError>) -> Result<bool, PortError> {
    match sent {
        Ok(()) => Ok(false),
        Err(PortError::Stopped) => Ok(true),
        Err(error) => Err(error),
    }
}
