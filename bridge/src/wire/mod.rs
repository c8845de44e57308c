//! The byte format of messages between machines, and the checks of bytes that come from another machine.
//!
//! A message consists of `CFLO`; the wire's version as a little-endian `u16`; the session as a little-endian `u64` (one number
//! per start of the sending bridge); 32 bytes of a code ([`seal`]; zeros without a key); the position in the link's stream as
//! three little-endian `u64`; then, in bincode 2 (`config::standard()`), the names of the memory layouts, the header, and the
//! body ([`codec`]). The body of objects and tracks is a count and the items. That of images and ellipses is a byte for the
//! compression (0 none, 1 LZ4, 2 Zstandard) and the compressed data; without compression the pixels as little-endian `u16`, or a
//! count and the ellipses. That of all other types is a byte for the compression, a count, and the items as in memory. A program
//! that only reads may ignore the code. Nothing is trusted: version, layouts, sizes, lengths, ranges and numbers are checked
//! before a message is passed on.

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
/// First bytes of each message between machines.
const MAGIC: [u8; 4] = *b"CFLO";
/// Length of [`MAGIC`] and the version in bytes.
const PREFIX: usize = MAGIC.len() + size_of::<u16>();

/// The position of a message in the stream of its link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamPosition {
    /// One number per start of the sending bridge.
    pub stream: u64,
    /// Number of the message in that stream, from 0.
    pub number: u64,
    /// Number of the oldest message that the sender still keeps; older ones will not come again.
    pub oldest: u64,
}

/// The part of a message before the body.
#[derive(Serialize, Deserialize)]
struct Opening<'a> {
    layout: &'a str,
    header: Header,
}

/// Encodes a message; `items` are its items of this type as in memory.
///
/// # Errors
/// The message is longer than [`MAX_MESSAGE`], or malformed.
pub fn encode_message(
    position: StreamPosition,
    item: &ItemType,
    header: &Header,
    items: &[u8],
    how: Compression,
) -> Result<Vec<u8>, WireError> {
    message_bytes(position, &item.layout(), header, |bytes| codec_of(item).encode(header, items, how, bytes))
}

/// Encodes a message; `body` appends its body, except for the end of a stream, which has none.
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

/// Decodes a message with items of this type; returns its position, its header and its items as in memory. The end of a stream
/// has none.
///
/// # Errors
/// The bytes are no valid message of this type.
pub fn decode_message(bytes: &[u8], item: &ItemType) -> Result<(StreamPosition, Header, Vec<u8>), WireError> {
    let (position, header, body) = open_message(bytes, &item.layout(), item.name())?;
    let mut codec = codec_of(item);
    body.map_or(Ok(()), |body| codec.decode(&header, body))?;
    Ok((position, header, codec.items().to_vec()))
}

/// Decodes and checks the position and the header of a message; returns them with the body, which the end of a stream lacks.
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

/// Encodes a small value with the same prefix as a message.
pub(crate) fn encode_note<N: Serialize>(note: &N) -> Result<Vec<u8>, WireError> {
    let mut bytes = opening_bytes();
    encode(note, &mut bytes)?;
    Ok(bytes)
}

/// Decodes a small value.
pub(crate) fn decode_note<N: DeserializeOwned>(bytes: &[u8]) -> Result<N, WireError> {
    decode_whole(content(bytes)?)
}

/// Updates the number of the oldest kept message in a message that is retransmitted.
pub(crate) fn set_oldest(bytes: &mut [u8], oldest: u64) {
    if let Some(slot) = bytes.get_mut(PREFIX + SEAL + 16..PREFIX + SEAL + 24) {
        slot.copy_from_slice(&oldest.to_le_bytes());
    }
}

/// Decodes the position of a message.
pub(crate) fn position_of(bytes: &[u8]) -> Result<StreamPosition, WireError> {
    split_position(content(bytes)?).map(|(position, _)| position)
}

fn split_position(bytes: &[u8]) -> Result<(StreamPosition, &[u8]), WireError> {
    let (numbers, rest) = bytes.split_at_checked(24).ok_or_else(|| WireError::Broken("no position".to_owned()))?;
    let number = |at: usize| numbers[at..at + 8].iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte));
    Ok((StreamPosition { stream: number(0), number: number(8), oldest: number(16) }, rest))
}

/// The layouts of all built-in types.
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

/// Checks the prefix of a message; returns the bytes after its prefix and seal.
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
