//! Decompresses zstd chunks without the C library, which would take as long to build as all of `mcap`.

use mcap::sans_io::decompressor::{DecompressResult, Decompressor};
use mcap::{McapError, McapResult};
use ruzstd::decoding::FrameDecoder;

/// Number of bytes with which the decoder always makes progress: the largest block, its header and that of a frame.
const BLOCK_BYTES: usize = 128 * 1024 + 3 + 18;

/// Decodes the chunks of a file, one after the other.
#[derive(Default)]
pub(super) struct Zstd(FrameDecoder);

impl Decompressor for Zstd {
    fn next_read_size(&self) -> usize {
        BLOCK_BYTES
    }

    fn decompress(&mut self, source: &[u8], target: &mut [u8]) -> McapResult<DecompressResult> {
        if self.0.blocks_decoded() > 0 && self.0.is_finished() && self.0.can_collect() == 0 {
            // Another frame follows in the same chunk.
            self.0 = FrameDecoder::new();
        }
        let decoded = self.0.decode_from_to(source, target);
        let (consumed, wrote) = decoded.map_err(|error| McapError::DecompressionError(error.to_string()))?;
        Ok(DecompressResult { consumed: consumed.min(source.len()), wrote })
    }

    fn reset(&mut self) -> McapResult<()> {
        self.0 = FrameDecoder::new();
        Ok(())
    }

    fn name(&self) -> &'static str {
        "zstd"
    }
}
