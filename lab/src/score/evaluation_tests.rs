//! Evaluations of scenes and recordings with made-up answers.

use super::matching::tests::answers;
use super::matching::{Fault, MatchedFrame};
use super::samples::Sample;
use super::*;
use crate::simulator::random_scene::{SceneGroup, random_scene};
use crate::simulator::scene_values::SceneTemplate;
use crate::simulator::truth::truth_at;
use conicflow_messages::{Camera, Header, Object, ObjectKind, ObjectSigma, Text};

const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };

fn header(name: &str) -> Header {
    Header { camera: CAMERA, source: Text::new(name), ..Header::default() }
}

fn evaluation_of(truth: RenderedTruth) -> Evaluation {
    Evaluation::new(TruthSource::Rendered(Box::new(truth)))
}

fn evaluation() -> Evaluation {
    evaluation_of(RenderedTruth::default())
}

/// Returns the number of missed objects and of wrong answers.
fn faults(frame: &MatchedFrame) -> (usize, usize) {
    (frame.missed().count(), frame.wrong.len())
}

/// Returns the visible parts of all objects, as a perfect detector would answer them.
fn perfect(group: SceneGroup, seed: u64) -> Vec<Object> {
    let truths = truth_at(&random_scene(group, seed), CAMERA, 0.0).into_iter();
    truths.filter(|truth| truth.object.points > 0).map(|truth| truth.object).collect()
}

#[test]
fn the_truth_itself_is_faultless() {
    let mut evaluation = evaluation();
    for group in SceneGroup::USUAL {
        for seed in 0..12 {
            let name = format!("{}/{seed}", group.name());
            let answers = answers(&perfect(group, seed));
            let frame = evaluation.add(&header(&name), &answers).unwrap().unwrap();
            assert_eq!(faults(&frame), (0, 0), "{name}");
        }
    }
    let score = evaluation.score();
    assert!(score.samples.len() > 100, "{}", score.samples.len());
    assert_eq!(score.groups.len(), SceneGroup::USUAL.len());
    assert!(score.samples.is_sorted_by_key(|sample| sample.group), "in the order in which they came");
    let error = |sample: &Sample| (sample.found.unwrap().0.radius_m - sample.radius_m).abs();
    assert!(score.samples.iter().map(error).fold(0.0, f64::max) < 1e-9);
}

#[test]
fn what_is_left_out_is_missed_and_what_is_made_up_is_wrong() {
    let mut evaluation = evaluation();
    let (header, objects) = (header("standing/3"), perfect(SceneGroup::Standing, 3));
    assert!(evaluation.add(&header, &[]).unwrap().unwrap().missed().count() > 0);
    let ghost = Object { center: [0.0, -5.0, 3.0], radius: 0.1, ..Object::default() };
    let answers = answers(&[objects, vec![ghost]].concat());
    let frame = evaluation.add(&header, &answers).unwrap().unwrap();
    assert_eq!(faults(&frame), (0, 1));
    let details = frame.details(&header);
    assert_eq!(details["wrong"][0]["why"], "nothing there");
    assert_eq!(details["scene"], "standing/3");
}

#[test]
fn an_object_that_cannot_be_asked_for_is_neither_missed_nor_wrong() {
    let required = VisibilityCriteria { min_extent_px: 1000, ..VisibilityCriteria::default() };
    let mut evaluation = evaluation_of(RenderedTruth { required, ..RenderedTruth::default() });
    let answers = answers(&perfect(SceneGroup::Standing, 3));
    let frame = evaluation.add(&header("standing/3"), &answers).unwrap().unwrap();
    assert_eq!(faults(&frame), (0, 0));
    assert_eq!(evaluation.score().extra, answers.len() as u64);
}

#[test]
fn built_in_scenes_are_known_by_name_and_others_are_asked_for() {
    let mut evaluation = evaluation();
    assert!(!evaluation.add(&header("bouncing_ball"), &[]).unwrap().unwrap().pairs.is_empty());
    let error = evaluation.add(&header("img12.png"), &[]).err().unwrap().to_string();
    assert!(error.contains("`img12.png`") && error.contains("hint:"), "{error}");
}

#[test]
fn honest_answers_have_honest_ratios() {
    let sigma = ObjectSigma { radius: 0.002, ..ObjectSigma::default() };
    let mut evaluation = evaluation();
    for (seed, error) in (0..40).zip([0.002, -0.002].into_iter().cycle()) {
        let off = |object: Object| Object { radius: object.radius + error, sigma, ..object };
        let objects: Vec<_> = perfect(SceneGroup::Standing, seed).into_iter().map(off).collect();
        evaluation.add(&header(&format!("standing/{seed}")), &answers(&objects)).unwrap();
    }
    let samples = &evaluation.score().samples;
    let ratios: Vec<f64> = samples.iter().filter_map(|sample| sample.found?.1.radius).collect();
    assert!(samples.len() > 40 && ratios.len() == samples.len(), "{} of {}", ratios.len(), samples.len());
    assert!(ratios.iter().all(|ratio| (ratio.abs() - 1.0).abs() < 1e-6));
}

/// The object is outside of the image here, but the track of another camera knows it.
#[test]
fn a_track_of_what_cannot_be_seen_here_is_not_wrong() {
    let away = Header { camera: Camera { cx: 2000.0, ..CAMERA }, ..header("standing/3") };
    let truths = truth_at(&random_scene(SceneGroup::Standing, 3), away.camera, 0.0);
    assert!(!truths.is_empty() && truths.iter().all(|truth| truth.object.points == 0));
    let answers = answers(&truths.iter().map(|truth| truth.body).collect::<Vec<_>>());
    let mut evaluation = evaluation();
    assert_eq!(faults(&evaluation.add(&away, &answers).unwrap().unwrap()), (0, 0));
}

/// Two balls, of which the farther one is 60 % hidden, and a bowl: both balls have to be found, the bowl need not be. One answer
/// in the place of both balls finds one of them.
#[test]
fn what_has_to_be_found_is_no_less_than_what_is_seen() {
    const SCENE: &str = r#"
        name = "balls and bowl"
        [camera]
        position  = [0, 0, 0]
        direction = [0, 1, 0]
        [[sphere]]
        name   = "near"
        center = [0.0, 1.5, 0]
        radius = 0.1
        [[sphere]]
        name   = "far"
        center = [0.03, 1.53, 0]
        radius = 0.11
        [[bowl]]
        name   = "bowl"
        center = [0.6, 2.0, 0]
        radius = 0.12
    "#;
    let scene = Some(SceneTemplate::new(SCENE.into(), "test".into()));
    let mut evaluation = evaluation_of(RenderedTruth { scene, ..RenderedTruth::default() });
    let header = header("balls and bowl");
    let frame = evaluation.add(&header, &[]).unwrap().unwrap();
    let (far, _) = frame.pairs.iter().find(|(truth, _)| truth.name == "far").unwrap();
    assert!((0.45..0.74).contains(&far.hidden), "{}", far.hidden);
    assert!(evaluation.score().samples.iter().any(|sample| sample.hidden == Some(far.hidden)), "it is counted as such");
    let missed: Vec<_> = frame.missed().map(|truth| truth.name.as_str()).collect();
    assert_eq!(missed, ["near", "far"]);
    let between = Object { kind: ObjectKind::Sphere.code(), radius: 0.105, center: [0.015, 0.0, 1.515], ..far.body };
    let answers = answers(&[between]);
    assert_eq!(faults(&evaluation.add(&header, &answers).unwrap().unwrap()), (1, 0));
}

const TRUTH: &str = r#"{"units": "m", "scenes": {"a.pcd": [
    {"type": "cylinder", "what": "tin", "radius_m": 0.05, "axis_point_m": [0, 0, 1], "axis_dir": [0, 1, 0]},
    {"type": "cylinder", "what": "pot", "radius_m": 0.09, "axis_point_m": [0.3, 0, 1], "axis_dir": [0, 1, 0]}]}}"#;

fn cylinder(x: f64, radius: f64) -> Object {
    let (kind, axis) = (ObjectKind::Cylinder.code(), [0.0, 1.0, 0.0]);
    Object { kind, center: [x, 0.02, 1.0], axis, radius, length: 0.1, ..Object::default() }
}

fn recording_of(truth: &str) -> Evaluation {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.json");
    std::fs::write(&path, truth).unwrap();
    Evaluation::new(TruthSource::Recorded(RecordedTruth::load(&path, &RecordedTolerances::default()).unwrap()))
}

#[test]
fn found_off_and_unlisted_are_told_apart() {
    let mut evaluation = recording_of(TRUTH);
    let answers = answers(&[cylinder(0.001, 0.051), cylinder(0.3, 0.097), cylinder(-0.5, 0.04)]);
    let frame = evaluation.add(&header("a.pcd"), &answers).unwrap().unwrap();
    let missed: Vec<_> = frame.missed().map(|truth| truth.name.as_str()).collect();
    assert_eq!(missed, ["pot"]);
    let wrong: Vec<_> = frame.wrong.iter().map(|(object, fault)| (object.center[0], *fault)).collect();
    assert_eq!(wrong, [(0.3, Fault::Radius), (-0.5, Fault::NothingThere)]);
    assert!(evaluation.add(&header("b.pcd"), &answers).unwrap().is_none());
    let report = evaluation.report().unwrap();
    assert!(report.contains("  found     tin: radius +1.0 mm, position 1.0 mm, axis 0.0 deg\n"), "{report}");
    assert!(
        report.contains("  missed    pot: cylinder at (0.300, 0.000, 1.000) m, radius 90.0 mm\n")
            && report.contains("radius is wrong about pot: radius +7.0 mm")
    );
    assert!(report.contains("1 of 2 found (50 %) in 1 frames; 1 frames not judged"), "{report}");
    assert!(report.contains("1 answers off (1.00 per frame), 1 about what is not listed (1.00 per frame)"), "{report}");
}

/// A tin with an unmeasured handle, in front of a carton: the boxes are those of the handle and of the carton behind both.
#[test]
fn what_was_not_measured_counts_neither_way_and_what_is_not_wanted_is_wrong() {
    let boxes = r#", "visible_unmeasured": {"a.pcd": [{"what": "handle", "box": [10, 110, 60, 130]}]},
        "not_wanted": {"a.pcd": [{"what": "carton", "box": [0, 90, 220, 150]}]}}"#;
    let mut evaluation = recording_of(&TRUTH.replace("]}}", &format!("]}}{boxes}")));
    // visible at u = 160, 28, 107 and 291 of 320
    let [right, on_handle, on_carton, nowhere] =
        [(0.001, 0.051), (-0.5, 0.01), (-0.2, 0.04), (0.5, 0.04)].map(|(x, radius)| cylinder(x, radius));
    let answers = answers(&[right, on_handle, on_carton, nowhere]);
    let frame = evaluation.add(&header("a.pcd"), &answers).unwrap().unwrap();
    let places = |objects: Vec<&Object>| objects.into_iter().map(|object| object.center[0]).collect::<Vec<_>>();
    assert_eq!(places(frame.wrong.iter().map(|(object, _)| object).collect()), [-0.2, 0.5]);
    assert_eq!(places(frame.neither.iter().map(|(object, _)| object).collect()), [-0.5]);
    assert_eq!(frame.details(&header("a.pcd"))["neither"][0]["on"], "handle");
    let (score, row) = (evaluation.score(), evaluation.row());
    let number = |column| row.number_of(column).unwrap();
    assert_eq!((score.neither, score.samples.len()), (1, 4), "two tins and two wrong answers");
    assert_eq!((number("found"), number("to_find"), number("wrong"), number("precision")), (1.0, 2.0, 2.0, 1.0 / 3.0));
    let report = evaluation.report().unwrap();
    assert!(report.contains("  found     tin"), "right is right in any box: {report}");
    assert!(
        report.contains("  unlisted  cylinder at (-0.200, 0.020, 1.000) m, radius 40.0 mm, on carton\n"),
        "{report}"
    );
    assert!(report.contains("  unlisted  cylinder at (0.500, 0.020, 1.000) m, radius 40.0 mm\n"), "{report}");
    assert!(report.contains("radius 10.0 mm; on what was not measured: handle\n"), "{report}");
}

/// A box around something unmeasured does not hide a miss: an object that has to be found there is missed all the same.
#[test]
fn a_miss_in_a_box_is_a_miss() {
    let boxes = r#", "visible_unmeasured": {"a.pcd": [{"what": "inside of the tin", "box": [100, 90, 220, 150]}]}}"#;
    let mut evaluation = recording_of(&TRUTH.replace("]}}", &format!("]}}{boxes}")));
    let frame = evaluation.add(&header("a.pcd"), &answers(&[cylinder(0.0, 0.2)])).unwrap().unwrap();
    assert_eq!(faults(&frame), (2, 0));
    assert_eq!((frame.neither.len(), evaluation.row().number_of("found")), (1, Some(0.0)));
}

#[test]
fn a_truth_file_of_other_frames_is_told() {
    let mut evaluation = recording_of(TRUTH);
    assert!(evaluation.report().is_ok(), "no frame came");
    evaluation.add(&header("0001.png"), &[]).unwrap();
    let error = evaluation.report().unwrap_err().to_string();
    assert!(error.contains("the first of 1 is `0001.png`, the file has `a.pcd`\n  hint: "), "{error}");
    evaluation.add(&header("a.pcd"), &[]).unwrap();
    assert!(evaluation.report().is_ok());
}

#[test]
fn frames_of_the_truth_file_that_do_not_come_are_counted() {
    let mut evaluation = recording_of(&TRUTH.replace(r#""scenes": {"#, r#""scenes": {"b.pcd": [], "c.pcd": [], "#));
    let absent = |evaluation: &Evaluation| {
        let report = evaluation.report().unwrap();
        report.lines().find(|line| line.contains("did not come")).map(str::to_owned)
    };
    evaluation.add(&header("clouds/a.pcd"), &[]).unwrap();
    assert_eq!(absent(&evaluation).as_deref(), Some("2 frames of the truth file did not come"));
    for name in ["b.pcd", "c.pcd"] {
        evaluation.add(&header(name), &[]).unwrap();
    }
    assert_eq!(absent(&evaluation), None);
}

#[test]
fn the_radii_of_an_object_are_summed_up_from_three_frames_on() {
    let mut evaluation = recording_of(TRUTH);
    for (radius, told) in [(0.049, None), (0.050, None), (0.051, Some("tin: radius 50.0 +- 1.0 mm in 3 frames"))] {
        evaluation.add(&header("a.pcd"), &answers(&[cylinder(0.0, radius)])).unwrap();
        let report = evaluation.report().unwrap();
        assert_eq!(report.lines().find(|line| line.contains("+-")), told);
    }
}
