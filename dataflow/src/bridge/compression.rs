//! The compressors that an edge between machines may ask for.

use serde::{Deserialize, Serialize};

/// How the bytes of depth images and of lists of ellipses are compressed on their way to another machine, always without
/// loss; other lists are too short to gain by it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Not at all: a link that is faster than the processor.
    None,
    /// LZ4: a half to a quarter of an image's bytes at the least cost.
    Lz4,
    /// Zstandard, level 1: a third to a sixth of an image's bytes, half of a list's.
    #[default]
    Zstd,
}

const ZSTD_LEVEL: i32 = 1;

impl Compression {
    /// The method of a number on the wire.
    pub(super) fn of_tag(tag: u8) -> Result<Self, String> {
        let known = [Self::None, Self::Lz4, Self::Zstd];
        known.get(usize::from(tag)).copied().ok_or_else(|| format!("compression number {tag}, known are 0 to 2"))
    }

    /// The bytes, packed.
    pub(super) fn pack(self, bytes: &[u8]) -> Result<Vec<u8>, String> {
        match self {
            Self::None => Ok(bytes.to_vec()),
            Self::Lz4 => Ok(lz4_flex::block::compress(bytes)),
            Self::Zstd => zstd::bulk::compress(bytes, ZSTD_LEVEL).map_err(|error| error.to_string()),
        }
    }

    /// The `length` bytes that were packed.
    pub(super) fn unpack(self, packed: &[u8], length: usize) -> Result<Vec<u8>, String> {
        let unpacked = match self {
            Self::None => packed.to_vec(),
            Self::Lz4 => lz4_flex::block::decompress(packed, length).map_err(|error| error.to_string())?,
            Self::Zstd => zstd::bulk::decompress(packed, length).map_err(|error| error.to_string())?,
        };
        let came = unpacked.len();
        if came == length { Ok(unpacked) } else { Err(format!("{came} bytes unpacked, expected {length}")) }
    }
}
