//! Measurements of a scene with made-up answers.

use super::*;
use crate::simulator::scene_values::SceneTemplate;
use conicflow_messages::{Camera, Header, Object, ObjectKind, RECORDED, Text, Track, TrackState};

const SCENE: &str = r#"
    name = "two balls"
    [camera]
    position  = [0, 0, 0]
    direction = [0, 1, 0]
    [[sphere]]
    name   = "left"
    center = [-0.3, 2.0, 0]
    radius = 0.1
    motion.linear = { velocity = [0.5, 0, 0] }
    [[sphere]]
    name   = "right"
    center = [0.3, 2.0, 0]
    radius = 0.1
"#;

fn header(time_s: f64) -> Header {
    let camera = Camera { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 79.5, cy: 59.5 };
    Header { camera, stamp_ns: (time_s * 1e9) as u64, source: Text::new("two balls"), ..Header::default() }
}

/// A ball in the camera frame: x right, y down, z forward.
fn ball(x: f64, radius: f64) -> Object {
    Object { kind: ObjectKind::Sphere.code(), center: [x, 0.0, 2.0], radius, ..Object::default() }
}

fn track(id: u64, x: f64) -> Track {
    Track { id, state: TrackState::Confirmed.code(), object: ball(x, 0.1), ..Track::default() }
}

fn answer(claim: impl Claim) -> Answer {
    claim.answer().unwrap()
}

/// The default criteria of a `measurement_sink`.
fn truth(scene: Option<SceneTemplate>) -> RenderedTruth {
    let required =
        VisibilityCriteria { max_hidden: 0.95, min_extent_px: 4, min_arc_deg: 5.0, min_view_angle_deg: 10.0 };
    let tolerance = Tolerances { position_m: 0.3, radius: 0.8, axis_deg: 30.0, half_angle_deg: 15.0 };
    RenderedTruth { scene, required, tolerance }
}

fn measure(from_s: f64, frames: &[(f64, Vec<Answer>)]) -> Vec<Row> {
    measure_scene(SCENE, from_s, frames)
}

fn measure_scene(scene: &str, from_s: f64, frames: &[(f64, Vec<Answer>)]) -> Vec<Row> {
    let mut measurement = Measurement::new(truth(Some(SceneTemplate::new(scene.into(), "test".into()))), from_s);
    for (time_s, answers) in frames {
        measurement.add(&header(*time_s), answers).unwrap();
    }
    measurement.rows()
}

#[test]
fn means_deviations_and_speeds_are_those_of_the_answers() {
    let frame =
        |time_s: f64, radius: f64| (time_s, vec![answer(ball(-0.3 + 0.6 * time_s, radius)), answer(ball(0.3, 0.1))]);
    let rows = measure(0.0, &[frame(0.0, 0.08), frame(0.1, 0.09), frame(0.2, 0.10)]);
    let left = &rows[0];
    let number = |column: &str| left.number_of(column).unwrap();
    assert_eq!(left.get("object"), Some(&Figure::Text("left".into())));
    assert_eq!((number("frames"), number("n")), (3.0, 3.0));
    assert!((number("radius_m") - 0.09).abs() < 1e-12 && (number("radius_sd_m") - 0.01).abs() < 1e-12);
    assert!((number("speed_mps") - 0.6).abs() < 1e-9 && (number("speed_true_mps") - 0.5).abs() < 1e-9);
    assert!((number("distance_true_m") - 2.0).abs() < 0.03);
    assert!((number("position_rms_m") - (5e-4_f64 / 3.0).sqrt()).abs() < 1e-9, "0, 1 and 2 cm off");
    assert_eq!((rows.len(), rows[2].number_of("mota")), (3, Some(1.0)));
    assert!((rows[2].number_of("motp_m").unwrap() - 0.005).abs() < 1e-9, "the other one is where it is");
    let columns = rows.iter().flat_map(|row| &row.0).map(|(column, _)| column.as_str());
    assert_eq!(columns.filter(|column| !measured_columns().any(|known| known == *column)).collect::<Vec<_>>(), [""; 0]);
}

#[test]
fn misses_wrong_answers_and_switches_count_against_mota() {
    let frames = [
        (0.0, vec![answer(track(1, -0.3)), answer(track(2, 0.3))]),
        (0.1, vec![answer(track(1, -0.25)), answer(track(3, 0.3)), answer(track(4, 2.0))]),
        (0.2, vec![answer(track(1, -0.2))]),
    ];
    let rows = measure(0.0, &frames);
    let all = rows.last().unwrap();
    let number = |column: &str| all.number_of(column).unwrap();
    assert_eq!(["frames", "n", "switches", "wrong", "identities"].map(number), [6.0, 5.0, 1.0, 1.0, 3.0]);
    assert!((number("mota") - 0.5).abs() < 1e-12, "one missed, one wrong, one switch in six");
}

#[test]
fn an_object_that_was_never_seen_says_nothing_of_how_far_off_the_others_are() {
    let rows = measure(0.0, &[(0.0, vec![answer(ball(-0.28, 0.1))])]);
    assert!((rows[2].number_of("motp_m").unwrap() - 0.02).abs() < 1e-9, "{:?}", rows[2]);
}

#[test]
fn what_is_wrong_is_told_of_one_object_too() {
    let (alone, _) = SCENE.rsplit_once("[[sphere]]").unwrap();
    let rows = measure_scene(alone, 0.0, &[(0.0, vec![answer(track(1, -0.3)), answer(track(2, 0.9))])]);
    let numbers = ["n", "wrong", "mota"].map(|column| rows[0].number_of(column));
    assert_eq!((rows.len(), numbers), (1, [Some(1.0), Some(1.0), Some(0.0)]));
}

/// The ball leaves the image at 5 m/s, and comes back.
#[test]
fn a_speed_is_that_since_the_frame_before_though_it_could_not_be_seen_there() {
    let path = "motion.path = { points = [{ t_s = 0, offset = [0, 0, 0] }, { t_s = 1, offset = [-5, 0, 0] },
        { t_s = 2, offset = [0, 0, 0] }] }";
    let scene = SCENE.replace("motion.linear = { velocity = [0.5, 0, 0] }", path);
    let seen = |time_s: f64, x: f64| (time_s, vec![answer(track(1, x))]);
    let rows = measure_scene(&scene, 0.0, &[seen(0.0, -0.3), (1.0, Vec::new()), seen(1.95, -0.55)]);
    assert_eq!(rows[0].number_of("frames"), Some(2.0));
    assert!((rows[0].number_of("speed_true_mps").unwrap() - 5.0).abs() < 0.01, "{:?}", rows[0]);
}

#[test]
fn an_identity_that_is_still_right_is_kept() {
    let near = |id, x| answer(track(id, x));
    let frames = [(0.0, vec![near(1, -0.3), near(2, 0.3)]), (0.0, vec![near(1, -0.2), near(2, 0.3), near(5, -0.3)])];
    let rows = measure(0.0, &frames);
    assert_eq!(rows[0].number_of("switches"), Some(0.0), "another track is nearer, but the first is still right");
}

#[test]
fn frames_before_the_filter_has_settled_are_left_out() {
    let frames = [0.0, 0.1, 0.2].map(|time_s| (time_s, vec![answer(ball(0.3, 0.1))]));
    let rows = measure(0.15, &frames);
    assert_eq!(rows.last().unwrap().number_of("frames"), Some(2.0));
}

#[test]
fn of_recorded_frames_each_track_has_its_row() {
    let mut measurement = Measurement::new(truth(None), 0.0);
    for number in 0..4_u64 {
        let source = Text::new(&format!("img{number}.PNG"));
        let header = Header { source, flags: RECORDED, ..header(0.0) };
        let tracks = [track(7, 0.0), track(8, 0.5)];
        let answers: Vec<_> = tracks[..if number < 3 { 2 } else { 1 }].iter().filter_map(Claim::answer).collect();
        measurement.add(&header, &answers).unwrap();
    }
    let rows = measurement.rows();
    assert_eq!(rows[0].get("object"), Some(&Figure::Text("sphere 7".into())));
    let numbers = |row: &Row| ["frames", "n", "distance_m", "radius_m"].map(|column| row.number_of(column).unwrap());
    assert_eq!((rows.len(), numbers(&rows[0])), (2, [4.0, 4.0, 2.0, 0.1]));
    assert_eq!(numbers(&rows[1])[1], 3.0);
    for name in ["another scene", "img.png"] {
        let unknown = Header { source: Text::new(name), ..header(0.0) };
        assert!(measurement.add(&unknown, &[]).is_err(), "the name of a file makes no recording");
    }
}

#[test]
fn recorded_frames_are_left_out_by_the_time_since_the_first() {
    let mut measurement = Measurement::new(truth(None), 0.05);
    for time_s in [1000.0, 1000.1, 1000.2, 1000.3] {
        let header = Header { flags: RECORDED, ..header(time_s) };
        measurement.add(&header, &[answer(track(7, 0.0))]).unwrap();
    }
    assert_eq!(measurement.rows()[0].number_of("frames"), Some(3.0));
}
