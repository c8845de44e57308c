//! Hostile files: the first inputs of the fuzzers, those in which they found faults, and mutations of both do no harm.

#[path = "../../fuzz/readers.rs"]
mod readers;

use conicflow_bridge::{StreamPosition, WIRE_VERSION, encode_message};
use conicflow_dataflow::pipeline::Compression;
use conicflow_dataflow::{BUILT_IN, ItemType};
use conicflow_messages::{Camera, END_OF_STREAM, Ellipse, Header, Hop, Item, Text};
use readers::{READERS, Reader, grasps};
use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

const MUTATIONS: &str = "CONICFLOW_MUTATIONS";
const DEFAULT_MUTATIONS: usize = 300;

/// The files of a corpus, by name. Files whose names begin with `good` have to be accepted, those with `bad` refused.
fn corpus(kind: &str) -> BTreeMap<String, Vec<u8>> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(kind);
    let files = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap());
    files.map(|file| (file.file_name().into_string().unwrap(), fs::read(file.path()).unwrap())).collect()
}

#[test]
fn the_corpora_of_the_fuzzers_do_no_harm() {
    for (kind, accepts) in READERS {
        let files = corpus(kind);
        assert!(files.keys().any(|name| name.starts_with("good")), "{kind}: {:?}", files.keys());
        assert!(files.keys().any(|name| name.starts_with("bad")), "{kind}: {:?}", files.keys());
        for (name, bytes) in files {
            let accepted = accepts(&bytes);
            assert!(accepted || !name.starts_with("good"), "{kind}/{name} was refused");
            assert!(!accepted || !name.starts_with("bad"), "{kind}/{name} was accepted");
        }
    }
}

/// Writes the first inputs of the fuzzer of messages. Run it after each change of the wire format: `cargo test --test end_to_end
/// begin_the_corpus -- --ignored`.
#[test]
#[ignore = "writes into the repository"]
fn begin_the_corpus_of_messages() {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/wire");
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    let mut header = Header { camera, depth_scale: 0.001, source: Text::new("frame-000012.png"), ..Header::default() };
    header.add_hop(Hop { stage: Text::new("source"), received_ns: 1, sent_ns: u64::MAX });
    let write = |item: &ItemType, name: &str, header: &Header, items: &[u8], how| {
        let message = encode_message(StreamPosition::default(), item, header, items, how).unwrap();
        fs::write(folder.join(name), message).unwrap();
    };
    let mut ellipse = Ellipse { line: 2, first: 1, last: 3, center: [-0.0, 0.1, 2.0], ..Ellipse::default() };
    ellipse.moments[0] = 4.0;
    let ellipses = bytemuck::cast_slice(&[ellipse; 12]).to_vec();
    for item in BUILT_IN.iter().chain([&grasps()]) {
        for how in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let name = format!("good_{}_{how:?}", item.name()).to_lowercase();
            let items = if item.name() == Ellipse::NAME { ellipses.clone() } else { vec![0; 12 * item.size()] };
            write(item, &name, &header, &items, how);
        }
    }
    write(&BUILT_IN[3], "good_end", &Header { flags: END_OF_STREAM, ..header }, &[], Compression::None);
    for bad in ["bad_cut", "bad_huge"] {
        let mut bytes = fs::read(folder.join(bad)).unwrap();
        bytes[4..6].copy_from_slice(&WIRE_VERSION.to_le_bytes());
        fs::write(folder.join(bad), bytes).unwrap();
    }
}

/// Returns one of the files after a mutation: a few bytes are changed, a piece is left out, repeated or exchanged, or a number is
/// inserted.
fn mutated(files: &[Vec<u8>], random: &mut fastrand::Rng) -> Vec<u8> {
    const NUMBERS: [&[u8]; 8] =
        [b"0", b"-1", b"4294967295", b"18446744073709551616", b"1e308", b"nan", b"inf", b"\xff\xff\xff\xff"];
    let mut bytes = random.choice(files).unwrap().clone();
    for _ in 0..random.usize(1..4) {
        let (from, length) = (random.usize(0..=bytes.len()), random.usize(0..32));
        let piece = from..(from + length).min(bytes.len());
        match random.u8(0..6) {
            0 => bytes[piece].iter_mut().take(2).for_each(|byte| *byte = random.u8(..)),
            1 => drop(bytes.drain(piece)),
            2 => bytes.truncate(from),
            3 => {
                let again = bytes[piece].to_vec();
                bytes.splice(from..from, again);
            }
            4 => drop(bytes.splice(from..piece.end.min(from + 4), random.choice(NUMBERS).unwrap().iter().copied())),
            _ => {
                let other = random.choice(files).unwrap();
                bytes.splice(from.., other[from.min(other.len())..].iter().copied());
            }
        }
    }
    bytes
}

fn mutate((kind, accepts): Reader, count: usize) {
    let files: Vec<_> = corpus(kind).into_values().collect();
    let mut random = fastrand::Rng::with_seed(7);
    let accepted = (0..count).filter(|_| accepts(&mutated(&files, &mut random))).count();
    assert!(accepted > 0 && accepted < count, "{kind}: {accepted} of {count} accepted, which shows little");
}

/// `CONICFLOW_MUTATIONS=100000 cargo test --release --test end_to_end -- mutations` tries more mutations.
#[test]
fn mutations_of_the_corpora_do_no_harm() {
    let count = std::env::var(MUTATIONS).map_or(DEFAULT_MUTATIONS, |text| text.parse().unwrap());
    READERS.into_iter().for_each(|reader| mutate(reader, count));
}
