use super::*;
use conicflow_messages::{Camera, Ellipse, Hop, Object, ObjectKind, Text, Track, TrackState};
use std::fs::File;
use std::io::BufReader;
use tempfile::TempDir;

const CAMERA: Camera = Camera { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 79.5, cy: 59.5 };
const HOLE: [u8; 3] = [10, 13, 19];
const ORANGE: [u8; 3] = [255, 135, 60];

fn header(sequence: u64, source: &str) -> Header {
    Header { sequence, camera: CAMERA, depth_scale: 0.001, source: Text::new(source), ..Header::default() }
}

fn sphere() -> Object {
    let kind = ObjectKind::Sphere.code();
    Object { kind, center: [0.0, 0.0, 1.0], radius: 0.2, confidence: 1.0, ..Object::default() }
}

fn sink<T: Drawn>(folder: &TempDir, config: Config) -> PictureSink<T> {
    let config = Config { path: Some("made/here".into()), ..config };
    PictureSink::new(config, &Context { base: folder.path().into(), ..Context::default() }).unwrap()
}

/// Draws one message over a wall with a hole, and reads the picture back.
fn picture<T: Drawn>(items: &[T], config: Config, side_inputs: &SideInputs) -> Vec<[u8; 3]> {
    let folder = tempfile::tempdir().unwrap();
    let input = Message { header: &header(0, ""), items };
    let path = sink(&folder, config).take(&input, side_inputs).unwrap().unwrap();
    let (size, pixels) = read(&path);
    assert_eq!(size, (160, 120));
    pixels
}

/// Size and pixels of a PNG.
fn read(path: &Path) -> ((u32, u32), Vec<[u8; 3]>) {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!(info.color_type, ColorType::Rgb);
    ((info.width, info.height), bytes.as_chunks::<3>().0.to_vec())
}

fn pixel(picture: &[[u8; 3]], u: usize, v: usize) -> [u8; 3] {
    picture[v * 160 + u]
}

#[test]
fn objects_are_drawn_over_depth_and_ellipses() {
    let mut wall = vec![2000_u16; 160 * 120];
    wall[..160 * 10].fill(0);
    let ellipse = Ellipse { line: 20, first: 30, last: 50, center: [0.0, 0.0, 1.0], ..Ellipse::default() };
    let (header, ellipses) = (header(0, ""), [ellipse]);
    let side_inputs = SideInputs::default()
        .with("depth", Message { header: &header, items: &wall })
        .with("ellipses", Message { header: &header, items: &ellipses });
    let picture = picture(&[sphere()], plain(), &side_inputs);
    assert_eq!(pixel(&picture, 80, 5), HOLE);
    let wall = pixel(&picture, 150, 80);
    assert!(wall != HOLE && wall != [0; 3]);
    assert_eq!((pixel(&picture, 30, 20), pixel(&picture, 50, 20)), ([240, 215, 90], [240, 215, 90]));
    assert_eq!(pixel(&picture, 80, 60), [235, 90, 200], "the ellipse's centre");
    // The limb of the sphere: 130 tan(asin(0.2)) = 26.5 pixels from the centre.
    assert!((105..=107).any(|u| pixel(&picture, u, 60) == ORANGE));
    assert_eq!(pixel(&picture, 95, 60), wall);
}

/// Parameters for outlines only.
fn plain() -> Config {
    Config { labels: false, legend: false, ..Config::default() }
}

fn painted(picture: &[[u8; 3]]) -> usize {
    picture.iter().filter(|pixel| **pixel != [0; 3]).count()
}

/// The strongest red in a picture.
fn strength(picture: &[[u8; 3]]) -> u8 {
    picture.iter().map(|pixel| pixel[0]).max().unwrap()
}

#[test]
fn without_depth_the_ground_is_black_and_an_empty_list_is_a_picture() {
    let empty = picture::<Object>(&[], plain(), &SideInputs::default());
    assert!(empty.iter().all(|pixel| *pixel == [0; 3]));
    let outline = picture(&[sphere()], plain(), &SideInputs::default());
    let labelled = picture(&[sphere()], Config { legend: false, ..Config::default() }, &SideInputs::default());
    assert!(painted(&outline) > 100 && painted(&labelled) > painted(&outline) + 20);
}

#[test]
fn the_legend_takes_the_lowest_lines_and_names_the_frame() {
    let picture = picture::<Object>(&[], Config::default(), &SideInputs::default());
    let rows: Vec<_> = (0..120).filter(|row| picture[row * 160..][..160].iter().any(|pixel| pixel[0] > 200)).collect();
    assert!(rows.first().is_some_and(|row| *row >= 104) && rows.len() > 8, "{rows:?}");
}

#[test]
fn more_confident_objects_are_drawn_more_strongly() {
    let of = |confidence| picture(&[Object { confidence, ..sphere() }], plain(), &SideInputs::default());
    let (sure, vague, unsaid) = (of(1.0), of(0.3), of(0.0));
    assert_eq!(strength(&sure), 255);
    assert!(strength(&vague) < strength(&unsaid) && strength(&unsaid) < 255, "who does not tell stands between");
    assert!(painted(&vague) < painted(&sure), "and thinner");
}

#[test]
fn the_colour_of_a_track_shows_its_number_and_its_stroke_the_state() {
    let track = |id, state: TrackState| Track { id, state: state.code(), object: sphere(), ..Track::default() };
    let drawn = |id, state| {
        let picture = picture(&[track(id, state)], plain(), &SideInputs::default());
        let strongest = picture.iter().max_by_key(|pixel| pixel.iter().map(|part| u32::from(*part)).sum::<u32>());
        let strongest = *strongest.unwrap();
        (strongest, picture.iter().filter(|pixel| pixel[2] > 100).count())
    };
    let (colour, full) = drawn(1, TrackState::Confirmed);
    assert_eq!(colour, [95, 190, 245]);
    assert_ne!(colour, drawn(2, TrackState::Confirmed).0);
    assert_eq!(colour, drawn(8, TrackState::Confirmed).0);
    let (tentative, coasting) = (drawn(1, TrackState::Tentative), drawn(1, TrackState::Coasting));
    assert!(tentative.1 < coasting.1 && coasting.1 < full, "dotted, broken, whole");
    assert!(tentative.0[1] < colour[1] && coasting.0[1] < colour[1], "and paler");
}

#[test]
fn a_picture_is_enlarged_by_the_requested_factor() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = sink::<Object>(&folder, Config { zoom: 3, ..plain() });
    let header = header(0, "");
    let wall = vec![2000_u16; 160 * 120];
    let depth = Message { header: &header, items: &wall[..] };
    let items = [sphere()];
    let path = sink.write_picture(&Message { header: &header, items: &items }, Some(&depth), &[]).unwrap().unwrap();
    let (size, pixels) = read(&path);
    assert_eq!(size, (480, 360));
    assert_eq!(pixels[0], pixels[480 * 360 - 1], "the wall is everywhere");
    // The limb of the sphere, at 79.5 + 26.5 pixels of the frame.
    assert!((318..=319).any(|u| pixels[179 * 480 + u] == ORANGE));
    sink.zoom = 8;
    let camera = Camera { width: 8192, height: 8192, ..CAMERA };
    let large = Message { header: &Header { camera, ..header }, items: &items[..] };
    let error = sink.take(&large, &SideInputs::default()).unwrap_err().to_string();
    assert!(error.starts_with("a picture 8 times as wide as 8192x8192 is too large\n  hint: "), "{error}");
}

#[test]
fn each_contact_sheet_holds_a_fixed_number_of_pictures_and_the_last_one_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = sink::<Object>(&folder, Config { sheet: 4, ..plain() });
    for sequence in 0..5 {
        let items = if sequence == 1 { vec![sphere()] } else { Vec::new() };
        sink.take(&Message { header: &header(sequence, ""), items: &items }, &SideInputs::default()).unwrap();
    }
    sink.write_sheet().unwrap();
    let sheet = |number| read(&folder.path().join(format!("made/here/sheet_000{number}.png")));
    let (size, pixels) = sheet(1);
    assert_eq!(size, (2 * 324 + 4, 2 * 244 + 4));
    let quarter = |x: bool, y: bool| {
        let place = |(index, _): &(usize, &[u8; 3])| ((index % 652 > 326) == x) && ((index / 652 > 246) == y);
        pixels.iter().enumerate().filter(place).filter(|(_, pixel)| **pixel != [0; 3]).count()
    };
    assert!(quarter(true, false) > 100, "the second picture");
    assert_eq!([quarter(false, false), quarter(false, true), quarter(true, true)], [0; 3]);
    assert_eq!(sheet(2).0, (328, 248), "no larger than it has to be");
    sink.write_sheet().unwrap();
    assert_eq!(fs::read_dir(folder.path().join("made/here")).unwrap().count(), 7, "no sheet of nothing");
}

#[test]
fn ellipses_can_be_the_driving_input() {
    let column = Ellipse { scan: 1, line: 20, first: 30, last: 50, center: [0.0, 0.0, -1.0], ..Ellipse::default() };
    let picture = picture(&[column], Config::default(), &SideInputs::default());
    assert_eq!((pixel(&picture, 20, 30), pixel(&picture, 20, 50)), ([240, 215, 90], [240, 215, 90]));
    assert_eq!(pixel(&picture, 20, 29), [0; 3]);
}

#[test]
fn an_ellipse_whose_centre_is_far_off_is_drawn_as_an_arc_without_centre() {
    let far = Ellipse { line: 20, first: 30, last: 50, center: [0.0, 1e15, 1.0], ..Ellipse::default() };
    let picture = picture(&[far], Config::default(), &SideInputs::default());
    assert!(picture.contains(&[240, 215, 90]) && !picture.contains(&[235, 90, 200]));
}

#[test]
fn depth_of_another_size_is_left_out() {
    let other = Header { camera: Camera { width: 2, height: 2, ..CAMERA }, ..header(0, "") };
    let side_inputs = SideInputs::default().with("depth", Message { header: &other, items: &[1000_u16; 4] });
    assert!(picture::<Object>(&[], plain(), &side_inputs).iter().all(|pixel| *pixel == [0; 3]));
}

#[test]
fn every_nth_message_is_drawn_also_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let mut sink = sink::<Object>(&folder, Config { every: 3, ..Config::default() });
    let mut written = |sequence| {
        let path = sink.take(&Message { header: &header(sequence, ""), items: &[] }, &SideInputs::default()).unwrap();
        path.map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
    };
    let names: Vec<_> = (10..17).filter_map(&mut written).collect();
    assert_eq!(names, ["frame_000010.png", "frame_000013.png", "frame_000016.png"]);
    assert_eq!(fs::read_dir(folder.path().join("made/here")).unwrap().count(), 3, "nothing else is left behind");
}

#[test]
fn names_after_the_source_stay_in_the_folder() {
    let name = |source| picture_name(&header(12, source), Names::Source);
    assert_eq!(name("frame-000001.depth.png"), "frame-000001.depth.png");
    assert_eq!(name("scan.pcd"), "scan.png");
    assert_eq!(name("camera"), "frame_000012.png");
    assert_eq!(name("../../etc/pass:wd.x"), "pass_wd.png");
    assert_eq!(picture_name(&header(12, "scan.pcd"), Names::Sequence), "frame_000012.png");
    let mut of_camera = header(12, "scan.pcd");
    of_camera.add_hop(Hop { stage: Text::new("front"), ..Hop::default() });
    assert_eq!(picture_name(&of_camera, Names::Stage), "front_000012.png");
    let long = picture_name(&header(12, &format!("{}.png", "ä".repeat(120))), Names::Source);
    assert_eq!(long, format!("{}.png", "ä".repeat(100)), "a file's name has 255 bytes at most");
}

#[test]
fn impossible_sizes_and_folders_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let camera = Camera { width: u32::MAX, height: u32::MAX, ..CAMERA };
    let input = Message { header: &Header { camera, ..header(7, "") }, items: &[] };
    let error =
        sink::<Object>(&folder, Config::default()).take(&input, &SideInputs::default()).unwrap_err().to_string();
    assert!(error.starts_with("frame 7 has 4294967295x4294967295 pixels, expected 1 to 67108864\n  hint: "));
    fs::write(folder.path().join("file"), "").unwrap();
    let config = Config { path: Some("file/inside".into()), ..Config::default() };
    let error = format!("{:#}", PictureSink::<Object>::open(&config, folder.path(), 0).err().unwrap());
    assert!(error.contains("file/inside` cannot be made: "), "{error}");
}

#[test]
fn faults_of_the_parameters_are_reported() {
    let faults = |config: &Config| PictureSink::<Object>::faults(config, Path::new(""));
    let keys = |config: Config| faults(&config).iter().map(|fault| fault.key).collect::<Vec<_>>();
    assert_eq!(keys(Config::default()), ["path"]);
    let turned = Config { path: Some("x".into()), near_m: Some(3.0), far_m: Some(1.0), ..Config::default() };
    assert_eq!(keys(turned), ["near_m"]);
    let config: Config = toml::from_str("path = 'x'\nnames = 'source'\nevery = 5").unwrap();
    assert_eq!((config.names, config.every), (Names::Source, 5));
}

#[test]
fn pictures_that_may_overwrite_each_other_are_reported() {
    for (names, is_reported) in [(Names::Sequence, true), (Names::Source, true), (Names::Stage, false)] {
        let folder = tempfile::tempdir().unwrap();
        let mut sink = sink::<Object>(&folder, Config { names, ..Config::default() });
        for camera in ["left", "right"] {
            let mut header = header(0, "0.png");
            header.add_hop(Hop { stage: Text::new(camera), ..Hop::default() });
            sink.take(&Message { header: &header, items: &[] }, &SideInputs::default()).unwrap();
        }
        assert_eq!(sink.is_reported, is_reported, "{names:?}");
    }
}
