//! Chooses the channels of a recording to play back: depth images with their camera's information, or a list that conicflow
//! recorded.

use super::config::Config;
use crate::recording::files::{Files, SurveyedChannel};
use crate::recording::own;
use crate::sources::WrittenIn;
use anyhow::{Context as _, Result, bail, ensure};
use conicflow_dataflow::ItemType;
use conicflow_messages::{Camera, Hinted};
use conicflow_ros::{
    CAMERA_INFO, COMPRESSED_IMAGE, CameraInfo, CompressedImage, Encoding, IMAGE, Image, camera_info_topics,
    is_rectified,
};

/// The message encoding of ROS 2.
const CDR: &str = "cdr";
/// The message encoding of ROS 1.
const ROS1: &str = "ros1";
/// Number of messages of a topic that are searched for a readable one: those of the seconds in which a driver starts.
const MOST_LOOKED_AT: usize = 300; // [algorithmic]
/// Returns the hint for recordings without the camera's intrinsics.
fn write_intrinsics(written_in: WrittenIn) -> String {
    format!("write `{}` with the numbers of your camera", written_in.intrinsics([".."; 4]))
}

/// The channels that are played back.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Chosen {
    /// A list, or other items, as conicflow recorded them.
    Items { topic: String },
    /// Images whose headers conicflow recorded beside them.
    OwnImages { topic: String, headers: String },
    /// Images of another program, with the first camera, and the topic of `CameraInfo`, where a changed one comes.
    Images { topic: String, is_compressed: bool, camera: Camera, info: Option<String> },
}

impl Chosen {
    /// Chooses among the channels of these files by `item` and the parameters.
    ///
    /// # Errors
    /// No channel fits, several do, or the camera is not known.
    pub(super) fn of(files: &Files, channels: &[SurveyedChannel], config: &Config, item: &ItemType) -> Result<Self> {
        let own = |channel: &&SurveyedChannel| is_own(channel, item);
        if !item.is_image() {
            let fitting: Vec<_> = channels.iter().filter(own).collect();
            let chosen = choose(channels, &fitting, config, item.name())?;
            own::check_schema(own_schema(chosen), item)
                .with_context(|| format!("the messages of `{}`", chosen.channel.topic))?;
            return Ok(Self::Items { topic: chosen.channel.topic.clone() });
        }
        let channels = &channels.iter().map(|channel| with_readable_image(files, channel)).collect::<Vec<_>>()[..];
        let fitting: Vec<_> = channels.iter().filter(|channel| is_depth(channel, config.topic.as_deref())).collect();
        let is_named = fitting.iter().any(|channel| Some(&channel.channel.topic) == config.topic.as_ref());
        let fitting = if is_named { fitting } else { without_doubles(&fitting) };
        let chosen = choose(channels, &fitting, config, "depth images")?;
        let topic = chosen.channel.topic.clone();
        let headers = own::header_channel(&topic);
        let headers = channels.iter().filter(own).find(|channel| Some(&channel.channel.topic) == headers.as_ref());
        if let Some(headers) = headers {
            own::check_schema(own_schema(headers), item).with_context(|| format!("the headers of `{topic}`"))?;
            return Ok(Self::OwnImages { topic, headers: headers.channel.topic.clone() });
        }
        let (camera, info) = camera(files, channels, chosen, config)?;
        Ok(Self::Images { topic, is_compressed: is(chosen, COMPRESSED_IMAGE.name), camera, info })
    }
}

/// Returns the result of `read` for the first message of a channel that it can read, or else its error for the very first
/// message.
fn first_readable<T>(files: &Files, channel: &SurveyedChannel, read: impl Fn(&[u8]) -> Result<T>) -> Result<T> {
    read(&channel.first).or_else(|error| {
        let messages = files.messages_again(&[&channel.channel.topic]).map_while(Result::ok);
        messages.take(MOST_LOOKED_AT).find_map(|message| read(&message.data).ok()).ok_or(error)
    })
}

/// Returns the channel with its first readable image in place of its very first.
fn with_readable_image(files: &Files, channel: &SurveyedChannel) -> SurveyedChannel {
    let read = |message: &[u8]| {
        if is(channel, COMPRESSED_IMAGE.name) {
            CompressedImage::read(message)?;
        } else if is(channel, IMAGE.name) {
            Image::encoding_of(message)?;
        }
        Ok(message.to_vec())
    };
    let first = first_readable(files, channel, read);
    SurveyedChannel { first: first.unwrap_or_else(|_| channel.first.clone()), ..channel.clone() }
}

/// Whether conicflow has recorded such items, in any version.
pub fn has_own(channels: &[SurveyedChannel], item: &ItemType) -> bool {
    channels.iter().any(|channel| is_own(channel, item))
}

/// Whether conicflow has recorded items of another type.
pub(super) fn has_other_own(channels: &[SurveyedChannel], item: &ItemType) -> bool {
    let is_other =
        |channel: &&SurveyedChannel| channel.channel.message_encoding == own::ENCODING && !is_own(channel, item);
    channels.iter().any(|channel| is_other(&channel))
}

/// Whether a channel carries messages of conicflow with such items, in any version.
fn is_own(channel: &SurveyedChannel, item: &ItemType) -> bool {
    let schema = serde_json::from_str::<own::Schema>(own_schema(channel));
    channel.channel.message_encoding == own::ENCODING && schema.is_ok_and(|schema| schema.kind == item.name())
}

/// Returns the schema in a channel's metadata, as conicflow writes it.
fn own_schema(channel: &SurveyedChannel) -> &str {
    channel.channel.metadata.get(own::SCHEMA).map_or("", String::as_str)
}

fn is(channel: &SurveyedChannel, schema: &str) -> bool {
    channel.channel.message_encoding == CDR && channel.schema() == schema
}

/// Whether the encoding of a channel is one of depth images; for 16-bit grey images the topic has to say so.
fn is_depth(channel: &SurveyedChannel, wanted: Option<&str>) -> bool {
    let topic = &channel.channel.topic;
    if is(channel, COMPRESSED_IMAGE.name) {
        return CompressedImage::read(&channel.first).is_ok_and(|image| image.is_depth());
    }
    let encoding = if is(channel, IMAGE.name) { Image::encoding_of(&channel.first).ok() } else { None };
    match encoding.and_then(Encoding::of) {
        Some(Encoding::Mono) => topic.to_lowercase().contains("depth") || wanted == Some(topic),
        Some(Encoding::Units | Encoding::Metres) => true,
        None => false,
    }
}

/// Leaves out the channels that carry the images of another channel compressed.
fn without_doubles<'a>(channels: &[&'a SurveyedChannel]) -> Vec<&'a SurveyedChannel> {
    let is_double = |channel: &SurveyedChannel| {
        let raw = channel.channel.topic.strip_suffix("/compressedDepth");
        raw.is_some_and(|raw| channels.iter().any(|other| other.channel.topic == raw))
    };
    channels.iter().filter(|channel| !is_double(channel)).copied().collect()
}

/// Returns the channel that `topic` names, in full or without its last part, or else the only one.
fn choose<'a>(
    all: &'a [SurveyedChannel],
    fitting: &[&'a SurveyedChannel],
    config: &Config,
    what: &str,
) -> Result<&'a SurveyedChannel> {
    let names = |channels: &[&SurveyedChannel]| {
        let named = channels.iter().map(|channel| format!("`{}`", channel.channel.topic));
        named.collect::<Vec<_>>().join(", ")
    };
    let Some(wanted) = config.topic.as_deref() else {
        return match fitting {
            [] => Err(nothing_fits(all, what).into()),
            [only] => Ok(only),
            several => {
                let rectified = several.iter().find(|channel| is_rectified(&channel.channel.topic));
                let example = config.written_in.topic(&rectified.unwrap_or(&several[0]).channel.topic);
                bail!(Hinted::new(
                    format!("several topics carry {what}: {}", names(several)),
                    format!("say which, such as `{example}`")
                ))
            }
        };
    };
    let is_wanted = |channel: &&SurveyedChannel| {
        let rest = channel.channel.topic.strip_prefix(wanted.trim_end_matches('/'));
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/') && !rest[1..].contains('/'))
    };
    // Prefers the raw image to the compressed one of the same topic.
    let found = all.iter().find(|channel| channel.channel.topic == wanted);
    let found = found.filter(|found| fitting.iter().any(|channel| channel.channel.topic == found.channel.topic));
    let found = found.or_else(|| fitting.iter().copied().find(is_wanted));
    found.ok_or_else(|| {
        let exists = all.iter().find(|channel| channel.channel.topic == wanted);
        let is = exists.map_or_else(
            || "is not in the recording, or has no messages".to_owned(),
            |channel| {
                let encoding = &channel.channel.message_encoding;
                format!("carries `{}` in `{encoding}`{}", channel.schema(), kind_of_image(channel))
            },
        );
        let there = if fitting.is_empty() { "there are none".to_owned() } else { names(fitting) };
        let what = format!("the topic `{wanted}` {is}; expected {what}");
        Hinted::new(what, format!("topics with such: {there}")).into()
    })
}

fn nothing_fits(all: &[SurveyedChannel], what: &str) -> Hinted {
    if all.iter().any(|channel| channel.channel.message_encoding == ROS1) {
        let hint = "play them into ROS 2 and record them there, or convert the .bag by `rosbags-convert` of rosbags";
        return Hinted::new("the recording has messages of ROS 1, expected those of ROS 2", hint);
    }
    let topics: Vec<_> = all
        .iter()
        .map(|channel| {
            format!(
                "\n    `{}` with `{}` in {}{}",
                channel.channel.topic,
                channel.schema(),
                channel.channel.message_encoding,
                kind_of_image(channel)
            )
        })
        .collect();
    let there = if topics.is_empty() { " no messages at all".to_owned() } else { topics.concat() };
    Hinted::new(format!("the recording has no {what}; it has{there}"), "was the right topic recorded?")
}

/// Returns the encoding of a channel's images for an error, or the reason why even the first image cannot be read.
fn kind_of_image(channel: &SurveyedChannel) -> String {
    if !is(channel, IMAGE.name) {
        return String::new();
    }
    match Image::encoding_of(&channel.first) {
        Ok(encoding) => format!(", whose pixels are `{encoding}`"),
        Err(fault) => format!(", of which the first one makes no sense: {fault}"),
    }
}

/// Returns the camera of the images, from the parameters, or from the `CameraInfo` beside them together with its topic.
fn camera(
    files: &Files,
    channels: &[SurveyedChannel],
    images: &SurveyedChannel,
    config: &Config,
) -> Result<(Camera, Option<String>)> {
    let topic = &images.channel.topic;
    let size = first_readable(files, images, |message| size_of(images, message));
    let size = size.with_context(|| format!("the first image of `{topic}`"))?;
    if let Some(intrinsics) = config.intrinsics {
        return Ok((intrinsics.camera(size), None));
    }
    let infos: Vec<_> = channels.iter().filter(|channel| is(channel, CAMERA_INFO.name)).collect();
    let beside = camera_info_topics(topic);
    let info = beside.iter().find_map(|name| infos.iter().find(|info| info.channel.topic == *name));
    let info = match (info, &infos[..]) {
        (Some(info), _) => info,
        (None, [only]) => only,
        (None, others) => {
            let there: Vec<_> = others.iter().map(|info| format!("`{}`", info.channel.topic)).collect();
            let there = if there.is_empty() { "there is none in the recording".to_owned() } else { there.join(", ") };
            bail!(Hinted::new(
                format!("no CameraInfo beside `{topic}`, expected at `{}`; {there}", beside[0]),
                write_intrinsics(config.written_in)
            ));
        }
    };
    let name = &info.channel.topic;
    let read = first_readable(files, info, |message| read_info(name, message, config.written_in))?;
    let mut rectified =
        channels.iter().filter(|channel| is_depth(channel, None) && is_rectified(&channel.channel.topic));
    let rectified = rectified.next().map(|channel| channel.channel.topic.as_str());
    Ok((camera_by((name, &read), topic, size, rectified, config.written_in)?, Some(name.clone())))
}

/// Reads a `CameraInfo` of the topic `name`.
pub(super) fn read_info(name: &str, message: &[u8], written_in: WrittenIn) -> Result<CameraInfo> {
    let info = CameraInfo::read(message).with_context(|| format!("a message of `{name}`"))?;
    ensure!(info.is_calibrated(), uncalibrated(name, written_in));
    Ok(info)
}

/// Returns the camera of images of a topic and this size from the `CameraInfo` of the topic `name`; `rectified` is another image
/// topic, for a hint.
pub(super) fn camera_by(
    (name, info): (&str, &CameraInfo),
    topic: &str,
    size: (u32, u32),
    rectified: Option<&str>,
    written_in: WrittenIn,
) -> Result<Camera> {
    if let Err((width, height)) = info.fits(size) {
        bail!(Hinted::new(
            format!("`{name}` is for images of {width}x{height}, those of `{topic}` have {}x{}", size.0, size.1),
            format!("intrinsics scale with the image; {} of these", write_intrinsics(written_in))
        ));
    }
    let camera = info.camera(size, is_rectified(topic)).map_err(|unrectified| {
        let hint = rectified.map_or_else(
            || "rectify them by image_proc of ROS, and record that topic".to_owned(),
            |rectified| format!("`{}` is rectified", written_in.topic(rectified)),
        );
        let distortion = unrectified.distortion;
        let what = format!(
            "the images of `{topic}` are distorted (`{name}`: {distortion:?}), expected those of a pinhole camera"
        );
        Hinted::new(what, hint)
    })?;
    ensure!(camera.has_intrinsics(), uncalibrated(name, written_in));
    Ok(camera)
}

fn uncalibrated(name: &str, written_in: WrittenIn) -> Hinted {
    Hinted::new(format!("`{name}` has no intrinsics: the camera was not calibrated"), write_intrinsics(written_in))
}

/// Returns width and height of an image of a channel.
fn size_of(images: &SurveyedChannel, message: &[u8]) -> Result<(u32, u32)> {
    if is(images, COMPRESSED_IMAGE.name) {
        return Ok(CompressedImage::read(message)?.depths()?.0);
    }
    let image = Image::read(message)?;
    Ok((image.width, image.height))
}
