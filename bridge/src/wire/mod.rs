//! The bytes of a message between machines, and the border where bytes from another machine become a message.
//!
//! `CFLO`, the wire's version as a little-endian `u16`, the session as a little-endian `u64` (one number per start of the
//! sending bridge), 32 bytes of a code ([`seal`]; zeros where there is no key), the position in the link's stream as three
//! little-endian `u64`, then in bincode 2 (`config::standard()`): the names of the memory layouts, the header, and the body
//! ([`codec`]): of objects and tracks a count and the items; of images and ellipses a byte for the compression (0 none, 1 LZ4,
//! 2 Zstandard), and what it has made, without compression the pixels as little-endian `u16`, and a count and the items; of all
//! others a byte for the compression, a count and the items as they lie in memory. Who only reads may pass over the code.
//! Nothing is believed: version, layouts, sizes, lengths, ranges and numbers are checked before a message is handed on.

pub(crate) mod codec;
mod compression;
mod depth_codec;
mod ellipse_codec;
mod encoding;
pub(crate) mod seal;
#[cfg(test)]
mod tests;

pub use encoding::{MAX_MESSAGE, WireError};

use codec::codec_of;
use conicflow_dataflow::pipeline::Compression;
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_messages::{HEADER_TYPE_NAME, Header};
use encoding::{decode_start, decode_whole, encode, trailing};
use seal::SEAL;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Version of the bytes between machines; machines of different versions refuse each other.
pub const WIRE_VERSION: u16 = 5;
const MAGIC: [u8; 4] = *b"CFLO";
const PREFIX: usize = MAGIC.len() + size_of::<u16>();

/// Where a message stands in the stream of its link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamPosition {
    /// One number per start of the sending bridge.
    pub stream: u64,
    /// Number of the message in that stream, from 0.
    pub number: u64,
    /// Number of the oldest message that the sender still keeps: what is older will not come again.
    pub oldest: u64,
}

/// What stands before the body.
#[derive(Serialize, Deserialize)]
struct Opening<'a> {
    layout: &'a str,
    header: Header,
}

/// The bytes of a message whose items of this type lie in memory as `items`.
///
/// # Errors
/// It is longer than [`MAX_MESSAGE`], or holds text that is none.
pub fn encode_message(
    position: StreamPosition,
    item: &ItemType,
    header: &Header,
    items: &[u8],
    how: Compression,
) -> Result<Vec<u8>, WireError> {
    message_bytes(position, &item.layout(), header, |bytes| codec_of(item).encode(header, items, how, bytes))
}

/// The bytes of a message, of which `body` appends those behind the header; of the end of a stream there are none.
pub(crate) fn message_bytes(
    position: StreamPosition,
    items_layout: &str,
    header: &Header,
    body: impl FnOnce(&mut Vec<u8>) -> Result<(), WireError>,
) -> Result<Vec<u8>, WireError> {
    let mut bytes = opening_bytes();
    bytes.extend([position.stream, position.number, position.oldest].iter().flat_map(|number| number.to_le_bytes()));
    encode(&Opening { layout: &layout(items_layout), header: *header }, &mut bytes)?;
    if !header.ends_stream() {
        body(&mut bytes)?;
    }
    if bytes.len() > MAX_MESSAGE { Err(WireError::TooLong { bytes: bytes.len() }) } else { Ok(bytes) }
}

/// Reads a message of items of this type; they come as they lie in memory. The message of an ended stream has none.
///
/// # Errors
/// What is wrong with the bytes.
pub fn decode_message(bytes: &[u8], item: &ItemType) -> Result<(StreamPosition, Header, Vec<u8>), WireError> {
    let (position, header, body) = open_message(bytes, &item.layout(), item.name())?;
    let mut codec = codec_of(item);
    body.map_or(Ok(()), |body| codec.decode(&header, body))?;
    Ok((position, header, codec.items().to_vec()))
}

/// The position and the header of a message, checked, and the bytes behind them; the end of a stream has none.
pub(crate) fn open_message<'a>(
    bytes: &'a [u8],
    items_layout: &str,
    kind: &str,
) -> Result<(StreamPosition, Header, Option<&'a [u8]>), WireError> {
    let (position, content) = split_position(content(bytes)?)?;
    let (opening, length) = decode_start::<Opening<'_>>(content)?;
    let ours = layout(items_layout);
    if opening.layout != ours {
        return Err(WireError::Layout { ours, theirs: opening.layout.to_owned() });
    }
    let (header, body) = (opening.header, &content[length..]);
    header.check(kind)?;
    if !header.ends_stream() {
        return Ok((position, header, Some(body)));
    }
    if body.is_empty() { Ok((position, header, None)) } else { Err(trailing()) }
}

/// The bytes of something small, with the same prefix as a message.
pub(crate) fn encode_note<N: Serialize>(note: &N) -> Result<Vec<u8>, WireError> {
    let mut bytes = opening_bytes();
    encode(note, &mut bytes)?;
    Ok(bytes)
}

/// Reads something small.
pub(crate) fn decode_note<N: DeserializeOwned>(bytes: &[u8]) -> Result<N, WireError> {
    decode_whole(content(bytes)?)
}

/// Tells anew, in the bytes of a message that is sent again, which is the oldest that is still kept.
pub(crate) fn set_oldest(bytes: &mut [u8], oldest: u64) {
    if let Some(slot) = bytes.get_mut(PREFIX + SEAL + 16..PREFIX + SEAL + 24) {
        slot.copy_from_slice(&oldest.to_le_bytes());
    }
}

/// Where a message stands in its stream.
pub(crate) fn position_of(bytes: &[u8]) -> Result<StreamPosition, WireError> {
    split_position(content(bytes)?).map(|(position, _)| position)
}

fn split_position(bytes: &[u8]) -> Result<(StreamPosition, &[u8]), WireError> {
    let (numbers, rest) = bytes.split_at_checked(24).ok_or_else(|| WireError::Broken("no position".to_owned()))?;
    let number = |at: usize| numbers[at..at + 8].iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte));
    Ok((StreamPosition { stream: number(0), number: number(8), oldest: number(16) }, rest))
}

/// The layouts of what every program knows.
pub(crate) fn layouts() -> String {
    let names: Vec<_> = BUILT_IN.iter().map(ItemType::type_name).collect();
    layout(&names.join(" "))
}

fn layout(items: &str) -> String {
    format!("{HEADER_TYPE_NAME} {items}")
}

fn opening_bytes() -> Vec<u8> {
    [MAGIC.as_slice(), &WIRE_VERSION.to_le_bytes(), &[0; SEAL]].concat()
}

/// What follows the prefix and the seal of bytes that are ours.
fn content(bytes: &[u8]) -> Result<&[u8], WireError> {
    if bytes.len() > MAX_MESSAGE {
        return Err(WireError::TooLong { bytes: bytes.len() });
    }
    let rest = bytes.strip_prefix(&MAGIC).filter(|_| bytes.len() >= PREFIX).ok_or(WireError::Foreign)?;
    let theirs = u16::from_le_bytes([rest[0], rest[1]]);
    if theirs != WIRE_VERSION {
        return Err(WireError::Version { ours: WIRE_VERSION, theirs });
    }
    bytes.get(PREFIX + SEAL..).ok_or_else(|| WireError::Broken("no room for a code".to_owned()))
}
