//! What the wire promises: every message comes back bit for bit, and no bytes whatever do harm.

use super::codec::{Wire, codec_of};
use super::{MAX_MESSAGE, Place, WIRE_VERSION, WireError, decode_message, encode_message, message_bytes, open_message};
use conicflow_dataflow::ItemType;
use conicflow_dataflow::pipeline::Compression;
use conicflow_messages::{Camera, END_OF_STREAM, Ellipse, Header, Hop, Object, Text, Track, Velocity};
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

fn place() -> Place {
    Place { stream: 7, number: 300, oldest: 299 }
}

fn bytes_of<T: Wire>(header: &Header, items: &[T], how: Compression) -> Vec<u8> {
    encode_message(place(), header, items, how).unwrap()
}

#[test]
fn lists_come_back_bit_for_bit() {
    let (mut back, header) = (Vec::new(), header(64, 48));
    for (how, length) in HOW.into_iter().flat_map(|how| [(how, 0), (how, 1), (how, 500)]) {
        let sent = vec![ellipse(); length];
        let decoded = decode_message::<Ellipse>(&bytes_of(&header, &sent, how), &mut back).unwrap();
        assert_eq!(decoded, (place(), header));
        assert_eq!(bytemuck::cast_slice::<_, u8>(&back), bytemuck::cast_slice::<_, u8>(&sent));
    }
}

#[test]
fn the_end_of_a_stream_has_no_items_and_nothing_behind_it() {
    let end = Header { flags: END_OF_STREAM, ..header(0, 0) };
    let mut bytes = bytes_of::<Track>(&end, &[], Compression::None);
    assert_eq!(decode_message::<Track>(&bytes, &mut Vec::new()), Ok((place(), end)));
    bytes.push(0);
    assert!(matches!(decode_message::<Track>(&bytes, &mut Vec::new()), Err(WireError::Broken(_))));
}

#[test]
fn another_version_and_another_layout_are_named() {
    let mut bytes = bytes_of::<Object>(&header(4, 3), &[], Compression::None);
    let error = decode_message::<Track>(&bytes, &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("`conicflow.Header.v2 conicflow.Object.v1`, this one reads"), "{error}");
    assert!(error.contains("`conicflow.Header.v2 conicflow.Track.v1`"), "{error}");
    bytes[4] = 0x63;
    let error = decode_message::<Object>(&bytes, &mut Vec::new()).unwrap_err();
    assert_eq!(error, WireError::Version { ours: WIRE_VERSION, theirs: 0x63 });
    bytes[0] = b'X';
    assert_eq!(decode_message::<Object>(&bytes, &mut Vec::new()), Err(WireError::Foreign));
}

#[test]
fn a_list_that_claims_more_than_it_has_is_refused() {
    let header = header(4, 3);
    let mut bytes = bytes_of::<Object>(&header, &[], Compression::None);
    assert_eq!(bytes.pop(), Some(0));
    // Bincode's mark for a length of eight bytes, and 2^60 items.
    bytes.extend([253, 0, 0, 0, 0, 0, 0, 0, 16]);
    assert!(matches!(decode_message::<Object>(&bytes, &mut Vec::new()), Err(WireError::Broken(_))));
}

#[test]
fn messages_that_are_too_long_neither_leave_nor_come() {
    let pixels = vec![0; MAX_MESSAGE / 2 + 1];
    let error = encode_message(place(), &header(pixels.len() as u32, 1), &pixels, Compression::None).unwrap_err();
    assert!(matches!(error, WireError::TooLong { bytes } if bytes > MAX_MESSAGE), "{error}");
    let mut bytes = bytes_of::<Object>(&header(4, 3), &[], Compression::None);
    bytes.resize(MAX_MESSAGE + 1, 0);
    let error = decode_message::<Object>(&bytes, &mut Vec::new()).unwrap_err();
    assert_eq!(error, WireError::TooLong { bytes: MAX_MESSAGE + 1 });
}

#[test]
fn images_that_do_not_fill_their_size_are_refused() {
    for how in HOW {
        let pixels = vec![1000; 12];
        let good = bytes_of(&header(4, 3), &pixels, how);
        let short = bytes_of(&header(4, 4), &pixels, how);
        let huge = encode_message::<u16>(place(), &header(8192, 4096), &pixels, how);
        assert!(matches!(huge, Err(WireError::Broken(_))), "it could not be read there: {how:?}");
        assert!(decode_message::<u16>(&good, &mut Vec::new()).is_ok());
        assert!(decode_message::<u16>(&short, &mut Vec::new()).is_err(), "{how:?}");
    }
}

#[test]
fn numbers_that_make_no_sense_are_refused() {
    let nonsense = Ellipse { rms: f64::NAN, ..ellipse() };
    // Also where no flag says that there is a pose.
    let nowhere = Header { world_from_camera: [[f64::NAN; 4]; 3], ..header(64, 48) };
    for (header, ellipse) in [(header(64, 48), nonsense), (nowhere, ellipse())] {
        for how in HOW {
            let bytes = bytes_of(&header, &[ellipse], how);
            assert!(matches!(decode_message::<Ellipse>(&bytes, &mut Vec::new()), Err(WireError::Malformed(_))));
        }
    }
}

#[test]
fn the_corpus_of_the_fuzzer_does_no_harm() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../fuzz/corpus/wire");
    let entries: Vec<_> = std::fs::read_dir(folder).unwrap().flatten().collect();
    assert!(entries.len() >= 8, "the corpus in {folder} is gone");
    for entry in entries {
        let bytes = std::fs::read(entry.path()).unwrap();
        let read = decode_message::<Track>(&bytes, &mut Vec::new());
        assert!(!matches!(read, Err(WireError::Version { .. })), "{} is of another version", entry.path().display());
        decode_all(&bytes);
    }
}

#[test]
fn the_python_example_reads_this_version() {
    let example = include_str!("../../../examples/read_objects.py");
    assert!(example.contains(&format!("(b\"CFLO\", {WIRE_VERSION})")));
}

/// What the fuzzer does, without what it needs to be built: `CONICFLOW_FUZZ_ROUNDS=200000000 cargo test --release -p
/// conicflow-dataflow mutations -- --ignored`.
#[test]
#[ignore = "takes as long as it is told to"]
fn mutations_of_the_corpus_do_no_harm() {
    let rounds = std::env::var("CONICFLOW_FUZZ_ROUNDS").map_or(1_000_000, |rounds| rounds.parse().unwrap());
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../fuzz/corpus/wire");
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let corpus: Vec<_> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let mut accepted = 0_u64;
    for _ in 0..rounds {
        let mut bytes = corpus[random.below(corpus.len())].clone();
        for _ in 0..=random.below(6) {
            mutate(&mut bytes, &mut random);
        }
        let tell = TellOnPanic(&bytes);
        accepted += decode_all(tell.0);
    }
    eprintln!("{accepted} of {rounds} mutations were messages");
    assert!(accepted > rounds / 1000, "the mutations no longer get past the first checks");
}

/// xorshift64*.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize) % limit.max(1)
    }
}

fn mutate(bytes: &mut Vec<u8>, random: &mut Random) {
    const EDGES: [u8; 8] = [0, 1, 127, 128, 250, 251, 253, 255];
    let at = random.below(bytes.len());
    match random.below(6) {
        0 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
        1 if !bytes.is_empty() => bytes[at] = EDGES[random.below(EDGES.len())],
        2 if !bytes.is_empty() => drop(bytes.remove(at)),
        3 => bytes.insert(at, EDGES[random.below(EDGES.len())]),
        4 => {
            let piece = bytes[at..bytes.len().min(at + 1 + random.below(32))].to_vec();
            let target = random.below(bytes.len());
            bytes.splice(target..target, piece);
        }
        _ if random.below(16) == 0 => bytes.truncate(at),
        _ => {}
    }
}

/// Shows the bytes that did harm.
struct TellOnPanic<'a>(&'a [u8]);

impl Drop for TellOnPanic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("these bytes did harm: {:02x?}", self.0);
        }
    }
}

/// Writes what the fuzzer begins with: `cargo test -p conicflow-dataflow begin_the_corpus -- --ignored`, after each change of
/// the wire.
#[test]
#[ignore = "writes into the repository"]
fn begin_the_corpus() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../fuzz/corpus/wire/");
    let write = |name: &str, bytes: &[u8]| std::fs::write(format!("{folder}{name}"), bytes).unwrap();
    let pixels: Vec<u16> = (0..12).map(|index| 900 + index * index).collect();
    for how in HOW {
        write(&format!("depth_{how:?}").to_lowercase(), &bytes_of(&header(4, 3), &pixels, how));
    }
    for how in HOW {
        write(&format!("ellipses_{how:?}").to_lowercase(), &bytes_of(&header(64, 48), &[ellipse(); 2], how));
    }
    let lists = bytes_of(&header(64, 48), &[ellipse(); 2], Compression::None);
    write("cut", &lists[..lists.len() / 2]);
    write("objects", &bytes_of::<Object>(&header(64, 48), &[Object::default()], Compression::None));
    write("tracks", &bytes_of::<Track>(&header(64, 48), &[Track::default()], Compression::None));
    let velocities = as_in_memory(place(), &header(64, 48), bytemuck::cast_slice(&[Velocity::default(); 3]));
    write("velocities", &velocities);
    let end = Header { flags: END_OF_STREAM, ..header(0, 0) };
    write("end", &bytes_of::<Track>(&end, &[], Compression::None));
    write("huge", &bytes_of(&header(65_536, 65_536), &pixels, Compression::Zstd));
}

/// As the fuzz target does: what is accepted has to survive being sent again; of how many kinds it was.
fn decode_all(bytes: &[u8]) -> u64 {
    let accepted = [again::<u16>(bytes), again::<Ellipse>(bytes), again::<Object>(bytes), again::<Track>(bytes)];
    accepted.into_iter().chain([again_as_in_memory(bytes)]).map(u64::from).sum()
}

fn again<T: Wire>(bytes: &[u8]) -> bool {
    let mut items = Vec::new();
    let Ok((place, header)) = decode_message::<T>(bytes, &mut items) else { return false };
    let resent = encode_message(place, &header, &items, Compression::Lz4).unwrap();
    let mut back = Vec::new();
    let (same_place, same_header) = decode_message::<T>(&resent, &mut back).unwrap();
    assert_eq!((same_place, bytemuck::bytes_of(&same_header)), (place, bytemuck::bytes_of(&header)));
    assert_eq!(bytemuck::cast_slice::<_, u8>(&back), bytemuck::cast_slice::<_, u8>(&items));
    true
}

/// The bytes of velocities, which have no form of their own on the wire.
fn as_in_memory(place: Place, header: &Header, items: &[u8]) -> Vec<u8> {
    let item = ItemType::of::<Velocity>();
    let body = |bytes: &mut Vec<u8>| codec_of(&item).encode(header, items, Compression::Lz4, bytes);
    message_bytes(place, item.type_name(), header, body).unwrap()
}

fn again_as_in_memory(bytes: &[u8]) -> bool {
    let item = ItemType::of::<Velocity>();
    let decode = |bytes: &[u8]| {
        let (place, header, body) = open_message(bytes, item.type_name(), item.name())?;
        let mut codec = codec_of(&item);
        body.map_or(Ok(()), |body| codec.decode(&header, body))?;
        Ok::<_, WireError>((place, header, codec.items().to_vec()))
    };
    let Ok((place, header, items)) = decode(bytes) else { return false };
    let resent = as_in_memory(place, &header, &items);
    let (same_place, same_header, back) = decode(&resent).unwrap();
    assert_eq!((same_place, bytemuck::bytes_of(&same_header)), (place, bytemuck::bytes_of(&header)));
    assert_eq!(back, items);
    true
}

proptest! {
    #[test]
    fn every_image_comes_back(width in 1_u32..40, height in 1_u32..30, seed: u64, rough: u16) {
        let mut state = seed | 1;
        let mut next = || { state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1); (state >> 48) as u16 };
        let pixels: Vec<u16> = (0..width * height).map(|_| next() & rough).collect();
        for how in HOW {
            let mut back = Vec::new();
            decode_message::<u16>(&bytes_of(&header(width, height), &pixels, how), &mut back).unwrap();
            prop_assert_eq!(&back, &pixels);
        }
    }

    #[test]
    fn no_bytes_do_harm(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        decode_all(&bytes);
        let prefixed = [b"CFLO\x02\x00".as_slice(), &bytes].concat();
        decode_all(&prefixed);
    }

    #[test]
    fn a_message_with_a_changed_or_missing_byte_does_no_harm(at: prop::sample::Index, value: u8, cut: bool) {
        for how in HOW {
            let mut bytes = bytes_of(&header(64, 48), &[ellipse(); 4], how);
            let index = at.index(bytes.len());
            if cut { bytes.truncate(index) } else { bytes[index] = value }
            decode_all(&bytes);
        }
        let mut image = bytes_of(&header(8, 4), &[900_u16; 32], Compression::Zstd);
        let index = at.index(image.len());
        if cut { image.truncate(index) } else { image[index] = value }
        decode_all(&image);
    }
}
