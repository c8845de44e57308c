use super::*;
use crate::assemble::{Assembler, AssemblerParameters};
use conicflow_geometry::Scan;
use conicflow_geometry::Vector3;
use conicflow_lab::rendered::{KINECT_HALF, block, cylinder, plane, render, scene_of, sphere};
use conicflow_lab::simulator::random_scene::{SceneGroup, random_scene};
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::sensor::{SensorConfig, SensorTable};
use conicflow_lab::simulator::shapes::Shape;
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Camera, END_POINTS, Header, Item, NoiseModel, Object};
use std::collections::BTreeSet;

fn config(scan: ScanLines) -> ExtractorParameters {
    ExtractorParameters { scan, ..ExtractorParameters::default() }
}

fn arcs(config: ExtractorParameters, (header, pixels): &(Header, Vec<u16>)) -> Vec<Ellipse> {
    let arcs = Extractor::new(config).extract(header, pixels).to_vec();
    assert_eq!(Ellipse::check(header, &arcs), Ok(()));
    arcs
}

fn can(x: f64, z: f64, radius: f64) -> Shape {
    cylinder(Vector3::new(x, 0.0, z), Vector3::y(), radius, 0.5)
}

fn wall(z: f64) -> Shape {
    plane(Vector3::z(), z)
}

fn room(seed: u64) -> (Header, Vec<u16>) {
    let floor = plane(Vector3::y(), 0.25);
    let ball = sphere(Vector3::new(0.5, 0.1, 1.4), 0.15);
    let block = block(Vector3::new(-0.5, 0.1, 1.7), Vector3::new(0.3, 0.3, 0.3), 0.4);
    render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(0.0, 1.6, 0.12), ball, block, floor, wall(3.0)], seed)
}

#[test]
fn lines_between_the_coarse_ones_show_as_much_as_those() {
    let arcs = arcs(config(ScanLines::Rows), &render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(0.1, 1.5, 0.2)], 1));
    // The near side of the can is in rows 64 to 175; the outermost coarse lines there are 64 and 172.
    for line in 65..175 {
        let widest = arcs.iter().filter(|arc| arc.line == line).map(|arc| arc.points).max();
        assert!(widest.is_some_and(|points| points > 40), "{widest:?} points in row {line}");
    }
}

#[test]
fn the_radius_of_an_arc_is_free_of_the_noise() {
    let arcs = arcs(config(ScanLines::Rows), &render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(0.0, 2.2, 0.2)], 2));
    let mut radii: Vec<f64> = arcs.iter().filter(|arc| arc.points > 40).map(|arc| arc.half_width).collect();
    radii.sort_by(f64::total_cmp);
    assert!(radii.len() > 50 && (radii[radii.len() / 2] - 0.2).abs() < 0.01, "{radii:?}");
}

#[test]
fn columns_are_the_rows_of_the_turned_image() {
    let (header, pixels) = room(3);
    let Camera { width, height, fx, fy, cx, cy } = header.camera;
    let camera = Camera { width: height, height: width, fx: fy, fy: fx, cx: cy, cy: cx };
    let turned: Vec<u16> = (0..width * height).map(|i| pixels[(i % height * width + i / height) as usize]).collect();
    // The noise level of an image is estimated from its rows, so it is set here.
    let found = |header: &Header, pixels: &[u16], scan| {
        let mut extractor = Extractor::new(config(ScanLines::Both));
        extractor.noise = NoiseEstimate::nominal(header.noise);
        extractor.search_along(header, pixels, scan);
        extractor.ellipses
    };
    let columns = found(&header, &pixels, Scan::Column);
    let rows = found(&Header { camera, ..header }, &turned, Scan::Row);
    assert!(columns.len() > 30 && columns.len() == rows.len(), "{} and {} arcs", columns.len(), rows.len());
    for (column, row) in columns.iter().zip(&rows) {
        assert_eq!((column.line, column.first, column.last), (row.line, row.first, row.last));
        assert!((column.half_width - row.half_width).abs() < 1e-9 * row.half_width);
    }
}

#[test]
fn arcs_come_in_the_order_of_scan_line_and_pixel() {
    let arcs = arcs(config(ScanLines::Both), &room(4));
    assert!(arcs.iter().any(|arc| arc.scan == 0) && arcs.iter().any(|arc| arc.scan == 1));
    for pair in arcs.windows(2) {
        let key = |arc: &Ellipse| (arc.scan, arc.line, arc.first);
        assert!(key(&pair[0]) < key(&pair[1]), "{pair:?}");
        let one_line = (pair[0].scan, pair[0].line) == (pair[1].scan, pair[1].line);
        assert!(!one_line || pair[0].last < pair[1].first, "{pair:?}");
    }
}

#[test]
fn lines_that_are_stepped_over_are_not_looked_at() {
    for line_step in [2, 3, 7] {
        let arcs = arcs(ExtractorParameters { line_step, ..config(ScanLines::Rows) }, &room(5));
        assert!(arcs.len() > 10 && arcs.iter().all(|arc| arc.line % line_step == 0), "every {line_step} lines");
    }
}

/// The arc of a can before a wall in one row of an image, after `change` has changed pixels of that row.
fn arc_in_row(row: u32, change: impl FnOnce(&mut [u16])) -> Ellipse {
    let (header, mut pixels) = render(KINECT_HALF, NoiseModel::IDEAL, &[can(0.0, 1.5, 0.08), wall(3.0)], 9);
    let width = header.camera.width as usize;
    change(&mut pixels[row as usize * width..][..width]);
    let header = Header { noise: NoiseModel::KINECT_V1, ..header };
    *arcs(config(ScanLines::Rows), &(header, pixels)).iter().find(|arc| arc.line == row).unwrap()
}

#[test]
fn a_pixel_between_two_jumps_is_of_neither_side() {
    let plain = arc_in_row(120, |_| {});
    let last = plain.contour[1] as usize;
    assert!(plain.contour[0] > 0.0 && last > 0);
    for units_before_the_wall in [12_000, 7_000, 1_500] {
        let arc = arc_in_row(120, |row| row[last + 1] -= units_before_the_wall);
        assert_eq!(arc.contour, [plain.contour[0], plain.contour[1] + 0.5], "{units_before_the_wall}");
        assert_eq!((arc.first, arc.last), (plain.first, plain.last));
    }
    let hidden = arc_in_row(120, |row| row[last + 1..last + 20].fill(9000));
    assert_eq!(hidden.contour, [plain.contour[0], 0.0]);
}

#[test]
fn an_arc_ends_where_a_flat_side_goes_on_from_it() {
    let (distance, radius) = (1.5, 0.2);
    let (header, mut pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(0.0, distance, radius), wall(3.0)], 9);
    let camera = crate::camera::pinhole(&header.camera);
    let near_side = |pixel: u32| {
        let slope = camera.ray_slope(Scan::Row, f64::from(pixel));
        let square = 1.0 + slope * slope;
        (distance - (distance * distance - square * (distance * distance - radius * radius)).sqrt()) / square
    };
    let (edge, width) = (180, header.camera.width);
    let steepness = near_side(edge) - near_side(edge - 1) + 0.006;
    for (index, depth) in (0..).zip(&mut pixels) {
        let pixel = index % width;
        if (edge..edge + 20).contains(&pixel) && (60..180).contains(&(index / width)) {
            let flat = near_side(edge) + steepness * f64::from(pixel - edge);
            *depth = depth.saturating_add_signed(((flat - near_side(pixel)) / header.depth_scale) as i16);
        }
    }
    let arcs = arcs(config(ScanLines::Rows), &(header, pixels));
    let mut ends: Vec<u32> =
        arcs.iter().filter(|arc| (70..170).contains(&arc.line) && arc.first < 160).map(|arc| arc.last).collect();
    ends.sort_unstable();
    let [few, half, most] = [ends.len() / 10, ends.len() / 2, ends.len() * 9 / 10].map(|at| ends[at]);
    assert!(ends.len() > 90 && half.abs_diff(edge) <= 2 && few + 5 > edge && most < edge + 5, "{ends:?}");
}

#[test]
fn an_end_that_is_off_the_circle_is_left_off() {
    let plain = arc_in_row(120, |_| {});
    let last = plain.contour[1] as usize;
    assert_eq!(plain.last as usize, last, "the outermost pixel is on the circle");
    let arc = arc_in_row(120, |row| row[last] += 300);
    assert_eq!((arc.first, arc.last as usize), (plain.first, last - 1));
    assert!((arc.half_width / plain.half_width - 1.0).abs() < 0.01);
    let wider = arc_in_row(120, |row| row[last + 1] = row[last]);
    assert_eq!(wider.contour[1], plain.contour[1] + 1.0);
    assert_eq!(wider.last as usize, last, "the ray of the pixel beyond passes the circle");
}

/// The arc in the middle row of a board before a noisy wall, and the width of the board in metres. The board reaches `half`
/// pixels to each side, and its middle bends away from the camera by `bend` metres.
fn arc_of_board(half: i32, ends: f64, bend: f64, max_radius_m: f64) -> (Option<Ellipse>, f64) {
    let (header, mut pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[wall(5.0)], 9);
    let (row, middle) = (120, 160);
    for (y, x) in (row - 20..row + 20).flat_map(|y| (-half..=half).map(move |x| (y, x))) {
        let depth = ends + bend * (1.0 - f64::from(x * x) / f64::from(half * half));
        let pixel = y * header.camera.width as i32 + middle + x;
        pixels[pixel as usize] = (depth / header.depth_scale).round() as u16;
    }
    let config = ExtractorParameters { max_radius_m, ..config(ScanLines::Rows) };
    let is_it = |arc: &Ellipse| arc.line == row as u32 && (arc.first..=arc.last).contains(&(middle as u32));
    let arc = arcs(config, &(header, pixels)).into_iter().find(is_it);
    (arc, f64::from(2 * half) * ends / header.camera.fx)
}

/// Noise bends a flat board. On a narrow board that counts as an arc, because many weak arcs together are strong evidence.
#[test]
fn a_flat_board_is_bent_in_more_of_its_rows_where_it_is_narrow() {
    let bent = |width_m: f64| {
        let board = block(Vector3::new(0.0, 0.0, 1.5), Vector3::new(width_m, 0.9, 0.1), 0.0);
        let config = ExtractorParameters { max_radius_m: 1.0, ..config(ScanLines::Rows) };
        let shots = (0..8).map(|seed| render(KINECT_HALF, NoiseModel::KINECT_V1, &[board, wall(5.0)], seed));
        let mut arcs: Vec<_> = shots.flat_map(|shot| arcs(config.clone(), &shot)).collect();
        arcs.retain(|arc| (arc.first..=arc.last).contains(&160));
        assert!(arcs.len() > 400, "{} arcs", arcs.len());
        arcs.iter().filter(|arc| arc.half_width < 4.0).count() as f64 / arcs.len() as f64
    };
    let (narrow, wide) = (bent(0.06), bent(0.16));
    assert!(narrow > 5.0 * wide, "{narrow} and {wide}");
}

/// A surface that bends away from the camera may be an object that noise bends so. Far away, where noise is large, a line
/// explains one that bends towards the camera as well.
#[test]
fn what_is_wider_than_any_object_may_be_is_none_although_jumps_set_it_off() {
    for (half, ends, bend) in [(40, 1.5, 0.04), (22, 4.0, -0.055)] {
        let (_, width_m) = arc_of_board(half, ends, bend, 1.0);
        let is_arc = |max_radius_m: f64| arc_of_board(half, ends, bend, max_radius_m).0.is_some();
        assert_eq!([0.501, 0.499].map(|share| is_arc(share * width_m)), [true, false], "{ends} m away");
    }
}

#[test]
fn any_number_of_points_may_be_taken_off_the_ends() {
    for seed in 5..8 {
        let points = |trim_px| {
            let arcs = arcs(ExtractorParameters { trim_px, ..config(ScanLines::Both) }, &room(seed));
            arcs.iter().map(|arc| arc.points).sum::<u32>()
        };
        let left = [0, 1, 2, 4, 8, 12, 16].map(points);
        assert!(left.iter().all(|&points| points > 0) && left[6] < left[1], "{left:?}");
    }
}

#[test]
fn a_floor_and_a_wall_give_next_to_nothing() {
    let floor = plane(Vector3::new(0.0, 0.9, 0.3).normalize(), 0.9);
    let arcs = arcs(config(ScanLines::Both), &render(KINECT_HALF, NoiseModel::KINECT_V1, &[floor, wall(2.5)], 6));
    assert!(arcs.len() < 20, "{} arcs", arcs.len());
}

#[test]
fn the_noise_level_is_that_of_the_image() {
    let bodies = [can(0.0, 1.5, 0.2), wall(2.5)];
    let level = |noise| {
        let (header, pixels) = render(KINECT_HALF, noise, &bodies, 7);
        let header = Header { noise: NoiseModel::KINECT_V1, ..header };
        let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &pixels);
        seen.level * seen.model.variance(2.0) / header.noise.variance(2.0)
    };
    let (as_told, none) = (level(NoiseModel::KINECT_V1), level(NoiseModel::IDEAL));
    assert!((0.85..1.15).contains(&as_told) && none < 0.1, "{as_told} and {none}");
    for factor in [1.2, 1.5, 2.0, 3.0] {
        let ratio = level(NoiseModel::KINECT_V1.times(factor)) / (factor * factor);
        assert!((0.85..1.15).contains(&ratio), "{ratio} at {factor}");
    }
}

#[test]
fn who_asks_is_told_how_noisy_an_image_was_and_what_was_turned_down_in_it() {
    let (header, pixels) = noisy_can(0.03, 320);
    let mut extractor = Extractor::new(config(ScanLines::Rows));
    extractor.extract(&Header { noise: header.noise.times(1.0 / 1.5), ..header }, &pixels);
    assert!(extractor.noise_ratios().iter().all(|ratio| (1.4..1.6).contains(ratio)), "{:?}", extractor.noise_ratios());
    let lines = extractor.rejections().find(|(words, _)| words.contains("line")).map(|(_, times)| times);
    assert!(lines.is_some_and(|times| times > 10), "the wall: {:?}", extractor.rejections().collect::<Vec<_>>());
    extractor.extract(&header, &vec![0; pixels.len()]);
    assert_eq!(extractor.rejections().count(), 0);
}

#[test]
fn a_model_that_grows_wrongly_is_replaced() {
    let floor = plane(Vector3::new(0.0, 0.9, 0.3).normalize(), 0.9);
    let kinect = NoiseModel::KINECT_V1;
    let even = NoiseModel { floor_m: 0.002, ..NoiseModel::IDEAL };
    for told in [even, NoiseModel::IDEAL] {
        let (header, pixels) = render(KINECT_HALF, kinect, &[can(0.0, 1.5, 0.2), floor, wall(3.5)], 7);
        let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(&Header { noise: told, ..header }, &pixels);
        assert!(seen.variance_ratios[0] != seen.variance_ratios[1], "{seen:?}");
        for depth in [1.5, 2.0, 2.5, 3.0] {
            let ratio = (seen.level * seen.model.variance(depth) / kinect.variance(depth)).sqrt();
            assert!((0.8..1.25).contains(&ratio), "{ratio} at {depth} m, told {told:?}");
        }
    }
    let (header, pixels) = render(KINECT_HALF, kinect, &[can(0.0, 1.5, 0.2), floor, wall(3.5)], 7);
    let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &pixels);
    assert_eq!(seen.model, kinect, "one that grows rightly is not");
}

/// A scene as a Kinect sees it, with steps of the disparity; `noise_window_px` is the width of the windows that share noise.
fn shot(scene: Scene, noise_window_px: u32, width: u32, seed: u64) -> (Header, Vec<u16>) {
    let noise = SensorConfig::Table(SensorTable { noise_window_px, ..SensorTable::default() });
    let config = SimulatorParameters { width, height: width / 4 * 3, noise, ..SimulatorParameters::default() };
    let mut camera = SyntheticCamera::new(scene, config.camera(), config.noise, config.depth_scale, 30.0, seed);
    let (mut header, mut pixels) = (Header::default(), vec![0; (config.width * config.height) as usize]);
    camera.shoot(0, &mut pixels);
    camera.describe(&mut header);
    (header, pixels)
}

/// If noisy depths divided the image into halves, the noise of the halves would differ: some pixels of the wall would count as
/// near because of their errors.
#[test]
fn a_small_thing_alone_before_a_wall_does_not_change_the_noise() {
    let thing = cylinder(Vector3::z() * 0.8, Vector3::y(), 0.03, 0.15);
    for seed in 0..6 {
        let (header, pixels) = shot(scene_of(&[thing, wall(1.8)]), 1, 640, seed);
        let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &pixels);
        assert_eq!(seen.model, header.noise, "{seen:?} with seed {seed}");
    }
}

/// The same image with every second pixel of every second row.
fn halved((header, pixels): &(Header, Vec<u16>)) -> (Header, Vec<u16>) {
    let Camera { width, height, fx, fy, cx, cy } = header.camera;
    let rows = pixels.chunks(width as usize).step_by(2);
    let pixels = rows.flat_map(|row| row.iter().step_by(2).copied()).collect();
    let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(|number| 0.5 * number);
    (Header { camera: Camera { width: width / 2, height: height / 2, fx, fy, cx, cy }, ..*header }, pixels)
}

/// Clutter is bent: between pixels with twice the spacing in the view that would look like noise.
#[test]
fn half_of_an_image_is_not_noisier() {
    for seed in 0..7 {
        let whole = shot(random_scene(SceneGroup::Furnished, seed), 3, 640, seed);
        let sigma = |(header, pixels): &(Header, Vec<u16>)| {
            let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(header, pixels);
            (seen.level * seen.model.variance(2.0)).sqrt()
        };
        let ratio = sigma(&halved(&whole)) / sigma(&whole);
        assert!((0.85..1.15).contains(&ratio), "{ratio} with seed {seed}");
    }
}

/// Number of neighbouring pixels that share their noise in a room, as estimated, for a sensor with windows of this width.
fn correlation_px(noise_window_px: u32, width: u32, seed: u64) -> [f64; 2] {
    let (header, pixels) = shot(random_scene(SceneGroup::Clutter, seed), noise_window_px, width, seed);
    Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &pixels).correlation_px
}

#[test]
fn as_many_pixels_share_their_noise_as_do() {
    for (width, window) in [(320, 1), (320, 3), (320, 5), (640, 1), (640, 5), (640, 13), (1280, 31)] {
        let rooms: Vec<_> = (0..7).map(|seed| correlation_px(window, width, seed)).collect();
        for direction in [0, 1] {
            let mut shared: Vec<_> = rooms.iter().map(|room| room[direction]).collect();
            shared.sort_unstable_by(f64::total_cmp);
            // Steps of the disparity give each pixel some noise of its own.
            let (median, all) = (shared[3], f64::from(window));
            assert!((0.6 * all..1.5 * all + 0.5).contains(&median), "{shared:?} of {all}, {width} pixels");
        }
    }
}

#[test]
fn silhouettes_and_creases_are_not_taken_for_noise() {
    for seed in 20..30 {
        let (header, pixels) = room(seed);
        let level = Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &pixels).level;
        assert!((0.85..1.15).contains(&level), "{level} in room {seed}");
    }
}

#[test]
fn the_outermost_points_of_an_arc_are_told_as_far_as_they_are_neighbours() {
    let (header, mut pixels) = render(KINECT_HALF, NoiseModel::IDEAL, &[can(0.0, 0.7, 0.2), wall(3.0)], 1);
    let row = 120 * header.camera.width;
    // Something nearer hides its right half, so its end there is not steep.
    pixels.chunks_mut(320).for_each(|row| row[160..].fill((0.4 / header.depth_scale) as u16));
    let mut lengths = BTreeSet::new();
    for hole in 148..160 {
        let mut pixels = pixels.clone();
        pixels[(row + hole) as usize] = 0;
        let depth = |pixel: u32| f64::from(pixels[(row + pixel) as usize]) * header.depth_scale;
        let mut arcs = arcs(config(ScanLines::Rows), &(header, pixels.clone()));
        arcs.retain(|arc| arc.line == 120 && arc.first < 160);
        let [Ellipse { first, last, ends, .. }] = arcs[..] else { panic!("{arcs:?}") };
        let inwards: [u32; END_POINTS] = std::array::from_fn(|n| n as u32);
        for (end, shown) in ends.iter().zip([inwards.map(|n| depth(first + n)), inwards.map(|n| depth(last - n))]) {
            let next = shown.iter().take_while(|depth| **depth > 0.0).count();
            assert_eq!(end[..next], shown[..next], "hole {hole}");
            assert_eq!(end[next..], [0.0; END_POINTS][next..], "hole {hole}");
        }
        lengths.insert(ends[1].iter().filter(|depth| **depth > 0.0).count());
    }
    assert_eq!(lengths, (1..=END_POINTS).collect());
}

#[test]
fn no_point_of_a_short_arc_is_told_at_both_ends() {
    let frame = render(KINECT_HALF, NoiseModel::IDEAL, &[can(0.0, 1.4, 0.025), wall(3.0)], 1);
    let arcs = arcs(config(ScanLines::Rows), &frame);
    let told = |arc: &Ellipse| arc.ends.map(|end| end.iter().filter(|depth| **depth > 0.0).count());
    let short: Vec<_> = arcs.iter().filter(|arc| arc.points < 2 * END_POINTS as u32).collect();
    assert!(short.len() > 20, "{arcs:?}");
    assert!(short.iter().all(|arc| told(arc) == [arc.points as usize / 2; 2]), "{short:?}");
}

/// A can before a wall with independent noise of `sigma_m` per pixel, in an image of this width in pixels.
fn noisy_can(sigma_m: f64, width: u32) -> (Header, Vec<u16>) {
    let noise = NoiseModel { floor_m: sigma_m, ..NoiseModel::IDEAL };
    let scale = f64::from(width) / f64::from(KINECT_HALF.width);
    let Camera { fx, fy, cx, cy, .. } = KINECT_HALF;
    let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(|pixels| pixels * scale);
    let camera = Camera { width, height: width * 3 / 4, fx, fy, cx, cy };
    render(camera, noise, &[can(0.0, 2.0, 0.2), wall(2.6)], 1)
}

#[test]
fn lines_are_averaged_where_noise_hides_their_jumps() {
    for (sigma_m, width, averaged, step) in [(0.003, 320, 1, 1), (0.03, 320, 5, 1), (0.03, 1280, 5, 2)] {
        let image = noisy_can(sigma_m, width);
        let mut extractor = Extractor::new(config(ScanLines::Both));
        let arcs = extractor.extract(&image.0, &image.1).to_vec();
        assert_eq!(extractor.noise.averaged, [averaged; 2], "{sigma_m}");
        for scan in [0, 1] {
            let mut wide: Vec<&Ellipse> = arcs.iter().filter(|arc| arc.scan == scan && arc.points > 20).collect();
            wide.sort_by(|a, b| a.sigma.total_cmp(&b.sigma));
            assert!(!wide.is_empty(), "no arc of scan {scan} at {sigma_m}");
            let arc = wide[wide.len() / 2];
            let ratio = arc.sigma / sigma_m * f64::from(averaged).sqrt();
            assert!((0.85..1.25).contains(&ratio), "{ratio} at {sigma_m}, {width}");
            let shared = arc.shared_lines / f64::from(averaged);
            assert!((0.9..1.6).contains(&shared) && arc.line_step == step, "{shared} at {sigma_m}, {width}");
            let told = arc.averaged_lines / f64::from(averaged);
            assert!((0.75..1.05).contains(&told), "{told} at {sigma_m}, {width}");
        }
    }
}

#[test]
fn what_could_not_be_averaged_is_as_noisy_as_it_is() {
    let mut arcs = arcs(config(ScanLines::Rows), &noisy_can(0.03, 640));
    arcs.retain(|arc| arc.points > 80 && (0.15..0.25).contains(&arc.half_width));
    // Above the upper end of the can is the wall.
    let first = arcs[0];
    arcs.sort_by(|a, b| a.sigma.total_cmp(&b.sigma));
    let within = &arcs[arcs.len() / 2];
    assert!(first.sigma > 1.2 * within.sigma && first.shared_lines < 0.7 * within.shared_lines, "{first:?} {within:?}");
}

#[test]
fn a_can_in_much_noise_ends_where_it_does() {
    let image = noisy_can(0.02, 640);
    let arcs = arcs(config(ScanLines::Rows), &image);
    // The silhouette of the can: half its width in pixels, between the tangents from the camera.
    let edge = image.0.camera.fx * 0.2 / (2.0_f64.powi(2) - 0.2_f64.powi(2)).sqrt();
    let mut off: Vec<f64> = arcs
        .iter()
        .flat_map(|arc| [image.0.camera.cx - arc.contour[0], arc.contour[1] - image.0.camera.cx])
        .map(|place| place - edge)
        .filter(|off| off.abs() < 10.0)
        .collect();
    off.sort_by(f64::total_cmp);
    assert!(off.len() > 200, "{} ends before the wall", off.len());
    assert!(off[off.len() / 2].abs() < 2.0, "{} pixels", off[off.len() / 2]);
}

fn points_of_arcs(room: &(Header, Vec<u16>)) -> f64 {
    arcs(config(ScanLines::Both), room).iter().map(|arc| f64::from(arc.points)).sum()
}

#[test]
fn what_is_noisier_than_its_model_shows_nearly_the_same_arcs() {
    for seed in 30..34 {
        let mut room = room(seed);
        let right = points_of_arcs(&room);
        room.0.noise = room.0.noise.times(1.0 / 1.6);
        let ratio = points_of_arcs(&room) / right;
        assert!((0.9..1.1).contains(&ratio), "{ratio} in room {seed}");
    }
}

#[test]
fn a_blank_image_is_as_noisy_as_its_model() {
    let (header, pixels) = room(8);
    let seen = Extractor::new(config(ScanLines::Rows)).estimate_noise(&header, &vec![0; pixels.len()]);
    assert_eq!(seen, NoiseEstimate { correlation_px: noise_planes::UNSEEN, ..NoiseEstimate::nominal(header.noise) });
}

#[test]
fn after_two_rounds_nothing_is_allocated() {
    let rooms: Vec<_> = (10..14).map(room).collect();
    let mut extractor = Extractor::new(config(ScanLines::Both));
    let mut round = || rooms.iter().map(|(header, pixels)| extractor.extract(header, pixels).len()).sum::<usize>();
    let first = allocation_counter::measure(|| assert!(round() > 100));
    round();
    let third = allocation_counter::measure(|| assert!(round() > 100));
    assert!(first.count_total > 0, "the counter counts nothing");
    assert_eq!(third.count_total, 0, "{third:?}");
}

/// A random image of steps, slopes, holes and noise.
fn nonsense(seed: u64) -> (Header, Vec<u16>) {
    let mut random = fastrand::Rng::with_seed(seed);
    let (width, height) = (random.u32(1..90), random.u32(1..60));
    let focal = random.f64() * 300.0 + 1.0;
    let camera = Camera { width, height, fx: focal, fy: focal, cx: 0.5 * f64::from(width), cy: 0.0 };
    let noise = [NoiseModel::KINECT_V1, NoiseModel::IDEAL, NoiseModel::KINECT_V1.times(0.01)][random.usize(0..3)];
    let header = Header { camera, noise, depth_scale: [1e-4, 1e-3, 1.0][random.usize(0..3)], ..Header::default() };
    let (mut depth, mut slope) = (random.u16(..), 0_i16);
    let pixels = (0..width * height).map(|_| {
        match random.u8(0..40) {
            0 => depth = random.u16(..),
            1..4 => slope = random.i16(-60..60),
            4 => return 0,
            _ => depth = depth.saturating_add_signed(slope),
        }
        depth.saturating_add(random.u16(0..8))
    });
    (header, pixels.collect())
}

#[test]
fn nonsense_does_no_harm() {
    let found: usize = (0..1000)
        .map(|seed| {
            let mut random = fastrand::Rng::with_seed(seed);
            let config = ExtractorParameters {
                trim_px: random.u32(0..17),
                max_hole_px: random.u32(0..9),
                line_step: random.u32(1..9),
                ..config(ScanLines::Both)
            };
            let image = nonsense(seed);
            let arcs = arcs(config, &image);
            let mut assembler = Assembler::new(AssemblerParameters::default());
            assert_eq!(Object::check(&image.0, assembler.assemble(&image.0, &arcs)), Ok(()));
            arcs.len()
        })
        .sum();
    assert!(found > 500, "{found} arcs");
}
