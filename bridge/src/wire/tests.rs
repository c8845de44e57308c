//! Tests of the wire format: each message comes back bit for bit, and no bytes do harm.

use super::codec::codec_of;
use super::{
    MAX_MESSAGE, StreamPosition, WIRE_VERSION, WireError, decode_message, encode_message, layouts, message_bytes,
    position_of, set_oldest,
};
use bytemuck::cast_slice;
use conicflow_dataflow::pipeline::Compression;
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_messages::{Camera, END_OF_STREAM, Ellipse, HEADER_TYPE_NAME, Header, Hop, Item, Object, Text, Track};
use proptest::prelude::*;

const HOW: [Compression; 3] = [Compression::None, Compression::Lz4, Compression::Zstd];

fn header(width: u32, height: u32) -> Header {
    let camera = Camera { width, height, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
    let source = Text::new("frame-000012.depth.png");
    let mut header = Header { epoch: u64::MAX, sequence: 12, camera, depth_scale: 0.001, source, ..Header::default() };
    header.add_hop(Hop { stage: Text::new("source"), received_ns: 1, sent_ns: u64::MAX });
    header
}

fn ellipse() -> Ellipse {
    let mut ellipse =
        Ellipse { line: 3, first: 1, last: 4, rms: 1e-300, center: [-0.0, 0.1, 2.0], ..Ellipse::default() };
    ellipse.moments[0] = 4.0;
    ellipse
}

fn position() -> StreamPosition {
    StreamPosition { stream: 7, number: 300, oldest: 299 }
}

fn encoded<T: Item>(header: &Header, items: &[T], how: Compression) -> Result<Vec<u8>, WireError> {
    encode_message(position(), &ItemType::of::<T>(), header, cast_slice(items), how)
}

fn bytes_of<T: Item>(header: &Header, items: &[T], how: Compression) -> Vec<u8> {
    encoded(header, items, how).unwrap()
}

fn decoded<T: Item>(bytes: &[u8]) -> Result<(StreamPosition, Header, Vec<u8>), WireError> {
    decode_message(bytes, &ItemType::of::<T>())
}

/// Checks that an accepted message is accepted again after encoding.
fn decode_as_all(bytes: &[u8]) {
    for item in &BUILT_IN {
        let Ok((position, header, items)) = decode_message(bytes, item) else { continue };
        let again = encode_message(position, item, &header, &items, Compression::Lz4).unwrap();
        assert_eq!(decode_message(&again, item), Ok((position, header, items)));
    }
}

#[test]
fn lists_are_decoded_bit_for_bit() {
    let header = header(64, 48);
    for (how, length) in HOW.into_iter().flat_map(|how| [(how, 0), (how, 1), (how, 500)]) {
        let sent = vec![ellipse(); length];
        let back = decoded::<Ellipse>(&bytes_of(&header, &sent, how));
        assert_eq!(back, Ok((position(), header, cast_slice(&sent).to_vec())));
    }
}

#[test]
fn a_retransmitted_message_names_the_oldest_one_kept_by_then() {
    let header = header(64, 48);
    let mut bytes = bytes_of(&header, &[ellipse()], Compression::None);
    set_oldest(&mut bytes, 300);
    let position = StreamPosition { oldest: 300, ..position() };
    assert_eq!(position_of(&bytes), Ok(position));
    assert_eq!(decoded::<Ellipse>(&bytes), Ok((position, header, cast_slice(&[ellipse()]).to_vec())));
}

#[test]
fn the_end_of_a_stream_has_no_items_and_no_further_bytes() {
    let end = Header { flags: END_OF_STREAM, ..header(0, 0) };
    let mut bytes = bytes_of::<Track>(&end, &[], Compression::None);
    assert_eq!(decoded::<Track>(&bytes), Ok((position(), end, Vec::new())));
    bytes.push(0);
    assert!(matches!(decoded::<Track>(&bytes), Err(WireError::Broken(_))));
}

#[test]
fn the_error_names_another_version_and_another_layout() {
    let mut bytes = bytes_of::<Object>(&header(4, 3), &[], Compression::None);
    let error = decoded::<Track>(&bytes).unwrap_err().to_string();
    assert!(error.contains("`conicflow.Header.v2 conicflow.Object.v2`, this one reads"), "{error}");
    assert!(error.contains("`conicflow.Header.v2 conicflow.Track.v2`"), "{error}");
    bytes[4] = 0x63;
    let error = decoded::<Object>(&bytes).unwrap_err();
    assert_eq!(error, WireError::Version { ours: WIRE_VERSION, theirs: 0x63 });
    bytes[0] = b'X';
    assert_eq!(decoded::<Object>(&bytes), Err(WireError::Foreign));
}

#[test]
fn a_list_that_claims_more_than_it_has_is_refused() {
    let header = header(4, 3);
    let mut bytes = bytes_of::<Object>(&header, &[], Compression::None);
    assert_eq!(bytes.pop(), Some(0));
    // Bincode's mark for a length of eight bytes, and 2^60 items.
    bytes.extend([253, 0, 0, 0, 0, 0, 0, 0, 16]);
    assert!(matches!(decoded::<Object>(&bytes), Err(WireError::Broken(_))));
}

#[test]
fn messages_that_are_too_long_are_neither_encoded_nor_decoded() {
    let pixels = vec![0; MAX_MESSAGE / 2 + 1];
    let error = encoded(&header(pixels.len() as u32, 1), &pixels, Compression::None).unwrap_err();
    assert!(matches!(error, WireError::TooLong { bytes } if bytes > MAX_MESSAGE), "{error}");
    let of_length = |length: usize| {
        let body = |bytes: &mut Vec<u8>| {
            bytes.resize(length, 0);
            Ok(())
        };
        message_bytes(position(), &ItemType::of::<Object>().layout(), &header(4, 3), body)
    };
    assert!(of_length(MAX_MESSAGE + 1).is_err());
    let mut bytes = of_length(MAX_MESSAGE).unwrap();
    assert_eq!(position_of(&bytes), Ok(position()));
    bytes.push(0);
    let error = decoded::<Object>(&bytes).unwrap_err();
    assert_eq!(error, WireError::TooLong { bytes: MAX_MESSAGE + 1 });
}

#[test]
fn images_that_do_not_fill_their_size_are_refused() {
    for how in HOW {
        let pixels = vec![1000; 12];
        let good = bytes_of(&header(4, 3), &pixels, how);
        assert!(decoded::<u16>(&good).is_ok());
        let huge = encoded(&header(8192, 4096), &pixels, how);
        assert!(matches!(huge, Err(WireError::Broken(_))), "it could not be read there: {how:?}");
        for (width, height) in [(4, 4), (4, 2), (0, 0)] {
            let other = header(width, height);
            assert!(matches!(encoded(&other, &pixels, how), Err(WireError::Malformed(_))), "{how:?}");
            // As from a sender that does not check it.
            let item = ItemType::of::<u16>();
            let body = |bytes: &mut Vec<u8>| codec_of(&item).encode(&header(4, 3), cast_slice(&pixels), how, bytes);
            let sent = message_bytes(position(), &item.layout(), &other, body).unwrap();
            assert!(decoded::<u16>(&sent).is_err(), "{how:?}");
        }
    }
}

#[test]
fn invalid_numbers_are_refused() {
    let nonsense = Ellipse { rms: f64::NAN, ..ellipse() };
    // The pose is checked even without the flag that says there is one.
    let nowhere = Header { world_from_camera: [[f64::NAN; 4]; 3], ..header(64, 48) };
    for (header, ellipse) in [(header(64, 48), nonsense), (nowhere, ellipse())] {
        for how in HOW {
            let bytes = bytes_of(&header, &[ellipse], how);
            assert!(matches!(decoded::<Ellipse>(&bytes), Err(WireError::Malformed(_))));
        }
    }
}

#[test]
fn the_reported_layouts_are_those_of_all_built_in_types() {
    let reported = layouts();
    let is_reported = |name: &str| reported.split(' ').any(|one| one == name);
    assert!(is_reported(HEADER_TYPE_NAME) && BUILT_IN.iter().all(|item| is_reported(item.type_name())), "{reported}");
}

#[test]
fn the_python_example_reads_this_version() {
    let example = include_str!("../../../examples/read_objects.py");
    assert!(example.contains(&format!("(b\"CFLO\", {WIRE_VERSION})")));
    assert!(example.contains(&format!("reads version {WIRE_VERSION} of the wire")));
}

proptest! {
    #[test]
    fn every_image_is_decoded_bit_for_bit(width in 1_u32..40, height in 1_u32..30, seed: u64, rough: u16) {
        let mut state = seed | 1;
        let mut next = || { state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1); (state >> 48) as u16 };
        let pixels: Vec<u16> = (0..width * height).map(|_| next() & rough).collect();
        for how in HOW {
            let (.., back) = decoded::<u16>(&bytes_of(&header(width, height), &pixels, how)).unwrap();
            prop_assert_eq!(back.as_slice(), cast_slice::<_, u8>(&pixels));
        }
    }

    #[test]
    fn arbitrary_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        decode_as_all(&bytes);
        decode_as_all(&[b"CFLO".as_slice(), &WIRE_VERSION.to_le_bytes(), &bytes].concat());
    }

    #[test]
    fn a_message_with_a_changed_or_missing_byte_does_no_harm(at: prop::sample::Index, value: u8, cut: bool) {
        let images = HOW.map(|how| bytes_of(&header(8, 4), &[900_u16; 32], how));
        let lists = HOW.map(|how| bytes_of(&header(64, 48), &[ellipse(); 4], how));
        for mut bytes in images.into_iter().chain(lists) {
            let index = at.index(bytes.len());
            if cut { bytes.truncate(index) } else { bytes[index] = value }
            decode_as_all(&bytes);
        }
    }
}
