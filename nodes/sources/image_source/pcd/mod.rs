//! Organised point clouds: reads x, y and z of a PCD file in any encoding, with its fields in any order and of any type.

mod header;
mod lzf;

pub(super) use header::Header;

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use conicflow_messages::Hinted;
use header::{Encoding, ReadColumn};

/// Hint of the errors about unreadable files.
pub(super) const HINT: &str =
    "save the cloud anew, organised, by PCL's `savePCDFileBinary` for one, or take the file out";

/// The points of one file, row by row; its buffers are reused for the next file.
#[derive(Default)]
pub(super) struct Cloud {
    /// Width of the image that the points form.
    pub(super) width: u32,
    /// Height of the image that the points form.
    pub(super) height: u32,
    columns: [Vec<f32>; 3],
    unpacked: Vec<u8>,
}

/// The position of one coordinate among the fields.
#[derive(Clone, Copy)]
struct CoordinateField {
    /// Index among the words of a line of text.
    word: usize,
    /// Offset in bytes in a point, and (for one point) in a file that is stored field after field.
    in_point: usize,
    in_fields: usize,
    read: ReadColumn,
    size: usize,
}

impl Cloud {
    /// Reads a whole file. Points without a measurement have NaN coordinates, as in the file.
    ///
    /// # Errors
    /// The header or the points cannot be read. Memory is allocated only as far as the file's length justifies it.
    pub(super) fn read(&mut self, file: &[u8]) -> Result<()> {
        let header = Header::parse(file)?;
        let places = places(&header)?;
        let data = &file[header.data_offset..];
        check_length(&header, data)?;
        for column in &mut self.columns {
            column.resize(header.points(), f32::NAN);
        }
        (self.width, self.height) = (header.width, header.height);
        match header.encoding {
            Encoding::Ascii => self.read_text(&header, places, data),
            Encoding::Binary => {
                let stride = header.point_size();
                read_columns(&mut self.columns, data, places.map(|place| (place, place.in_point, stride)));
                Ok(())
            }
            Encoding::BinaryCompressed => self.read_compressed(&header, places, data),
        }
    }

    /// Returns the points, row by row; holes have a NaN in some coordinate.
    pub(super) fn points(&self) -> impl Iterator<Item = [f32; 3]> + Clone {
        let [x, y, z] = &self.columns;
        x.iter().zip(y).zip(z).map(|((&x, &y), &z)| [x, y, z])
    }

    /// Returns the z coordinates, row by row.
    pub(super) fn depths(&self) -> &[f32] {
        &self.columns[2]
    }

    fn read_compressed(&mut self, header: &Header, places: [CoordinateField; 3], data: &[u8]) -> Result<()> {
        let packed = packed_block(header, data)?;
        self.unpacked.resize(header.points() * header.point_size(), 0);
        let outcome = lzf::decompress(packed, &mut self.unpacked);
        read_columns(&mut self.columns, &self.unpacked, places.map(|place| (place, place.in_fields, place.size)));
        outcome
    }

    fn read_text(&mut self, header: &Header, places: [CoordinateField; 3], data: &[u8]) -> Result<()> {
        let words: usize = header.fields.iter().map(|field| field.count).sum();
        let points = header.points();
        let mut read = 0;
        for (index, line) in data.split(|&byte| byte == b'\n').enumerate() {
            if line.iter().all(u8::is_ascii_whitespace) || read == points {
                continue;
            }
            let point = read_line(line, words, places).with_context(|| format!("line {}", header.lines + index + 1))?;
            for (column, value) in self.columns.iter_mut().zip(point) {
                column[read] = value;
            }
            read += 1;
        }
        ensure!(
            read == points,
            Hinted::new(format!("{read} points, expected {points}"), "the file seems to be cut off")
        );
        Ok(())
    }
}

fn read_columns(columns: &mut [Vec<f32>; 3], data: &[u8], places: [(CoordinateField, usize, usize); 3]) {
    for (column, (place, first, stride)) in columns.iter_mut().zip(places) {
        (place.read)(&data[first..], stride, column);
    }
}

/// Finds x, y and z among the fields.
fn places(header: &Header) -> Result<[CoordinateField; 3]> {
    let mut found = [None; 3];
    let (mut word, mut in_point, mut in_fields) = (0, 0, 0);
    for field in &header.fields {
        if let Some(axis) = ["x", "y", "z"].iter().position(|name| *name == field.name) {
            ensure!(field.count == 1, "field `{}` has COUNT {}, expected 1", field.name, field.count);
            found[axis] = Some(CoordinateField { word, in_point, in_fields, read: field.read, size: field.size });
        }
        word += field.count;
        in_point += field.count * field.size;
        in_fields += field.count * field.size * header.points();
    }
    match found {
        [Some(x), Some(y), Some(z)] => Ok([x, y, z]),
        _ => {
            let names: Vec<_> = header.fields.iter().map(|field| field.name.as_str()).collect();
            bail!("FIELDS {}, expected x, y and z among them", names.join(" "))
        }
    }
}

/// Refuses a header that claims more points than the file can hold, before memory is allocated for them.
fn check_length(header: &Header, data: &[u8]) -> Result<()> {
    let whole = header.points() * header.point_size();
    let needed = match header.encoding {
        Encoding::Ascii => header.points() * header.fields.len() * 2 - 1,
        Encoding::Binary => whole,
        Encoding::BinaryCompressed => 8 + whole / lzf::MAX_RATIO,
    };
    let got = data.len();
    ensure!(
        got >= needed,
        Hinted::new(format!("{got} bytes of points, expected {needed} or more"), "the file seems to be cut off")
    );
    Ok(())
}

/// Returns the compressed bytes, which follow their two lengths.
fn packed_block<'a>(header: &Header, data: &'a [u8]) -> Result<&'a [u8]> {
    let length = |at: usize| {
        let bytes = data.get(at..).and_then(|rest| rest.first_chunk::<4>()).context("the lengths are cut off")?;
        Ok::<_, anyhow::Error>(u32::from_le_bytes(*bytes) as usize)
    };
    let (packed, unpacked) = (length(0)?, length(4)?);
    let expected = header.points() * header.point_size();
    ensure!(unpacked == expected, "{unpacked} bytes when decompressed, expected {expected} by the header");
    let got = data.len() - 8;
    let block = data.get(8..8 + packed);
    block.ok_or_else(|| {
        let what = format!("{got} bytes of compressed points, expected {packed}");
        Hinted::new(what, "the file seems to be cut off").into()
    })
}

fn read_line(line: &[u8], words: usize, places: [CoordinateField; 3]) -> Result<[f32; 3]> {
    let line = std::str::from_utf8(line).map_err(|_| anyhow!("not text"))?;
    let mut point = [f32::NAN; 3];
    let mut got = 0;
    for (index, word) in line.split_ascii_whitespace().enumerate() {
        if let Some(axis) = places.iter().position(|place| place.word == index) {
            point[axis] = word.parse().map_err(|_| anyhow!("`{word}` is no number"))?;
        }
        got = index + 1;
    }
    ensure!(got == words, "{got} numbers, expected {words}");
    Ok(point)
}

#[cfg(test)]
mod tests;
