//! Encoding and decoding of values with bincode 2 within a size limit, and the errors of that.

use bincode::config::{Configuration, Limit, standard};
use bincode::serde::{borrow_decode_from_slice, encode_into_std_write};
use conicflow_messages::Malformed;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Maximum size of a message, in bytes.
pub const MAX_MESSAGE: usize = 8 << 20;

/// Why bytes from another machine are refused.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// The bytes do not come from conicflow.
    #[error("bytes that do not come from conicflow\n  hint: who else publishes under this key?")]
    Foreign,
    /// The other side uses another version of the wire.
    #[error(
        "the other machine speaks version {theirs} of the wire, this one {ours}\n  \
         hint: install the same conicflow on both"
    )]
    Version {
        /// The version of this side.
        ours: u16,
        /// The version of the other side.
        theirs: u16,
    },
    /// The types of the other side have another layout.
    #[error(
        "the other machine sends messages laid out as `{theirs}`, this one reads `{ours}`\n  \
         hint: install the same conicflow on both"
    )]
    Layout {
        /// The layout of this side.
        ours: String,
        /// The layout of the other side.
        theirs: String,
    },
    /// The code is wrong: a third party made or changed the bytes, or they belong to another topic.
    #[error(
        "its code was not made with the key of this machine\n  hint: are the keys of all machines the same file? make one with \
         `conicflow key`, copy it, and name it in each machine's table as `key`. If they are, somebody else is on the link"
    )]
    WrongCode,
    /// This side has a key, but the bytes have no code.
    #[error(
        "it has no code, and this machine takes only what was made with its key\n  hint: give all machines the same `key`, \
         as `conicflow key` makes it, or all `insecure = true`. If they have it, somebody else is on the link"
    )]
    NoCode,
    /// The bytes have a code, but this side has no key.
    #[error(
        "it has a code, and this machine has no key\n  hint: give all machines the same `key`, as `conicflow key` makes it, \
         or all `insecure = true`"
    )]
    UnexpectedCode,
    /// The bytes claim something that the other machine cannot have sent.
    #[error(
        "it cannot have said that {0}\n  \
         hint: any machine that can connect can send; with the same `key` on all machines only these can"
    )]
    Impossible(&'static str),
    /// The message is too long.
    #[error("a message of {bytes} bytes, allowed are {MAX_MESSAGE}\n  hint: send smaller images, or lists")]
    TooLong {
        /// Number of bytes.
        bytes: usize,
    },
    /// The bytes cannot be decoded, or a value cannot be encoded.
    #[error("broken bytes: {0}")]
    Broken(String),
    /// The bytes can be decoded, but the message is malformed.
    #[error(transparent)]
    Malformed(#[from] Malformed),
}

type Bounded = Configuration<bincode::config::LittleEndian, bincode::config::Varint, Limit<MAX_MESSAGE>>;

fn bounded() -> Bounded {
    standard().with_limit::<MAX_MESSAGE>()
}

pub(super) fn encode<V: Serialize>(value: &V, bytes: &mut Vec<u8>) -> Result<(), WireError> {
    let written = encode_into_std_write(value, bytes, bounded());
    written.map(drop).map_err(|error| WireError::Broken(error.to_string()))
}

/// Decodes a value at the start of the bytes; returns it and its length in bytes.
pub(super) fn decode_start<'a, V: Deserialize<'a>>(bytes: &'a [u8]) -> Result<(V, usize), WireError> {
    borrow_decode_from_slice(bytes, bounded()).map_err(|error| WireError::Broken(error.to_string()))
}

pub(super) fn decode_whole<V: DeserializeOwned>(bytes: &[u8]) -> Result<V, WireError> {
    let (value, length) = decode_start(bytes)?;
    if length == bytes.len() { Ok(value) } else { Err(trailing()) }
}

pub(super) fn trailing() -> WireError {
    WireError::Broken("more bytes than the message needs".to_owned())
}
