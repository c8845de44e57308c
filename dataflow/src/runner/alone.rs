//! Runs a single stage or source as in a pipeline, but alone: for tests.

use super::peers::Peers;
use super::source_loop::run_source;
use super::stage_loop::run_stage;
use super::untyped::{NewSource, NewStage, of_same_frame};
use super::{RunError, StageRuntime};
use crate::item_type::ItemType;
use crate::pause::Pause;
use crate::ports::in_memory::{InMemory, MemoryReader};
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport, Wiring, Writer};
use crate::side_inputs::SideInputs;
use crate::stage::{Context, Memory, Output, Source, Stage, StageError, UntypedOutput};
use crate::status::StatusFile;
use bytemuck::{cast_slice, cast_slice_mut};
use conicflow_messages::{END_OF_STREAM, Header, Hop, Item, Message, Nothing, Text};
use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

/// A message that owns its header and items.
pub type Owned<T> = (Header, Vec<T>);

const UPSTREAM: &str = "upstream";
const DOWNSTREAM: &str = "downstream";

/// Runs one step of a stage that was created by [`Stage::new`], with these side inputs, and returns the message that it would
/// send.
///
/// # Errors
/// The stage failed, or the input or the output is a message that no reader would take.
pub fn step<S: Stage>(
    stage: &mut S,
    (header, items): &Owned<S::Input>,
    side_inputs: &SideInputs,
) -> Result<Owned<S::Output>, StageError> {
    check(header, items)?;
    let (mut loan, mut list, mut counts) = (Loan(Vec::new()), Vec::new(), BTreeMap::new());
    let output = UntypedOutput { header: *header, memory: &mut loan, counts: &mut counts };
    let mut output = Output::new(output, &mut list);
    stage.step(&Message { header, items }, side_inputs, &mut output)?;
    let (made, is_loaned) = (of_same_frame(output.header, header), output.is_loaned());
    let items = if is_loaned { loan.0 } else { list };
    check(&made, &items)?;
    Ok((made, items))
}

/// Memory of this process only.
struct Loan<T>(Vec<T>);

impl<T: Item> Memory for Loan<T> {
    fn loan(&mut self, length: usize) -> Result<&mut [u8], StageError> {
        self.0 = vec![T::zeroed(); length];
        Ok(cast_slice_mut(&mut self.0))
    }
}

/// Checks a message as a reader would; the output of a sink is not checked.
fn check<T: Item>(header: &Header, items: &[T]) -> Result<(), StageError> {
    let item = const { ItemType::of::<T>() };
    Ok(if item.is::<Nothing>() { Ok(()) } else { item.check(header, cast_slice(items)) }?)
}

/// Runs the stage `S` over `messages`, and returns what it sent. No message is lost unless `context.delivery` is
/// [`Delivery::Latest`].
///
/// # Errors
/// The stage refused its parameters, or failed, or sent a message that no reader would take; or no reader would take one of
/// `messages`, each of which needs a later `sequence` than the one before.
pub fn pass<S: Stage>(
    config: S::Config,
    context: Context,
    messages: &[Owned<S::Input>],
) -> Result<Vec<Owned<S::Output>>, RunError> {
    let headers = messages.iter().map(|(header, _)| header);
    let mut pairs = headers.clone().zip(headers.skip(1));
    if pairs.any(|(before, after)| before.epoch == after.epoch && before.sequence >= after.sequence) {
        return Err(RunError::Refused("each message needs a larger `sequence` than the one before".into()));
    }
    messages.iter().try_for_each(|(header, items)| check(header, items)).map_err(RunError::Refused)?;
    let parameters = serde_json::to_value(config).map_err(|error| RunError::Refused(error.into()))?;
    let memory = InMemory::new(context.stop.clone());
    let mut input = topic("input", UPSTREAM, &context.stage, messages.len() + 1);
    input.readers[0].delivery = context.delivery.unwrap_or(Delivery::Lossless);
    let output = topic("output", &context.stage, DOWNSTREAM, messages.len() + 1);
    let mut writer = memory.writer::<S::Input>(&input)?;
    let wiring = Wiring { input: Some(input), output: Some(output.clone()), ..Wiring::default() };
    run_alone(
        &memory,
        wiring,
        context,
        &output,
        |runtime| run_stage(&NewStage::of::<S>(parameters)?, runtime),
        |is_over| {
            while writer.connected().is_empty() && !is_over() {
                thread::yield_now();
            }
            for (header, items) in messages {
                writer.loan(items.len())?.copy_from_slice(items);
                writer.send(&from_upstream(*header))?;
            }
            let number = messages.last().map_or(0, |(header, _)| header.number.saturating_add(1));
            writer.send(&from_upstream(Header { flags: END_OF_STREAM, number, ..Header::default() })).map(drop)
        },
    )
}

/// Runs the source `S` until it has made `frames` messages or is exhausted, and returns them. For a source of items of any type,
/// `context.output` is the actual type.
///
/// # Errors
/// The source refused its parameters, or failed, or made a message that no reader would take.
pub fn collect<S: Source>(config: S::Config, context: Context, frames: u64) -> Result<Vec<Owned<S::Output>>, RunError> {
    let parameters = serde_json::to_value(config).map_err(|error| RunError::Refused(error.into()))?;
    let memory = InMemory::new(context.stop.clone());
    let output = Topic { item: context.output.clone(), ..topic("output", &context.stage, DOWNSTREAM, 4) };
    let wiring = Wiring { output: Some(output.clone()), frames: Some(frames), ..Wiring::default() };
    run_alone(
        &memory,
        wiring,
        context,
        &output,
        |runtime| run_source(&NewSource::of::<S>(parameters)?, runtime),
        |_| Ok(()),
    )
}

fn topic(name: &str, writer: &str, reader: &str, queue: usize) -> Topic {
    let reader = TopicReader { stage: reader.to_owned(), delivery: Delivery::Lossless, queue };
    Topic { name: name.to_owned(), item: None, writers: vec![writer.to_owned()], readers: vec![reader] }
}

fn from_upstream(header: Header) -> Header {
    let mut header = Header { hop_count: 0, ..header };
    header.add_hop(Hop { stage: Text::new(UPSTREAM), ..Hop::default() });
    header
}

/// Runs a loop on its own thread, feeds it, and collects its messages until it is over.
fn run_alone<T: Item>(
    memory: &InMemory,
    wiring: Wiring,
    context: Context,
    output: &Topic,
    run: impl FnOnce(StageRuntime<InMemory>) -> Result<(), RunError> + Send,
    feed: impl FnOnce(&dyn Fn() -> bool) -> Result<(), PortError>,
) -> Result<Vec<Owned<T>>, RunError> {
    let item = output.item.clone().unwrap_or(const { ItemType::of::<T>() });
    let mut reader = memory.reader_of(&item, output, DOWNSTREAM)?;
    let record = StatusFile::nowhere();
    let (transport, peers) = (memory.clone(), Peers::default());
    let (pause, handover, successor, lock) = (Pause::default(), None, None, None);
    let runtime = StageRuntime { transport, wiring, context, peers, record, handover, successor, pause, lock };
    thread::scope(|scope| {
        let running = scope.spawn(|| run(runtime));
        let fed = feed(&|| running.is_finished());
        let sent = gather(&mut reader, || running.is_finished());
        drop(reader);
        running.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        fed?;
        let sent = sent?;
        sent.iter().try_for_each(|(header, items)| check(header, items)).map_err(RunError::Refused)?;
        Ok(sent)
    })
}

/// All messages up to the end of the stream, or until the sender has ended.
fn gather<T: Item>(reader: &mut MemoryReader, is_over: impl Fn() -> bool) -> Result<Vec<Owned<T>>, PortError> {
    let mut messages = Vec::new();
    loop {
        let over = is_over();
        match reader.receive()? {
            Some(message) if message.header().ends_stream() => return Ok(messages),
            Some(message) => messages.push((*message.header(), message.items().to_vec())),
            None if over => return Ok(messages),
            None => reader.wait(Duration::from_millis(10))?,
        }
    }
}
