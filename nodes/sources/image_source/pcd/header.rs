//! The text header of a PCD file: the fields of its points, their number, and their encoding.
//!
//! Format: <https://pointclouds.org/documentation/tutorials/pcd_file_format.html>, versions .5 to .7. VIEWPOINT, the sensor's
//! pose in the world, is ignored: like PCL, this reader takes the points to be in the sensor's frame.

use super::super::faulty::excerpt;
use anyhow::{Context as _, Result, anyhow, bail, ensure};
use conicflow_messages::{Hinted, MAX_PIXELS};
use std::str::SplitAsciiWhitespace;

/// Longest header that is read.
pub(super) const MAX_HEADER_BYTES: usize = 64 * 1024;

/// The encoding of the points after the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    /// One point per line, as text.
    Ascii,
    /// Point after point.
    Binary,
    /// LZF-compressed, field after field.
    BinaryCompressed,
}

/// Reads one number of each point as `f32`; `stride` is the number of bytes from one point to the next.
pub(super) type ReadColumn = fn(bytes: &[u8], stride: usize, out: &mut [f32]);

/// One field of a point.
#[derive(Clone, Debug)]
pub(super) struct Field {
    pub name: String,
    pub read: ReadColumn,
    /// Size of one number in bytes.
    pub size: usize,
    /// Number of numbers in the field.
    pub count: usize,
}

/// The content of the header; every number in it has been checked.
#[derive(Clone, Debug)]
pub(crate) struct Header {
    pub(super) fields: Vec<Field>,
    /// Width of the organised cloud.
    pub(crate) width: u32,
    /// Height of the organised cloud.
    pub(crate) height: u32,
    pub(super) encoding: Encoding,
    /// Offset of the points in the file, in bytes.
    pub(super) data_offset: usize,
    /// Number of lines of the header.
    pub(super) lines: usize,
}

impl Header {
    /// Reads the header at the beginning of a file.
    ///
    /// # Errors
    /// Says which line is wrong, and why; also a cloud that is not organised as an image is refused.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self> {
        let mut draft = Draft::default();
        let mut rest = &bytes[..bytes.len().min(MAX_HEADER_BYTES)];
        for number in 1.. {
            let end = rest.iter().position(|&byte| byte == b'\n').with_context(|| no_end(number))?;
            let line = std::str::from_utf8(&rest[..end]).map_err(|_| anyhow!("line {number} is not text"))?;
            draft.read_line(line).with_context(|| format!("line {number}, `{}`", excerpt(line)))?;
            rest = &rest[end + 1..];
            if let Some(encoding) = draft.encoding {
                let data_offset = bytes.len().min(MAX_HEADER_BYTES) - rest.len();
                return draft.finish(encoding, data_offset, number);
            }
        }
        bail!("no `DATA` line")
    }

    /// Number of points.
    pub(super) fn points(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Size of one point in bytes.
    pub(super) fn point_size(&self) -> usize {
        self.fields.iter().map(|field| field.size * field.count).sum()
    }
}

fn no_end(line: usize) -> Hinted {
    let what = format!("the header ends in line {line} without a `DATA` line");
    Hinted::new(what, "is this a PCD file, and is it complete?")
}

/// The header as far as it has been read.
#[derive(Default)]
struct Draft {
    names: Vec<String>,
    sizes: Vec<usize>,
    types: Vec<char>,
    counts: Vec<usize>,
    width: Option<u64>,
    height: Option<u64>,
    points: Option<u64>,
    encoding: Option<Encoding>,
}

impl Draft {
    fn read_line(&mut self, line: &str) -> Result<()> {
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("FIELDS" | "COLUMNS") => self.names = words.map(str::to_owned).collect(),
            Some("SIZE") => self.sizes = numbers(words)?,
            Some("TYPE") => self.types = words.map(type_letter).collect::<Result<_>>()?,
            Some("COUNT") => self.counts = numbers(words)?,
            Some("WIDTH") => self.width = Some(number(words)?),
            Some("HEIGHT") => self.height = Some(number(words)?),
            Some("POINTS") => self.points = Some(number(words)?),
            Some("VERSION" | "VIEWPOINT") | None => {}
            Some("DATA") => self.encoding = Some(encoding(words.next().unwrap_or(""))?),
            Some(comment) if comment.starts_with('#') => {}
            Some(_) => bail!(Hinted::new("no key of a PCD header", "is this a PCD file?")),
        }
        Ok(())
    }

    fn finish(mut self, encoding: Encoding, data_offset: usize, lines: usize) -> Result<Header> {
        let missing = |key: &str| format!("the header has no `{key}` line");
        let width = self.width.with_context(|| missing("WIDTH"))?;
        let height = self.height.with_context(|| missing("HEIGHT"))?;
        let (width, height) = size(width, height, self.points)?;
        let fields = self.fields()?;
        Ok(Header { fields, width, height, encoding, data_offset, lines })
    }

    fn fields(&mut self) -> Result<Vec<Field>> {
        if self.counts.is_empty() {
            self.counts = vec![1; self.names.len()];
        }
        let lengths = [self.sizes.len(), self.types.len(), self.counts.len()];
        let expected = self.names.len();
        if lengths != [expected; 3] {
            let [sizes, types, counts] = lengths;
            bail!("the header names {expected} FIELDS, but {sizes} SIZE, {types} TYPE and {counts} COUNT");
        }
        let field = |index: usize| {
            let (size, count) = (self.sizes[index], self.counts[index]);
            let name = self.names[index].clone();
            let read = reader(self.types[index], size).with_context(|| format!("field `{name}`"))?;
            ensure!(count <= 4096, "field `{name}`: COUNT {count} is more than the 4096 that are read");
            Ok(Field { name, read, size, count })
        };
        (0..expected).map(field).collect()
    }
}

/// Checks that the cloud is organised as an image, and not too large.
fn size(width: u64, height: u64, points: Option<u64>) -> Result<(u32, u32)> {
    let pixels = width.checked_mul(height).filter(|&pixels| pixels <= MAX_PIXELS);
    let Some(pixels) = pixels else {
        bail!("WIDTH {width} and HEIGHT {height} make more than the {MAX_PIXELS} points that are read");
    };
    ensure!(pixels > 0, "an empty cloud: WIDTH {width}, HEIGHT {height}");
    if width == 1 || height == 1 {
        bail!(Hinted::new(
            format!("the cloud is not organised as an image: WIDTH {width}, HEIGHT {height}"),
            "save the cloud as the camera gave it; filters that drop points instead of setting them to NaN lose the \
             rows and columns"
        ));
    }
    if let Some(points) = points.filter(|&points| points != pixels) {
        bail!("POINTS {points}, but WIDTH {width} times HEIGHT {height} is {pixels}");
    }
    Ok((width as u32, height as u32))
}

fn numbers(words: SplitAsciiWhitespace) -> Result<Vec<usize>> {
    words.map(|word| word.parse().map_err(|_| anyhow!("`{word}` is no whole number"))).collect()
}

fn number(mut words: SplitAsciiWhitespace) -> Result<u64> {
    let word = words.next().context("a number is missing")?;
    word.parse().map_err(|_| anyhow!("`{word}` is no whole number"))
}

fn type_letter(word: &str) -> Result<char> {
    match word {
        "F" => Ok('F'),
        "I" => Ok('I'),
        "U" => Ok('U'),
        _ => bail!("TYPE `{word}`, expected F, I or U"),
    }
}

fn encoding(word: &str) -> Result<Encoding> {
    match word {
        "ascii" => Ok(Encoding::Ascii),
        "binary" => Ok(Encoding::Binary),
        "binary_compressed" => Ok(Encoding::BinaryCompressed),
        _ => bail!("expected `ascii`, `binary` or `binary_compressed`"),
    }
}

fn reader(letter: char, size: usize) -> Result<ReadColumn> {
    let reader: ReadColumn = match (letter, size) {
        ('F', 4) => |bytes, stride, out| convert(bytes, stride, out, f32::from_le_bytes),
        ('F', 8) => |bytes, stride, out| convert(bytes, stride, out, |raw| f64::from_le_bytes(raw) as f32),
        ('I', 1) => |bytes, stride, out| convert(bytes, stride, out, |raw| i8::from_le_bytes(raw).into()),
        ('I', 2) => |bytes, stride, out| convert(bytes, stride, out, |raw| i16::from_le_bytes(raw).into()),
        ('I', 4) => |bytes, stride, out| convert(bytes, stride, out, |raw| i32::from_le_bytes(raw) as f32),
        ('I', 8) => |bytes, stride, out| convert(bytes, stride, out, |raw| i64::from_le_bytes(raw) as f32),
        ('U', 1) => |bytes, stride, out| convert(bytes, stride, out, |raw| u8::from_le_bytes(raw).into()),
        ('U', 2) => |bytes, stride, out| convert(bytes, stride, out, |raw| u16::from_le_bytes(raw).into()),
        ('U', 4) => |bytes, stride, out| convert(bytes, stride, out, |raw| u32::from_le_bytes(raw) as f32),
        ('U', 8) => |bytes, stride, out| convert(bytes, stride, out, |raw| u64::from_le_bytes(raw) as f32),
        _ => bail!("no number of TYPE {letter} has SIZE {size}"),
    };
    Ok(reader)
}

fn convert<const N: usize>(bytes: &[u8], stride: usize, out: &mut [f32], number: impl Fn([u8; N]) -> f32) {
    for (value, point) in out.iter_mut().zip(bytes.chunks(stride)) {
        *value = point.first_chunk().map_or(f32::NAN, |raw| number(*raw));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "# .PCD v0.7\nVERSION 0.7\nFIELDS label x y z\nSIZE 4 4 8 2\nTYPE U F F I\nCOUNT 2 1 1 1\n\
                        WIDTH 4\nHEIGHT 3\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\nDATA binary\n";

    fn error_of(text: &str) -> String {
        format!("{:#}", Header::parse(text.as_bytes()).unwrap_err())
    }

    #[test]
    fn a_header_is_read() {
        let header = Header::parse(format!("{GOOD}rest").as_bytes()).unwrap();
        assert_eq!((header.width, header.height, header.points()), (4, 3, 12));
        assert_eq!((header.encoding, header.lines), (Encoding::Binary, 11));
        assert_eq!(header.data_offset, GOOD.len());
        assert_eq!(header.point_size(), 2 * 4 + 4 + 8 + 2);
        let mut numbers = [0.0];
        (header.fields[2].read)(&2.5_f64.to_le_bytes(), 8, &mut numbers);
        assert_eq!(numbers, [2.5]);
    }

    #[test]
    fn old_and_foreign_spellings_are_read() {
        let text = GOOD.replace("FIELDS", "COLUMNS").replace("COUNT 2 1 1 1\n", "").replace("POINTS 12\n", "");
        let header = Header::parse(text.replace('\n', "\r\n").as_bytes()).unwrap();
        assert_eq!((header.point_size(), header.points()), (4 + 4 + 8 + 2, 12));
    }

    #[test]
    fn a_cloud_without_rows_is_refused() {
        let text = GOOD.replace("WIDTH 4", "WIDTH 12").replace("HEIGHT 3", "HEIGHT 1");
        let error = error_of(&text);
        assert!(error.starts_with("the cloud is not organised as an image: WIDTH 12, HEIGHT 1\n  hint: "), "{error}");
    }

    #[test]
    fn faults_are_reported_with_their_line() {
        let error_after = |from: &str, to: &str| error_of(&GOOD.replace(from, to));
        assert_eq!(error_after("WIDTH 4", "WIDTH 4x"), "line 7, `WIDTH 4x`: `4x` is no whole number");
        assert_eq!(error_after("WIDTH 4", "WIDTH"), "line 7, `WIDTH`: a number is missing");
        assert_eq!(error_after("WIDTH 4", "WIDTH -4"), "line 7, `WIDTH -4`: `-4` is no whole number");
        assert_eq!(error_after("TYPE U", "TYPE Q"), "line 5, `TYPE Q F F I`: TYPE `Q`, expected F, I or U");
        assert_eq!(error_after("SIZE 4", "SIZE 3"), "field `label`: no number of TYPE U has SIZE 3");
        assert_eq!(error_after("SIZE 4 ", "SIZE "), "the header names 4 FIELDS, but 3 SIZE, 4 TYPE and 4 COUNT");
        assert_eq!(error_after("WIDTH 4\n", ""), "the header has no `WIDTH` line");
        assert_eq!(error_after("POINTS 12", "POINTS 13"), "POINTS 13, but WIDTH 4 times HEIGHT 3 is 12");
        assert_eq!(error_after("HEIGHT 3", "HEIGHT 0"), "an empty cloud: WIDTH 4, HEIGHT 0");
        assert!(error_after("DATA binary", "DATA zip").starts_with("line 11, `DATA zip`: expected `ascii`"));
        assert!(
            error_after("DATA binary\n", "").starts_with("the header ends in line 11 without a `DATA` line\n  hint:")
        );
        assert!(error_after("VERSION", "wersion").contains("line 2, `wersion 0.7`: no key of a PCD header\n  hint:"));
        assert!(error_after("COUNT 2", "COUNT 99999").contains("COUNT 99999 is more than the 4096"));
    }

    #[test]
    fn impossible_sizes_are_refused() {
        let huge = GOOD.replace("WIDTH 4", "WIDTH 4294967295").replace("HEIGHT 3", "HEIGHT 4294967295");
        assert!(error_of(&huge).contains("more than the"));
        let wraps = GOOD.replace("WIDTH 4", "WIDTH 9223372036854775809").replace("HEIGHT 3", "HEIGHT 2");
        assert!(error_of(&wraps).contains("more than the"));
    }
}
