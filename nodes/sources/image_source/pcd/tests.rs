use super::*;
use crate::sources::image_source::fixtures::{CAMERA, depth_m, pcd_file, points};

type Fields = &'static [(&'static str, char, usize, usize)];

const XYZ: Fields = &[("x", 'F', 4, 1), ("y", 'F', 4, 1), ("z", 'F', 4, 1)];
const MIXED: Fields = &[
    ("label", 'U', 4, 1),
    ("z", 'F', 8, 1),
    ("_", 'U', 1, 3),
    ("normal", 'F', 4, 3),
    ("y", 'F', 4, 1),
    ("x", 'F', 8, 1),
    ("rgba", 'U', 4, 1),
];
const ENCODINGS: [&str; 3] = ["ascii", "binary", "binary_compressed"];

fn same(got: &[f32; 3], expected: &[f32; 3]) -> bool {
    got.iter().zip(expected).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()))
}

fn error_of(file: &[u8]) -> String {
    format!("{:#}", Cloud::default().read(file).unwrap_err())
}

#[test]
fn every_encoding_and_field_order_gives_the_same_points() {
    let expected = points(&depth_m());
    let mut cloud = Cloud::default();
    for fields in [XYZ, MIXED] {
        for encoding in ENCODINGS {
            cloud.read(&pcd_file(&expected, fields, encoding)).unwrap();
            assert_eq!((cloud.width, cloud.height), (CAMERA.width, CAMERA.height));
            assert_eq!(cloud.points().count(), expected.len());
            assert!(cloud.points().zip(&expected).all(|(got, expected)| same(&got, expected)), "{encoding}");
        }
    }
}

#[test]
fn whole_numbers_of_every_size_are_read() {
    let expected: Vec<_> = (0..48 * 36).map(|i| [(i % 100) as f32, (i % 50) as f32, (i % 120) as f32]).collect();
    for (kind, size) in [('I', 1), ('I', 2), ('I', 4), ('I', 8), ('U', 1), ('U', 2), ('U', 4), ('U', 8)] {
        let fields = [("x", kind, size, 1), ("y", kind, size, 1), ("z", kind, size, 1)];
        let mut cloud = Cloud::default();
        cloud.read(&pcd_file(&expected, &fields, "binary")).unwrap();
        assert!(cloud.points().zip(&expected).all(|(got, expected)| got == *expected), "{kind}{size}");
    }
    let negative = vec![[-1.0, -2.0, -3.0]; 48 * 36];
    let mut cloud = Cloud::default();
    cloud.read(&pcd_file(&negative, &[("x", 'I', 1, 1), ("y", 'I', 2, 1), ("z", 'I', 4, 1)], "binary")).unwrap();
    assert_eq!(cloud.points().next(), Some([-1.0, -2.0, -3.0]));
}

#[test]
fn a_file_cut_off_anywhere_is_an_error_and_never_a_panic() {
    let expected = points(&depth_m());
    for encoding in ENCODINGS {
        let file = pcd_file(&expected, MIXED, encoding);
        for length in (0..file.len() - 8).step_by(97) {
            assert!(!error_of(&file[..length]).is_empty());
        }
        let error = error_of(&file[..file.len() * 3 / 4]);
        let in_a_line = encoding == "ascii" && error.contains("numbers, expected 11");
        assert!(in_a_line || error.contains("the file seems to be cut off"), "{error}");
    }
}

#[test]
fn damaged_bytes_never_panic() {
    let file = pcd_file(&points(&depth_m()), XYZ, "binary_compressed");
    let mut cloud = Cloud::default();
    for position in (0..file.len()).step_by(41) {
        let mut damaged = file.clone();
        damaged[position] ^= 0xa5;
        let _ = cloud.read(&damaged);
    }
}

#[test]
fn text_that_is_no_points_is_reported_with_its_line() {
    let file = String::from_utf8(pcd_file(&points(&depth_m()), XYZ, "ascii")).unwrap();
    let mut lines: Vec<_> = file.lines().collect();
    lines[12] = "1.0 2.0";
    assert_eq!(error_of(lines.join("\n").as_bytes()), "line 13: 2 numbers, expected 3");
    lines[12] = "1.0 ? 3.0";
    assert_eq!(error_of(lines.join("\n").as_bytes()), "line 13: `?` is no number");
    lines.remove(12);
    let error = error_of(lines.join("\n").as_bytes());
    assert_eq!(error, "1727 points, expected 1728\n  hint: the file seems to be cut off");
}

#[test]
fn missing_and_unsuitable_fields_are_reported() {
    let flat = pcd_file(&points(&depth_m()), &[("x", 'F', 4, 1), ("y", 'F', 4, 1), ("rgb", 'F', 4, 1)], "binary");
    assert_eq!(error_of(&flat), "FIELDS x y rgb, expected x, y and z among them");
    let twice = pcd_file(&points(&depth_m()), &[("x", 'F', 4, 2), ("y", 'F', 4, 1), ("z", 'F', 4, 1)], "binary");
    assert_eq!(error_of(&twice), "field `x` has COUNT 2, expected 1");
}

#[test]
fn no_memory_is_taken_for_points_that_the_file_cannot_hold() {
    let header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 8000\nHEIGHT 8000\nDATA ";
    for encoding in ENCODINGS {
        let mut cloud = Cloud::default();
        let error = cloud.read(format!("{header}{encoding}\n0 0 0\n").as_bytes()).unwrap_err().to_string();
        assert!(error.starts_with("6 bytes of points, expected "), "{error}");
        assert_eq!(cloud.columns.iter().map(Vec::capacity).sum::<usize>(), 0);
    }
}

#[test]
fn wrong_compressed_lengths_are_reported() {
    let file = pcd_file(&points(&depth_m()), XYZ, "binary_compressed");
    let at = Header::parse(&file).unwrap().data_offset;
    let mut lies = file.clone();
    lies[at + 4..at + 8].copy_from_slice(&7_u32.to_le_bytes());
    assert_eq!(error_of(&lies), "7 bytes when decompressed, expected 20736 by the header");
    let mut lies = file.clone();
    lies[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(error_of(&lies).contains("bytes of compressed points, expected 4294967295\n  hint:"));
}
