//! The compression methods of edges between machines, and their numbers on the wire.

use conicflow_dataflow::pipeline::Compression;
use std::borrow::Cow;
use std::cell::RefCell;
use std::io;
use zstd::bulk::{Compressor, Decompressor};

const ZSTD_LEVEL: i32 = 1;

// Each thread keeps its contexts: creating one takes longer than compressing a short list.
thread_local! {
    static COMPRESSOR: RefCell<io::Result<Compressor<'static>>> = RefCell::new(Compressor::new(ZSTD_LEVEL));
    static DECOMPRESSOR: RefCell<io::Result<Decompressor<'static>>> = RefCell::new(Decompressor::new());
}

/// The number of a method.
pub(super) fn tag_of(how: Compression) -> u8 {
    match how {
        Compression::None => 0,
        Compression::Lz4 => 1,
        Compression::Zstd => 2,
    }
}

/// The method of a number.
pub(super) fn of_tag(tag: u8) -> Result<Compression, String> {
    match tag {
        0 => Ok(Compression::None),
        1 => Ok(Compression::Lz4),
        2 => Ok(Compression::Zstd),
        _ => Err(format!("compression number {tag}, known are 0 to 2")),
    }
}

/// Compresses bytes.
pub(super) fn pack(how: Compression, bytes: &[u8]) -> Result<Cow<'_, [u8]>, String> {
    match how {
        Compression::None => Ok(Cow::Borrowed(bytes)),
        Compression::Lz4 => Ok(Cow::Owned(lz4_flex::block::compress(bytes))),
        Compression::Zstd => COMPRESSOR.with_borrow_mut(|compressor| {
            let packed = compressor.as_mut().map(|compressor| compressor.compress(bytes));
            packed.map_err(|error| error.to_string())?.map(Cow::Owned).map_err(|error| error.to_string())
        }),
    }
}

/// Decompresses bytes and checks that there are `length` of them.
pub(super) fn unpack(how: Compression, packed: &[u8], length: usize) -> Result<Cow<'_, [u8]>, String> {
    let unpacked = match how {
        Compression::None => Cow::Borrowed(packed),
        Compression::Lz4 => Cow::Owned(lz4_flex::block::decompress(packed, length).map_err(|error| error.to_string())?),
        Compression::Zstd => DECOMPRESSOR.with_borrow_mut(|decompressor| {
            let unpacked = decompressor.as_mut().map(|decompressor| decompressor.decompress(packed, length));
            unpacked.map_err(|error| error.to_string())?.map(Cow::Owned).map_err(|error| error.to_string())
        })?,
    };
    let unpacked_length = unpacked.len();
    if unpacked_length == length {
        Ok(unpacked)
    } else {
        Err(format!("{unpacked_length} bytes unpacked, expected {length}"))
    }
}
