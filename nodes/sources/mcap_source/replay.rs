//! Plays the messages of a recording one by one, with their recorded headers, or with headers made from the camera's information.

use super::channels::{Chosen, camera_by, read_info};
use super::config::Config;
use crate::recording::files::{Files, Messages, SurveyedChannel};
use crate::recording::own;
use crate::sources::image_source::USUAL_RATE_HZ;
use anyhow::{Context as _, Error, Result, bail, ensure};
use conicflow_dataflow::{EmptyFrames, ItemType, Stop, TOO_FAR, report_frame};
use conicflow_messages::{Camera, Header, Hinted, Hop, INVALID_FAR, INVALID_NEAR, Item, MAX_HOPS, RECORDED, Text};
use conicflow_ros::{CameraInfo, CompressedImage, Depths, Image, Stamped, TF_MESSAGE, Transforms, Units};
use mcap::Message;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

const DAMAGED: &str = "damaged places";
const UNREADABLE: &str = "frames unreadable";
const INFOS_UNREADABLE: &str = "CameraInfo unreadable";
const TRANSFORMS_UNREADABLE: &str = "transforms unreadable";
const WITHOUT_POSE: &str = "frames without pose";
/// Period between repetitions of a recording that has a single frame.
const USUAL_PERIOD_NS: u64 = (1e9 / USUAL_RATE_HZ) as u64;

/// A message of a recording.
#[derive(Clone, Debug)]
pub struct Replayed {
    /// Its header.
    pub header: Header,
    /// Log time of the file.
    pub written_ns: u64,
    /// Its items as bytes, in the order of this machine.
    pub items: Vec<u8>,
}

impl Replayed {
    /// The items as values; the bytes need no alignment.
    pub fn items_as<T: Item>(&self) -> Vec<T> {
        self.items.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
    }
}

/// Plays a recording back.
pub struct Replay {
    files: Files,
    chosen: Chosen,
    item: ItemType,
    config: Config,
    transforms: Option<Transforms>,
    /// The last `CameraInfo` that came while the recording was played.
    info: Option<CameraInfo>,
    messages: Messages,
    /// The last header that was read, for images whose headers are in another channel.
    header: Option<Header>,
    round: Round,
    counts: BTreeMap<&'static str, u64>,
    /// Kinds of unusable messages for which the reason was already logged.
    reported_sorts: BTreeSet<&'static str>,
    is_reported: bool,
    empty: EmptyFrames,
}

/// The position in a recording, and in which repetition of it.
#[derive(Clone, Copy, Debug, Default)]
struct Round {
    /// Log time of the first message.
    begin_ns: Option<u64>,
    /// Offset added to stamps in this round; that of the sequence numbers follows.
    stamp_ns: u64,
    sequence: u64,
    /// Smallest and largest stamp and sequence number that were sent, and the number of messages.
    least: Option<(u64, u64)>,
    most: (u64, u64),
    sent: u64,
}

impl Replay {
    /// Opens the recording that `config` names, relative to `base`, to send messages of `item`.
    ///
    /// # Errors
    /// There is no recording, or nothing in it fits.
    pub fn open(config: &Config, base: &Path, item: &ItemType) -> Result<Self> {
        Self::resume(config, base, item, 0, &Stop::default())
    }

    /// Opens the recording for a stage, which reports through `stop` that it is alive; skips the first `resume_at` messages,
    /// which an earlier process of it has sent.
    ///
    /// # Errors
    /// As for [`Self::open`].
    pub fn resume(config: &Config, base: &Path, item: &ItemType, resume_at: u64, stop: &Stop) -> Result<Self> {
        let path = config.path.as_ref();
        let path = path.ok_or_else(|| Hinted::new("`path` is missing", "write `path = \"run.mcap\"`"))?;
        let path = base.join(path);
        let files = Files::find(&path)?.of_stage(stop);
        let channels = files.survey()?;
        let chosen = Chosen::of(&files, &channels, config, item).with_context(|| format!("`{}`", path.display()))?;
        let mut replay = Self {
            messages: files.messages(&chosen.topics()),
            files,
            chosen,
            item: item.clone(),
            config: config.clone(),
            transforms: None,
            info: None,
            header: None,
            round: Round::default(),
            counts: BTreeMap::new(),
            reported_sorts: BTreeSet::new(),
            is_reported: resume_at > 0,
            empty: if resume_at > 0 { EmptyFrames::silent() } else { EmptyFrames::default() },
        };
        if config.is_part() {
            let first = replay.files.messages_again(&[replay.chosen.topics()[0]]).next().transpose()?;
            replay.round.begin_ns = first.map(|message| message.log_time);
            replay.messages = replay.part(replay.files.messages(&replay.chosen.topics()));
        }
        for _ in 0..resume_at {
            if replay.next_message()?.is_none() {
                break;
            }
        }
        // The earlier process has counted what was skipped.
        replay.counts.clear();
        if let Some(world) = &config.world {
            replay.learn_transforms(&channels, world, resume_at == 0)?;
        }
        Ok(replay)
    }

    /// Reads all transforms between coordinate frames, one of which has to be `world`; unreadable ones are counted if
    /// `is_counted`.
    fn learn_transforms(&mut self, channels: &[SurveyedChannel], world: &str, is_counted: bool) -> Result<()> {
        let of_transforms = channels.iter().filter(|channel| channel.schema() == TF_MESSAGE.name);
        let topics: Vec<_> = of_transforms.map(|channel| channel.channel.topic.as_str()).collect();
        let mut transforms = Transforms::default();
        for message in self.files.messages_again(&topics) {
            let message = message?;
            let topic = &message.channel.topic;
            if let Err(error) = transforms.add(&message.data, topic.ends_with("tf_static"))
                && is_counted
            {
                self.pass_over(topic, TRANSFORMS_UNREADABLE, &error.into());
            }
        }
        let names = transforms.names();
        if !names.contains(world.trim_start_matches('/')) {
            let listed: Vec<_> = names.into_iter().map(|name| format!("`{name}`")).collect();
            let listed = if listed.is_empty() { "nothing tells of any".to_owned() } else { listed.join(", ") };
            let what = format!("`world`: the recording has no frame `{world}`");
            bail!(Hinted::new(what, format!("frames: {listed}")));
        }
        self.transforms = Some(transforms);
        Ok(())
    }

    /// Suppresses the log line about resolution and depths of the images.
    #[must_use]
    pub fn silent(self) -> Self {
        Self { is_reported: true, empty: EmptyFrames::silent(), ..self }
    }

    /// The item type that is sent.
    pub fn item(&self) -> &ItemType {
        &self.item
    }

    /// Number of pixels of an image, if it is known before the recording is played.
    pub fn pixels(&self) -> Option<usize> {
        let camera = match &self.chosen {
            Chosen::Images { camera, .. } => *camera,
            Chosen::OwnImages { headers, .. } => {
                let first = self.files.messages_again(&[headers]).next()?.ok()?;
                own::read(&first.data).ok()?.0.camera
            }
            Chosen::Items { .. } => return None,
        };
        Some(camera.width as usize * camera.height as usize)
    }

    /// Returns the counts since the last call.
    pub fn take_counts(&mut self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        std::mem::take(&mut self.counts).into_iter()
    }

    /// Goes to the first message that was written at `from_ns` or later.
    pub fn seek(&mut self, from_ns: u64) {
        self.messages = self.files.messages_again(&self.chosen.topics()).between(from_ns, None);
        self.header = None;
    }

    /// Returns the next message that can be read; `None` at the end.
    ///
    /// # Errors
    /// A file cannot be read, or none of the messages can be.
    pub fn next_message(&mut self) -> Result<Option<Replayed>> {
        loop {
            let before = self.messages.damaged();
            let sent = self.round.sent;
            let message = self.messages.next().transpose().with_context(|| format!("after {sent} messages"))?;
            let damaged = self.messages.damaged() - before;
            if damaged > 0 {
                *self.counts.entry(DAMAGED).or_default() += damaged;
            }
            let Some(message) = message else {
                if self.begins_again()? {
                    continue;
                }
                return Ok(None);
            };
            let topic = &message.channel.topic;
            if self.chosen.info() == Some(topic) {
                match read_info(topic, &message.data, self.config.written_in) {
                    Ok(info) => self.info = Some(info),
                    Err(error) => self.pass_over(topic, INFOS_UNREADABLE, &error),
                }
                continue;
            }
            if !self.is_in_time(&message) {
                continue;
            }
            match self.decode(&message) {
                Ok(Some(replayed)) => return Ok(Some(self.in_round(replayed))),
                Ok(None) => {}
                Err(error) => self.pass_over(topic, UNREADABLE, &error),
            }
        }
    }

    /// Counts a message that cannot be used; logs the reason for the first one of its kind.
    fn pass_over(&mut self, topic: &str, sort: &'static str, error: &Error) {
        if self.reported_sorts.insert(sort) {
            tracing::warn!("passed over a message of `{topic}`, more of that is counted as `{sort}`: {error:#}");
        }
        *self.counts.entry(sort).or_default() += 1;
    }

    /// Starts again from the beginning if `repeat` is set. It is an error if no message could be read.
    fn begins_again(&mut self) -> Result<bool> {
        let Round { least, most, sent, begin_ns, .. } = self.round;
        let Some((stamp_ns, sequence)) = least else {
            let topic = self.chosen.topics()[0];
            bail!(Hinted::lasting(
                format!("none of the messages of `{topic}` can be read, or is between `from_s` and `to_s`"),
                "look at the recording with another program, such as `mcap info`"
            ));
        };
        if !self.config.repeat {
            return Ok(false);
        }
        // The gap between two rounds is the mean period of the messages; their stamps need neither rise nor differ.
        let span_ns = most.0 - stamp_ns;
        let period_ns = if span_ns > 0 { span_ns / (sent - 1).max(1) } else { USUAL_PERIOD_NS };
        self.round = Round {
            begin_ns,
            stamp_ns: self.round.stamp_ns.saturating_add(span_ns).saturating_add(period_ns),
            sequence: self.round.sequence.saturating_add((most.1 - sequence).saturating_add(1)),
            ..Round::default()
        };
        self.info = None;
        self.messages = self.part(self.files.messages_again(&self.chosen.topics()));
        Ok(true)
    }

    /// Restricts messages to those between `from_s` and `to_s`, with 1 ns more at each end.
    fn part(&self, messages: Messages) -> Messages {
        let Some(begin_ns) = self.round.begin_ns.filter(|_| self.config.is_part()) else { return messages };
        let after = |seconds: f64| begin_ns.saturating_add((seconds * 1e9).ceil() as u64);
        let Config { from_s, to_s, .. } = self.config;
        let from_ns = if from_s > 0.0 { after(from_s).saturating_sub(1) } else { 0 };
        messages.between(from_ns, to_s.map(|to_s| after(to_s).saturating_add(1)))
    }

    fn is_in_time(&mut self, message: &Message) -> bool {
        let begin_ns = *self.round.begin_ns.get_or_insert(message.log_time);
        let at_s = message.log_time.saturating_sub(begin_ns) as f64 * 1e-9;
        at_s >= self.config.from_s && self.config.to_s.is_none_or(|to_s| at_s < to_s)
    }

    /// Moves the stamp and sequence number of a message on to this round.
    fn in_round(&mut self, mut replayed: Replayed) -> Replayed {
        let header = &mut replayed.header;
        let now = (header.stamp_ns, header.sequence);
        let (least, most) = (self.round.least.unwrap_or(now), self.round.most);
        self.round.least = Some((least.0.min(now.0), least.1.min(now.1)));
        self.round.most = (most.0.max(now.0), most.1.max(now.1));
        self.round.sent += 1;
        header.stamp_ns = header.stamp_ns.saturating_add(self.round.stamp_ns);
        header.sequence = header.sequence.saturating_add(self.round.sequence);
        replayed
    }

    /// Decodes a message; `None` for a header, whose image follows.
    fn decode(&mut self, message: &Message) -> Result<Option<Replayed>> {
        let replayed = match &self.chosen {
            Chosen::Items { .. } => {
                let (header, items) = own::read(&message.data)?;
                self.own(message, header, items.to_vec())?
            }
            Chosen::OwnImages { headers, .. } if message.channel.topic == *headers => {
                self.header = Some(own::read(&message.data)?.0);
                return Ok(None);
            }
            Chosen::OwnImages { .. } => {
                let header = self.header.take().filter(|header| header.sequence as u32 == message.sequence);
                let header = header.context("its header is missing")?;
                let items = own_pixels(&Image::read(&message.data)?.depths()?, header.depth_scale);
                self.own(message, header, items)?
            }
            Chosen::Images { is_compressed, camera, .. } => self.image(message, *is_compressed, *camera)?,
        };
        if self.item.is_image() {
            self.report_first_image(&replayed);
        }
        Ok(Some(replayed))
    }

    /// Checks a message that conicflow recorded, and replaces what the parameters override.
    fn own(&self, message: &Message, recorded: Header, items: Vec<u8>) -> Result<Replayed> {
        self.item.check(&recorded, &items)?;
        ensure!(!recorded.ends_stream(), "it is the end of a stream");
        let mut header = Header { hop_count: 0, hops: [Hop::default(); MAX_HOPS], ..recorded };
        if let Some(intrinsics) = self.config.intrinsics {
            header.camera = intrinsics.camera((header.camera.width, header.camera.height));
        }
        header.depth_scale = self.config.depth_scale.unwrap_or(header.depth_scale);
        header.noise = self.config.noise.map_or(header.noise, Into::into);
        Ok(Replayed { header, written_ns: message.log_time, items })
    }

    /// Decodes an image of another program; its camera is that of the last `CameraInfo`, or else of the first image.
    fn image(&mut self, message: &Message, is_compressed: bool, first: Camera) -> Result<Replayed> {
        let (stamped, size, depths) = if is_compressed {
            let image = CompressedImage::read(&message.data)?;
            let (size, depths) = image.depths()?;
            (image.stamped, size, depths)
        } else {
            let image = Image::read(&message.data)?;
            (image.stamped, (image.width, image.height), image.depths()?)
        };
        let camera = match (&self.info, self.chosen.info()) {
            (Some(info), Some(name)) => {
                camera_by((name, info), &message.channel.topic, size, None, self.config.written_in)?
            }
            _ => first,
        };
        let expected = (camera.width, camera.height);
        ensure!(size == expected, "{}x{} pixels, expected {}x{}", size.0, size.1, expected.0, expected.1);
        let Units { pixels, depth_scale, too_far } = depths.in_units(self.config.depth_scale);
        // A driver without a clock leaves the stamp at zero.
        let stamp_ns = if stamped.stamp_ns > 0 { stamped.stamp_ns } else { message.log_time };
        let noise = self.config.noise.unwrap_or_default().into();
        let source = Text::new(&message.channel.topic);
        let mut header = Header { camera, depth_scale, noise, stamp_ns, source, flags: RECORDED, ..Header::default() };
        header.sequence = self.round.sent;
        self.place(&mut header, &Stamped { stamp_ns, ..stamped });
        let items = bytemuck::cast_slice(&pixels).to_vec();
        self.item.check(&header, &items)?;
        self.count_too_far(&message.channel.topic, &pixels, too_far);
        Ok(Replayed { header, written_ns: message.log_time, items })
    }

    /// Sets the camera's pose, if `world` is configured and the pose is known.
    fn place(&mut self, header: &mut Header, stamped: &Stamped<'_>) {
        let (Some(transforms), Some(world)) = (&self.transforms, &self.config.world) else { return };
        match transforms.pose(world, stamped.frame_id, stamped.stamp_ns) {
            Some(pose) => header.set_pose(pose),
            None => *self.counts.entry(WITHOUT_POSE).or_default() += 1,
        }
    }

    /// Counts the pixels that are too far for the units; warns where an image is empty.
    fn count_too_far(&mut self, topic: &str, pixels: &[u16], too_far: u64) {
        if too_far > 0 {
            *self.counts.entry(TOO_FAR).or_default() += too_far;
        }
        self.empty.look(topic, pixels, too_far);
    }

    /// Logs once the resolution and depths of the images, so that a wrong scale is seen.
    fn report_first_image(&mut self, replayed: &Replayed) {
        let Header { camera, depth_scale, .. } = &replayed.header;
        let pixels = || replayed.items_as::<u16>();
        let report = || report_frame("frames", self.chosen.topics()[0], camera, *depth_scale, &pixels());
        self.is_reported = self.is_reported || report();
    }
}

impl Chosen {
    /// The topics that are read.
    fn topics(&self) -> Vec<&str> {
        match self {
            Self::Items { topic } => vec![topic],
            Self::OwnImages { topic, headers } => vec![topic, headers],
            Self::Images { topic, info, .. } => std::iter::once(topic).chain(info).map(String::as_str).collect(),
        }
    }

    /// The topic of `CameraInfo` for images of another program.
    fn info(&self) -> Option<&String> {
        if let Self::Images { info, .. } = self { info.as_ref() } else { None }
    }
}

/// Returns the pixels that `mcap_sink` has recorded, as bytes, exactly as it received them.
fn own_pixels(depths: &Depths, depth_scale: f64) -> Vec<u8> {
    let unit = |z: &f32| match *z {
        z if z.is_nan() => INVALID_NEAR,
        z if z.is_infinite() => INVALID_FAR,
        // Single precision distinguishes 65,535 steps, so that rounding gives the exact unit.
        z => (f64::from(z) / depth_scale).round() as u16,
    };
    match depths {
        Depths::Units(pixels) => bytemuck::cast_slice(pixels).to_vec(),
        Depths::Metres(depths) => bytemuck::cast_slice(&depths.iter().map(unit).collect::<Vec<_>>()).to_vec(),
    }
}
