//! A contact sheet: many small pictures in one, to see a whole run at a glance.

use super::canvas::{Box2, Canvas};

/// Width of a small picture, in pixels.
const WIDTH: i64 = 320;
/// Distance between small pictures, in pixels.
const GAP: i64 = 4;
/// Largest number of columns; with fewer pictures a sheet is narrower.
const COLUMNS: usize = 6;

/// Collects small pictures until a sheet is full.
pub(super) struct Sheet {
    room: usize,
    /// Number of sheets before this one.
    before: u64,
    small: Vec<Canvas>,
}

impl Sheet {
    /// Creates sheets of `room` pictures each; `before` sheets exist already.
    pub(super) fn new(room: usize, before: u64) -> Self {
        Self { room, before, small: Vec::new() }
    }

    /// Adds a picture.
    pub(super) fn add(&mut self, picture: &Canvas) {
        let (width, height) = picture.size();
        let high = (WIDTH * i64::from(height) / i64::from(width)).clamp(1, 4 * WIDTH);
        let mut small = Canvas::default();
        small.begin(WIDTH as u32, high as u32);
        picture.shrink_into(&mut small, Box2 { left: 0, top: 0, width: WIDTH, height: high });
        self.small.push(small);
    }

    pub(super) fn is_full(&self) -> bool {
        self.small.len() >= self.room
    }

    pub(super) fn is_empty(&self) -> bool {
        self.small.is_empty()
    }

    /// Number of the sheet, from 1.
    pub(super) fn number(&self) -> u64 {
        self.before + 1
    }

    /// Returns the sheet as a picture, and begins the next one.
    pub(super) fn take(&mut self) -> Canvas {
        let small = std::mem::take(&mut self.small);
        self.before += 1;
        let columns = self.room.isqrt().clamp(1, COLUMNS).min(small.len()).max(1);
        let high = small.iter().map(|canvas| i64::from(canvas.size().1)).max().unwrap_or(1);
        let rows = small.len().div_ceil(columns);
        let mut sheet = Canvas::default();
        let side = |count: usize, length: i64| (count as i64 * (length + GAP) + GAP) as u32;
        sheet.begin(side(columns, WIDTH), side(rows, high));
        for (number, picture) in small.iter().enumerate() {
            let [column, row] = [number % columns, number / columns].map(|place| place as i64);
            let (left, top) = (GAP + column * (WIDTH + GAP), GAP + row * (high + GAP));
            picture.shrink_into(&mut sheet, Box2 { left, top, width: WIDTH, height: picture.size().1.into() });
        }
        sheet
    }
}
