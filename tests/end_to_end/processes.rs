//! The processes of a run: which process starts which, what a run survives, how it ends, and that nothing is left behind.

use crate::support::{
    Playground, Started, TRACKING, TRACKING_STAGES, TRACKING_TOPICS, copy_program, environment, hearing_hangups,
    parent, processes, signal, tracking_behind, wait_until,
};
use rustix::process::Signal;
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::Duration;

/// Starts a run of these stages at this rate, which does not end by itself, and waits until it delivers tracks. Returns its
/// playground and the run.
pub fn at_work(text: &str, rate_hz: u32) -> (Playground, Started) {
    let playground = Playground::with_pipeline(text);
    let mut run = playground.start(&["run", "--set", &format!("source.rate_hz={rate_hz}")]);
    wait_for_lines(&mut run, &playground);
    (playground, run)
}

/// Starts a run at 50 Hz that does not end by itself.
pub fn start(playground: &Playground) -> Started {
    Started::new(hearing_hangups(&playground.command(&["run", "--set", "source.rate_hz=50"])))
}

/// Waits until a run has written more than three further lines of tracks.
pub fn wait_for_lines(run: &mut Started, playground: &Playground) {
    let before = playground.count("tracks.jsonl");
    run.wait_until("it delivers", || playground.count("tracks.jsonl") > before + 3);
}

/// Waits until each writer before a stopped stage is blocked by the stage after it, and the source has made no further frame in
/// the meantime.
pub fn wait_for_standstill(run: &mut Started, playground: &Playground, stopped: &str) {
    let last = TRACKING_TOPICS.iter().position(|(_, _, reader)| *reader == stopped).unwrap();
    let mut made = Json::Null;
    run.wait_until("all writers wait", || {
        let state = playground.top();
        let stage =
            |name: &str| state["stages"].as_array().unwrap().iter().find(|stage| stage["stage"] == name).unwrap();
        let all_wait = TRACKING_TOPICS[..=last].iter().all(|(_, writer, reader)| stage(writer)["waits_for"] == *reader);
        let now = stage("source")["messages"].clone();
        std::mem::replace(&mut made, now) == made && all_wait
    });
}

/// The processes of a launcher's stages, by name.
pub fn stages_of(launcher: u32) -> BTreeMap<String, u32> {
    let children = processes().filter(|process| parent(*process) == Some(launcher));
    children.filter_map(|process| Some((environment(process, "CONICFLOW_STAGE")?, process))).collect()
}

fn expect_nothing_lives(playground: &Playground) {
    let living = playground.processes();
    assert!(living.is_empty(), "the run is over, but not for {living:?}");
}

#[test]
fn each_stage_is_a_process_whose_parent_is_the_launcher_and_top_shows_it_at_work() {
    let (playground, run) = at_work(TRACKING, 50);
    let state = playground.top();
    assert_eq!(state["pipeline"], "tracking", "{state:#}");
    let processes = stages_of(run.id());
    assert_eq!(playground.processes().len(), processes.len() + 1, "one process per stage, and the launcher");
    for (index, name) in TRACKING_STAGES.into_iter().enumerate() {
        let stage = &state["stages"][index];
        assert_eq!((&stage["stage"], &stage["process"]), (&name.into(), &processes[name].into()), "{state:#}");
        assert!(stage["messages"].as_u64().unwrap() > 0, "{state:#}");
    }
}

#[test]
fn top_and_the_summary_count_what_the_file_of_results_has() {
    let (playground, mut run) = at_work(TRACKING, 50);
    // While the source is stopped, all messages under way arrive, and the counts no longer change. The source may be stopped
    // after it has sent a message and before it has counted the message.
    let source = stages_of(run.id())["source"];
    signal(source, Signal::STOP);
    let counts = |state: &Json, list: &str, key: &str| -> Vec<u64> {
        state[list].as_array().unwrap().iter().map(|row| row[key].as_u64().unwrap()).collect()
    };
    run.wait_until("all that was sent has arrived", || {
        let worked = counts(&playground.top(), "stages", "messages");
        let lines = playground.lines("tracks.jsonl").len() as u64;
        worked[1..] == [lines; 4] && (worked[0]..=worked[0] + 1).contains(&lines)
    });
    let (state, lines) = (playground.top(), playground.lines("tracks.jsonl").len() as u64);
    assert_eq!(counts(&state, "topics", "sent")[1..], [lines; 3], "{state:#}");
    assert_eq!(counts(&state, "inputs", "received"), [lines; 4], "{state:#}");
    for lost in ["dropped", "gaps", "late", "malformed"] {
        assert_eq!(counts(&state, "inputs", lost), [0; 4], "{state:#}");
    }
    signal(source, Signal::CONT);
    wait_for_lines(&mut run, &playground);
    let ended = run.end();
    let lines = playground.lines("tracks.jsonl").len() as u64;
    assert!(TRACKING_STAGES.iter().all(|stage| ended.stage(stage).messages == lines), "{lines}: {}", ended.stderr);
    assert_eq!(ended.input("tracks", "json").received, lines, "{}", ended.stderr);
}

#[test]
fn a_reader_that_never_reads_does_not_keep_a_run_from_ending() {
    let (playground, mut run) = at_work(TRACKING, 50);
    let reader = stages_of(run.id())["tracker"];
    signal(reader, Signal::STOP);
    wait_for_standstill(&mut run, &playground, "tracker");
    let report = |stages: [&str; 2]| format!("`{}` waits for `{}` to take its messages", stages[0], stages[1]);
    assert_eq!(playground.top()["stages"][0]["waits_for"], "extractor");
    run.wait_for_text("nothing has moved for 10 s: ");
    for pair in [["source", "extractor"], ["extractor", "assembler"], ["assembler", "tracker"]] {
        assert!(run.stderr().contains(&report(pair)), "{}", run.stderr());
    }
    signal(run.id(), Signal::INT);
    let ended = run.wait().expect_code(1);
    assert!(ended.stderr.contains("\ntracking: "), "no summary: {}", ended.stderr);
    let why = "\nnot complete: nothing was delivered any more for 7 s: waited for `source`, `extractor`, `assembler`, ";
    let summary = ended.stderr.split_once(why).unwrap_or_else(|| panic!("{}", ended.stderr)).1;
    assert!(summary.contains("`tracker` has given no sign of life for "), "{summary}");
    assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..ended.stage("json").messages), "{}", ended.stderr);
    expect_nothing_lives(&playground);
}

/// Number of messages that exceeds the capacity of five stages and the queues between them.
pub const UNDER_WAY: u64 = 24;

/// Kills the stages one after another, each after the restarted stage before it has worked. Asserts that each killed stage
/// restarts, that no other stage restarts, and that results arrive in order.
fn kill_each_stage(delivery: &str) {
    let (playground, mut run) = at_work(&TRACKING.replace("lossless", delivery), 50);
    let launcher = run.id();
    for stage in TRACKING_STAGES {
        let before = stages_of(launcher);
        signal(before[stage], Signal::KILL);
        let at = playground.newest("tracks.jsonl");
        let is_new = |process: Option<&u32>| process.is_some_and(|process| *process != before[stage]);
        run.wait_until("the stage is started anew", || is_new(stages_of(launcher).get(stage)));
        run.wait_until("it has worked", || playground.newest("tracks.jsonl") > at + UNDER_WAY);
        let mut after = stages_of(launcher);
        after.insert(stage.to_owned(), before[stage]);
        assert_eq!(after, before, "only `{stage}` was to be started anew");
    }
    let ended = run.end();
    for stage in TRACKING_STAGES {
        assert_eq!(ended.stage(stage).starts, 2, "{stage}: {}", ended.stderr);
        let report = format!("stage `{stage}` was killed by signal 9, and is started anew in 0.1 s");
        assert!(ended.stderr.contains(&report), "{stage}: {}", ended.stderr);
    }
    let sequences = playground.sequences("tracks.jsonl");
    assert!(sequences.is_sorted(), "frames went back: {sequences:?}");
    if delivery == "lossless" {
        playground.expect_each_frame(&ended);
    }
}

#[test]
fn the_run_survives_the_death_of_any_stage_with_latest() {
    kill_each_stage("latest");
}

#[test]
fn the_run_survives_the_death_of_any_stage_on_lossless_topics() {
    kill_each_stage("lossless");
}

#[test]
fn no_stage_outlives_its_launcher_and_the_next_run_does_not_wait_for_them() {
    let (playground, mut run) = at_work(TRACKING, 50);
    signal(run.id(), Signal::KILL);
    wait_until("the launcher is dead", || !run.is_running());
    playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]).expect_code(0);
    assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2]);
    wait_until("all processes are gone", || playground.processes().is_empty());
}

#[test]
fn interrupt_and_terminate_end_a_run_in_order() {
    for end in [Signal::INT, Signal::TERM] {
        let (playground, run) = at_work(TRACKING, 50);
        signal(run.id(), end);
        let ended = run.wait().expect_code(0);
        assert_eq!(ended.stages(), TRACKING_STAGES, "{end:?}");
        assert!(playground.expect_each_frame(&ended) > 0, "{end:?}");
        expect_nothing_lives(&playground);
    }
}

#[test]
fn a_second_interrupt_ends_stages_that_ignore_the_first() {
    let deaf = r#"
[stage]
deaf = { program = ["sh", "-c", "trap '' INT TERM; exec sleep 600"], input = "tracks" }
"#;
    let (playground, mut run) = at_work(&format!("{TRACKING}{deaf}"), 50);
    let launcher = run.id();
    signal(launcher, Signal::INT);
    run.wait_until("all others have ended", || stages_of(launcher).keys().eq(["deaf"]));
    wait_until("it is gone too", || {
        signal(launcher, Signal::INT);
        stages_of(launcher).is_empty()
    });
    let ended = run.wait();
    assert!(ended.stderr.contains("\ntracking: "), "no summary: {}", ended.stderr);
    expect_nothing_lives(&playground);
}

#[test]
fn a_run_goes_on_when_the_reader_of_its_log_has_gone() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut command = playground.command(&["run", "--frames", "30", "--set", "tracker.node=no_such_node"]);
    assert_eq!(command.stderr(Stdio::piped()).spawn().map(read_nothing).unwrap(), Some(2));
    let mut command = playground.command(&["run", "--frames", "30"]);
    assert_eq!(command.stderr(Stdio::piped()).spawn().map(read_nothing).unwrap(), Some(0));
    assert_eq!(playground.sequences("tracks.jsonl").len(), 30);
}

/// Closes the pipe into which a program logs, and waits for the program.
fn read_nothing(mut program: Child) -> Option<i32> {
    drop(program.stderr.take());
    program.wait().unwrap().code()
}

#[test]
fn a_source_that_cannot_start_ends_the_run() {
    let source = "node = \"image_source\"\npath = \"frames/\"\nrate_hz = 0";
    let playground = Playground::with_pipeline(&tracking_behind(source, "lossless"));
    fs::create_dir(playground.path("frames")).unwrap();
    playground.conicflow(&["validate"]).expect_code(0);
    let ended = playground.conicflow(&["run"]).expect_code(1);
    let folder = playground.path("frames").display().to_string();
    assert!(ended.stderr.lines().any(|line| line.starts_with("error: ") && line.contains(&folder)), "{}", ended.stderr);
    ended.expect_texts(&["\n  hint: "]);
    assert!(ended.stderr.ends_with("not complete: a stage was lost, see above\n"), "{}", ended.stderr);
    expect_nothing_lives(&playground);
}

#[test]
fn a_sink_that_cannot_write_ends_the_run() {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = playground.conicflow(&["run", "--set", "json.path=pipeline.toml/tracks.jsonl"]).expect_code(1);
    let is_expected = |line: &str| line.starts_with("error: ") && line.contains("pipeline.toml/tracks.jsonl");
    assert!(ended.stderr.lines().any(is_expected), "{}", ended.stderr);
    assert!(ended.stderr.ends_with("not complete: a stage was lost, see above\n"), "{}", ended.stderr);
    expect_nothing_lives(&playground);
}

#[test]
fn a_stage_that_is_never_restarted_leaves_the_others_at_work() {
    let other = r#"
[stage]
other = { node = "json_sink", input = { topic = "tracks", delivery = "lossless" }, path = "other.jsonl", restart = "never" }
"#;
    let (playground, mut run) = at_work(&format!("{TRACKING}{other}"), 50);
    let launcher = run.id();
    let killed = stages_of(launcher)["other"];
    signal(killed, Signal::KILL);
    run.wait_until("its death is seen", || !stages_of(launcher).contains_key("other"));
    wait_for_lines(&mut run, &playground);
    wait_for_lines(&mut run, &playground);
    signal(launcher, Signal::INT);
    let ended = run.wait().expect_code(1);
    ended.expect_texts(&["stage `other` was killed by signal 9, and is not started anew"]);
    assert_eq!((ended.stage("other").starts, ended.stage("json").starts), (1, 1));
    assert!(ended.stage("other").messages < ended.stage("json").messages, "{}", ended.stderr);
}

#[test]
fn a_run_ends_by_itself_though_one_of_two_cameras_died_for_good() {
    let camera = |name: &str, keys: &str| {
        format!("\n[stage.{name}]\nnode = \"synthetic_source\"\noutput = \"depth\"\nwidth = 64\nheight = 48\n{keys}\n")
    };
    let (_, rest) = TRACKING.split_once("[stage.extractor]").unwrap();
    let [first, second] = [camera("first", "rate_hz = 50\nframes = 200"), camera("second", "restart = \"never\"")];
    let playground = Playground::with_pipeline(&format!("name = \"two\"\n{first}{second}\n[stage.extractor]{rest}"));
    let mut run = playground.start(&["run"]);
    wait_for_lines(&mut run, &playground);
    signal(stages_of(run.id())["second"], Signal::KILL);
    let ended = run.wait().expect_code(1);
    ended.expect_texts(&["stage `second` was killed by signal 9, and is not started anew"]);
    assert_eq!(ended.stage("first").messages, 200);
}

#[test]
fn a_stage_whose_program_is_missing_returns_with_it_and_the_others_go_on() {
    let other = "\n[stage.other]\nnode = \"json_sink\"\ninput = \"tracks\"\npath = \"other.jsonl\"\n";
    let playground = Playground::with_pipeline(&format!("{TRACKING}{other}"));
    let (program, away) = (playground.path("conicflow"), playground.path("away"));
    copy_program(Path::new(env!("CARGO_BIN_EXE_conicflow")), &program);
    let mut run = Started::new(playground.command_of(&program, &["run", "--set", "source.rate_hz=50"]));
    wait_for_lines(&mut run, &playground);
    fs::rename(&program, &away).unwrap();
    let (launcher, before) = (run.id(), stages_of(run.id()));
    signal(before["other"], Signal::KILL);
    run.wait_for_text("stage `other` cannot be started (No such file or directory (os error 2)), and is started anew");
    wait_for_lines(&mut run, &playground);
    fs::rename(&away, &program).unwrap();
    run.wait_until("it is back", || stages_of(launcher).contains_key("other"));
    wait_for_lines(&mut run, &playground);
    let mut after = stages_of(launcher);
    after.insert("other".to_owned(), before["other"]);
    assert_eq!(after, before, "only `other` was to be started anew");
    signal(launcher, Signal::INT);
    assert_eq!(run.wait().expect_code(0).stage("other").starts, 2);
}

#[test]
fn a_stage_that_is_always_restarted_returns_even_after_a_success() {
    let again = r#"
[stage]
again = { program = ["sh", "-c", "echo start >> starts.txt"], input = "tracks", restart = "always" }
"#;
    let playground = Playground::with_pipeline(&format!("{TRACKING}{again}"));
    let mut run = start(&playground);
    run.wait_until("it was started three times", || playground.lines("starts.txt").len() >= 3);
    wait_for_lines(&mut run, &playground);
    run.end();
}

/// The files in shared memory that a process uses, except one of 16 bytes that all runs on a machine share.
pub fn shared_files(process: u32) -> BTreeSet<PathBuf> {
    let maps = fs::read_to_string(format!("/proc/{process}/maps")).unwrap_or_default();
    let paths =
        maps.lines().filter_map(|line| line.find("/dev/shm/conicflow_").map(|start| PathBuf::from(&line[start..])));
    paths.filter(|path| path.extension().is_none_or(|end| end != "global_mgmt")).collect()
}

/// Prefix of the names of all files of a playground's runs in shared memory: `conicflow_` and a hash of eight digits, which
/// identifies the folder `shm` in the runtime folder. This folder exists as soon as a run has begun.
pub fn shared_prefix(playground: &Playground) -> String {
    let about = fs::metadata(playground.runtime().join("shm")).unwrap();
    let bytes = [about.dev(), about.ino(), about.uid().into()].map(u64::to_le_bytes);
    let add = |hash: u32, byte: &u8| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
    format!("conicflow_{:08x}_", bytes.as_flattened().iter().fold(0x811c_9dc5_u32, add))
}

/// Waits until a run has shared memory. Returns the prefix of the names of its files.
pub fn wait_for_shared_memory(run: &mut Started, playground: &Playground) -> String {
    run.wait_until("it has a folder", || playground.runtime().join("shm").is_dir());
    let prefix = shared_prefix(playground);
    run.wait_until("it has shared memory", || !files_in_shared_memory(&prefix).is_empty());
    prefix
}

#[test]
fn no_other_user_can_open_what_a_run_shares() {
    let (playground, _run) = at_work(TRACKING, 50);
    let prefix = shared_prefix(&playground);
    let shared = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
    let own: Vec<_> = shared.filter(|path| path.file_name().unwrap().to_str().unwrap().starts_with(&prefix)).collect();
    assert!(own.len() > 20, "only {own:?}");
    // No other user can open the runtime folder, and so none of the files in it.
    for path in own.iter().map(PathBuf::as_path).chain([playground.runtime()]) {
        let mode = path.metadata().map_or(0, |about| about.permissions().mode());
        assert_eq!(mode & 0o077, 0, "{}: {mode:o}", path.display());
    }
}

/// All files in shared memory with this prefix.
pub fn files_in_shared_memory(prefix: &str) -> Vec<String> {
    let names = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.starts_with(prefix)).collect()
}

/// All files in a folder and its subfolders.
pub fn files_below(folder: &Path) -> Vec<PathBuf> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

#[test]
fn nothing_stays_in_shared_memory_however_runs_end() {
    let playground = Playground::with_pipeline(TRACKING);
    const ALL_KILLED: usize = 6;
    let mut used = BTreeSet::new();
    for round in 0..10 {
        fs::remove_file(playground.path("tracks.jsonl")).ok();
        let mut run = start(&playground);
        wait_for_lines(&mut run, &playground);
        let stages = stages_of(run.id());
        stages.values().for_each(|process| used.extend(shared_files(*process)));
        let prefix = shared_prefix(&playground);
        if round % 5 == 1 {
            stages.values().for_each(|process| signal(*process, Signal::KILL));
        }
        signal(run.id(), [Signal::INT, Signal::INT, Signal::KILL, Signal::TERM][round % 4]);
        drop(run.wait());
        wait_until("all processes are gone", || playground.processes().is_empty());
        // If only the launcher was killed, the last of its stages removes the shared memory. If all processes were killed, none
        // is left to remove it.
        if round != ALL_KILLED {
            assert_eq!(files_in_shared_memory(&prefix), [""; 0], "left in round {round}");
        }
    }
    assert!(used.len() > 100, "only {} files were used, which shows little", used.len());
    let left = files_below(&playground.runtime().join("shm"));
    assert!(left.iter().all(|path| path.ends_with("lock")), "{left:?}");
}

#[test]
fn a_run_that_is_interrupted_as_soon_as_it_has_shared_memory_leaves_nothing() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut random = fastrand::Rng::with_seed(1);
    for round in 0..10 {
        let mut run = start(&playground);
        let prefix = wait_for_shared_memory(&mut run, &playground);
        std::thread::sleep(Duration::from_millis(random.u64(0..50)));
        signal(run.id(), [Signal::INT, Signal::TERM, Signal::HUP][round % 3]);
        run.wait().expect_code(0);
        assert_eq!(files_in_shared_memory(&prefix), [""; 0], "left in round {round}");
    }
}

/// Creates a file like the one that a process leaves if it is killed while it creates a segment of shared memory: the file is
/// empty and not readable.
fn begin(path: &Path) {
    fs::OpenOptions::new().write(true).create_new(true).mode(0o200).open(path).unwrap();
}

#[test]
fn a_resource_left_half_made_by_a_killed_stage_is_removed_while_the_run_goes_on() {
    let (playground, mut run) = at_work(TRACKING, 50);
    let path = Path::new("/dev/shm").join(shared_prefix(&playground) + "begun.dynamic");
    begin(&path);
    run.wait_until("it is removed", || !path.exists());
    wait_for_lines(&mut run, &playground);
    run.end();
}

#[test]
fn resources_left_half_made_by_killed_processes_stop_no_later_run() {
    let (playground, run) = at_work(TRACKING, 50);
    let prefix = shared_prefix(&playground);
    signal(run.id(), Signal::STOP);
    stages_of(run.id()).into_values().chain([run.id()]).for_each(|process| signal(process, Signal::KILL));
    drop(run.wait());
    wait_until("all processes are gone", || playground.processes().is_empty());
    let is_of_a_service = |name: &String| name.ends_with(".dynamic");
    let left: Vec<_> = files_in_shared_memory(&prefix).into_iter().filter(is_of_a_service).collect();
    assert!(left.len() > 10, "only {left:?}");
    for path in left.iter().map(|name| Path::new("/dev/shm").join(name)) {
        fs::remove_file(&path).unwrap();
        begin(&path);
    }
    let next = playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]).expect_code(0);
    assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2], "{}", next.stderr);
    assert_eq!(files_in_shared_memory(&prefix), [""; 0]);
}
