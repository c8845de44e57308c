//! `cargo +nightly fuzz run list`; the corpus is replayed by an ordinary test, `hostile_files`.

#![no_main]

#[path = "../readers.rs"]
#[allow(dead_code)] // each target calls one of them
mod readers;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    readers::list(bytes);
});
