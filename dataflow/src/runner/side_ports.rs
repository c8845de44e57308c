//! The side inputs of a running stage: finds for each step the messages that belong to it.

use super::input_port::InputPort;
use crate::item_type::{AnyMessage, ItemType};
use crate::ports::{Delivery, MAX_KEPT, PortError, Reader, Received, Topic, Transport};
use crate::side_inputs::{Pairing, SideInputs};
use crate::status::InputCounts;
use conicflow_messages::Header;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Maximum wait of a step for a message of its frame that is still on its way.
const ON_ITS_WAY: Duration = Duration::from_millis(500);

/// A message that its holder may keep; meanwhile the writer cannot reuse its memory.
pub type RetainedMessage = Arc<dyn Received + Send + Sync>;

/// The inputs of a stage: its side inputs, and the driving one.
pub(crate) type Inputs<R> = (Vec<SidePort<R>>, InputPort<R>);

/// Opens the side input `name`, which reads items of this type from `topic`.
pub(crate) fn open<T: Transport>(
    transport: &T,
    (name, pairing): (&str, Pairing),
    item: &ItemType,
    topic: &Topic,
    stage: &str,
) -> Result<SidePort<T::Reader>, PortError> {
    let reader = transport.reader_of(item, topic, stage)?;
    let wired = topic.readers.iter().find(|reader| reader.stage == stage);
    let lossless = wired.is_some_and(|reader| reader.delivery == Delivery::Lossless);
    let taking = if pairing == Pairing::Latest { Delivery::Latest } else { Delivery::Lossless };
    Ok(SidePort {
        input_port: InputPort::new(reader, taking, &topic.name, topic.writers.len()),
        name: name.to_owned(),
        pairing,
        patience: if lossless { ON_ITS_WAY } else { Duration::ZERO },
        waiting: VecDeque::new(),
        found: None,
    })
}

/// The messages that were found, for a step.
pub(crate) fn found<R: Reader>(ports: &[SidePort<R>]) -> SideInputs<'_> {
    SideInputs(ports.iter().filter_map(|port| Some((port.name(), port.message()?))).collect())
}

/// The messages that were found, in a form that can be kept, with their item types.
pub(crate) fn retained<R: Reader>(ports: &[SidePort<R>]) -> impl Iterator<Item = (&str, RetainedMessage, &ItemType)> {
    ports.iter().filter_map(|port| Some((port.name(), port.found.clone()? as RetainedMessage, port.input_port.item())))
}

/// An open side input.
pub(crate) struct SidePort<R: Reader> {
    input_port: InputPort<R>,
    name: String,
    pairing: Pairing,
    patience: Duration,
    waiting: VecDeque<R::Message>,
    found: Option<Arc<R::Message>>,
}

impl<R: Reader> SidePort<R> {
    fn find_latest(&mut self) -> Result<(), PortError> {
        while let Some(message) = self.input_port.take()? {
            self.found = Some(Arc::new(message));
        }
        Ok(())
    }

    fn find_same_frame(&mut self, step: &Header) -> Result<(), PortError> {
        self.found = None;
        let deadline = Instant::now() + self.patience;
        loop {
            self.gather(step)?;
            if let Some(index) = self.waiting.iter().position(|message| same_frame(message.header(), step)) {
                self.found = self.waiting.remove(index).map(Arc::new);
                return Ok(());
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let overtaken = self.waiting.iter().any(|message| follows(message.header(), step));
            if overtaken || left.is_zero() || self.input_port.ended() {
                return Ok(());
            }
            self.input_port.wait(left)?;
        }
    }

    /// Takes received messages, and drops those that the step has passed.
    fn gather(&mut self, step: &Header) -> Result<(), PortError> {
        loop {
            self.waiting.retain(|message| !follows(step, message.header()));
            if self.waiting.len() >= MAX_KEPT {
                self.waiting.pop_front();
            }
            match self.input_port.take()? {
                Some(message) => self.waiting.push_back(message),
                None => return Ok(()),
            }
            // Messages of another camera do not end the search.
            if self.waiting.back().is_some_and(|message| reaches(message.header(), step)) {
                return Ok(());
            }
        }
    }

    /// Its name in the pipeline file.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Finds the message for a step: by the pairing that of its frame or the latest one; for a source (`None`) the latest one.
    pub(crate) fn find(&mut self, step: Option<&Header>) -> Result<(), PortError> {
        match (self.pairing, step) {
            (Pairing::SameFrame, Some(header)) => self.find_same_frame(header),
            _ => self.find_latest(),
        }
    }

    /// The message that was found.
    fn message(&self) -> Option<AnyMessage<'_>> {
        let message = self.found.as_ref()?;
        Some(AnyMessage { header: message.header(), item: self.input_port.item(), bytes: message.bytes() })
    }

    /// Counts of received and lost messages.
    pub(crate) fn counts(&self) -> InputCounts {
        self.input_port.counts()
    }

    /// Buffers received messages until this process's turn comes.
    pub(crate) fn buffer_ahead(&mut self) -> Result<(), PortError> {
        self.input_port.buffer_ahead()
    }

    /// Whether the messages for this step and all later ones are, or will be, buffered.
    pub(crate) fn covers(&self, step: &Header) -> bool {
        let before = |header: &Header| reaches(step, header);
        self.pairing == Pairing::Latest || self.input_port.buffered().any(before)
    }

    /// Acknowledges the messages that the step has used or passed.
    pub(crate) fn acknowledge(&mut self) {
        self.input_port.acknowledge_but(self.waiting.iter().map(Received::header));
    }

    /// Takes received messages, and releases their writers from keeping them: the driving messages that belong to them may be
    /// lost, and the writers would be blocked for ever.
    pub(crate) fn let_go(&mut self) -> Result<(), PortError> {
        if self.pairing == Pairing::Latest {
            self.find_latest()?;
        }
        while self.waiting.len() < MAX_KEPT
            && let Some(message) = self.input_port.take()?
        {
            self.waiting.push_back(message);
        }
        self.input_port.acknowledge();
        Ok(())
    }

    /// Continues after an earlier process of the same stage, with the buffered messages.
    pub(crate) fn resume(&mut self, counts: InputCounts) -> Result<(), PortError> {
        self.input_port.buffer_ahead()?;
        self.input_port.resume(counts);
        self.input_port.admit_buffered();
        Ok(())
    }
}

fn same_frame(a: &Header, b: &Header) -> bool {
    (a.epoch, a.sequence) == (b.epoch, b.sequence)
}

/// Whether `a` is a later frame of the same source than `b`.
fn follows(a: &Header, b: &Header) -> bool {
    a.epoch == b.epoch && a.sequence > b.sequence
}

/// Whether `a` is the same frame as `b`, or a later one of the same source.
fn reaches(a: &Header, b: &Header) -> bool {
    same_frame(a, b) || follows(a, b)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
    use crate::ports::{TopicReader, Writer};
    use crate::runner::output_port::end_of_stream;
    use conicflow_messages::{Camera, Hop, Object, Text};
    use std::thread;

    fn frame(camera: &str, sequence: u64) -> Header {
        let epoch = if camera == "left" { 1 } else { 2 };
        let camera_of = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
        let mut header =
            Header { epoch, sequence, number: sequence, camera: camera_of, depth_scale: 0.001, ..Header::default() };
        header.add_hop(Hop { stage: Text::new(camera), ..Hop::default() });
        header
    }

    #[test]
    fn a_step_finds_its_frame_behind_those_of_another_camera() {
        let reader = TopicReader { stage: "sink".into(), delivery: Delivery::Latest, queue: 8 };
        let writers = vec!["left".into(), "right".into()];
        let topic =
            Topic { name: "objects".into(), item: Some(ItemType::of::<Object>()), writers, readers: vec![reader] };
        let memory = InMemory::default();
        let side = ("objects", Pairing::SameFrame);
        let mut side = open(&memory, side, &ItemType::of::<Object>(), &topic, "sink").unwrap();
        let mut writer = memory.writer::<Object>(&topic).unwrap();
        for (camera, sequence) in [("left", 0), ("left", 1), ("right", 0), ("left", 2), ("right", 1)] {
            writer.send(&frame(camera, sequence)).unwrap();
        }
        for (camera, sequence) in [("right", 0), ("left", 0), ("right", 1), ("left", 2)] {
            let step = frame(camera, sequence);
            side.find(Some(&step)).unwrap();
            let Some(found) = side.message() else { panic!("{camera} {sequence}") };
            assert_eq!(found.item.name(), "objects");
            assert_eq!((found.header.epoch, found.header.sequence), (step.epoch, step.sequence));
        }
    }

    /// A side input of the stage `sink`, and its writer, which keeps unfinished messages.
    fn joined(pairing: Pairing, delivery: Delivery) -> (SidePort<MemoryReader>, MemoryWriter) {
        let readers = ["viewer", "sink"].map(|stage| {
            let delivery = if stage == "sink" { delivery } else { Delivery::Latest };
            TopicReader { stage: stage.to_owned(), delivery, queue: 40 }
        });
        let (item, writers) = (Some(ItemType::of::<Object>()), vec!["left".into()]);
        let topic = Topic { name: "objects".into(), item, writers, readers: readers.into() };
        let memory = InMemory::default().keeping();
        let side = open(&memory, ("objects", pairing), &ItemType::of::<Object>(), &topic, "sink").unwrap();
        (side, memory.writer::<Object>(&topic).unwrap())
    }

    fn send(writer: &mut MemoryWriter, sequences: std::ops::Range<u64>) {
        sequences.for_each(|sequence| _ = writer.send(&frame("left", sequence)).unwrap());
    }

    /// Sequence number of the message that a step of this frame finds.
    fn found(side: &mut SidePort<MemoryReader>, sequence: u64) -> Option<u64> {
        side.find(Some(&frame("left", sequence))).unwrap();
        side.message().map(|message| message.header.sequence)
    }

    #[test]
    fn a_step_finds_its_frame_however_many_have_come_behind_it() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        send(&mut writer, 0..2 * MAX_KEPT as u64);
        for sequence in 0..2 * MAX_KEPT as u64 {
            assert_eq!(found(&mut side, sequence), Some(sequence));
        }
    }

    #[test]
    fn an_input_that_is_paired_with_no_frame_gives_the_newest_message_to_all_steps() {
        let (mut side, mut writer) = joined(Pairing::Latest, Delivery::Lossless);
        assert_eq!(found(&mut side, 0), None);
        send(&mut writer, 0..3);
        assert_eq!([found(&mut side, 0), found(&mut side, 9)], [Some(2), Some(2)]);
        side.acknowledge();
        assert_eq!(writer.unfinished("sink"), 0);
    }

    #[test]
    fn a_step_waits_for_a_message_of_its_frame_that_is_on_its_way_where_none_may_be_lost() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        assert_eq!(side.patience, ON_ITS_WAY);
        side.patience = Duration::from_secs(3600);
        thread::scope(|scope| {
            scope.spawn(|| {
                thread::sleep(Duration::from_millis(50));
                send(&mut writer, 0..2);
            });
            assert_eq!(found(&mut side, 1), Some(1));
        });
    }

    #[test]
    fn a_step_does_not_wait_for_ever_for_a_message_that_does_not_come() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        thread::scope(|scope| {
            let finding = scope.spawn(|| found(&mut side, 1));
            let deadline = Instant::now() + Duration::from_secs(10);
            while !finding.is_finished() && Instant::now() < deadline {
                thread::sleep(Duration::from_millis(1));
            }
            let has_found = finding.is_finished();
            writer.send(&end_of_stream(&frame("left", 0), Text::new("left"), 0)).unwrap();
            assert_eq!((finding.join().unwrap(), has_found), (None, true));
        });
    }

    #[test]
    fn what_waits_for_a_later_step_is_not_finished() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        send(&mut writer, 0..4);
        side.let_go().unwrap();
        assert_eq!(writer.unfinished("sink"), 0, "nothing is asked for again that was let go of");
        send(&mut writer, 4..6);
        assert_eq!([found(&mut side, 2), found(&mut side, 4)], [Some(2), Some(4)], "and still there");
        side.acknowledge();
        assert_eq!(writer.unfinished("sink"), 1);
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        send(&mut writer, 0..4);
        assert_eq!(found(&mut side, 3), Some(3));
        assert_eq!(writer.unfinished("sink"), 4, "it is not said yet");
        side.acknowledge();
        assert_eq!(writer.unfinished("sink"), 0);
    }

    #[test]
    fn what_is_let_go_of_is_taken_as_far_as_there_is_room() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        send(&mut writer, 0..MAX_KEPT as u64 + 3);
        side.let_go().unwrap();
        assert_eq!(writer.unfinished("sink"), 3);
        let (mut side, mut writer) = joined(Pairing::Latest, Delivery::Lossless);
        send(&mut writer, 0..MAX_KEPT as u64 + 3);
        side.let_go().unwrap();
        assert_eq!(writer.unfinished("sink"), 0, "the newest alone is kept");
        assert_eq!(side.message().map(|message| message.header.sequence), Some(MAX_KEPT as u64 + 2));
    }

    #[test]
    fn a_step_is_covered_from_the_first_frame_on_that_is_buffered() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        let covered = |side: &SidePort<MemoryReader>| [3, 4, 5].map(|sequence| side.covers(&frame("left", sequence)));
        assert_eq!(covered(&side), [false; 3]);
        send(&mut writer, 4..5);
        side.buffer_ahead().unwrap();
        assert_eq!(covered(&side), [false, true, true]);
        assert!(!side.covers(&frame("right", 5)), "of another camera nothing is there");
        let (side, _writer) = joined(Pairing::Latest, Delivery::Lossless);
        assert_eq!(covered(&side), [true; 3], "whatever is the newest");
    }

    #[test]
    fn who_is_started_anew_goes_on_counting_with_what_was_buffered() {
        let (mut side, mut writer) = joined(Pairing::SameFrame, Delivery::Lossless);
        send(&mut writer, 0..2);
        side.resume(InputCounts { topic: Text::new("objects"), received: 7, ..InputCounts::default() }).unwrap();
        assert_eq!(found(&mut side, 1), Some(1));
        assert_eq!(side.counts().received, 9);
    }
}
