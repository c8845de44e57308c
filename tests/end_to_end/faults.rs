//! Stages that panic, hang or are stopped: they are reported, they restart if the file says so, and they affect no other stage.

use crate::bridge::{joined, loopback, machines, top_link};
use crate::processes::{at_work, files_in_shared_memory, shared_prefix, stages_of, start, wait_for_lines};
use crate::programs::program;
use crate::support::{Playground, Started, TRACKING, TRACKING_STAGES, signal, wait_until};
use rustix::process::Signal;

/// [`TRACKING`] with a stage between assembler and tracker that fails at one frame.
fn with_faulty_stage(keys: &str) -> Playground {
    with_program(&program("faulty_stage"), keys)
}

/// [`TRACKING`] with a program between assembler and tracker.
fn with_program(program: &str, keys: &str) -> Playground {
    Playground::with_pipeline(&text_with_program(program, keys))
}

fn text_with_program(program: &str, keys: &str) -> String {
    let (before, after) = TRACKING.split_once("[stage.tracker]").unwrap();
    let after = after.replacen("\"objects\"", "\"passed_on\"", 1);
    format!(
        r#"{before}
[stage.faulty]
program = {program}
input   = {{ topic = "objects", delivery = "lossless" }}
output  = {{ topic = "passed_on", kind = "objects" }}
{keys}

[stage.tracker]{after}"#
    )
}

/// Ends a run. Asserts that the faulty stage died twice on each of this number of frames, beginning with frame 20, that the other
/// stages were started once, and that all other frames arrived.
fn expect_two_deaths_each(run: Started, playground: &Playground, frames: u64) -> String {
    signal(run.id(), Signal::INT);
    let ended = run.wait().expect_code(1);
    assert_eq!(ended.stage("faulty").starts, 1 + 2 * frames, "{}", ended.stderr);
    for stage in TRACKING_STAGES {
        assert_eq!(ended.stage(stage).starts, 1, "{stage}: {}", ended.stderr);
    }
    let sequences = playground.sequences("tracks.jsonl");
    let sent = ended.stage("assembler").messages;
    assert!(sequences.iter().copied().eq((0..20).chain(20 + frames..sent)), "{sequences:?}: {}", ended.stderr);
    let lost = ended.input("objects", "faulty");
    assert_eq!((lost.dropped, lost.gaps), (frames, frames), "{}", ended.stderr);
    for frame in 20..20 + frames {
        let report =
            format!("stage `faulty` leaves out frame {frame} of topic `objects`, which it has died of 2 times");
        assert_eq!(ended.stderr.matches(&report).count(), 1, "{report}: {}", ended.stderr);
    }
    ended.expect_texts(&[&format!(
        "not complete: `faulty` lost {frames} of {sent} messages of the lossless topic `objects`"
    )]);
    assert_eq!(ended.input("passed_on", "tracker").gaps, frames, "{}", ended.stderr);
    ended.stderr
}

fn wait_for_frame(run: &mut Started, playground: &Playground, frame: u64) {
    run.wait_until("it delivers again", || playground.newest("tracks.jsonl") > frame);
}

#[test]
fn a_panic_is_reported_with_its_frame_and_the_next_frame_is_processed() {
    let playground = with_faulty_stage("panic_at = 20");
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 40);
    let log = expect_two_deaths_each(run, &playground, 1);
    assert!(log.contains("at frame 20: panicked: this frame is too much"), "{log}");
    assert!(log.contains("stage `faulty` ended with exit code 1, and is started anew"), "{log}");
}

/// A frame that was left out is not delivered again when the stage dies on a later frame.
#[test]
fn each_of_two_successive_frames_that_kill_a_stage_is_left_out_once() {
    let playground = with_faulty_stage("panic_at = 20\npanics_more = 1");
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 40);
    expect_two_deaths_each(run, &playground, 2);
}

#[test]
fn a_stage_that_hangs_is_killed_and_restarted_if_the_file_says_so() {
    let playground = with_faulty_stage("hang_at = 20\nrestart = { when = \"on_failure\", hang_s = 3 }");
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 40);
    let log = expect_two_deaths_each(run, &playground, 1);
    assert!(log.contains("stage `faulty` hangs after 20 messages, "), "{log}");
    assert!(log.contains("stage `faulty` was killed by signal 9, and is started anew"), "{log}");
}

#[test]
fn a_stage_that_is_stopped_is_reported_and_goes_on() {
    let (playground, mut run) = at_work(TRACKING, 50);
    let tracker = stages_of(run.id())["tracker"];
    signal(tracker, Signal::STOP);
    run.wait_until("its silence is seen", || {
        let state = playground.top();
        let stages = state["stages"].as_array().unwrap();
        let silence = |name: &str| stages.iter().find(|stage| stage["stage"] == name).unwrap()["silent_s"].as_f64();
        // The assembler, which waits for another stage, still sends heartbeats.
        silence("tracker") > Some(3.0) && silence("assembler") < Some(2.0)
    });
    run.wait_for_text("stage `tracker` hangs after ");
    signal(tracker, Signal::CONT);
    run.wait_for_text("stage `tracker` goes on after 1");
    wait_for_lines(&mut run, &playground);
    let ended = run.end();
    assert_eq!(ended.stage("tracker").starts, 1, "{}", ended.stderr);
    ended.expect_texts(&["hint: with restart = { when = \"on_failure\", hang_s = 5 }"]);
    playground.expect_each_frame(&ended);
}

#[test]
fn malformed_messages_in_shared_memory_are_counted_and_left_out() {
    let playground = with_faulty_stage("nonsense_at = 20");
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 40);
    let state = playground.top();
    let inputs = state["inputs"].as_array().unwrap();
    let malformed = |name: &str| inputs.iter().find(|input| input["reader"] == name).unwrap()["malformed"].as_u64();
    assert_eq!(
        (malformed("faulty"), malformed("tracker"), malformed("json")),
        (Some(0), Some(3), Some(0)),
        "{state:#}"
    );
    signal(run.id(), Signal::INT);
    let ended = run.wait().expect_code(1);
    assert_eq!((ended.stage("faulty").starts, ended.stage("tracker").starts), (1, 1), "{}", ended.stderr);
    let sequences = playground.sequences("tracks.jsonl");
    let made = ended.stage("source").messages;
    ended.expect_texts(&[&format!(
        "not complete: `tracker` lost 3 of {made} messages of the lossless topic `passed_on`, 3 of them because they made no sense"
    )]);
    assert!(sequences.iter().copied().eq((0..20).chain(23..made)), "{sequences:?}");
}

#[test]
fn malformed_messages_do_not_leave_their_machine_and_are_counted_at_the_edge() {
    let places = [
        ("source", "robot"),
        ("extractor", "robot"),
        ("assembler", "robot"),
        ("faulty", "robot"),
        ("tracker", "base"),
        ("json", "base"),
    ];
    let endpoint = loopback();
    let text = text_with_program(&program("faulty_stage"), "nonsense_at = 20");
    let [robot, base] = machines(&joined(&text, &places, &endpoint, &endpoint));
    let start = |machine: &Playground, name| machine.start(&["run", "--machine", name, "--set", "source.rate_hz=50"]);
    let mut runs = [start(&robot, "robot"), start(&base, "base")];
    wait_for_frame(&mut runs[1], &base, 40);
    let malformed = |machine: &Playground| top_link(machine)["edges"][0]["malformed"].as_u64();
    runs[0].wait_until("it is counted", || malformed(&robot) == Some(3));
    assert_eq!(malformed(&base), Some(0));
    let report = "left out a message of topic `passed_on`";
    assert!(runs[0].stderr().contains(report) && !runs[1].stderr().contains(report), "{}", runs[0].stderr());
    signal(runs[0].id(), Signal::INT);
    let [ended, ended_base] = runs.map(|run| run.wait().expect_code(1));
    let made = ended.stage("faulty").messages;
    ended.expect_texts(&[&format!(
        "not complete: machine `base` lost 3 of {made} messages of the lossless topic `passed_on`, 3 of them because they made no sense"
    )]);
    ended_base.expect_texts(&["not complete: `tracker` lost 3 of "]);
    let sequences = base.sequences("tracks.jsonl");
    assert!(sequences.iter().copied().take(38).eq((0..20).chain(23..41)), "{sequences:?}");
}

#[test]
fn a_run_whose_shared_memory_is_removed_ends_in_order_and_reports_it() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    wait_for_lines(&mut run, &playground);
    for name in files_in_shared_memory(&shared_prefix(&playground)) {
        std::fs::remove_file(std::path::Path::new("/dev/shm").join(name)).unwrap();
    }
    let ended = run.wait().expect_code(1);
    let report = "not complete: what its stages share was removed while it went on";
    assert!(ended.stderr.contains(report) && ended.stderr.contains("RemoveIPC"), "{}", ended.stderr);
    let sequences = playground.sequences("tracks.jsonl");
    assert!(sequences.into_iter().eq(0..ended.stage("source").messages), "{}", ended.stderr);
}

#[test]
fn a_run_whose_folder_is_removed_ends_in_order_and_reports_it_even_if_a_stage_dies_then() {
    for dies in [false, true] {
        let playground = Playground::with_pipeline(TRACKING);
        let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
        wait_for_lines(&mut run, &playground);
        let tracker = stages_of(run.id())["tracker"];
        std::fs::remove_dir_all(playground.runtime()).unwrap();
        if dies {
            signal(tracker, Signal::KILL);
        }
        let ended = run.wait().expect_code(1);
        ended.expect_texts(&[
            "ERROR the run ends: its folder `",
            "was removed while it went on\n  hint: systemd removes the folder of a login",
            "not complete: its folder was removed while it went on",
        ]);
        for misleading in [
            "without having joined",
            "could not start: see its error above",
            "set CONICFLOW_RUNTIME_DIR to a short path",
        ] {
            assert!(!ended.stderr.contains(misleading), "{}", ended.stderr);
        }
        let sequences = playground.sequences("tracks.jsonl");
        assert!(!sequences.is_empty() && sequences.iter().copied().eq(0..sequences.len() as u64), "{sequences:?}");
        assert!(playground.processes().is_empty());
        std::fs::create_dir(playground.runtime()).unwrap();
    }
}

/// Number of processes that [`in_a_shell`] has started in the background.
fn background(playground: &Playground) -> usize {
    playground.processes().into_iter().filter(|process| is_sleep(*process)).count()
}

#[test]
fn children_of_a_program_end_with_it_however_the_program_and_the_run_end() {
    let playground = with_program(&in_a_shell("sleep 1000 & sleep 1000 & exec", ""), "");
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 20);
    assert_eq!(background(&playground), 2);
    signal(stages_of(run.id())["faulty"], Signal::KILL);
    run.wait_for_text("stage `faulty` was killed by signal 9, and is started anew");
    wait_for_frame(&mut run, &playground, playground.newest("tracks.jsonl") + 20);
    assert_eq!(background(&playground), 2, "those of the new one alone");
    run.end();
    assert_eq!(background(&playground), 0);

    std::fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    let mut run = start(&playground);
    wait_for_frame(&mut run, &playground, 20);
    assert_eq!(background(&playground), 2);
    signal(run.id(), Signal::KILL);
    wait_until("nothing of the run is left", || playground.processes().is_empty());
}

#[test]
fn a_program_that_never_joins_is_waited_for_no_longer_than_the_file_says_when_the_others_have_ended() {
    let idle = "\n[stage.idle]\nprogram = [\"sleep\", \"1000\"]\ninput = \"tracks\"\nrestart = { join_s = 15 }\n";
    let playground = Playground::with_pipeline(&format!("{TRACKING}{idle}"));
    let ended = playground.conicflow(&["run", "--frames", "5"]).expect_code(1);
    ended.expect_texts(&[
        "the run waits for stage `idle`, which has not joined it: all that write for it have ended",
        "stage `idle` has not joined the run 15 s after its start: nothing can come to it any more",
    ]);
    assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2, 3, 4]);
    assert!(playground.processes().is_empty());
}

#[test]
fn a_stage_finds_its_run_whatever_runtime_folder_its_own_variables_name() {
    let elsewhere = "env = { XDG_RUNTIME_DIR = \"/nowhere\" }\n[stage.tracker]";
    let playground = Playground::with_pipeline(&TRACKING.replace("[stage.tracker]", elsewhere));
    let mut command = playground.command(&["run", "--frames", "5"]);
    command.env_remove("CONICFLOW_RUNTIME_DIR").env("XDG_RUNTIME_DIR", playground.runtime());
    Started::new(command).wait().expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2, 3, 4]);
}

#[test]
fn a_run_that_is_stopped_by_ctrl_z_stops_and_goes_on_as_a_whole() {
    let (playground, mut run) = at_work(TRACKING, 50);
    let all: Vec<_> = stages_of(run.id()).into_values().chain([run.id()]).collect();
    let are_stopped = |expected: bool| all.iter().all(|process| is_stopped(*process) == expected);
    signal(run.id(), Signal::TSTP);
    wait_until("all are stopped", || are_stopped(true));
    signal(run.id(), Signal::CONT);
    wait_until("all go on", || are_stopped(false));
    wait_for_lines(&mut run, &playground);
    let ended = run.end();
    playground.expect_each_frame(&ended);
}

fn is_stopped(process: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    stat.rsplit_once(')').unwrap().1.trim_start().starts_with('T')
}

/// A shell that starts the faulty stage, here without a fault, between these two commands.
fn in_a_shell(before: &str, after: &str) -> String {
    let words: Vec<String> = serde_json::from_str(&program("faulty_stage")).unwrap();
    format!("{:?}", ["sh", "-c", &format!("{before} {} {after}", words.join(" "))])
}

#[test]
fn a_program_that_never_joins_a_lossless_topic_is_named_and_ends_the_run() {
    let playground = with_program(r#"["sleep", "1000"]"#, "restart = { join_s = 3 }");
    let mut run = start(&playground);
    run.wait_until("the program is there", || playground.processes().iter().any(|process| is_sleep(*process)));
    run.wait_for_text("stage `faulty` has not joined the run: `");
    let ended = run.wait().expect_code(1);
    ended.expect_texts(&[
        "and topic `objects` waits for it: the run ends if it has not 3 s after its start\n  \
         hint: a program joins by `run_stage`",
        "stage `faulty` has not joined the run 3 s after its start: `",
        "takes no part in topic `objects`, which is lossless and waits for it",
        "the run ends, because a stage is lost",
    ]);
    assert_eq!(playground.processes().into_iter().filter(|process| is_sleep(*process)).count(), 0);
}

fn is_sleep(process: u32) -> bool {
    std::fs::read(format!("/proc/{process}/cmdline")).is_ok_and(|line| line.ends_with(b"sleep\x001000\0"))
}

#[test]
fn a_program_that_takes_long_to_start_is_named_and_loses_nothing() {
    let playground = with_program(&in_a_shell("sleep 3; exec", ""), "");
    let mut run = start(&playground);
    run.wait_for_text("the run ends if it has not 120 s after its start");
    run.wait_for_text("stage `faulty` has joined the run, ");
    wait_for_frame(&mut run, &playground, 20);
    let ended = run.end();
    playground.expect_each_frame(&ended);
}

/// `uv run` also starts the program as a child process of its own, so the launcher is not its parent.
#[test]
fn a_program_started_by_another_than_the_launcher_is_refused_with_a_hint() {
    let playground = with_program(&in_a_shell("", "; exit $?"), "");
    let ended = start(&playground).wait().expect_code(1);
    let error = "error: stage `faulty` was not started by its launcher itself, which would not hear of its end\n  \
                hint: name the program";
    ended.expect_texts(&[error, "ERROR stage `faulty` could not start: see its error above"]);
}
