//! `cargo +nightly fuzz run poses` runs this target. The ordinary test `hostile_files` replays its corpus.

#![no_main]

#[path = "../readers.rs"]
#[allow(dead_code)] // each target calls one of the readers
mod readers;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    readers::poses(bytes);
});
