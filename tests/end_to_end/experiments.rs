//! The paper's experiments in a short form: the files of `experiments/`, with fewer frames and values.

use crate::support::{Playground, Started, signal};
use conicflow_lab::score::truth::load_scene;
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::scene_values::Values;
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Rows of the CSV of an experiment.
struct Table(Vec<BTreeMap<String, String>>);

impl Table {
    /// Runs `experiments/NAME.toml` after some replacements in its text.
    fn of(name: &str, edits: &[(&str, &str)], frames: u32) -> Self {
        let playground = playground(name, edits);
        let file = format!("{name}.toml");
        let ended = playground.conicflow(&["run", &file, "--quiet", "--frames", &frames.to_string()]).expect_code(0);
        assert!(!ended.stdout.is_empty(), "no table");
        Self::read(&playground, &format!("results/{name}.csv"))
    }

    fn read(playground: &Playground, path: &str) -> Self {
        let lines = playground.lines(path);
        let titles: Vec<&str> = lines[0].split(',').collect();
        let row = |line: &String| {
            let cells = titles.iter().zip(line.split(',')).filter(|(_, cell)| !cell.is_empty());
            cells.map(|(title, cell)| ((*title).to_owned(), cell.to_owned())).collect()
        };
        Self(lines[1..].iter().map(row).collect())
    }

    /// The number in a column of the row with these cells.
    fn number(&self, cells: &[(&str, &str)], column: &str) -> f64 {
        let fits = |row: &&BTreeMap<String, String>| {
            cells.iter().all(|(column, cell)| row.get(*column).map(String::as_str) == Some(*cell))
        };
        let row = self.0.iter().find(fits).unwrap_or_else(|| panic!("no row with {cells:?} in {:?}", self.0));
        row.get(column).unwrap_or_else(|| panic!("no `{column}` in {row:?}")).parse().unwrap()
    }
}

fn playground(name: &str, edits: &[(&str, &str)]) -> Playground {
    let playground = Playground::new();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
    let mut text = fs::read_to_string(folder.join(format!("{name}.toml"))).unwrap();
    for (from, to) in edits {
        assert!(text.contains(from), "`{from}` does not stand in {name}.toml");
        text = text.replace(from, to);
    }
    playground.write(&format!("{name}.toml"), &text);
    fs::create_dir(playground.path("scenes")).unwrap();
    for scene in fs::read_dir(folder.join("scenes")).unwrap().flatten() {
        fs::copy(scene.path(), playground.path("scenes").join(scene.file_name())).unwrap();
    }
    playground
}

/// Asserts that the errors of the confirmed tracks agree with their sigmas over a whole sequence. The errors of its frames depend
/// on each other, so an object counts as one sample: ratios far below one are possible, ratios far above one are wrong. The
/// errors are also smaller than with real sensors: a sigma has a third of its variance for errors that do not average out over
/// frames, and a simulated sensor has few of these besides the bias of its contours, which is estimated.
fn assert_honest(table: &Table, object: &str) {
    let least = if object == "all" { 0.3 } else { 0.2 };
    for column in ["radius_sigmas", "center_sigmas"] {
        let error = table.number(&[("stage", "filtered"), ("object", object)], column);
        assert!((least..1.5).contains(&error), "{column} of {object}: {error}");
    }
}

fn assert_near(what: &str, number: f64, expected: f64, tolerance: f64) {
    assert!((number - expected).abs() <= tolerance, "{what}: {number}, expected {expected} +- {tolerance}");
}

#[test]
fn basic_scene_is_found_by_both_methods() {
    let table = Table::of("basic", &[], 12);
    for method in ["profile", "pooled"] {
        for object in ["trash can", "parking cone", "exercise ball"] {
            let found = table.number(&[("method", method), ("stage", "measured"), ("object", object)], "n");
            assert_eq!(found, 12.0, "{object}, {method}");
        }
    }
    let pooled =
        |object, column| table.number(&[("method", "pooled"), ("stage", "filtered"), ("object", object)], column);
    assert_near("radius of the can", pooled("trash can", "radius_m"), 0.17, 0.002);
    assert_near("radius of the ball", pooled("exercise ball", "radius_m"), 0.28, 0.003);
    assert_near("half-angle of the cone", pooled("parking cone", "half_angle_deg"), 13.57, 0.6);
    assert_eq!(pooled("all", "wrong"), 0.0);
    assert_eq!(pooled("all", "switches"), 0.0);
}

/// One entry under `cases` replaces the extractor by RANSAC, which finds can and ball in each row, and no cone.
#[test]
fn ransac_takes_the_extractors_place_in_the_basic_scene() {
    let table = Table::of("basic", &[], 4);
    let cell =
        |object, column| table.number(&[("method", "RANSAC"), ("stage", "measured"), ("object", object)], column);
    for (object, radius) in [("trash can", 0.147), ("exercise ball", 0.255)] {
        assert!(cell(object, "n") >= 3.0, "{object} in {} of 4 frames", cell(object, "n"));
        assert_near(object, cell(object, "radius_m"), radius, 0.015);
    }
    assert!(cell("parking cone", "n") <= 2.0);
}

#[test]
fn ransac_finds_ellipses_in_the_wall_and_wants_many_more_trials() {
    let table = Table::of("ransac", &[], 40);
    let cell = |method, ratio, column| table.number(&[("method", method), ("min_ratio", ratio)], column);
    for ratio in ["0.01", "0.2", "0.4"] {
        assert_eq!((cell("row by row", ratio, "n"), cell("row by row", ratio, "others")), (40.0, 0.0));
        assert_near("longer semi-axis", cell("row by row", ratio, "long_m"), 0.395, 0.002);
        let of_papers_trials = cell("RANSAC", ratio, "n");
        assert!((12.0..30.0).contains(&of_papers_trials), "{of_papers_trials} of 40 at a ratio of {ratio}");
        assert!(cell("RANSAC", ratio, "others") > 8.0, "ellipses in the wall");
    }
    let many = |ratio| cell("RANSAC x16", ratio, "n");
    assert_eq!((many("0.2"), many("0.4")), (40.0, 40.0));
    assert!(many("0.01") < 28.0, "without a limit of the ratio {} of 40", many("0.01"));
    assert_near("longer semi-axis", cell("RANSAC x16", "0.4", "long_m"), 0.397, 0.002);
}

/// The radius of the paper's way shrinks with the distance: 0.20, 0.16, 0.15 m. That of pooled moments does not.
#[test]
fn accuracy_shows_the_papers_bias_and_none_of_ours() {
    let table = Table::of(
        "accuracy",
        &[("[1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0]", "[1.0, 2.0, 3.0]"), ("from_s = 1.0 ", "from_s = 0.2 ")],
        18,
    );
    let radius = |distance, method, stage| {
        table.number(&[("distance", distance), ("method", method), ("stage", stage)], "radius_m")
    };
    for (distance, paper) in [("1", 0.20), ("2", 0.16), ("3", 0.15)] {
        assert_near("the paper's way", radius(distance, "profile", "measured"), paper, 0.012);
        assert_near("pooled", radius(distance, "pooled", "measured"), 0.2, 0.003);
        assert_near("pooled and filtered", radius(distance, "pooled", "filtered"), 0.2, 0.003);
    }
    let far = |stage, column| table.number(&[("distance", "3"), ("method", "pooled"), ("stage", stage)], column);
    assert_near("distance", far("measured", "distance_m"), 3.0, 0.005);
    assert!(far("filtered", "radius_sd_m") < 0.5 * far("measured", "radius_sd_m"), "the filter steadies the radius");
}

#[test]
fn occlusion_shrinks_the_papers_radius_and_not_ours() {
    let edits = [
        ("[1.0, 1.5, 2.0] }", "[1.0] }"),
        ("[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]", "[0.1, 0.4, 0.7]"),
        ("from_s = 1.0 ", "from_s = 0.2 "),
    ];
    let table = Table::of("occlusion", &edits, 12);
    let cell =
        |hidden, method, column| table.number(&[("hidden", hidden), ("method", method), ("stage", "measured")], column);
    assert_near("the paper's way, 40 %", cell("0.4", "profile", "radius_m"), 0.11, 0.015);
    assert_eq!(cell("0.7", "profile", "n"), 0.0, "the paper stops at 50 %");
    for hidden in ["0.1", "0.4", "0.7"] {
        assert_near("pooled", cell(hidden, "pooled", "radius_m"), 0.2, 0.006);
    }
}

#[test]
fn speeds_are_right_and_the_filter_steadies_them() {
    let table = Table::of("speed", &[("[0.21, 0.65, 0.71, 1.09, 1.54, 1.64, 2.66]", "[0.65, 2.66]")], 40);
    for (speed, expected) in [("0.65", 0.65), ("2.66", 2.66)] {
        let cell = |stage, column| table.number(&[("speed", speed), ("stage", stage)], column);
        assert_near("way over time", cell("measured", "speed_mps"), expected, 0.02);
        assert_near("filtered", cell("filtered", "speed_mps"), expected, 0.02);
        assert!(cell("filtered", "speed_sd_mps") < 0.015);
        assert_eq!(cell("filtered", "identities"), 1.0);
    }
}

#[test]
fn tilted_cones_are_found() {
    let table = Table::of("tilted_cone", &[], 8);
    for tilt in ["5", "20", "40"] {
        let cell = |column| table.number(&[("tilt_deg", tilt), ("method", "pooled")], column);
        assert_eq!(cell("n"), 8.0);
        assert_near("half-angle", cell("half_angle_deg"), 13.5, 0.7);
        assert!(cell("axis_rms_deg") < 1.0, "axis at {tilt} degrees: {}", cell("axis_rms_deg"));
    }
    let found = |tilt| table.number(&[("tilt_deg", tilt), ("method", "profile")], "n");
    assert_eq!((found("5"), found("20")), (8.0, 8.0));
}

#[test]
fn lying_pipes_need_columns() {
    let table = Table::of("lying_cylinder", &[], 8);
    let cell = |turned, scan, column| table.number(&[("turned_deg", turned), ("scan", scan)], column);
    assert_eq!(cell("0", "rows", "n"), 0.0, "its sections by rows are no ellipses");
    for (turned, scan) in [("0", "columns"), ("0", "both"), ("30", "both"), ("60", "both")] {
        assert_eq!(cell(turned, scan, "n"), 8.0);
        assert_near("radius", cell(turned, scan, "radius_m"), 0.1, 0.003);
    }
}

#[test]
fn a_ball_is_distinguished_from_the_can_below_it() {
    let table = Table::of("ball_on_cylinder", &[], 8);
    for (object, radius) in [("ball", 0.12), ("can", 0.15)] {
        let cell = |method, column| table.number(&[("method", method), ("object", object)], column);
        assert_eq!((cell("pooled", "n"), cell("profile", "n")), (8.0, 8.0));
        assert_near(object, cell("pooled", "radius_m"), radius, 0.002);
    }
    assert_eq!(table.number(&[("method", "pooled"), ("object", "all")], "wrong"), 0.0);
}

/// Times differ between machines. The test checks that the table has them, and that everything is found.
#[test]
fn cost_has_a_time_for_each_size() {
    let small = "        { name = 4800, set = { \"source.width\" = 80, \"source.height\" = 60 } },\n";
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments/cost.toml")).unwrap();
    let large: String =
        text.lines().filter(|line| line.contains("name = 1228800")).map(|line| format!("{line}\n")).collect();
    let table = Table::of("cost", &[(small, ""), (&large, "")], 4);
    for pixels in ["19200", "76800", "307200"] {
        assert!(table.number(&[("pixels", pixels), ("object", "all")], "extractor_ms") > 0.0);
    }
    let found = table.number(&[("pixels", "307200"), ("object", "all")], "n");
    assert_eq!(found, 12.0, "three objects in four frames");
}

#[test]
fn the_same_file_gives_the_same_table() {
    let edits = [("[1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0]", "[2.0]"), ("from_s = 1.0 ", "from_s = 0.0 ")];
    let playground = playground("accuracy", &edits);
    let run = || playground.conicflow(&["run", "accuracy.toml", "--quiet", "--frames", "6"]).expect_code(0).stdout;
    let first = run();
    assert_eq!(first, run());
    let plot = fs::read_to_string(playground.path("results/accuracy.svg")).unwrap();
    assert!(plot.contains("<polyline") && plot.contains("profile, measured"), "{plot}");
}

#[test]
fn a_wrong_experiment_is_refused() {
    let playground = playground("accuracy", &[("source.values.distance", "source.values.distanse")]);
    let ended = playground.conicflow(&["validate", "accuracy.toml"]).expect_code(2);
    ended.expect_texts(&["the scene has no value `distanse`"]);
    let playground = self::playground("accuracy", &[]);
    for command in ["validate", "run"] {
        let ended = playground.conicflow(&[command, "accuracy.toml", "--set", "source.values.distance=2"]);
        assert!(ended.expect_code(2).stderr.contains("the experiment varies `source.values.distance`"), "{command}");
    }
    let playground = self::playground("accuracy", &[("y = [\"radius_m\"]", "y = [\"radius\"]")]);
    for command in ["validate", "run"] {
        let ended = playground.conicflow(&[command, "accuracy.toml"]).expect_code(2);
        assert!(
            ended.stderr.contains("`experiment.plot.y`: there is no column `radius`"),
            "{command}: {}",
            ended.stderr
        );
    }
    let playground = self::playground("accuracy", &[("name = \"distance\"", "name = \"n\"")]);
    let ended = playground.conicflow(&["validate", "accuracy.toml"]).expect_code(2);
    ended.expect_texts(&["`vary` has the name `n`, as a column has that is measured"]);
}

#[test]
fn results_that_cannot_be_written_are_reported_before_anything_is_measured() {
    let playground = playground("accuracy", &[]);
    fs::write(playground.path("results"), "no folder").unwrap();
    let ended = playground.conicflow(&["run", "accuracy.toml"]).expect_code(2);
    ended.expect_texts(&["cannot write `", "results/accuracy.csv`: ", "a part of the path before the last is a file"]);
    assert!(!ended.stderr.contains("run 1 of"), "{}", ended.stderr);
}

/// The evaluation does not restart, because the truth would be missing again.
#[test]
fn a_run_ends_at_the_first_frame_without_a_truth() {
    let playground = playground("recording", &[]);
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 3);
    let ended = playground.conicflow(&["run", "recording.toml", "--set", "source.path=frames"]).expect_code(1);
    ended.expect_texts(&["the truth of the frames of `0.png` is not known", "`truth` the truth file of a recording"]);
    assert_eq!(ended.stage("evaluation").starts, 1, "{}", ended.stderr);
}

/// An interrupted experiment keeps the measurements of the runs that have finished.
#[test]
fn an_experiment_that_is_ended_from_outside_shows_the_runs_before() {
    let edits = [("[1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0]", "[2.0, 2.5]"), ("from_s = 1.0 ", "from_s = 0.0 ")];
    let playground = playground("accuracy", &edits);
    let mut run = playground.start(&["run", "accuracy.toml", "--frames", "120"]);
    run.wait_for_text("run 3 of 4");
    signal(run.id(), Signal::INT);
    let ended = run.wait().expect_code(1);
    ended.expect_texts(&["was ended from outside", "the tables and files have the first 2 of 4 runs"]);
    let rows = playground.lines("results/accuracy.csv");
    assert!(rows.len() == 5 && rows[1..].iter().all(|row| row.starts_with("2,")), "{rows:?}");
}

/// The command for each frame reaches the camera before the next frame. Only the time that this takes differs from run to run.
#[test]
fn the_robot_stops_a_metre_before_the_ball() {
    let table = Table::of("follow", &[("\"scenes/held_ball.toml\", ", ""), ("from_s = 11.0", "from_s = 7.5")], 240);
    let cell = |stage, column| table.number(&[("stage", stage)], column);
    assert_near("distance over ground", (cell("halt", "distance_m").powi(2) - 0.25_f64.powi(2)).sqrt(), 1.0, 0.03);
    assert!(cell("halt", "distance_sd_m") < 0.01, "it stands");
    assert_eq!(cell("way", "identities"), 1.0);
    assert!(cell("way", "position_rms_m") < 0.005, "the camera's way is taken out");
}

#[test]
fn crossing_balls_keep_their_identities() {
    let table = Table::of("crossing_balls", &[], 240);
    let all = |column| table.number(&[("stage", "filtered"), ("object", "all")], column);
    assert_eq!((all("switches"), all("identities")), (0.0, 5.0));
    assert!(all("mota") >= 0.95, "MOTA {}", all("mota"));
    assert!(all("motp_m") < 0.005, "MOTP {}", all("motp_m"));
    assert_honest(&table, "all");
}

#[test]
fn a_bouncing_ball_is_one_track_near_its_true_path() {
    let table = Table::of("bouncing_ball", &[], 110);
    let cell = |column| table.number(&[("stage", "filtered")], column);
    assert_eq!((cell("identities"), cell("switches")), (1.0, 0.0));
    assert!(cell("n") >= 106.0, "seen in {} of 110 frames", cell("n"));
    assert!(cell("position_rms_m") < 0.005, "{} m off", cell("position_rms_m"));
    assert_near("radius", cell("radius_m"), 0.1, 0.002);
    assert_honest(&table, "ball");
}

/// Writes frames of a scene and their camera.
fn record(playground: &Playground, scene: &str, frames: u64) {
    let scene = load_scene(&playground.path(scene)).unwrap().scene(&Values::new()).unwrap();
    playground.record_with_camera(scene, 77, frames);
}

/// An error at the end is reported once. The stage does not restart, because it would not get the earlier frames again.
#[test]
fn a_recording_that_is_too_short_to_measure_the_noise_is_reported_once() {
    let playground = playground("noise", &[]);
    record(&playground, "scenes/basic.toml", 3);
    let ended = playground.conicflow(&["run", "noise.toml", "--set", "source.path=frames"]).expect_code(1);
    ended.expect_texts(&[
        "the recording has 3 frames, but a static scene needs",
        "stage `estimator` failed at the end of its work",
    ]);
    assert!(!ended.stderr.contains("anew"), "{}", ended.stderr);
}

/// A few settings replace the synthetic source by recorded frames. The table has a row for each shape and each track.
#[test]
fn an_experiment_takes_recorded_frames() {
    let playground = playground("basic", &[]);
    record(&playground, "scenes/basic.toml", 6);
    let set = ["source.node=image_source", "source.path=frames", "source.rate_hz=0", "source.noise=kinect_v1"];
    let sets = set.iter().flat_map(|set| ["--set", set]);
    let arguments: Vec<&str> = ["run", "basic.toml", "--quiet"].into_iter().chain(sets).collect();
    playground.conicflow(&arguments).expect_code(0);
    let table = Table::read(&playground, "results/basic.csv");
    let cell =
        |stage, object, column| table.number(&[("method", "pooled"), ("stage", stage), ("object", object)], column);
    for (shape, radius) in [("cylinder", 0.17), ("cone", 0.09), ("sphere", 0.28)] {
        assert_eq!((cell("measured", shape, "frames"), cell("measured", shape, "n")), (6.0, 6.0), "{shape}");
        assert_near(shape, cell("measured", shape, "radius_m"), radius, 0.004);
    }
    let tracks = table.0.iter().filter(|row| row["method"] == "pooled" && row["stage"] == "filtered");
    assert_eq!(
        tracks.map(|row| row["n"].as_str()).collect::<Vec<_>>(),
        ["4", "4", "4"],
        "confirmed in the third frame"
    );
}

/// With recorded frames, too, the summary counts missed objects and wrong answers, and the details list them.
#[test]
fn faults_of_recorded_frames_are_counted_and_reported() {
    let playground = playground("recording", &[]);
    record(&playground, "scenes/basic.toml", 2);
    let balloon = r#"{"type": "sphere", "what": "balloon", "radius_m": 0.1, "centre_m": [0, -0.5, 1]}"#;
    playground.write("truth.json", &format!(r#"{{"units": "m", "scenes": {{"1.png": [{balloon}]}}}}"#));
    let set = ["source.path=frames", "evaluation.truth=truth.json", "evaluation.details_path=details.jsonl"];
    let sets = set.iter().flat_map(|set| ["--set", set]);
    let arguments: Vec<&str> = ["run", "recording.toml"].into_iter().chain(sets).collect();
    let ended = playground.conicflow(&arguments).expect_code(0);
    for counted in ["evaluation: missed: 1\n", "evaluation: wrong: 3\n"] {
        assert!(ended.stderr.contains(counted), "no `{counted}` in {}", ended.stderr);
    }
    let details = playground.json_lines("details.jsonl");
    assert_eq!((details.len(), &details[0]["scene"]), (1, &"1.png".into()), "the other frame is not judged");
    assert_eq!(details[0]["missed"][0]["name"], "balloon");
    let wrong = details[0]["wrong"].as_array().unwrap();
    assert_eq!((wrong.len(), &wrong[0]["why"]), (3, &"nothing there".into()));
}

/// The script processes all folders with frames, and prints one table. Recordings without a truth have no right answers.
#[test]
fn the_recordings_are_one_table() {
    let playground = playground("recording", &[]);
    record(&playground, "scenes/basic.toml", 2);
    let experiments = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
    for file in ["recordings.sh", "flipped_recording.toml", "nothing_to_find.json"] {
        fs::copy(experiments.join(file), playground.path(file)).unwrap();
    }
    let truth = r#"{"units": "m", "scenes": {"0.png": [], "1.png": []}, "visible_unmeasured": {
        "1.png": [{"what": "all of it", "box": [0, 0, 319, 239]}]}}"#;
    for name in ["a", "b"] {
        fs::create_dir_all(playground.path(&format!("data/{name}/depth"))).unwrap();
        for file in ["0.png", "1.png", "camera.json"] {
            let copy = playground.path(&format!("data/{name}/depth/{file}"));
            fs::copy(playground.path(&format!("frames/{file}")), copy).unwrap();
        }
    }
    fs::create_dir(playground.path("data/notes")).unwrap();
    playground.write("data/a/truth.json", truth);
    let mut command = playground.command_of(Path::new("sh"), &["recordings.sh", "--pictures", "pictures", "--quiet"]);
    command.env("CONICFLOW", env!("CARGO_BIN_EXE_conicflow")).env("CONICFLOW_DATA", "data");
    let ended = Started::new(command).wait().expect_code(0);
    assert!(
        ended.stdout.contains("  neither   sphere at ") && ended.stdout.contains("\ndetection on recorded frames\n")
    );
    let table = Table::read(&playground, "results/recordings.csv");
    let cells = ["frames", "to_find", "found", "wrong", "neither", "wrong_per_frame"];
    let row = |name| cells.map(|column| table.number(&[("recording", name)], column));
    assert_eq!((row("a"), row("b")), ([2.0, 0.0, 0.0, 3.0, 3.0, 1.5], [2.0, 0.0, 0.0, 6.0, 0.0, 3.0]));
    assert_eq!(table.0.len(), 2, "a folder without frames is none");
    assert!(playground.path("pictures/b/1.png").is_file());
    let flipped = |arguments: &[&str]| {
        let arguments = [&["recordings.sh", "--flip", "none clockwise"], arguments].concat();
        let mut command = playground.command_of(Path::new("sh"), &arguments);
        command.env("CONICFLOW", env!("CARGO_BIN_EXE_conicflow")).env("CONICFLOW_DATA", "data");
        Started::new(command).wait()
    };
    // Answers on rotated frames have to be rotated back to lie in the box of the truth.
    let ended = flipped(&["--quiet"]).expect_code(0);
    let table = Table::read(&playground, "results/recordings.csv");
    let wrong =
        |flip, name| ["wrong", "neither"].map(|cell| table.number(&[("flip", flip), ("recording", name)], cell));
    for flip in ["none", "clockwise"] {
        assert_eq!((wrong(flip, "a"), wrong(flip, "b")), ([3.0, 3.0], [6.0, 0.0]), "{flip}");
    }
    let sums: Vec<Vec<&str>> = ended.stdout.lines().map(|line| line.split_whitespace().collect()).collect();
    assert!(sums.contains(&vec!["all", "8", "0", "0", "18"]), "{}", ended.stdout);
    assert!(flipped(&["--pictures", "pictures"]).expect_code(2).stderr.contains("one way at a time"));
}

/// Runs two configurations of the limit. Apart from chance, no detector can beat the bound.
#[test]
fn no_detector_is_better_than_the_bound() {
    let wanted = ["\"sphere 10 cm at 1 m\"", "\"cylinder 10 cm at 2 m\"", "cases = ["];
    let text = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments/limit.toml")).unwrap();
    let cases = text.lines().filter(|line| line.trim_start().starts_with("{ name = "));
    let others = cases.filter(|line| !wanted.iter().any(|wanted| line.contains(wanted)));
    let table = Table::of("limit", &others.map(|line| (line, "")).collect::<Vec<_>>(), 60);
    let quantities = ["radius mm", "position mm", "axis deg"];
    for (configuration, quantities) in
        [("sphere 10 cm at 1 m", &quantities[..2]), ("cylinder 10 cm at 2 m", &quantities)]
    {
        for quantity in quantities {
            let cell = |column| table.number(&[("configuration", configuration), ("quantity", quantity)], column);
            let what = format!("{quantity} of {configuration}");
            assert_eq!((cell("frames"), cell("found"), cell("wrong")), (60.0, 1.0, 0.0), "{what}");
            assert!(0.0 < cell("bound_b") && cell("bound_b") <= cell("bound_a"), "{what}");
            // The scatter of 60 frames is known to a tenth.
            assert!((0.1..1.4).contains(&cell("efficiency_b")), "{what}: {}", cell("efficiency_b"));
            assert!((0.3..3.0).contains(&cell("sigma_over_scatter")), "{what}: {}", cell("sigma_over_scatter"));
        }
    }
    assert_eq!(table.0.len(), 5);
}

/// A ball on a stick that a person carries has one identity in all frames.
#[test]
fn the_recorded_ball_has_one_identity_from_first_to_last_sight() {
    let folder = std::env::var_os("CONICFLOW_DATA").map(|data| Path::new(&data).join("ball-kinect-cam1/depth"));
    let Some(folder) = folder.filter(|folder| folder.is_dir()) else {
        eprintln!("SKIPPED: CONICFLOW_DATA does not name a folder with `ball-kinect-cam1/depth`");
        return;
    };
    let playground = playground("recorded_ball", &[]);
    let path = format!("source.path={:?}", folder.canonicalize().unwrap());
    let arguments = ["run", "recorded_ball.toml", "--quiet", "--set", &path, "--set", "json.path=\"tracks.jsonl\""];
    playground.conicflow(&arguments).expect_code(0);
    let frames = playground.json_lines("tracks.jsonl");
    for frame in &frames {
        let tracks = frame["tracks"].as_array().unwrap();
        let is_ball = |radius: f64| (0.195..0.222).contains(&radius); // what its truth file accepts
        let ball = tracks.iter().find(|track| track["kind"] == "sphere" && is_ball(track["radius"].as_f64().unwrap()));
        assert_eq!(
            ball.map(|ball| (ball["id"].as_u64(), ball["misses"].as_u64())),
            Some((Some(1), Some(0))),
            "{frame}"
        );
    }
    assert_eq!(frames.len(), 101);
}

/// An ellipse fitted to a short noisy arc is too small: the paper's bias, in one scan line.
#[test]
fn an_ellipse_is_found_in_noise_and_shrinks_with_it() {
    let edits = [("[0.0, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04]", "[0.0, 0.005, 0.02]")];
    let table = Table::of("ellipse_noise", &edits, 50);
    let cell = |sigma, column| table.number(&[("sigma_m", sigma)], column);
    assert_near("without noise", cell("0", "long_m"), 0.4, 5e-4);
    assert_near("without noise", cell("0", "short_m"), 0.2, 5e-4);
    assert_eq!((cell("0.005", "n"), cell("0.02", "n")), (50.0, 50.0));
    assert_near("residual", cell("0.02", "rms_m"), 0.02, 0.001);
    assert!((0.30..0.34).contains(&cell("0.02", "long_m")) && cell("0.02", "long_sd_m") < 0.02);
}
