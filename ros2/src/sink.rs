//! The sink that sends results to ROS 2: detections, markers for RViz, and the camera's transform.

use crate::link::Link;
use crate::participant::topic_fault;
use crate::{Distro, End, Middleware, Participant, Via, Way};
use conicflow_dataflow::{ConfigFault, Context, Output, SideInputs, Stage, StageError};
use conicflow_messages::{Header, Item, Message, Nothing};
use conicflow_ros::{
    DETECTION_ARRAY, MARKER_ARRAY, Marked, Markers, Stamped, TF_MESSAGE, detections, markers, write_transform,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::marker::PhantomData;
use std::path::Path;
use std::time::{Duration, Instant};

// The indices of the endpoints.
const DETECTIONS: usize = 0;
const MARKERS: usize = 1;
const TRANSFORMS: usize = 2;

/// How long the sink waits for the router when it starts, so that the first messages are not lost.
const ROUTER_TIMEOUT: Duration = Duration::from_secs(1);
/// How often the sink checks whether the router has answered when it starts.
const ROUTER_CHECK_PERIOD: Duration = Duration::from_millis(10);
/// The frame id of messages whose source has no name.
const NAMELESS: &str = "camera";

/// Parameters of [`Ros2Sink`].
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SinkConfig {
    /// The topic of the detections; the markers are at `markers` below it. Default: `/conicflow/tracks` or `/conicflow/objects`.
    pub topic: Option<String>,
    /// The coordinate frame of the camera; default: that of the images, as `ros2_source` received it, else the name of the stage
    /// that the frames come from.
    pub frame_id: Option<String>,
    /// How long RViz shows a marker without a newer message, in seconds.
    #[schemars(range(min = 0.01, max = 3600.0))]
    pub lifetime_s: f64,
    /// The coordinate frame in which the source reports the camera's pose, which is then sent to /tf; default: no pose is sent.
    pub world: Option<String>,
    /// Zenoh endpoints of the robot's router, such as `["tcp/192.168.0.2:7447"]`; of several, the first that answers is used.
    pub connect: Vec<String>,
    /// The ROS 2 domain, equal to `ROS_DOMAIN_ID` on the robot.
    #[schemars(range(max = 232))]
    pub domain: u32,
    /// The ROS 2 distribution on the robot.
    pub distro: Distro,
    /// The software that carries messages from Zenoh to ROS 2.
    pub via: Via,
}

impl Default for SinkConfig {
    fn default() -> Self {
        Self {
            topic: None,
            frame_id: None,
            lifetime_s: 0.5,
            world: None,
            connect: Vec::new(),
            domain: 0,
            distro: Distro::default(),
            via: Via::default(),
        }
    }
}

impl SinkConfig {
    fn faults(&self) -> Vec<ConfigFault> {
        let mut faults = Participant::faults(&self.connect, self.domain);
        faults.extend(self.topic.as_deref().and_then(|topic| topic_fault("topic", topic)));
        for (key, frame) in [("frame_id", &self.frame_id), ("world", &self.world)] {
            if frame.as_deref().is_some_and(|name| name.is_empty() || name.contains('\0')) {
                let hint = "such as \"camera_depth_optical_frame\" or \"map\"";
                faults.push(ConfigFault::new(key, "is no name of a frame", hint));
            }
        }
        faults
    }

    fn ends(&self, input: &str) -> Vec<End> {
        let topic = self.topic.clone().unwrap_or_else(|| format!("/conicflow/{input}"));
        let markers = format!("{topic}/markers");
        let ends = [(topic, DETECTION_ARRAY), (markers, MARKER_ARRAY), ("/tf".to_owned(), TF_MESSAGE)];
        let wanted = if self.world.is_some() { 3 } else { 2 };
        ends.into_iter().take(wanted).map(|(topic, definition)| End { topic, definition, way: Way::Publish }).collect()
    }
}

/// Publishes objects or tracks on ROS 2 topics.
pub struct Ros2Sink<T, M> {
    middleware: M,
    link: Link,
    config: SinkConfig,
    items: PhantomData<T>,
}

impl<T: Item + Marked, M: Middleware> Stage for Ros2Sink<T, M> {
    const NAME: &'static str = "ros2_sink";
    const SUMMARY: &'static str =
        "Sends objects or tracks to ROS 2 over Zenoh: detections with covariance, markers, transforms";
    type Config = SinkConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &SinkConfig, _: &Path) -> Vec<ConfigFault> {
        config.faults()
    }

    fn new(config: SinkConfig, context: &Context) -> Result<Self, StageError> {
        let participant = Participant {
            connect: config.connect.clone(),
            domain: config.domain,
            distro: config.distro,
            via: config.via,
            name: Participant::name_of(&context.stage),
            ends: config.ends(T::NAME),
        };
        let middleware = M::join(participant)?;
        let begin = Instant::now();
        while !middleware.is_joined() && begin.elapsed() < ROUTER_TIMEOUT && !context.stop.requested() {
            std::thread::sleep(ROUTER_CHECK_PERIOD);
        }
        Ok(Self { middleware, link: Link::new(&config.connect), config, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, output: &mut Output<Nothing>) -> Result<(), StageError> {
        if !self.link.look(&self.middleware) {
            output.count("messages without a router", 1);
            return Ok(());
        }
        let header = input.header;
        let origin = header.origin();
        let stamped = Stamped { stamp_ns: header.stamp_ns, frame_id: self.frame_id(header, origin.as_str()) };
        self.middleware.publish(DETECTIONS, detections(stamped, input.items, Vec::new()));
        let lifetime_ns = (self.config.lifetime_s * 1e9) as u64;
        let drawn = markers(stamped, input.items, Markers::Expire(lifetime_ns), Vec::new());
        self.middleware.publish(MARKERS, drawn);
        if let (Some(world), Some(pose)) = (&self.config.world, header.pose()) {
            let in_world = Stamped { stamp_ns: header.stamp_ns, frame_id: world };
            self.middleware.publish(TRANSFORMS, write_transform(in_world, stamped.frame_id, pose, Vec::new()));
        }
        output.count("messages sent", 1);
        Ok(())
    }
}

impl<T, M> Ros2Sink<T, M> {
    /// Returns the frame id of a message. For recorded frames, the header's source is a file name and not used.
    fn frame_id<'a>(&'a self, header: &'a Header, origin: Option<&'a str>) -> &'a str {
        let source = header.source.as_str().filter(|name| !name.is_empty() && !header.is_recorded());
        let named = self.config.frame_id.as_deref().or(source).or(origin.filter(|name| !name.is_empty()));
        named.unwrap_or(NAMELESS)
    }
}
