//! Measures ellipses against one true section: how often it was found, and mean and standard deviation of its semi-axes.

use super::row::Statistic::{Deviation, Mean};
use super::row::{Column, Row, Sums};
use conicflow_messages::Ellipse;

/// The columns for ellipses that match the section, with their distances from its centre.
const FOUND: &[Column<(Ellipse, f64)>] = &[
    Column("long_m", Mean, |(ellipse, _)| Some(ellipse.semi_axes[0])),
    Column("long_sd_m", Deviation, |(ellipse, _)| Some(ellipse.semi_axes[0])),
    Column("short_m", Mean, |(ellipse, _)| Some(ellipse.semi_axes[1])),
    Column("short_sd_m", Deviation, |(ellipse, _)| Some(ellipse.semi_axes[1])),
    Column("offset_m", Mean, |(_, offset)| Some(*offset)),
    Column("rms_m", Mean, |(ellipse, _)| Some(ellipse.rms)),
];

/// Figures of one section over all frames.
pub struct Sections {
    center: [f64; 2],
    max_offset_m: f64,
    frames: u64,
    found: u64,
    others: u64,
    sums: Sums<(Ellipse, f64)>,
}

impl Sections {
    /// Returns the names of the columns of its row.
    pub fn columns() -> impl Iterator<Item = &'static str> {
        ["object", "frames", "n", "others"].into_iter().chain(FOUND.iter().map(|Column(name, ..)| *name))
    }

    /// Creates the sums for a section whose centre in the plane of its scan line is at `center`; an ellipse within `max_offset_m`
    /// matches it.
    pub fn new(center: [f64; 2], max_offset_m: f64) -> Self {
        Self { center, max_offset_m, frames: 0, found: 0, others: 0, sums: Sums::new(FOUND) }
    }

    /// Adds the ellipses of a frame; the one nearest to the section, if it is near enough, matches it.
    pub fn add(&mut self, ellipses: &[Ellipse]) {
        self.frames += 1;
        self.others += ellipses.len() as u64;
        let offset = |ellipse: &Ellipse| {
            let [s, t] = ellipse.plane_center;
            (s - self.center[0]).hypot(t - self.center[1])
        };
        let offsets = ellipses.iter().map(|ellipse| (*ellipse, offset(ellipse)));
        let near = offsets.filter(|(_, offset)| *offset <= self.max_offset_m);
        if let Some(nearest) = near.min_by(|(_, a), (_, b)| a.total_cmp(b)) {
            self.found += 1;
            self.others -= 1;
            self.sums.add(&nearest);
        }
    }

    /// Returns the figures.
    pub fn row(&self) -> Row {
        let mut row = Row::about("section", self.frames, self.found);
        row.count("others", self.others);
        self.sums.write(&mut row);
        row
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_ellipse_is_the_section_and_the_others_are_not() {
        let ellipse =
            |s: f64, long: f64| Ellipse { plane_center: [0.5 + s, 2.0], semi_axes: [long, 0.2], ..Ellipse::default() };
        let mut sections = Sections::new([0.5, 2.0], 0.25);
        sections.add(&[ellipse(0.2, 9.0), ellipse(0.01, 0.41), ellipse(1.0, 9.0)]);
        sections.add(&[ellipse(0.01, 0.39)]);
        sections.add(&[ellipse(0.3, 9.0)]);
        let row = sections.row();
        let number = |column: &str| row.number_of(column).unwrap();
        assert!(row.0.iter().map(|(column, _)| column.as_str()).eq(Sections::columns()));
        assert_eq!(["frames", "n", "others"].map(number), [3.0, 2.0, 3.0]);
        assert!((number("long_m") - 0.4).abs() < 1e-12 && (number("long_sd_m") - 0.02_f64.sqrt() / 10.0).abs() < 1e-12);
    }
}
