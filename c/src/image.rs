//! An image from C: a pointer to the first pixel, and the distance of rows.

use conicflow_detection::Camera;
use conicflow_messages::Hinted;

/// An image in the memory of a program in C.
pub(crate) struct Image<T> {
    pub(crate) first: *const T,
    /// Distance of rows in bytes; 0: there are no gaps.
    pub(crate) row_bytes: usize,
}

impl<T: Copy> Image<T> {
    /// Returns the pixels row by row without gaps: in place, or copied to `buffer` if there are gaps between rows.
    ///
    /// # Errors
    /// It is no valid image of that camera.
    ///
    /// # Safety
    /// `first` is null or points to as many rows as the camera has, at distances of `row_bytes`, which nobody writes to
    /// meanwhile. Any bits are a `T`.
    pub(crate) unsafe fn pixels<'a>(&self, camera: &Camera, buffer: &'a mut Vec<T>) -> Result<&'a [T], Hinted> {
        let (columns, rows, stride) = (camera.width as usize, camera.height as usize, self.stride(camera)?);
        if stride == columns {
            // SAFETY: the caller guarantees the number of pixels; `stride` has refused null and unaligned pointers.
            return Ok(unsafe { std::slice::from_raw_parts(self.first, columns * rows) });
        }
        buffer.clear();
        for row in 0..rows {
            // SAFETY: as above, for each row; `stride` has checked that the offset fits an address.
            buffer.extend_from_slice(unsafe { std::slice::from_raw_parts(self.first.add(row * stride), columns) });
        }
        Ok(buffer)
    }

    /// The distance of rows in pixels.
    fn stride(&self, camera: &Camera) -> Result<usize, Hinted> {
        let Self { first, row_bytes } = *self;
        let (columns, rows, size) = (camera.width as usize, camera.height as usize, size_of::<T>());
        if first.is_null() {
            return Err(Hinted::new("`depth` is NULL", "give the first pixel of the image"));
        }
        if !first.is_aligned() {
            let what = format!("`depth` is at an address that is no multiple of {size}");
            return Err(Hinted::new(what, "give an array of pixels, not of bytes"));
        }
        let stride = if row_bytes == 0 { columns } else { row_bytes / size };
        let fits = stride
            .checked_mul(size)
            .and_then(|row| row.checked_mul(rows))
            .is_some_and(|all| all <= isize::MAX as usize);
        if stride < columns || !row_bytes.is_multiple_of(size) || !fits {
            let what = format!("`row_bytes` is {row_bytes}, of rows of {columns} pixels of {size} bytes");
            let hint = format!("it is a multiple of {size} and at least {}; 0: rows have no gaps", columns * size);
            return Err(Hinted::new(what, hint));
        }
        Ok(stride)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera { width: 3, height: 2, fx: 9.0, fy: 9.0, cx: 1.0, cy: 1.0 };

    fn pixels(memory: &[u16], row_bytes: usize) -> Result<Vec<u16>, String> {
        let (image, mut buffer) = (Image { first: memory.as_ptr(), row_bytes }, Vec::new());
        // SAFETY: the tests pass enough memory for these strides.
        unsafe { image.pixels(&CAMERA, &mut buffer) }.map(<[u16]>::to_vec).map_err(|error| error.to_string())
    }

    #[test]
    fn gaps_between_rows_are_left_out() {
        assert_eq!(pixels(&[1, 2, 3, 4, 5, 6], 0), Ok(vec![1, 2, 3, 4, 5, 6]));
        assert_eq!(pixels(&[1, 2, 3, 4, 5, 6], 6), Ok(vec![1, 2, 3, 4, 5, 6]));
        assert_eq!(
            pixels(&[1, 2, 3, 0, 0, 4, 5, 6], 10),
            Ok(vec![1, 2, 3, 4, 5, 6]),
            "the last row has no gap behind it"
        );
    }

    #[test]
    fn strides_that_cannot_be_are_refused() {
        for row_bytes in [1, 4, 7, usize::MAX, usize::MAX - 1, isize::MAX as usize - 1] {
            let told = pixels(&[0; 6], row_bytes).unwrap_err();
            assert!(
                told.starts_with(&format!("`row_bytes` is {row_bytes}, ")) && told.contains("\n  hint: "),
                "{told}"
            );
        }
    }

    #[test]
    fn addresses_that_cannot_be_are_refused() {
        let of = |first: *const u16| Image { first, row_bytes: 0 }.stride(&CAMERA).unwrap_err().what;
        assert_eq!(of(std::ptr::null()), "`depth` is NULL");
        let odd = [0_u16; 8].as_ptr().wrapping_byte_add(1);
        assert_eq!(of(odd), "`depth` is at an address that is no multiple of 2");
    }
}
