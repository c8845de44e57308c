//! Messages of conicflow in a recording: the header and the items as they lie in memory, in channels of their own. For a depth
//! image there is only the header, beside a `sensor_msgs/Image` with its pixels.

use anyhow::{Context as _, Result, ensure};
use conicflow_dataflow::ItemType;
use conicflow_messages::{HEADER_TYPE_NAME, Header, Hinted};
use serde::{Deserialize, Serialize};

/// Name of the encoding of conicflow's own messages.
pub const ENCODING: &str = "conicflow";
/// Key of the metadata that holds the schema of a channel of own messages. A schema of MCAP would disturb readers that know only
/// those of ROS 2, such as `rosbags`.
pub const SCHEMA: &str = "conicflow";
/// Last part of the topic of a channel of own messages.
pub const MESSAGE: &str = "message";
/// Last part of the topic with the pixels of depth images.
pub const IMAGE: &str = "image_rect_raw";

/// The schema of a channel of own messages: the types and sizes of its bytes.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Schema {
    header: String,
    header_bytes: usize,
    /// [`ItemType::name`].
    pub kind: String,
    /// [`ItemType::type_name`].
    item: String,
    item_bytes: usize,
    /// [`ItemType::layout`].
    layout: String,
    is_big_endian: bool,
}

impl Schema {
    /// Returns the schema of messages with such items, as this program writes them.
    pub fn of(item: &ItemType) -> Self {
        Self {
            header: HEADER_TYPE_NAME.to_owned(),
            header_bytes: size_of::<Header>(),
            kind: item.name().to_owned(),
            item: item.type_name().to_owned(),
            item_bytes: item.size(),
            layout: item.layout(),
            is_big_endian: cfg!(target_endian = "big"),
        }
    }
}

/// Encodes a message: the header, and the items if there are any. Uses `memory` as buffer.
pub fn write(header: &Header, items: &[u8], mut memory: Vec<u8>) -> Vec<u8> {
    memory.clear();
    memory.extend(bytemuck::bytes_of(header));
    memory.extend(items);
    memory
}

/// Splits a message into header and items; neither is checked.
///
/// # Errors
/// The message is shorter than a header.
pub fn read(message: &[u8]) -> Result<(Header, &[u8])> {
    let whole = message.len() >= size_of::<Header>();
    ensure!(whole, "{} bytes, a header has {}", message.len(), size_of::<Header>());
    let (header, items) = message.split_at(size_of::<Header>());
    Ok((bytemuck::pod_read_unaligned(header), items))
}

/// Checks that this program can read the messages of a channel with this schema as those of `item`.
///
/// # Errors
/// Another version wrote the messages, or they are of another type.
pub fn check_schema(schema: &str, item: &ItemType) -> Result<()> {
    let recorded: Schema = serde_json::from_str(schema).context("the schema of our own messages is damaged")?;
    let expected = Schema::of(item);
    ensure!(
        recorded == expected,
        Hinted::new(
            format!(
                "they are `{}` of {} bytes with `{}`, expected `{}` of {} bytes with `{}`",
                recorded.layout,
                recorded.item_bytes,
                recorded.header,
                expected.layout,
                expected.item_bytes,
                expected.header
            ),
            "replay them with the version of conicflow that recorded them, or replay what they were made of"
        )
    );
    Ok(())
}

/// Returns the name of a channel for the messages of `topic` about frames of the source stage `origin`.
pub fn channel(origin: &str, topic: &str, part: &str) -> String {
    format!("/{origin}/{topic}/{part}")
}

/// Returns the channel with the headers for the images of this topic.
pub fn header_channel(image_topic: &str) -> Option<String> {
    Some(format!("{}{MESSAGE}", image_topic.strip_suffix(IMAGE)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::BUILT_IN;

    #[test]
    fn messages_are_read_as_they_were_written() {
        let header = Header { sequence: 7, depth_scale: 0.25, ..Header::default() };
        let written = write(&header, &[1, 2, 3], vec![9; 5]);
        assert_eq!(read(&written).unwrap(), (header, &[1, 2, 3][..]));
        assert!(read(&written[..800]).is_err());
    }

    #[test]
    fn other_layouts_are_refused() {
        let schema = serde_json::to_string(&Schema::of(&BUILT_IN[1])).unwrap();
        assert!(check_schema(&schema, &BUILT_IN[1]).is_ok());
        let error = check_schema(&schema, &BUILT_IN[2]).unwrap_err().to_string();
        assert!(error.starts_with("they are `conicflow.Ellipse.v8` of") && error.contains("\n  hint: "), "{error}");
        assert!(check_schema(&schema[1..], &BUILT_IN[1]).is_err());
    }

    #[test]
    fn images_and_their_headers_lie_side_by_side() {
        let image = channel("camera", "depth", IMAGE);
        assert_eq!(image, "/camera/depth/image_rect_raw");
        assert_eq!(header_channel(&image), Some(channel("camera", "depth", MESSAGE)));
        assert_eq!(header_channel("/camera/depth/image"), None);
    }
}
