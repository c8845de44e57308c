use super::*;
use conicflow_lab::simulator::random_scene::{SceneGroup, random_scene};
use conicflow_lab::simulator::truth::truth_at;
use conicflow_messages::{Camera, Header, ObjectSigma, Text};

const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };

fn header(name: &str) -> Header {
    Header { camera: CAMERA, source: Text::new(name), ..Header::default() }
}

fn evaluation() -> Evaluation {
    Evaluation::new(EvaluationConfig::default(), None)
}

/// The visible parts of all objects, which is what a detector without fault would answer.
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
            let answers = perfect(group, seed);
            let frame = evaluation.add(&header(&name), &answers).unwrap();
            assert_eq!((frame.missed().count(), frame.matching.wrong.len()), (0, 0), "{name}");
        }
    }
    let score = evaluation.score();
    assert!(score.samples.len() > 100, "{}", score.samples.len());
    assert_eq!(score.groups.len(), SceneGroup::USUAL.len());
    let worst = score.samples.iter().filter_map(|sample| sample.errors).map(|errors| errors.radius.abs());
    assert!(worst.fold(0.0, f64::max) < 1e-9);
}

#[test]
fn what_is_left_out_is_missed_and_what_is_made_up_is_wrong() {
    let mut evaluation = evaluation();
    let (header, answers) = (header("standing/3"), perfect(SceneGroup::Standing, 3));
    let none = evaluation.add(&header, &[]).unwrap().missed().count();
    assert!(none > 0);
    let ghost = Object { center: [0.0, -5.0, 3.0], radius: 0.1, ..Object::default() };
    let answers = [answers, vec![ghost]].concat();
    let frame = evaluation.add(&header, &answers).unwrap();
    assert_eq!((frame.missed().count(), frame.matching.wrong.len()), (0, 1));
    let details = frame.details(&header);
    assert_eq!(details["wrong"][0]["why"], "nothing there");
    assert_eq!(details["scene"], "standing/3");
}

#[test]
fn an_object_that_cannot_be_asked_for_is_neither_missed_nor_wrong() {
    let required = Duties { min_extent_px: 1000, ..Duties::default() };
    let mut evaluation = Evaluation::new(EvaluationConfig { required, ..EvaluationConfig::default() }, None);
    let answers = perfect(SceneGroup::Standing, 3);
    let frame = evaluation.add(&header("standing/3"), &answers).unwrap();
    assert_eq!((frame.missed().count(), frame.matching.wrong.len()), (0, 0));
    assert_eq!(evaluation.score().extra, answers.len() as u64);
}

#[test]
fn built_in_scenes_are_known_by_name_and_others_are_asked_for() {
    let mut evaluation = evaluation();
    assert!(!evaluation.add(&header("bouncing_ball"), &[]).unwrap().expected.is_empty());
    let error = evaluation.add(&header("img12.png"), &[]).err().unwrap().to_string();
    assert!(error.contains("`img12.png`") && error.contains("hint:"), "{error}");
}

#[test]
fn honest_answers_have_honest_ratios() {
    let sigma = ObjectSigma { radius: 0.002, ..ObjectSigma::default() };
    let mut evaluation = evaluation();
    for (seed, error) in (0..40).zip([0.002, -0.002].into_iter().cycle()) {
        let answers: Vec<_> = perfect(SceneGroup::Standing, seed)
            .into_iter()
            .map(|object| Object { radius: object.radius + error, sigma, ..object })
            .collect();
        evaluation.add(&header(&format!("standing/{seed}")), &answers).unwrap();
    }
    let samples = &evaluation.score().samples;
    let ratios: Vec<f64> = samples.iter().filter_map(|sample| sample.errors?.sigmas.radius).collect();
    assert!(samples.len() > 40 && ratios.len() == samples.len(), "{} of {}", ratios.len(), samples.len());
    assert!(ratios.iter().all(|ratio| (ratio.abs() - 1.0).abs() < 1e-6));
}

/// It stands outside of the image here, but a track that another camera sees is there.
#[test]
fn a_track_of_what_cannot_be_seen_here_is_not_wrong() {
    let away = Header { camera: Camera { cx: 2000.0, ..CAMERA }, ..header("standing/3") };
    let answers: Vec<_> = truth_at(&random_scene(SceneGroup::Standing, 3), away.camera, 0.0)
        .into_iter()
        .inspect(|truth| assert_eq!(truth.object.points, 0))
        .map(|truth| truth.body)
        .collect();
    let mut evaluation = evaluation();
    let frame = evaluation.add(&away, &answers).unwrap();
    assert!(!answers.is_empty());
    assert_eq!((frame.missed().count(), frame.matching.wrong.len()), (0, 0));
}

#[test]
fn details_go_into_a_folder_that_is_made() {
    let base = tempfile::tempdir().unwrap();
    let context = Context { base: base.path().into(), ..Context::default() };
    let config = EvaluationConfig { details_path: Some("new/details.jsonl".into()), ..EvaluationConfig::default() };
    let inputs = vec![(Header { depth_scale: 0.001, ..header("standing/3") }, Vec::<Object>::new())];
    conicflow_dataflow::testing::pass::<EvaluationSink<Object>>(config, context, &inputs).unwrap();
    assert!(std::fs::read_to_string(base.path().join("new/details.jsonl")).unwrap().contains("\"missed\":[{"));
}

#[test]
fn only_confirmed_tracks_are_answers() {
    let track = |state: TrackState| Track { state: state.code(), ..Track::default() };
    assert!(track(TrackState::Confirmed).object().is_some());
    assert!(track(TrackState::Tentative).object().is_none());
    assert!(track(TrackState::Coasting).object().is_none());
}

#[test]
fn files_that_cannot_be_used_are_told_before_the_start() {
    let base = tempfile::tempdir().unwrap();
    let config = EvaluationConfig {
        scene: Some("garden.toml".into()),
        truth: Some("truth.json".into()),
        ..EvaluationConfig::default()
    };
    let keys: Vec<_> = config.faults(base.path()).into_iter().map(|fault| fault.key).collect();
    assert_eq!(keys, ["scene", "truth", "truth"]);
    assert!(EvaluationConfig::default().faults(base.path()).is_empty());
}
