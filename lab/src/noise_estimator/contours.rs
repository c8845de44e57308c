//! Measures how far a sensor shifts the silhouettes of objects, and how far their points scatter, as the assembler of the
//! detection learns them; reported after all frames.

use conicflow_detection::assemble::{ContourErrors, PooledParameters, SideErrors};
use conicflow_detection::{Assembler, AssemblerParameters, Extractor, ExtractorParameters};
use conicflow_geometry::Scan;
use conicflow_messages::{Header, Object};
use std::fmt;

/// Number of images over which the assembler averages: the largest value of that parameter, as the sensor stays the same.
const MEMORY: f64 = 1e6; // [algorithmic]

/// Head of the table.
const HEAD: &str = "\
# contours: how far outside their place silhouettes are seen, offset + share r, less than 0: inside; r is the radius of
# curvature of the surface along the view, in pixels; behind each number its sigma
# side    objects   points   mean r px    offset px        share %    together, px";

/// The contours of the objects in all frames so far.
#[derive(Debug)]
pub struct Contours {
    extractor: Extractor,
    assembler: Assembler,
}

impl Default for Contours {
    fn default() -> Self {
        let pooled = PooledParameters { contour_memory: MEMORY, ..PooledParameters::default() };
        let parameters = AssemblerParameters { pooled, ..AssemblerParameters::default() };
        Self { extractor: Extractor::new(ExtractorParameters::default()), assembler: Assembler::new(parameters) }
    }
}

impl Contours {
    /// Finds the objects of a depth image from the same camera, and learns from their contours.
    pub fn add(&mut self, header: &Header, pixels: &[u16]) -> &[Object] {
        self.assembler.assemble(header, self.extractor.extract(header, pixels))
    }

    /// Returns the errors of contours in rows and in columns, if an object showed them.
    pub fn errors(&self) -> impl Iterator<Item = ContourErrors> {
        self.assembler.contour_errors()
    }
}

/// Writes a table as comments of a pipeline file.
impl fmt::Display for Contours {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let errors: Vec<_> = self.errors().collect();
        if errors.is_empty() {
            return writeln!(f, "# contours: no object was seen that shows where this sensor sees silhouettes");
        }
        writeln!(f, "{HEAD}")?;
        for ContourErrors { scan, objects, sides, .. } in &errors {
            for (name, side) in names(*scan).into_iter().zip(sides).filter(|(_, side)| side.points > 0.0) {
                let SideErrors { points, radius_px, offset_px, share, outside_px } = side;
                write!(f, "# {name:7} {objects:7.0} {points:8.0} {radius_px:11.1}")?;
                for [value, sigma] in [*offset_px, share.map(|share| 100.0 * share), *outside_px] {
                    write!(f, "   {value:6.2} {sigma:5.2}")?;
                }
                writeln!(f)?;
            }
        }
        for ContourErrors { scan, scatter_px, scatter_share, .. } in &errors {
            let lines = if *scan == Scan::Row { "rows" } else { "columns" };
            let percent = 100.0 * scatter_share;
            writeln!(f, "# scatter of a point along {lines}: {scatter_px:.2} px, and beside it {percent:.2} % of r")?;
        }
        Ok(())
    }
}

/// Names the ends of a scan line.
fn names(scan: Scan) -> [&'static str; 2] {
    match scan {
        Scan::Row => ["left", "right"],
        Scan::Column => ["top", "bottom"],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::CounterRng;
    use crate::rendered::{KINECT_HALF, cylinder, plane, render};
    use conicflow_geometry::Vector3;
    use conicflow_messages::NoiseModel;

    /// Depth that separates the cylinders from the wall, in metres.
    const BETWEEN_M: f64 = 3.0;

    /// Upright cylinders of several radii in front of a wall.
    fn cylinders() -> Vec<(Header, Vec<u16>)> {
        let wall = plane(Vector3::z(), 4.0);
        let radii = [0.05, 0.08, 0.12, 0.18];
        let body = |seed: u64| {
            let center = Vector3::new(0.03 * (seed % 5) as f64, 0.01, 1.4 + 0.017 * (seed % 7) as f64);
            cylinder(center, Vector3::y(), radii[seed as usize % radii.len()], 0.6)
        };
        (0..24).map(|seed| render(KINECT_HALF, NoiseModel::KINECT_V1, &[body(seed), wall], seed)).collect()
    }

    /// Returns an image with the silhouettes of the cylinder shifted outwards by `shift` pixels at both ends of each row; its
    /// arguments are the side, half the width in pixels, and a random number from 0 to 1.
    fn shifted(
        (header, pixels): &(Header, Vec<u16>),
        dice: &CounterRng,
        shift: impl Fn(usize, f64, f64) -> f64,
    ) -> Vec<u16> {
        let is_near = |z: &u16| *z > 0 && f64::from(*z) * header.depth_scale < BETWEEN_M;
        let shifted_row = |(number, row): (usize, &[u16])| {
            let mut shifted = row.to_vec();
            let Some(first) = row.iter().position(is_near) else { return shifted };
            let last = row.iter().rposition(is_near).unwrap();
            let by = |side: usize| {
                let draw = |i: u64| dice.uniform(4 * number as u64 + 2 * side as u64 + i);
                // Rounds to whole pixels without bias.
                (shift(side, 0.5 * (last - first) as f64, draw(0)) + draw(1)).floor() as isize
            };
            let (begin, end) = (first.saturating_add_signed(-by(0)), last.saturating_add_signed(by(1)));
            // Pixels of the other side, mirrored at the silhouette, replace the covered ones.
            (begin.min(first)..begin.max(first)).for_each(|u| shifted[u] = row[2 * first - 1 - u]);
            (end.min(last) + 1..=end.max(last)).for_each(|u| shifted[u] = row[2 * last + 1 - u]);
            shifted
        };
        pixels.chunks(header.camera.width as usize).enumerate().flat_map(shifted_row).collect()
    }

    /// Returns the image with rows and columns exchanged.
    fn turned((header, pixels): &(Header, Vec<u16>)) -> (Header, Vec<u16>) {
        let camera = header.camera;
        let (width, height) = (camera.width as usize, camera.height as usize);
        let turned = (0..width).flat_map(|u| (0..height).map(move |v| pixels[v * width + u])).collect();
        let (width, height, cx, cy) = (camera.height, camera.width, camera.cy, camera.cx);
        (Header { camera: conicflow_messages::Camera { width, height, cx, cy, ..camera }, ..*header }, turned)
    }

    fn contours(images: impl Iterator<Item = (Header, Vec<u16>)>) -> Contours {
        let mut contours = Contours::default();
        images.for_each(|(header, pixels)| {
            contours.add(&header, &pixels);
        });
        contours
    }

    /// Returns the errors learned from cylinders by a sensor that shifts silhouettes.
    fn learned(shift: impl Fn(usize, f64, f64) -> f64) -> Contours {
        let images = cylinders();
        let shifted = |(number, image): (usize, &(Header, Vec<u16>))| {
            (image.0, shifted(image, &CounterRng::new(7, number as u64), &shift))
        };
        contours(images.iter().enumerate().map(shifted))
    }

    /// Returns the errors in rows or in columns, and checks that there are no others.
    fn only(contours: &Contours, scan: Scan) -> ContourErrors {
        let errors: Vec<_> = contours.errors().collect();
        assert_eq!(errors.iter().map(|errors| errors.scan).collect::<Vec<_>>(), [scan]);
        errors[0]
    }

    fn assert_outside(errors: &ContourErrors, expected: [f64; 2]) {
        for (side, expected) in errors.sides.iter().zip(expected) {
            assert!((side.outside_px[0] - expected).abs() < 0.2 && side.outside_px[1] < 0.1, "{expected}: {errors:?}");
        }
    }

    #[test]
    fn a_sensor_that_sees_silhouettes_where_they_are_has_no_bias_and_the_scatter_of_a_pixel() {
        let errors = only(&learned(|_, _, _| 0.0), Scan::Row);
        assert_outside(&errors, [0.0, 0.0]);
        let pixel = (1.0_f64 / 12.0).sqrt();
        assert!((errors.scatter_px - pixel).abs() < 0.05 && errors.scatter_share < 0.01, "{errors:?}");
        assert_eq!(errors.objects.round(), 24.0);
        // Each row of a cylinder shows both sides; their distance from the axis in pixels is its radius.
        let (rows, radii) = ((110.0..130.0), (20.0..24.0));
        for side in errors.sides {
            assert!(rows.contains(&(side.points / 24.0)) && radii.contains(&side.radius_px), "{errors:?}");
        }
    }

    #[test]
    fn an_offset_is_told_of_each_side_by_itself() {
        let errors = only(&learned(|side, _, _| [-2.0, 1.0][side]), Scan::Row);
        assert_outside(&errors, [-2.0, 1.0]);
        for (side, expected) in errors.sides.iter().zip([-2.0, 1.0]) {
            assert!((side.offset_px[0] - expected).abs() < 0.4 && side.share[0].abs() < 0.02, "{errors:?}");
        }
    }

    #[test]
    fn what_goes_with_the_size_is_told_as_a_share_of_the_radius() {
        for share in [-0.04, 0.04] {
            let errors = only(&learned(|_, half, _| share * half), Scan::Row);
            assert_outside(&errors, errors.sides.map(|side| share * side.radius_px));
            for side in errors.sides {
                assert!((side.share[0] - share).abs() < 0.015 && side.offset_px[0].abs() < 0.4, "{errors:?}");
            }
        }
    }

    /// Silhouettes that scatter uniformly within two pixels, and are rounded to whole pixels.
    #[test]
    fn restless_silhouettes_scatter() {
        let errors = only(&learned(|_, _, draw| 4.0 * draw - 2.0), Scan::Row);
        assert_outside(&errors, [0.0, 0.0]);
        let expected = (16.0_f64 / 12.0 + 2.0 / 12.0).sqrt();
        let seen = errors.scatter_px.hypot(errors.scatter_share * errors.sides[0].radius_px);
        assert!((seen / expected - 1.0).abs() < 0.1, "{seen} {expected}: {errors:?}");
    }

    #[test]
    fn columns_begin_at_the_top_and_end_at_the_bottom() {
        let shift = |side: usize, _, _| [-2.0, 1.0][side];
        let shifted = |(header, pixels): (Header, Vec<u16>)| {
            let shifted = shifted(&(header, pixels), &CounterRng::new(7, 0), shift);
            turned(&(header, shifted))
        };
        let contours = contours(cylinders().into_iter().map(shifted));
        assert_outside(&only(&contours, Scan::Column), [-2.0, 1.0]);
        let text = contours.to_string();
        let numbers = |side: &str| -> Vec<f64> {
            let line = text.lines().find(|line| line.starts_with(&format!("# {side} "))).unwrap();
            line.split_whitespace().skip(2).map(|number| number.parse().unwrap()).collect()
        };
        let [top, bottom] = ["top", "bottom"].map(numbers);
        assert_eq!((top.len(), top[0], bottom[0]), (9, 24.0, 24.0), "{text}");
        assert!((top[7] + 2.0).abs() < 0.2 && (bottom[7] - 1.0).abs() < 0.2, "{text}");
        assert!(text.contains("# scatter of a point along columns: 0.") && !text.contains("rows"), "{text}");
    }

    #[test]
    fn where_no_object_was_seen_nothing_is_told() {
        let wall = plane(Vector3::z(), 2.0);
        let images = (0..2).map(|seed| render(KINECT_HALF, NoiseModel::KINECT_V1, &[wall], seed));
        let contours = contours(images);
        assert_eq!(contours.errors().count(), 0);
        assert!(contours.to_string().starts_with("# contours: no object was seen"), "{contours}");
    }
}
