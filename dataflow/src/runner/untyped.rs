//! Stages and sources without their types: they take and return bytes, so that each loop is compiled only once, not for each
//! node.

use super::RunError;
use super::pace::Rhythm;
use crate::item_type::ItemType;
use crate::side_inputs::{SideInput, SideInputs};
use crate::stage::{Context, Next, Output, Source, Stage, StageError, UntypedOutput};
use bytemuck::{cast_slice, try_cast_slice};
use conicflow_messages::{END_OF_STREAM, Header, Item, Message, Nothing};
use serde::de::DeserializeOwned;
use serde_json::Value as Json;

/// A stage that is still to be created.
pub(crate) type NewStage<'a> = New<'a, dyn AnyStage + 'a>;
/// A source that is still to be created.
pub(crate) type NewSource<'a> = New<'a, dyn AnySource + 'a>;

/// A stage or source that is still to be created: the types of its inputs and output, and the function that creates it.
pub(crate) struct New<'a, S: ?Sized> {
    pub(crate) side_inputs: &'static [SideInput],
    /// Type of its driving input; [`Nothing`] for a source.
    pub(crate) input: ItemType,
    /// Type of its output; [`Nothing`] for a sink.
    pub(crate) output: ItemType,
    make: Box<Make<'a, S>>,
}

type Make<'a, S> = dyn Fn(&Context) -> Result<Box<S>, StageError> + 'a;

/// A stage of any type.
pub(crate) trait AnyStage {
    /// Calls [`Stage::step`] with a message that has this header and these bytes.
    fn step(
        &mut self,
        message: (&Header, &[u8]),
        side_inputs: &SideInputs,
        output: UntypedOutput<'_>,
    ) -> Result<Made<'_>, StageError>;

    /// Calls [`Stage::finish`].
    fn finish(&mut self) -> Result<(), StageError>;
}

/// A source of any type.
pub(crate) trait AnySource {
    fn rhythm(&self) -> Rhythm;

    /// Calls [`Source::total`].
    fn total(&self) -> Option<u64>;

    /// Calls [`Source::next`].
    fn next(&mut self, side_inputs: &SideInputs, output: UntypedOutput<'_>) -> Result<(Next, Made<'_>), StageError>;

    /// Calls [`Source::finish`].
    fn finish(&mut self) -> Result<(), StageError>;
}

/// Output of a step.
pub(crate) struct Made<'a> {
    pub(crate) header: Header,
    /// The bytes of a list; `None`: an image, which was written in place.
    pub(crate) list: Option<&'a [u8]>,
}

impl<S: ?Sized> New<'_, S> {
    /// Creates it.
    pub(crate) fn make(&self, context: &Context) -> Result<Box<S>, RunError> {
        (self.make)(context).map_err(RunError::Refused)
    }
}

impl<'a> NewStage<'a> {
    /// The stage `S` with these parameters.
    pub(crate) fn of<S: Stage + 'a>(parameters: Json) -> Result<Self, RunError> {
        let config = checked::<S::Config>(parameters)?;
        Ok(Self {
            side_inputs: S::side_inputs(),
            input: ItemType::of::<S::Input>(),
            output: ItemType::of::<S::Output>(),
            make: Box::new(move |context| Ok(Box::new(Typed { inner: S::new(config()?, context)?, list: Vec::new() }))),
        })
    }
}

impl<'a> NewSource<'a> {
    /// The source `S` with these parameters.
    pub(crate) fn of<S: Source + 'a>(parameters: Json) -> Result<Self, RunError> {
        let config = checked::<S::Config>(parameters)?;
        Ok(Self {
            side_inputs: S::side_inputs(),
            input: ItemType::of::<Nothing>(),
            output: ItemType::of::<S::Output>(),
            make: Box::new(move |context| Ok(Box::new(Typed { inner: S::new(config()?, context)?, list: Vec::new() }))),
        })
    }
}

/// Returns a function that parses the parameters, which may be called repeatedly. Parses them once now, so that invalid ones are
/// refused before a port is opened or a place taken.
fn checked<C: DeserializeOwned>(parameters: Json) -> Result<impl Fn() -> serde_json::Result<C>, RunError> {
    let read = move || serde_json::from_value(parameters.clone());
    read().map_err(|error| RunError::Refused(error.into()))?;
    Ok(read)
}

/// A stage or source with the list of its last step, which is empty after an image.
struct Typed<S, T> {
    inner: S,
    list: Vec<T>,
}

impl<S: Stage> AnyStage for Typed<S, S::Output> {
    fn step(
        &mut self,
        (header, bytes): (&Header, &[u8]),
        side_inputs: &SideInputs,
        output: UntypedOutput<'_>,
    ) -> Result<Made<'_>, StageError> {
        let input = Message { header, items: items(bytes)? };
        let mut output = Output::new(output, &mut self.list);
        self.inner.step(&input, side_inputs, &mut output)?;
        let (made, is_loaned) = (output.header, output.is_loaned());
        Ok(Made { header: of_same_frame(made, header), list: (!is_loaned).then_some(cast_slice(&self.list)) })
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.inner.finish()
    }
}

impl<S: Source> AnySource for Typed<S, S::Output> {
    fn rhythm(&self) -> Rhythm {
        let source = &self.inner;
        Rhythm { rate_hz: source.rate_hz(), keeps_stamps: source.keeps_stamps(), can_pause: source.can_pause() }
    }

    fn total(&self) -> Option<u64> {
        self.inner.total()
    }

    fn next(&mut self, side_inputs: &SideInputs, output: UntypedOutput<'_>) -> Result<(Next, Made<'_>), StageError> {
        let mut output = Output::new(output, &mut self.list);
        let next = self.inner.next(side_inputs, &mut output)?;
        let (header, is_loaned) = (output.header, output.is_loaned());
        Ok((next, Made { header, list: (!is_loaned).then_some(cast_slice(&self.list)) }))
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.inner.finish()
    }
}

/// Restores those fields of an output header that a stage may not change: the identity of the frame and the hops, from which
/// readers know what they have missed.
pub(crate) fn of_same_frame(made: Header, frame: &Header) -> Header {
    let Header { epoch, sequence, number, hop_count, hops, .. } = *frame;
    Header { epoch, sequence, number, hop_count, hops, flags: made.flags & !END_OF_STREAM, ..made }
}

/// Casts bytes to items; an empty slice may be unaligned.
fn items<T: Item>(bytes: &[u8]) -> Result<&[T], StageError> {
    if bytes.is_empty() {
        return Ok(&[]);
    }
    try_cast_slice(bytes).map_err(|error| format!("{} bytes are no items of {}: {error}", bytes.len(), T::NAME).into())
}
