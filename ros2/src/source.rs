//! The source that reads depth images from a ROS 2 topic as they come.
//!
//! Unusable messages are counted, reported once, and skipped; the stage goes on, because later messages may be usable.

use crate::cameras::{Cameras, WRITE_INTRINSICS};
use crate::link::Link;
use crate::notices::{Fault, Notices, unreadable};
use crate::participant::topic_fault;
use crate::picture::{Kind, Picture};
use crate::{Distro, End, Middleware, Participant, Via, Way};
use conicflow_dataflow::{
    ConfigFault, Context, EmptyFrames, Next, Output, SideInputs, Source, StageError, Stop, TOO_FAR, report_frame,
    unix_ns,
};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{Camera, Header, Hinted, Text};
use conicflow_ros::{CAMERA_INFO, Stamped, TF_MESSAGE, Transforms, Units, camera_info_topics};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::path::Path;
use std::time::{Duration, Instant};

const UNREADABLE: &str = "frames unreadable";
const LOST: &str = "frames lost";
const WITHOUT_CAMERA: &str = "frames without camera";
const WITHOUT_POSE: &str = "frames without pose";
const INFOS_UNREADABLE: &str = "CameraInfo unreadable";
const TRANSFORMS_UNREADABLE: &str = "transforms unreadable";

/// Queue of images that wait to be read: the pipeline reads them at once, unless it is lossless and slow.
const IMAGES_WAITING: usize = 4;
/// The most images that wait for their poses: those of 0.2 s at 90 Hz.
const MOST_WITHOUT_POSE: usize = 18;
/// Queue of transforms: those of some seconds.
const TRANSFORMS_WAITING: usize = 4096;
/// How long an image waits for its CameraInfo.
const CAMERA_INFO_TIMEOUT: Duration = Duration::from_secs(1);
/// How long an image waits for the transforms of its time.
const TRANSFORM_TIMEOUT: Duration = Duration::from_millis(200);
/// After this time without an image, the source reports it.
const REPORT_SILENCE_AFTER: Duration = Duration::from_secs(5);
/// Longest wait for the next image in a step while no image waits for its camera or pose.
const IMAGE_TIMEOUT: Duration = Duration::from_millis(50);
/// Longest wait for the next image in a step while one waits for its camera or pose.
const IMAGE_TIMEOUT_WHILE_ONE_WAITS: Duration = Duration::from_millis(5);
/// The most topics that a hint names.
const MOST_NAMED: usize = 8;

/// The endpoint of the images.
const IMAGES: usize = 0;

/// Parameters of [`Ros2Source`].
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SourceConfig {
    /// The topic with the depth images, such as `/camera/depth/image_rect_raw`.
    pub topic: Option<String>,
    /// The type of its messages; default: by the topic's name: `points`, `compressedDepth`, else an image.
    pub message: Option<Kind>,
    /// The topic with the CameraInfo; default: `camera_info` beside the images.
    pub camera_info: Option<String>,
    /// fx, fy, cx, cy in pixels; default: those of the CameraInfo.
    pub intrinsics: Option<Intrinsics>,
    /// Metres per unit of depth; default: 0.001, for depths in single precision 1.
    #[schemars(range(min = 0.0))]
    pub depth_scale: Option<f64>,
    /// Depth noise of the sensor: a name (`kinect_v1`, `realsense_d435`, `time_of_flight`, `ideal`) or a table; default:
    /// `kinect_v1`.
    pub noise: Option<NoiseConfig>,
    /// The coordinate frame of the camera's pose, such as `map`, which is looked up in /tf and /tf_static; default: no pose.
    pub world: Option<String>,
    /// Zenoh endpoints of the robot's router, such as `["tcp/192.168.0.2:7447"]`; of several, the first that answers is used.
    pub connect: Vec<String>,
    /// The ROS 2 domain, equal to `ROS_DOMAIN_ID` on the robot.
    #[schemars(range(max = 232))]
    pub domain: u32,
    /// The ROS 2 distribution on the robot.
    pub distro: Distro,
    /// The software that carries messages from ROS 2 to Zenoh.
    pub via: Via,
}

impl SourceConfig {
    fn faults(&self) -> Vec<ConfigFault> {
        let mut faults = Participant::faults(&self.connect, self.domain);
        if self.topic.is_none() {
            let hint = "write `topic = \"/camera/depth/image_rect_raw\"`";
            faults.push(ConfigFault::new("topic", "is missing", hint));
        }
        for (key, topic) in [("topic", &self.topic), ("camera_info", &self.camera_info)] {
            faults.extend(topic.as_deref().and_then(|topic| topic_fault(key, topic)));
        }
        faults.extend(self.depth_scale.and_then(ConfigFault::of_depth_scale));
        faults.extend(self.intrinsics.and_then(|intrinsics| intrinsics.fault()));
        faults
    }

    /// The endpoint for the CameraInfo, unless the file names the intrinsics.
    fn camera_end(&self, topic: &str, kind: Kind) -> Option<End> {
        let [beside, above, _] = camera_info_topics(topic);
        let usual = if kind == Kind::CompressedDepth { above } else { beside };
        let topic = self.camera_info.clone().unwrap_or(usual);
        self.intrinsics.is_none().then_some(End { topic, definition: CAMERA_INFO, way: Way::Subscribe(1) })
    }

    /// The endpoints for transforms, if the file asks for poses.
    fn transform_ends(&self) -> Vec<End> {
        let (still, moving) = (Way::SubscribeLatched(TRANSFORMS_WAITING), Way::Subscribe(TRANSFORMS_WAITING));
        let wanted = [("/tf_static", still), ("/tf", moving)].into_iter().filter(|_| self.world.is_some());
        wanted.map(|(topic, way)| End { topic: topic.to_owned(), definition: TF_MESSAGE, way }).collect()
    }
}

/// An image that was received.
struct Waiting {
    message: Vec<u8>,
    arrived: Instant,
    /// The time when it was received, in nanoseconds since 1970.
    arrived_ns: u64,
}

/// Reads depth images from a ROS 2 topic.
pub struct Ros2Source<M> {
    middleware: M,
    link: Link,
    /// The first endpoint is that of the images.
    ends: Vec<End>,
    kind: Kind,
    config: SourceConfig,
    cameras: Cameras,
    transforms: Transforms,
    /// The images that were received and not sent yet, in order.
    waiting: VecDeque<Waiting>,
    /// How long an image waits for its CameraInfo.
    pub(crate) camera_timeout: Duration,
    /// How long an image waits for the transforms of its time.
    pub(crate) patience_with_pose: Duration,
    /// Since when images come without a known camera.
    without_camera: Option<Instant>,
    /// Since when frames lack the pose that the file asks for.
    without_pose: Option<Instant>,
    /// The last camera that was found to match its point clouds.
    checked: Option<Camera>,
    notices: Notices,
    /// When the last image came, and whether the silence since then was reported.
    last_image: (Instant, bool),
    is_reported: bool,
    empty: EmptyFrames,
    stop: Stop,
}

impl<M: Middleware> Source for Ros2Source<M> {
    const NAME: &'static str = "ros2_source";
    const SUMMARY: &'static str = "Takes depth images or organised point clouds from a topic of ROS 2, over Zenoh";
    type Config = SourceConfig;
    type Output = u16;

    fn faults(config: &SourceConfig, _: &Path) -> Vec<ConfigFault> {
        config.faults()
    }

    fn new(config: SourceConfig, context: &Context) -> Result<Self, StageError> {
        let topic = config.topic.clone();
        let topic = topic.ok_or_else(|| Hinted::new("`topic` is missing", "write `topic = \"/camera/depth/..\"`"))?;
        let kind = config.message.unwrap_or_else(|| Kind::of(&topic));
        let images = End { topic: topic.clone(), definition: kind.definition(), way: Way::Subscribe(IMAGES_WAITING) };
        let camera = config.camera_end(&topic, kind);
        let ends: Vec<_> = std::iter::once(images).chain(camera).chain(config.transform_ends()).collect();
        let participant = Participant {
            connect: config.connect.clone(),
            domain: config.domain,
            distro: config.distro,
            via: config.via,
            name: Participant::name_of(&context.stage),
            ends: ends.clone(),
        };
        Ok(Self {
            link: Link::new(&config.connect),
            middleware: M::join(participant)?,
            ends,
            kind,
            cameras: Cameras::new(&topic, config.intrinsics),
            config,
            transforms: Transforms::live(),
            waiting: VecDeque::new(),
            camera_timeout: CAMERA_INFO_TIMEOUT,
            patience_with_pose: TRANSFORM_TIMEOUT,
            without_camera: None,
            without_pose: None,
            checked: None,
            notices: Notices::default(),
            last_image: (Instant::now(), false),
            is_reported: context.resume_at > 0,
            empty: if context.resume_at > 0 { EmptyFrames::silent() } else { EmptyFrames::default() },
            stop: context.stop.clone(),
        })
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        if self.stop.requested() {
            return Ok(Next::End);
        }
        let is_joined = self.link.look(&self.middleware);
        self.take_image(output);
        self.learn(output);
        let Some(image) = self.waiting.pop_front() else {
            self.tell_silence(is_joined);
            return Ok(Next::Later);
        };
        match self.frame(&image) {
            Ok(Some((header, Units { pixels, too_far, .. }))) => {
                output.count(TOO_FAR, too_far);
                output.header = header;
                output.loan(pixels.len())?.copy_from_slice(&pixels);
                self.look_for_pose(&header, output);
                return Ok(Next::Message);
            }
            Ok(None) => self.waiting.push_front(image),
            Err(fault) => self.notice(&fault, output),
        }
        Ok(Next::Later)
    }
}

impl<M: Middleware> Ros2Source<M> {
    /// Receives the next image, waiting for a short while. While the camera is unknown, only the newest image is kept.
    fn take_image(&mut self, output: &mut Output<u16>) {
        let look = if self.waiting.is_empty() { IMAGE_TIMEOUT } else { IMAGE_TIMEOUT_WHILE_ONE_WAITS };
        let message = self.middleware.receive(IMAGES, look);
        output.count(LOST, self.middleware.take_lost(IMAGES));
        let Some(message) = message else { return };
        let arrived = Instant::now();
        if std::mem::replace(&mut self.last_image, (arrived, false)).1 {
            tracing::info!("images come on `{}`", self.ends[IMAGES].topic);
        }
        if !self.cameras.are_known() {
            output.count(WITHOUT_CAMERA, self.waiting.drain(..).count() as u64);
        }
        self.waiting.push_back(Waiting { message, arrived, arrived_ns: unix_ns() });
    }

    /// Whether the camera is unknown and its CameraInfo is still waited for.
    fn awaits_camera(&mut self) -> bool {
        if self.cameras.are_known() {
            return false;
        }
        self.without_camera.get_or_insert_with(Instant::now).elapsed() < self.camera_timeout
    }

    /// Processes the CameraInfo messages and transforms that have come.
    fn learn(&mut self, output: &mut Output<u16>) {
        for end in 1..self.ends.len() {
            while let Some(message) = self.middleware.receive(end, Duration::ZERO) {
                let End { topic, definition, way } = &self.ends[end];
                let (sort, learnt) = if *definition == CAMERA_INFO {
                    (INFOS_UNREADABLE, self.cameras.learn(topic, &message))
                } else {
                    let is_fixed = matches!(way, Way::SubscribeLatched(_));
                    (TRANSFORMS_UNREADABLE, self.transforms.add(&message, is_fixed))
                };
                if let Err(error) = learnt {
                    let fault = unreadable(sort, topic, &error);
                    self.notice(&fault, output);
                }
            }
        }
    }

    /// Returns the frame of an image, or `None` while its camera or pose may still come.
    fn frame(&mut self, image: &Waiting) -> Result<Option<(Header, Units)>, Fault> {
        let topic = self.ends[IMAGES].topic.clone();
        let picture =
            Picture::read(self.kind, &image.message).map_err(|error| unreadable(UNREADABLE, &topic, &error))?;
        if self.awaits_camera() {
            return Ok(None);
        }
        // A driver without a clock leaves the time at zero.
        let stamped = picture.stamped();
        let stamp_ns = if stamped.stamp_ns > 0 { stamped.stamp_ns } else { image.arrived_ns };
        let pose = self.pose(&Stamped { stamp_ns, ..stamped });
        let may_come = image.arrived.elapsed() < self.patience_with_pose && self.waiting.len() < MOST_WITHOUT_POSE;
        if pose.is_none() && self.config.world.is_some() && may_come {
            return Ok(None);
        }
        let (size, depths) = picture.depths().map_err(|error| unreadable(UNREADABLE, &topic, &error))?;
        let camera = self.cameras.of(size).map_err(|hinted| (WITHOUT_CAMERA, hinted))?;
        self.check_cloud(&picture, &camera)?;
        let units = depths.in_units(self.config.depth_scale);
        let noise = self.config.noise.unwrap_or_default().into();
        let source = Text::new(stamped.frame_id);
        let mut header =
            Header { camera, depth_scale: units.depth_scale, noise, stamp_ns, source, ..Header::default() };
        if let Some(pose) = pose {
            header.set_pose(pose);
        }
        header.check(&topic).map_err(|error| {
            (
                UNREADABLE,
                Hinted::new(error.to_string(), "are the numbers of /tf and of the CameraInfo those of a robot?"),
            )
        })?;
        self.tell(&header, &units.pixels);
        self.empty.look(&topic, &units.pixels, units.too_far);
        Ok(Some((header, units)))
    }

    /// Checks that the points of a cloud lie where the camera sees their pixels; done once per camera.
    fn check_cloud(&mut self, picture: &Picture<'_>, camera: &Camera) -> Result<(), Fault> {
        let Picture::Cloud(cloud) = picture else { return Ok(()) };
        if self.checked != Some(*camera) {
            if !cloud.is_of(camera) {
                let topic = &self.ends[IMAGES].topic;
                let what = format!("the points of `{topic}` do not lie where the camera sees its pixels");
                return Err((WITHOUT_CAMERA, Hinted::new(what, WRITE_INTRINSICS)));
            }
            self.checked = Some(*camera);
        }
        Ok(())
    }

    /// The pose of the camera, if the file asks for it and it is known.
    fn pose(&self, stamped: &Stamped<'_>) -> Option<[[f64; 4]; 3]> {
        self.transforms.pose(self.config.world.as_deref()?, stamped.frame_id, stamped.stamp_ns)
    }

    /// Counts a frame without the pose that the file asks for; reports once that poses have been missing for long.
    fn look_for_pose(&mut self, header: &Header, output: &mut Output<u16>) {
        let Some(world) = self.config.world.as_deref().filter(|_| header.pose().is_none()) else {
            self.without_pose = None;
            return;
        };
        output.count(WITHOUT_POSE, 1);
        if self.without_pose.get_or_insert_with(Instant::now).elapsed() > REPORT_SILENCE_AFTER {
            let frame = header.source.as_str().unwrap_or_default();
            let what = format!("nothing tells where `{frame}` is in `{world}`: frames go without a pose");
            self.notices.tell(&(
                WITHOUT_POSE,
                Hinted::new(what, format!("`ros2 run tf2_ros tf2_echo {world} {frame}` tells what is missing")),
            ));
        }
    }

    fn notice(&mut self, fault: &Fault, output: &mut Output<u16>) {
        output.count(fault.0, 1);
        self.notices.tell(fault);
    }

    /// Reports once what the images are like, so that a wrong scale is noticed.
    fn tell(&mut self, header: &Header, pixels: &[u16]) {
        let tell = || report_frame("images", &self.ends[IMAGES].topic, &header.camera, header.depth_scale, pixels);
        self.is_reported = self.is_reported || tell();
    }

    /// Reports that no images come, and which topics there are instead.
    fn tell_silence(&mut self, is_joined: bool) {
        if !is_joined {
            self.last_image.0 = Instant::now();
        }
        if self.last_image.0.elapsed() > REPORT_SILENCE_AFTER && !self.last_image.1 {
            self.last_image.1 = true;
            let Hinted { what, hint, .. } = self.explain_silence();
            tracing::warn!("{what}\n  hint: {hint}");
        }
    }

    fn explain_silence(&self) -> Hinted {
        let End { topic, definition, .. } = &self.ends[IMAGES];
        let published = self.middleware.published();
        let types: Vec<_> = published.iter().filter(|(name, _)| name == topic).map(|(_, kind)| kind.as_str()).collect();
        if types.contains(&definition.name) {
            let what = format!("nothing comes on `{topic}`, which somebody publishes");
            return Hinted::new(what, "does the camera run? `ros2 topic hz` tells");
        }
        let other_kind = types.iter().find_map(|name| Some((name, Kind::of_type(name)?)));
        if let Some((name, kind)) = other_kind {
            let what = format!("`{topic}` carries {name}, expected {}", definition.name);
            return Hinted::new(what, format!("write `message = \"{}\"`", kind.word()));
        }
        // Names that ROS does not allow are not printed.
        let is_fitting = |name: &&String| topic_fault("topic", name).is_none();
        let fitting = published.iter().filter(|(_, kind)| Kind::of_type(kind).is_some()).map(|(name, _)| name);
        let there: Vec<_> = fitting.filter(is_fitting).take(MOST_NAMED).map(|name| format!("`{name}`")).collect();
        let hint = if there.is_empty() {
            format!(
                "nobody publishes images or clouds: does the camera's node run, in domain {}, with \
                 RMW_IMPLEMENTATION=rmw_zenoh_cpp or a bridge (`via`)?",
                self.config.domain
            )
        } else {
            format!("topics with images or clouds: {}", there.join(", "))
        };
        Hinted::new(format!("nobody publishes `{topic}`"), hint)
    }
}
