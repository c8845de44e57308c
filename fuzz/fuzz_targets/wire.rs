//! No bytes from another machine may do harm, and what is accepted has to survive being sent again.
//!
//! `cargo +nightly fuzz run wire`; the corpus is replayed by an ordinary test, beside the decoder.

#![no_main]

use conicflow_bridge::{Wire, decode_message, encode_message};
use conicflow_dataflow::pipeline::Compression;
use conicflow_messages::{Ellipse, Object, Track};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    again::<u16>(bytes);
    again::<Ellipse>(bytes);
    again::<Object>(bytes);
    again::<Track>(bytes);
});

fn again<T: Wire>(bytes: &[u8]) {
    let mut items = Vec::new();
    let Ok((place, header)) = decode_message::<T>(bytes, &mut items) else { return };
    let resent = encode_message(place, &header, &items, Compression::Lz4).expect("it was accepted");
    let mut back = Vec::new();
    let (same_place, same_header) = decode_message::<T>(&resent, &mut back).expect("it was accepted");
    assert_eq!((same_place, bytemuck::bytes_of(&same_header)), (place, bytemuck::bytes_of(&header)));
    assert_eq!(bytemuck::cast_slice::<_, u8>(&back), bytemuck::cast_slice::<_, u8>(&items));
}
