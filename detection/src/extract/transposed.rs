//! The transposed image: its columns follow one another as rows do, and are read in the same way.

use std::array::from_fn;
use wide::u16x8;

/// Number of rows, and of columns, that are transposed together.
const BLOCK: usize = 8; // [algorithmic]

/// Writes the columns of an image of `width` pixels per row into `columns`, one after another.
pub(crate) fn transposed<'a>(image: &[u16], width: usize, columns: &'a mut Vec<u16>) -> &'a [u16] {
    let height = image.len() / width;
    columns.resize(image.len(), 0);
    let whole_rows = height - height % BLOCK;
    for first_row in (0..whole_rows).step_by(BLOCK) {
        let rows: [&[u16]; BLOCK] = from_fn(|row| &image[(first_row + row) * width..][..width]);
        let blocks: [&[[u16; BLOCK]]; BLOCK] = from_fn(|row| rows[row].as_chunks().0);
        for index in 0..width / BLOCK {
            let block = u16x8::transpose(blocks.map(|row| u16x8::new(row[index])));
            for (column, pixels) in (index * BLOCK..).zip(block) {
                columns[column * height + first_row..][..BLOCK].copy_from_slice(pixels.as_array());
            }
        }
        for column in width - width % BLOCK..width {
            columns[column * height + first_row..][..BLOCK].copy_from_slice(&rows.map(|row| row[column]));
        }
    }
    for (row, pixels) in image.chunks_exact(width).enumerate().skip(whole_rows) {
        pixels.iter().enumerate().for_each(|(column, &depth)| columns[column * height + row] = depth);
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_come_one_behind_another_whatever_the_size() {
        let mut columns = vec![7; 3];
        for (width, height) in [(16, 8), (19, 8), (16, 13), (21, 30), (3, 5), (1, 9), (9, 1)] {
            let image: Vec<u16> = (0..width * height).collect();
            let expected: Vec<u16> = (0..width).flat_map(|x| (0..height).map(move |y| y * width + x)).collect();
            assert_eq!(transposed(&image, width.into(), &mut columns), expected, "{width}x{height}");
        }
    }
}
