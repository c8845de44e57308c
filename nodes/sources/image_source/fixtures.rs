//! Rendered frames for the tests, and writers for every file that can be read.

use super::pcd::Header;
use conicflow_messages::Camera;
use png::{BitDepth, ColorType, Encoder};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// A small camera whose principal point is not in the middle.
pub(super) const CAMERA: Camera = Camera { width: 48, height: 36, fx: 40.0, fy: 41.0, cx: 22.25, cy: 18.5 };

/// Depth of a tilted wall with a ball of radius 0.2 m in front of it and a hole in the corner, in metres.
pub(super) fn depth_m() -> Vec<f32> {
    let pixels = (0..CAMERA.height).flat_map(|v| (0..CAMERA.width).map(move |u| (u, v)));
    pixels.map(|(u, v)| if u < 6 && v < 6 { f32::NAN } else { depth_at(f64::from(u), f64::from(v)) as f32 }).collect()
}

fn depth_at(u: f64, v: f64) -> f64 {
    let (x, y) = ((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy);
    let wall = 2.0 / (1.0 - 0.3 * x + 0.1 * y);
    // |p - c| = r with p = z (x, y, 1), c = (0, 0, 1.2), r = 0.2.
    let (square, half) = (x * x + y * y + 1.0, 1.2);
    let root = half * half - square * (1.2 * 1.2 - 0.2 * 0.2);
    if root > 0.0 { (half - root.sqrt()) / square } else { wall }
}

/// Points of a depth image, NaN where there is no depth.
pub(super) fn points(depth_m: &[f32]) -> Vec<[f32; 3]> {
    let point = |(index, &z): (usize, &f32)| {
        let (u, v) = (index % CAMERA.width as usize, index / CAMERA.width as usize);
        let x = f64::from(z) * (u as f64 - CAMERA.cx) / CAMERA.fx;
        let y = f64::from(z) * (v as f64 - CAMERA.cy) / CAMERA.fy;
        [x as f32, y as f32, z]
    };
    depth_m.iter().enumerate().map(point).collect()
}

/// The depth image in units, 0 where there is no depth.
pub(super) fn units(depth_m: &[f32], scale: f64) -> Vec<u16> {
    depth_m.iter().map(|&z| if z.is_nan() { 0 } else { (f64::from(z) / scale).round() as u16 }).collect()
}

/// A PNG file of any kind.
pub(super) fn png_bytes(width: u32, height: u32, color: ColorType, bits: BitDepth, bytes: &[u8]) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = Encoder::new(&mut file, width, height);
    encoder.set_color(color);
    encoder.set_depth(bits);
    encoder.write_header().unwrap().write_image_data(bytes).unwrap();
    file
}

/// A 16-bit grey PNG file.
pub(super) fn png16(width: u32, height: u32, pixels: &[u16]) -> Vec<u8> {
    let bytes: Vec<u8> = pixels.iter().flat_map(|pixel| pixel.to_be_bytes()).collect();
    png_bytes(width, height, ColorType::Grayscale, BitDepth::Sixteen, &bytes)
}

/// Writes the rendered frame as a PNG in millimetres.
pub(super) fn write_depth_png(path: &Path) {
    fs::write(path, png16(CAMERA.width, CAMERA.height, &units(&depth_m(), 0.001))).unwrap();
}

/// Writes an 8-bit colour PNG.
pub(super) fn write_colour_png(path: &Path) {
    let bytes = vec![77; 3 * (CAMERA.width * CAMERA.height) as usize];
    fs::write(path, png_bytes(CAMERA.width, CAMERA.height, ColorType::Rgb, BitDepth::Eight, &bytes)).unwrap();
}

/// A PCD file: `fields` as (name, type, size, count); x, y and z get the points, other fields a running number.
pub(super) fn pcd_file(points: &[[f32; 3]], fields: &[(&str, char, usize, usize)], data: &str) -> Vec<u8> {
    let column =
        |text: fn(&(&str, char, usize, usize)) -> String| fields.iter().map(text).collect::<Vec<_>>().join(" ");
    let header = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {}\n\
         HEIGHT {}\nVIEWPOINT 1 2 3 0 1 0 0\nPOINTS {}\nDATA {data}\n",
        column(|field| field.0.to_owned()),
        column(|field| field.2.to_string()),
        column(|field| field.1.to_string()),
        column(|field| field.3.to_string()),
        CAMERA.width,
        CAMERA.height,
        points.len(),
    );
    Header::parse(header.as_bytes()).unwrap();
    let body = match data {
        "ascii" => text_body(points, fields),
        "binary" => {
            points.iter().enumerate().flat_map(|(i, p)| fields.iter().flat_map(move |f| raw(i, p, f))).collect()
        }
        _ => compressed_body(points, fields),
    };
    [header.into_bytes(), body].concat()
}

fn number(index: usize, point: &[f32; 3], name: &str) -> f64 {
    match name {
        "x" => point[0].into(),
        "y" => point[1].into(),
        "z" => point[2].into(),
        _ => (index % 100) as f64,
    }
}

fn text_body(points: &[[f32; 3]], fields: &[(&str, char, usize, usize)]) -> Vec<u8> {
    let line = |(index, point): (usize, &[f32; 3])| {
        let words = fields.iter().flat_map(|f| vec![number(index, point, f.0).to_string(); f.3]);
        words.collect::<Vec<_>>().join(" ") + "\n"
    };
    points.iter().enumerate().map(line).collect::<String>().into_bytes()
}

fn compressed_body(points: &[[f32; 3]], fields: &[(&str, char, usize, usize)]) -> Vec<u8> {
    let field = |f| points.iter().enumerate().flat_map(move |(i, p)| raw(i, p, f)).collect::<Vec<u8>>();
    let plain: Vec<u8> = fields.iter().flat_map(field).collect();
    let packed = lzf_compress(&plain);
    [&(packed.len() as u32).to_le_bytes()[..], &(plain.len() as u32).to_le_bytes(), &packed].concat()
}

fn raw(index: usize, point: &[f32; 3], &(name, kind, size, count): &(&str, char, usize, usize)) -> Vec<u8> {
    let value = number(index, point, name);
    let bytes = match (kind, size) {
        ('F', 4) => (value as f32).to_le_bytes().to_vec(),
        ('F', 8) => value.to_le_bytes().to_vec(),
        _ => (value as i64).to_le_bytes()[..size].to_vec(),
    };
    bytes.repeat(count)
}

/// Compresses by LZF, greedily; remembers the last position of every three bytes.
pub(super) fn lzf_compress(data: &[u8]) -> Vec<u8> {
    let (mut packed, mut seen) = (Vec::new(), BTreeMap::<&[u8], usize>::new());
    let (mut at, mut literals_from) = (0, 0);
    while at < data.len() {
        let key = data.get(at..at + 3);
        let earlier = key.and_then(|key| seen.insert(key, at)).filter(|earlier| at - earlier <= 8192);
        let Some(earlier) = earlier else {
            at += 1;
            continue;
        };
        let same = data[at..].iter().zip(&data[earlier..]).take(264).take_while(|(a, b)| a == b).count();
        put_literals(&mut packed, &data[literals_from..at]);
        put_reference(&mut packed, at - earlier - 1, same - 2);
        at += same;
        literals_from = at;
    }
    put_literals(&mut packed, &data[literals_from..]);
    packed
}

fn put_literals(packed: &mut Vec<u8>, literals: &[u8]) {
    for run in literals.chunks(32) {
        packed.push(run.len() as u8 - 1);
        packed.extend(run);
    }
}

fn put_reference(packed: &mut Vec<u8>, distance: usize, length: usize) {
    let (high, low) = ((distance >> 8) as u8, distance as u8);
    if length < 7 {
        packed.extend([(length as u8) << 5 | high, low]);
    } else {
        packed.extend([7 << 5 | high, (length - 7) as u8, low]);
    }
}
