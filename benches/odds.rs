//! Fits the weights of `detection/src/assemble/odds.rs` to candidates in simulated scenes, and prints how often candidates of
//! each confidence are right: `cargo bench --bench odds`.
//!
//! Each sensor has its own scenes. A detector processes them one after another, and learns the contours of the sensor as in a
//! run. A candidate is right if it matches a true object by the criteria of an experiment's evaluation, whether the evaluation
//! requires this object or not. The benchmark takes six minutes on two cores.

use conicflow_detection::Detector;
use conicflow_detection::assemble::odds::{TERMS, WEIGHTS};
use conicflow_lab::score::RenderedTruth;
use conicflow_lab::score::matching::fault;
use conicflow_lab::simulator::SimulatorParameters;
use conicflow_messages::Header;
use nalgebra::{SMatrix, SVector};
use std::ops::Range;
use std::path::Path;

/// Name, first and last seed, and source parameters of each sensor.
const SENSORS: [(&str, [u64; 2], &str); 12] = [
    ("Kinect v1, 320x240", [500, 529], "width = 320\nheight = 240"),
    ("Kinect v1, 320x240, blobs of 9 px", [640, 659], "width = 320\nheight = 240\nnoise = { noise_window_px = 9 }"),
    ("stereo, own noise, 320x240", [620, 639], "width = 320\nheight = 240\nnoise = \"realsense_d435\""),
    ("Kinect v1", [500, 511], ""),
    ("Kinect v1, blobs of 5 px", [515, 526], "noise = { noise_window_px = 5 }"),
    ("stereo, own noise", [570, 577], "noise = \"realsense_d435\""),
    (
        "stereo, blobs of 9 px",
        [530, 541],
        "noise = { noise_window_px = 9, growth_per_m = 0.0025, floor_m = 0, step_per_m = 0 }",
    ),
    (
        "stereo, blobs of 13 px",
        [545, 552],
        "noise = { noise_window_px = 13, growth_per_m = 0.0025, floor_m = 0, step_per_m = 0 }",
    ),
    ("stereo, simulated", [700, 731], "sensor = \"stereo\"\ndepth_scale = 0.0002"),
    ("structured light, simulated", [740, 771], "sensor = \"structured_light\""),
    ("time of flight", [560, 564], "noise = \"time_of_flight\""),
    ("time of flight, simulated", [565, 569], "sensor = \"time_of_flight\""),
];
/// Groups of the scenes: all but `flat_tins`, because the other groups contain flat tins, too.
const GROUPS: &str = "\"standing\", \"tilted\", \"occluded\", \"tabletop\", \"lying\", \"composed\", \"clutter\", \"bowls\", \
                      \"empty\", \"furnished\", \"kitchen\", \"lived_in\", \"hall\"";
/// Groups of additional scenes: rooms, because many surfaces in rooms belong to no object.
const ROOMS: &str = "\"furnished\", \"clutter\", \"empty\", \"kitchen\"";
/// Offset of the seeds of the additional scenes.
const ROOM_SEEDS: u64 = 2000;
/// Strength of the prior that keeps the weights finite. With this number each weight has the standard deviation 2.
const PRIOR: f64 = 0.25;
/// Number of rounds of Newton's method, which converges in less than ten.
const ROUNDS: usize = 30;
/// Limits of the confidence classes in the table.
const CLASSES: [f64; 8] = [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0];

/// The terms of a candidate, and whether it is right.
struct Sample {
    terms: SVector<f64, TERMS>,
    is_right: bool,
    confidence: f64,
}

fn main() -> anyhow::Result<()> {
    let mut all = Vec::new();
    println!("{:34} {:>10} {:>6}", "sensor", "candidates", "right");
    for (name, samples) in look_at_all()? {
        let right = samples.iter().filter(|sample| sample.is_right).count();
        println!("{name:34} {:>10} {right:>6}", samples.len());
        all.extend(samples);
    }
    for (what, fitted) in [
        ("weights, that of roundness as it is", 0..TERMS - 1),
        ("that of roundness, all others as they are", TERMS - 1..TERMS),
    ] {
        let weights = fit(&all, &fitted);
        println!(
            "{what}: {:?}",
            weights.as_slice()[fitted].iter().map(|weight| (weight * 100.0).round() / 100.0).collect::<Vec<_>>()
        );
    }
    println!("\n{:>12} {:>10} {:>12}", "confidence", "candidates", "share right");
    for class in CLASSES.windows(2) {
        let of_it = |sample: &&Sample| class[0] <= sample.confidence && sample.confidence < class[1];
        let (count, right) = all
            .iter()
            .filter(of_it)
            .fold((0, 0), |(count, right), sample| (count + 1, right + usize::from(sample.is_right)));
        println!("{:>5} to {:<4} {count:>10} {:>12.2}", class[0], class[1], right as f64 / f64::from(count));
    }
    Ok(())
}

/// Returns the candidates of all sensors. Several sensors run at the same time.
fn look_at_all() -> anyhow::Result<Vec<(&'static str, Vec<Sample>)>> {
    let look_by = |(name, seeds, parameters): (&'static str, [u64; 2], &str)| {
        let mut samples = look(seeds, GROUPS, parameters)?;
        samples.extend(look(seeds.map(|seed| seed + ROOM_SEEDS), ROOMS, parameters)?);
        Ok((name, samples))
    };
    std::thread::scope(|scope| {
        let sensors = SENSORS.map(|sensor| scope.spawn(move || look_by(sensor)));
        sensors
            .into_iter()
            .map(|sensor| sensor.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}

/// Returns the candidates in the scenes with seeds in this range.
fn look(seeds: [u64; 2], groups: &str, parameters: &str) -> anyhow::Result<Vec<Sample>> {
    let parameters = format!("{parameters}\nscenes = {{ seeds = {seeds:?}, groups = [{groups}] }}");
    let parameters: SimulatorParameters = toml::from_str(&parameters)?;
    let (camera, frames) = (parameters.camera(), parameters.total().unwrap_or_default());
    let mut simulator = parameters.open(Path::new("."))?;
    let mut pixels = vec![0; camera.width as usize * camera.height as usize];
    let (truth, mut samples) = (RenderedTruth::default(), Vec::new());
    let mut detector = None;
    for number in 0..frames {
        let mut header = Header::default();
        simulator.shoot(number, &mut pixels);
        simulator.describe(&mut header);
        let new = || Detector::new(camera).noise(header.noise).depth_scale(header.depth_scale);
        let detector = detector.get_or_insert_with(new);
        detector.detect(&pixels);
        let truths = truth.objects(&header, &truth.scene_of(&header)?);
        samples.extend(detector.candidates().iter().map(|(object, evidence)| Sample {
            terms: SVector::from(evidence.terms()),
            is_right: truths.iter().any(|truth| fault(truth, object).is_none()),
            confidence: f64::from(object.confidence),
        }));
    }
    Ok(samples)
}

/// Fits the weights in the range `fitted` by logistic regression with Newton's method, and keeps the other weights.
fn fit(samples: &[Sample], fitted: &Range<usize>) -> SVector<f64, TERMS> {
    let only_fitted =
        |of: &SVector<f64, TERMS>| SVector::from_fn(|term, _| if fitted.contains(&term) { of[term] } else { 0.0 });
    let mut weights = SVector::from(WEIGHTS);
    weights -= only_fitted(&weights);
    for _ in 0..ROUNDS {
        let (mut gradient, mut curvature) =
            (-PRIOR * only_fitted(&weights), SMatrix::<f64, TERMS, TERMS>::identity() * PRIOR);
        for Sample { terms, is_right, .. } in samples {
            let (probability, terms) = (1.0 / (1.0 + (-weights.dot(terms)).exp()), only_fitted(terms));
            gradient += terms * (f64::from(*is_right) - probability);
            curvature += terms * terms.transpose() * (probability * (1.0 - probability));
        }
        let Some(curvature) = curvature.cholesky() else { break };
        weights += curvature.solve(&gradient);
    }
    weights
}
