//! Checks whether the machine has the resources that a run needs: shared memory for all messages that can exist at once, and open
//! files.
//!
//! A writer reuses the memory that was returned to it last. A topic therefore needs memory for as many messages as its readers
//! can queue and hold at once, each of the length that its source gives. Needs that are not certain beforehand are checked when
//! they arise: a list that is longer than usual, an onlooker, a stage that is replaced.

mod insufficient;

pub use insufficient::InsufficientResource;

use crate::item_type::ItemType;
use crate::network::Edge;
use crate::node::Node;
use crate::plan::{Plan, PlannedStage, Runs};
use crate::ports::capacity::{HELD, LOANED, ROOM_PER_PORT, message_bytes, taken};
use crate::ports::{Delivery, MAX_KEPT, Topic, TopicReader};
use crate::side_inputs::{Pairing, SideInput};
use insufficient::enough;

/// Messages that a reader holds of a side input that is matched by frame: the kept ones, and the one in use.
const HELD_FOR_FRAME: usize = MAX_KEPT + 1;
/// Open files of a stage without topics: 16, with a margin for files of its own.
const FILES_PER_STAGE: u64 = 24; // [measured]
/// Open files of a stage for each of its topics: 6, and those for four onlookers.
const FILES_PER_TOPIC: u64 = 18; // [measured]
/// Open files of a stage for each reader and each writer of its topics.
const FILES_PER_PEER: u64 = 3; // [measured]
/// Open files of the network part, besides those for topics, for edges and for each machine that it communicates with.
const FILES_OF_NETWORK: u64 = 64;
/// Open files in which the network part keeps the messages of a lossless edge until they are acknowledged.
const FILES_PER_LOSSLESS_EDGE: u64 = 64; // [derived]
/// Open files of a launcher without topics: 13, with a margin for files that it reads. It has one more for each stage that is a
/// program.
const FILES_OF_LAUNCHER: u64 = 24; // [measured]
/// Open files of a launcher for each topic: three services, each in two files (121 files in all with 18 topics).
const FILES_PER_KEPT_TOPIC: u64 = 6; // [measured]

/// Resources that a plan needs of its machine.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Requirements {
    /// Shared memory that its topics need.
    pub topics: Vec<TopicRequirements>,
    /// Maximum number of files that one process has open at once.
    pub open_files: u64,
}

/// Shared memory that a topic needs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TopicRequirements {
    /// Name of the topic.
    pub name: String,
    /// Maximum number of bytes that it takes.
    pub bytes: u64,
    /// Size of its longest message in bytes.
    pub longest_message: u64,
}

impl Requirements {
    /// Requirements of a plan; `nodes` has its nodes.
    pub fn of(plan: &Plan, nodes: &[Node]) -> Self {
        let mut topics: Vec<TopicRequirements> = Vec::new();
        for stage in &plan.stages {
            for (topic, bytes) in written(plan, stage, nodes) {
                let readers = topic.readers.iter();
                let with_readers = readers.map(|reader| reader.queue + held(plan, topic, reader, nodes)).sum();
                let (taken, longest_message) = (taken(topic, bytes, with_readers), bytes as u64);
                match topics.iter_mut().find(|requirements| requirements.name == topic.name) {
                    Some(requirements) => {
                        requirements.bytes += taken;
                        requirements.longest_message = requirements.longest_message.max(longest_message);
                    }
                    None => topics.push(TopicRequirements { name: topic.name.clone(), bytes: taken, longest_message }),
                }
            }
        }
        let of_launcher =
            FILES_OF_LAUNCHER + FILES_PER_KEPT_TOPIC * plan.topics().count() as u64 + plan.stages.len() as u64;
        Self { topics, open_files: plan.stages.iter().map(open_files).fold(of_launcher, u64::max) }
    }

    /// Checks that there is room, now, for an onlooker of a topic.
    ///
    /// # Errors
    /// Says how much is missing.
    pub fn look_for_onlooker(&self, topic: &Topic) -> Result<(), InsufficientResource> {
        let needed = self.with_another_reader(topic, topic.longest_queue(), 1);
        enough(needed, || format!("look into topic `{}`", topic.name))
    }

    /// Checks that there is room, now, for a second process of a stage beside the one at work.
    ///
    /// # Errors
    /// Says how much is missing.
    pub fn look_for_successor(&self, stage: &PlannedStage) -> Result<(), InsufficientResource> {
        let queue =
            |topic: &Topic| topic.readers.iter().find(|reader| reader.stage == stage.name).map_or(0, |r| r.queue);
        let read = stage.wiring.inputs();
        let read: u64 = read.map(|topic| self.with_another_reader(topic, queue(topic), HELD_FOR_FRAME)).sum();
        let waiting = |topic: &Topic| topic.readers.iter().map(|reader| reader.queue + HELD).sum();
        let written = stage.wiring.output.iter();
        let written: u64 = written.map(|topic| self.with_another_reader(topic, waiting(topic), LOANED)).sum();
        enough(read + written, || format!("replace stage `{}`", stage.name))
    }

    /// Bytes that a topic needs for an additional port, with this many more messages in queues and held.
    fn with_another_reader(&self, topic: &Topic, queue: usize, held: usize) -> u64 {
        let own = self.topics.iter().find(|requirements| requirements.name == topic.name);
        own.map_or(0, |requirements| requirements.longest_message) * (queue + held) as u64 + ROOM_PER_PORT as u64
    }

    /// Total shared memory in bytes.
    pub fn shared_memory(&self) -> u64 {
        self.topics.iter().map(|requirements| requirements.bytes).sum()
    }
}

/// The topics that a stage writes here, and the size of its longest message there in bytes.
fn written<'a>(plan: &Plan, stage: &'a PlannedStage, nodes: &[Node]) -> Vec<(&'a Topic, usize)> {
    if let Runs::Bridge(bridge) = &stage.runs {
        let edges = bridge.incoming.iter();
        return edges.map(|edge| (&edge.topic, message_bytes(&edge.item, None))).collect();
    }
    let Some(topic) = &stage.wiring.output else { return Vec::new() };
    // A program's output of unknown type is assumed to be images of the usual size.
    let item = topic.item.as_ref().unwrap_or(const { &ItemType::of::<u16>() });
    // A recording gives the size of its images; the length of its lists is unknown.
    let node = node_of(stage, nodes).filter(|node| item.is_image() || !node.writes_any());
    let length = node.and_then(|node| (node.message_length)(stage.parameters.clone(), &plan.base));
    vec![(topic, message_bytes(item, length))]
}

fn node_of<'a>(stage: &PlannedStage, nodes: &'a [Node]) -> Option<&'a Node> {
    let Runs::Node { node, .. } = &stage.runs else { return None };
    nodes.iter().find(|row| row.name == *node)
}

/// Maximum number of messages of a topic that a reader holds at once, in addition to those in its queue.
fn held(plan: &Plan, topic: &Topic, reader: &TopicReader, nodes: &[Node]) -> usize {
    let Some(stage) = plan.stage(&reader.stage) else { return HELD };
    let side_inputs = node_of(stage, nodes).map_or(&[] as &[SideInput], Node::side_inputs);
    let wired = stage.wiring.side_inputs.iter().filter(|(_, wired)| wired.name == topic.name);
    let waits_for_frame =
        |name: &str| side_inputs.iter().any(|side| side.name == name && side.pairing == Pairing::SameFrame);
    if wired.into_iter().any(|(name, _)| waits_for_frame(name)) { HELD_FOR_FRAME } else { HELD }
}

fn open_files(stage: &PlannedStage) -> u64 {
    let own = stage.wiring.inputs().chain(&stage.wiring.output);
    let of_topic =
        |topic: &Topic| FILES_PER_TOPIC + FILES_PER_PEER * (topic.readers.len() + topic.writers.len()) as u64;
    let bridged = match &stage.runs {
        Runs::Bridge(plan) => {
            let edges = plan.incoming.iter().chain(&plan.outgoing);
            let is_lossless = |edge: &&Edge| edge.to.iter().any(|receiver| receiver.delivery == Delivery::Lossless);
            FILES_OF_NETWORK
                + edges.map(|edge| of_topic(&edge.topic)).sum::<u64>()
                + FILES_PER_LOSSLESS_EDGE * plan.outgoing.iter().filter(is_lossless).count() as u64
                + 8 * plan.peers().len() as u64
        }
        _ => 0,
    };
    FILES_PER_STAGE + bridged + own.map(of_topic).sum::<u64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::tests::{node, variant};
    use crate::pipeline::{Pipeline, SourceText};
    use crate::registry::Registry;
    use crate::stage::{Context, NoConfig, Output, Source, StageError};
    use crate::{Next, SideInputs};
    use conicflow_messages::{Item, Nothing};
    use std::path::Path;

    const PIXELS: usize = 1_000_000;

    struct Camera;

    impl Source for Camera {
        const NAME: &'static str = "camera";
        const SUMMARY: &'static str = "Makes images of a million pixels";
        type Config = NoConfig;
        type Output = u16;

        fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
            Ok(Self)
        }

        fn message_length(_: &NoConfig, _: &Path) -> Option<usize> {
            Some(PIXELS)
        }

        fn next(&mut self, _: &SideInputs, _: &mut Output<u16>) -> Result<Next, StageError> {
            Ok(Next::End)
        }
    }

    const NODES: &[Node] = &[
        Node::source::<Camera>(),
        Node {
            side_inputs: || const { &[SideInput::same_frame::<u16>("other")] },
            ..node("overlay", &[variant(u16::NAME, Nothing::NAME)])
        },
    ];
    const REGISTRY: Registry = Registry { nodes: NODES, network: None };

    fn requirements(stages: &str) -> Requirements {
        let text = format!("name = \"test\"\n{stages}");
        let source = SourceText { name: "test.toml".to_owned(), text };
        let (pipeline, _) = Pipeline::read(source, Path::new("/"), &[], &REGISTRY).unwrap();
        Requirements::of(&Plan::of(&pipeline, None, None, 1), NODES)
    }

    /// Number of images that fit in the shared memory that a topic needs.
    fn images(requirements: &Requirements, topic: &str) -> u64 {
        requirements.topics.iter().find(|requirements| requirements.name == topic).unwrap().bytes / (2 * PIXELS as u64)
    }

    const SOURCE: &str = "[stage.source]\nnode = \"camera\"\noutput = \"depth\"\n";

    #[test]
    fn a_topic_needs_as_many_messages_as_can_wait_and_be_held() {
        let one = format!("{SOURCE}[stage.a]\nnode = \"overlay\"\ninput = {{ topic = \"depth\", queue = 5 }}\n");
        let two = format!("{one}[stage.b]\nnode = \"overlay\"\ninput = {{ topic = \"depth\", queue = 9 }}\n");
        assert_eq!(images(&requirements(&one), "depth"), (5 + 2) + 1);
        assert_eq!(images(&requirements(&two), "depth"), (5 + 2) + (9 + 2) + 1);
        assert!(requirements(&two).open_files > requirements(&one).open_files);
    }

    #[test]
    fn a_launcher_that_keeps_many_topics_needs_more_open_files_than_its_stages() {
        let pairs = |count: usize| {
            let pair = |nth: usize| {
                let source = SOURCE.replace("source", &format!("source{nth}")).replace("depth", &format!("depth{nth}"));
                format!("{source}[stage.sink{nth}]\nnode = \"overlay\"\ninput = \"depth{nth}\"\n")
            };
            requirements(&(0..count).map(pair).collect::<String>()).open_files
        };
        assert_eq!(pairs(1), pairs(2), "a stage needs more");
        assert_eq!(pairs(60), FILES_OF_LAUNCHER + 60 * (FILES_PER_KEPT_TOPIC + 2));
    }

    #[test]
    fn who_waits_for_the_same_frame_holds_more() {
        let second = SOURCE.replace("source", "second").replace("depth", "more");
        let other = "{ topic = \"more\", queue = 5 }";
        let stage = format!("[stage.a]\nnode = \"overlay\"\ninput = \"depth\"\ninputs = {{ other = {other} }}\n");
        assert_eq!(images(&requirements(&format!("{SOURCE}{second}{stage}")), "more"), (5 + 13) + 1);
    }

    #[test]
    fn what_a_program_writes_is_taken_for_a_usual_image() {
        let sink = "[stage.a]\nnode = \"overlay\"\ninput = { topic = \"depth\", queue = 5 }\n";
        let program = SOURCE.replace("node = \"camera\"", "program = [\"sh\"]");
        let (known, usual) = (requirements(&format!("{SOURCE}{sink}")), requirements(&format!("{program}{sink}")));
        let ratio = known.shared_memory() as f64 / usual.shared_memory() as f64;
        assert!((ratio / (PIXELS as f64 / u16::USUAL_LENGTH as f64) - 1.0).abs() < 0.05, "{ratio}");
    }
}
