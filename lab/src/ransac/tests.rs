//! Tests of the extractor as a whole, on rendered frames.

use super::*;
use crate::rendered::{KINECT_HALF, cylinder, plane, render};
use conicflow_geometry::Vector3;
use conicflow_messages::{Item, NoiseModel};

fn scene() -> (Header, Vec<u16>) {
    let wall = plane(Vector3::z(), 3.0);
    let upright = cylinder(Vector3::new(0.1, 0.0, 1.2), Vector3::y(), 0.2, 0.5);
    render(KINECT_HALF, NoiseModel::KINECT_V1, &[upright, wall], 3)
}

fn extract(config: &RansacParameters, (header, pixels): &(Header, Vec<u16>)) -> Vec<Ellipse> {
    let mut extractor = RansacEllipseExtractor::new(config.clone());
    let ellipses = extractor.extract(header, pixels).to_vec();
    assert_eq!(Ellipse::check(header, &ellipses), Ok(()));
    ellipses
}

#[test]
fn the_number_of_trials_is_the_papers() {
    assert_eq!(RansacParameters::default().trials(), 369);
}

#[test]
fn rows_of_a_cylinder_give_its_sections() {
    let config = RansacParameters { max_ellipses: 1, line_step: 8, ..RansacParameters::default() };
    let ellipses = extract(&config, &scene());
    let near: Vec<_> = ellipses.iter().filter(|ellipse| ellipse.center[2] < 2.0).collect();
    assert!(near.len() >= 9, "{} sections", near.len());
    let mean = near.iter().map(|ellipse| ellipse.half_width).sum::<f64>() / near.len() as f64;
    assert!((0.17..0.21).contains(&mean), "mean half width {mean}");
    assert!(near.iter().all(|ellipse| (ellipse.center[0] - 0.1).abs() < 0.03), "{near:?}");
}

#[test]
fn without_a_limit_of_the_ratio_walls_are_ellipses() {
    let config = |min_radius_ratio| RansacParameters {
        conic: EllipseLimits { min_radius_ratio, ..EllipseLimits::default() },
        max_radius_m: 2.0,
        max_ellipses: 1,
        line_step: 8,
        ..RansacParameters::default()
    };
    let (header, pixels) = scene();
    let is_wall = |pixel: &u16| *pixel == 0 || f64::from(*pixel) * header.depth_scale > 2.5;
    let rows = pixels.chunks(header.camera.width as usize).step_by(8);
    let bare = rows.filter(|row| row.iter().all(is_wall)).count();
    let frame = (header, pixels.clone());
    let of_wall = |ratio| extract(&config(ratio), &frame).iter().filter(|found| found.center[2] > 2.5).count();
    let (free, limited) = (of_wall(0.0), of_wall(0.4));
    assert!(bare >= 10 && free * 10 >= bare * 8, "{free} of {bare} lines that show the wall alone");
    assert!(limited <= 3, "{limited} of {bare} lines");
}

#[test]
fn the_same_frame_gives_the_same_ellipses_and_the_next_one_other_draws() {
    let config = RansacParameters { line_step: 24, ..RansacParameters::default() };
    let (header, pixels) = scene();
    let next = (Header { sequence: header.sequence + 1, ..header }, pixels.clone());
    let this = (header, pixels);
    assert_eq!(extract(&config, &this), extract(&config, &this));
    assert_ne!(extract(&config, &this), extract(&config, &next));
}

#[test]
fn columns_see_what_lies() {
    let lying = cylinder(Vector3::new(0.0, 0.0, 1.2), Vector3::x(), 0.15, 0.8);
    let frame = render(KINECT_HALF, NoiseModel::KINECT_V1, &[lying], 4);
    let found = |scan| extract(&RansacParameters { scan, line_step: 16, ..RansacParameters::default() }, &frame);
    let columns = found(ScanLines::Columns);
    assert!(
        columns.len() >= 8 && columns.iter().all(|ellipse| ellipse.direction() == conicflow_messages::Scan::Column)
    );
    assert!(columns.iter().all(|ellipse| (ellipse.half_width - 0.15).abs() < 0.04), "{columns:?}");
    assert_eq!(found(ScanLines::Both).len(), columns.len() + found(ScanLines::Rows).len());
}

#[test]
fn an_image_without_measurements_is_an_empty_list() {
    let frame = render(KINECT_HALF, NoiseModel::IDEAL, &[], 8);
    assert_eq!(extract(&RansacParameters::default(), &frame).len(), 0);
}
