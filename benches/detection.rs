//! Measures the CPU time of the parts of the detector for several image sizes, on cluttered rendered scenes. For comparison it
//! measures the minimum for any detector (reading the frame, summing the moments of its rows) and the paper's method, which fits
//! an ellipse at every point.
//!
//! `cargo bench --bench detection` uses one thread, and prints the medians over scenes of the medians over repetitions. The last
//! column is the exponent p in `time ~ pixels^p`, fitted over all sizes: 1 is linear.
//!
//! `cargo bench --bench detection -- FOLDER...` uses recorded frames instead of scenes, with a column for each folder that
//! `image_source` can read.

use conicflow_detection::{Assembler, AssemblerParameters, Extractor, ExtractorParameters};
use conicflow_geometry::{Pinhole, PlaneMoments, Scan, fit_ellipse};
use conicflow_lab::paper::assembler::{ProfileAssembler, ProfileConfig};
use conicflow_lab::paper::extractor::{ConicConfig, ConicExtractor};
use conicflow_lab::simulator::random_scene::SceneGroup;
use conicflow_lab::simulator::random_scenes::RandomScenes;
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Ellipse, Header, is_measured};
use conicflow_nodes::sources::image_source::{self, Playback};
use rustix::time::{ClockId, clock_gettime};
use std::error::Error;
use std::hint::black_box;
use std::path::Path;

const SIZES: [(u32, u32); 5] = [(80, 60), (160, 120), (320, 240), (640, 480), (1280, 960)];
const GROUPS: [SceneGroup; 4] = [SceneGroup::Clutter, SceneGroup::Standing, SceneGroup::Tabletop, SceneGroup::Composed];
const SEEDS: [u64; 2] = [0, 4];
const REPETITIONS: usize = 5;

/// The work of a part of the detector on a frame. The work has a result, so that the compiler cannot remove it.
type Work<'a> = Box<dyn FnMut(&Frame) -> u64 + 'a>;

struct Frame {
    header: Header,
    pixels: Vec<u16>,
    ellipses: Vec<Ellipse>,
}

/// Frames of one kind: a column of the table.
struct Column {
    name: String,
    frames: Vec<Frame>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let folders: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    let columns: Vec<Column> = if folders.is_empty() {
        SIZES.iter().map(|&size| scenes(size)).collect::<Result<_, _>>()?
    } else {
        folders.iter().map(|folder| recorded(folder)).collect::<Result<_, _>>()?
    };
    let line = |name: &str, cells: &mut dyn Iterator<Item = String>| {
        println!("{name:<32}{}", cells.map(|cell| format!("{cell:>12}")).collect::<String>());
    };
    line("milliseconds of CPU per frame", &mut columns.iter().map(|column| tail(&column.name, 11)));
    line("frames", &mut columns.iter().map(|column| column.frames.len().to_string()));
    let mut floors = Vec::new();
    for (name, mut work) in parts() {
        let times: Vec<Times> = columns.iter().map(|column| Times::of(&column.frames, &mut work)).collect();
        let exponent = folders.is_empty().then(|| format!("p = {:.2}", exponent(&times)));
        line(name, &mut times.iter().map(|times| format!("{:.3}", times.median)).chain(exponent));
        match name {
            FLOOR => floors = times,
            BOTH => {
                let over = times.iter().zip(&floors).map(|(both, floor)| both.median / floor.median);
                line("  over the floor of the moments", &mut over.map(|ratio| format!("{ratio:.1}")));
                let slowest = times.iter().map(|times| times.percentile_99 / times.median);
                line("  99th percentile over median", &mut slowest.map(|ratio| format!("{ratio:.1}")));
            }
            _ => {}
        }
    }
    Ok(())
}

/// The last characters of a text.
fn tail(text: &str, characters: usize) -> String {
    text.chars().skip(text.chars().count().saturating_sub(characters)).collect()
}

const FLOOR: &str = "floor: 15 moments of each row";
const BOTH: &str = "both";

fn parts() -> [(&'static str, Work<'static>); 7] {
    let (mut extractor, mut assembler) = detector();
    let (mut first, mut second) = detector();
    let (mut conics, mut profile) = detector_of_the_paper();
    [
        ("floor: reading the frame", Box::new(read)),
        (FLOOR, Box::new(sum_moments)),
        ("row_ellipse_extractor", Box::new(move |frame| extractor.extract(&frame.header, &frame.pixels).len() as u64)),
        ("object_assembler", Box::new(move |frame| assembler.assemble(&frame.header, &frame.ellipses).len() as u64)),
        (
            BOTH,
            Box::new(move |frame| {
                let ellipses = first.extract(&frame.header, &frame.pixels);
                second.assemble(&frame.header, ellipses).len() as u64
            }),
        ),
        (
            "the paper: conics and profiles",
            Box::new(move |frame| {
                let ellipses = conics.extract(&frame.header, &frame.pixels);
                profile.assemble(&frame.header, ellipses).len() as u64
            }),
        ),
        ("the paper: a fit at every point", Box::new(fit_every_point)),
    ]
}

fn detector() -> (Extractor, Assembler) {
    (Extractor::new(ExtractorParameters::default()), Assembler::new(AssemblerParameters::default()))
}

fn detector_of_the_paper() -> (ConicExtractor, ProfileAssembler) {
    (ConicExtractor::new(ConicConfig::of_the_paper()), ProfileAssembler::new(ProfileConfig::of_the_paper()))
}

/// Simulated scenes with this image size.
fn scenes((width, height): (u32, u32)) -> Result<Column, Box<dyn Error>> {
    let config = SimulatorParameters { width, height, ..SimulatorParameters::default() };
    let scenes = RandomScenes { groups: GROUPS.into(), seeds: SEEDS, ..RandomScenes::default() };
    let (first, _) = scenes.scene(0);
    let count = scenes.frames();
    let mut camera =
        SyntheticCamera::new(first, config.camera(), config.noise, config.depth_scale, 30.0, 0).before(scenes);
    let (mut extractor, _) = detector();
    let frame = |number| {
        let mut pixels = vec![0; width as usize * height as usize];
        camera.shoot(number, &mut pixels);
        let mut header = Header::default();
        camera.describe(&mut header);
        Frame::new(header, pixels, &mut extractor)
    };
    Ok(Column { name: format!("{width}x{height}"), frames: (0..count).map(frame).collect() })
}

/// The recorded frames of a folder.
fn recorded(folder: &str) -> Result<Column, Box<dyn Error>> {
    let config = image_source::Config { path: Some(folder.into()), ..Default::default() };
    let mut playback = Playback::open(&config, Path::new(""), 0, 0)?;
    let (mut extractor, _) = detector();
    let mut frames = Vec::new();
    while let Some(loaded) = playback.load()? {
        let mut pixels = vec![0; loaded.pixels()];
        if let Some(header) = playback.decode(&loaded, &mut pixels)? {
            frames.push(Frame::new(header, pixels, &mut extractor));
        }
    }
    Ok(Column { name: folder.trim_end_matches('/').to_owned(), frames })
}

impl Frame {
    fn new(header: Header, pixels: Vec<u16>, extractor: &mut Extractor) -> Self {
        let ellipses = extractor.extract(&header, &pixels).to_vec();
        Self { header, pixels, ellipses }
    }
}

/// Median and 99th percentile of the times of a column's frames. The time of a frame is the median over its repetitions.
struct Times {
    median: f64,
    percentile_99: f64,
}

impl Times {
    fn of(frames: &[Frame], work: &mut Work) -> Self {
        let of_frame = |frame: &Frame| {
            let mut times: Vec<f64> = (0..=REPETITIONS).map(|_| cpu_ms(|| work(black_box(frame)))).collect();
            times.remove(0); // the first repetition only warms the caches
            quantile(&mut times, 0.5)
        };
        let mut times: Vec<f64> = frames.iter().map(of_frame).collect();
        Self { median: quantile(&mut times, 0.5), percentile_99: quantile(&mut times, 0.99) }
    }
}

fn quantile(values: &mut [f64], share: f64) -> f64 {
    let place = (share * values.len() as f64) as usize;
    *values.select_nth_unstable_by(place, f64::total_cmp).1
}

fn cpu_ms(work: impl FnOnce() -> u64) -> f64 {
    let now = || {
        let time = clock_gettime(ClockId::ThreadCPUTime);
        time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
    };
    let start = now();
    black_box(work());
    now() - start
}

/// The exponent p in `time ~ pixels^p`: the slope of a straight line that is fitted to the logarithms.
fn exponent(times: &[Times]) -> f64 {
    let x: Vec<f64> = SIZES.iter().map(|(width, height)| (f64::from(*width) * f64::from(*height)).ln()).collect();
    let y: Vec<f64> = times.iter().map(|times| times.median.ln()).collect();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (mean_x, mean_y) = (mean(&x), mean(&y));
    let product = x.iter().zip(&y).map(|(x, y)| (x - mean_x) * (y - mean_y)).sum::<f64>();
    product / x.iter().map(|x| (x - mean_x).powi(2)).sum::<f64>()
}

fn read(frame: &Frame) -> u64 {
    frame.pixels.iter().map(|&pixel| u64::from(pixel)).sum()
}

/// The measurements of each row as points in the row's plane, in metres.
fn rows(frame: &Frame) -> impl Iterator<Item = impl Iterator<Item = [f64; 2]>> {
    let camera = &frame.header.camera;
    let pinhole = Pinhole { fx: camera.fx, fy: camera.fy, cx: camera.cx, cy: camera.cy };
    frame.pixels.chunks_exact(camera.width as usize).enumerate().map(move |(number, row)| {
        let stretch = pinhole.plane(Scan::Row, number as f64).stretch();
        row.iter().enumerate().filter(|(_, pixel)| is_measured(**pixel)).map(move |(u, &pixel)| {
            let z = f64::from(pixel) * frame.header.depth_scale;
            [z * pinhole.ray_slope(Scan::Row, u as f64), z * stretch]
        })
    })
}

fn sum_moments(frame: &Frame) -> u64 {
    let mut check = 0;
    for points in rows(frame) {
        let mut moments = PlaneMoments::new([0.0, 1.0]);
        points.for_each(|point| moments.add(point));
        check ^= moments.get(4, 0).to_bits();
    }
    check
}

/// Algorithm 1 of the paper: add a point, fit, and start again where the error exceeds the noise.
fn fit_every_point(frame: &Frame) -> u64 {
    const JUMP_M: f64 = 0.05;
    const FEWEST: f64 = 6.0;
    let noise = frame.header.noise;
    let mut found = 0;
    for points in rows(frame) {
        let mut moments = PlaneMoments::new([0.0, 1.0]);
        let mut last = 0.0;
        for [s, t] in points {
            moments.add([s, t]);
            let jump = (t - last).abs() > JUMP_M;
            last = t;
            if moments.count() < FEWEST && !jump {
                continue;
            }
            let rms = fit_ellipse(&moments).and_then(|conic| conic.rms(&moments));
            if jump || rms.is_some_and(|rms| rms > 0.0005 + 1.3 * noise.sigma(t)) {
                found += 1;
                moments = PlaneMoments::new([s, t]);
            }
        }
    }
    found
}
