//! Tests of `conicflow topic`: an onlooker sees all messages, and does not affect the stages, even if it is stopped or killed.

use crate::processes::{at_work, stages_of, wait_for_lines};
use crate::support::{Ended, Playground, Started, TRACKING, TRACKING_STAGES, TRACKING_TOPICS, signal};
use rustix::process::Signal;
use serde_json::Value as Json;
use std::fs::{self, DirEntry};
use std::io::{BufRead, BufReader};
use std::process::ChildStdout;

/// Starts `topic echo`, and waits for its first line.
fn echo(playground: &Playground, topic: &str) -> (Started, BufReader<ChildStdout>) {
    let (echo, mut output) = Started::piped(playground.command(&["topic", "echo", topic]));
    let mut line = String::new();
    output.read_line(&mut line).unwrap();
    assert!(line.starts_with("{\"sequence\":"), "{line}: {}", echo.stderr());
    (echo, output)
}

/// Ends a run, and asserts that each stage processed every frame.
fn end_without_loss(mut run: Started, playground: &Playground) -> Ended {
    run.wait_until("so many frames came that they show something", || playground.newest("tracks.jsonl") > 50);
    let ended = run.end();
    let made = playground.expect_each_frame(&ended);
    for stage in TRACKING_STAGES {
        assert_eq!(ended.stage(stage).messages, made, "{stage}: {}", ended.stderr);
        assert_eq!(ended.stage(stage).starts, 1, "{stage}: {}", ended.stderr);
    }
    ended
}

/// Processor time of processes, in nanoseconds.
fn processor_ns(processes: impl IntoIterator<Item = u32>) -> u64 {
    // A thread of the process may end before its time is read; it is left out.
    let of_thread = |thread: std::io::Result<DirEntry>| {
        let text = fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    };
    processes.into_iter().flat_map(|id| fs::read_dir(format!("/proc/{id}/task")).unwrap()).filter_map(of_thread).sum()
}

/// Measures the processor time per frame of the stages of one run, alternately without and with an onlooker, in an order that
/// balances a steady trend. Other load on the machine makes most turns slower, but makes no quarter of the turns faster, so the
/// best quarters are compared.
#[test]
fn observing_a_run_at_full_speed_costs_it_no_processor_time() {
    const PAIRS: usize = 8;
    const FRAMES: u64 = 150;
    let (playground, mut run) = at_work(TRACKING, 0);
    let stages = stages_of(run.id());
    let newest = || playground.newest("tracks.jsonl");
    let turn = |run: &mut Started| {
        let before = (newest(), processor_ns(stages.values().copied()));
        run.wait_until("frames pass", || newest() > before.0 + FRAMES);
        let after = (newest(), processor_ns(stages.values().copied()));
        (after.1 - before.1) as f64 / (after.0 - before.0) as f64
    };
    let watched_turn = |run: &mut Started| {
        let (echo, mut output) = echo(&playground, "depth");
        let drained = std::thread::spawn(move || std::io::copy(&mut output, &mut std::io::sink()));
        let watched = turn(run);
        drop(echo);
        drained.join().unwrap().unwrap();
        watched
    };
    let pair = |number: usize| {
        let first = number.is_multiple_of(2).then(|| turn(&mut run));
        let watched = watched_turn(&mut run);
        watched / first.unwrap_or_else(|| turn(&mut run))
    };
    let mut ratios: Vec<f64> = (0..PAIRS).map(pair).collect();
    ratios.sort_by(f64::total_cmp);
    eprintln!("processor time per frame with an onlooker over that without: {ratios:.3?}");
    assert!(ratios[PAIRS / 4] < 1.1, "{ratios:?}");
    end_without_loss(run, &playground);
}

#[test]
fn echo_prints_what_the_sink_writes_and_ends_with_the_run() {
    let (playground, run) = at_work(TRACKING, 50);
    let (echo, output) = echo(&playground, "tracks");
    let echoed = std::thread::spawn(move || output.lines().map(Result::unwrap).collect::<Vec<_>>());
    playground.conicflow(&["topic", "echo", "tracks", "--count", "60"]).expect_code(0);
    end_without_loss(run, &playground);
    echo.wait().expect_code(0);
    let mut written = playground.json_lines("tracks.jsonl");
    let mut echoed: Vec<Json> = echoed.join().unwrap().iter().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(echoed.len() >= 60, "{} lines", echoed.len());
    for line in written.iter_mut().chain(&mut echoed) {
        line.as_object_mut().unwrap().remove("latency_ms").unwrap();
    }
    for line in &echoed {
        assert_eq!(*line, written[line["sequence"].as_u64().unwrap() as usize]);
    }
    assert!(echoed.is_sorted_by_key(|line| line["sequence"].as_u64()), "frames went back");
}

#[test]
fn images_are_summed_up() {
    let (playground, _run) = at_work(TRACKING, 50);
    let ended = playground.conicflow(&["topic", "echo", "depth", "--count", "2"]).expect_code(0);
    assert_eq!(ended.stdout.lines().count(), 2);
    for line in ended.stdout.lines() {
        let line: Json = serde_json::from_str(line).unwrap();
        assert_eq!((&line["depth"]["width"], &line["depth"]["height"]), (&64.into(), &48.into()), "{line}");
        assert!(line["depth"]["measured"].as_u64().unwrap() > 100, "{line}");
        let median = line["depth"]["median_m"].as_f64().unwrap();
        assert!((0.3..10.0).contains(&median), "{line}");
    }
}

#[test]
fn an_observer_that_is_stopped_or_killed_costs_the_run_nothing() {
    let (playground, mut run) = at_work(TRACKING, 0);
    let (stopped, _stopped_output) = echo(&playground, "depth");
    signal(stopped.id(), Signal::STOP);
    for topic in ["depth", "ellipses", "objects", "tracks"] {
        let (killed, _output) = echo(&playground, topic);
        signal(killed.id(), Signal::KILL);
        drop(killed.wait());
    }
    let before = playground.lines("tracks.jsonl").len();
    run.wait_until("hundreds of frames more came", || playground.lines("tracks.jsonl").len() > before + 300);
    end_without_loss(run, &playground);
    signal(stopped.id(), Signal::CONT);
    stopped.wait().expect_code(0);
}

#[test]
fn echo_ends_silently_when_the_reader_of_its_output_has_gone() {
    let (playground, _run) = at_work(TRACKING, 50);
    let (echo, output) = echo(&playground, "tracks");
    drop(output);
    let ended = echo.wait().expect_code(0);
    assert_eq!(ended.stderr, "");
}

#[test]
fn the_ninth_observer_is_refused() {
    let (playground, run) = at_work(TRACKING, 50);
    let lookers: Vec<_> = (0..8).map(|_| echo(&playground, "tracks")).collect();
    let ended = playground.conicflow(&["topic", "echo", "tracks"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: topic `tracks` has 8 onlookers already"), "{}", ended.stderr);
    ended.expect_texts(&["\n  hint: "]);
    lookers.iter().for_each(|(looker, _)| signal(looker.id(), Signal::KILL));
    lookers.into_iter().for_each(|(looker, _)| drop(looker.wait()));
    playground.conicflow(&["topic", "echo", "tracks", "--count", "50"]).expect_code(0);
    end_without_loss(run, &playground);
}

#[test]
fn rates_and_bytes_are_those_that_were_sent() {
    let (playground, mut run) = at_work(TRACKING, 50);
    // Each line has the rate of one second. A busy host may send nothing in one second, and all messages that had waited in
    // another.
    run.wait_until("seconds in which it keeps its rate", || {
        let hz = playground.conicflow(&["topic", "hz", "depth", "--count", "2"]).expect_code(0);
        assert_eq!(hz.stdout.lines().count(), 2);
        hz.stdout.lines().all(|line| {
            assert!([", interval min ", ", max ", ", std "].iter().all(|part| line.contains(part)), "{line}");
            let rate: f64 = line.strip_prefix("depth: ").unwrap().split(' ').next().unwrap().parse().unwrap();
            rate > 0.0 && rate < 60.0
        })
    });
    let (mut bw, mut megabytes, mut rate) = (String::new(), 0.0_f64, 0.0_f64);
    run.wait_until("a second in which it sends", || {
        bw = playground.conicflow(&["topic", "bw", "depth", "--count", "1"]).expect_code(0).stdout;
        let words: Vec<_> = bw.split([' ', ',']).filter(|word| !word.is_empty()).collect();
        (megabytes, rate) = (words[1].parse().unwrap(), words[3].parse().unwrap());
        rate > 0.0
    });
    let per_message = megabytes * 1e6 / rate;
    assert!((per_message / (64.0 * 48.0 * 2.0) - 1.0).abs() < 0.3, "{per_message} bytes: {bw}");
    end_without_loss(run, &playground);
}

#[test]
fn the_list_shows_the_type_and_the_readers_of_each_topic() {
    let (playground, _run) = at_work(TRACKING, 50);
    let list = playground.conicflow(&["topic", "list"]).expect_code(0);
    let rows: Vec<Vec<_>> = list.stdout.lines().skip(1).map(|line| line.split_whitespace().collect()).collect();
    for (row, (name, writer, reader)) in rows.iter().zip(TRACKING_TOPICS) {
        assert_eq!(row[..3], [name, name, writer], "{}", list.stdout);
        assert_eq!(row[5..], [reader, "(lossless,", "queue", "4)"], "{}", list.stdout);
    }
    assert_eq!(rows.len(), 4, "{}", list.stdout);
}

#[test]
fn a_topic_without_a_running_writer_is_listed_as_such() {
    let other = "\n[stage.other]\nnode = \"json_sink\"\ninput = \"objects\"\npath = \"objects.jsonl\"\n";
    let never = TRACKING.replace("[stage.tracker]\n", "[stage.tracker]\nrestart = \"never\"\n");
    let (playground, mut run) = at_work(&format!("{never}{other}"), 50);
    signal(stages_of(run.id())["tracker"], Signal::KILL);
    run.wait_for_text("stage `tracker` was killed by signal 9, and is not started anew");
    let list = playground.conicflow(&["topic", "list"]).expect_code(0).stdout;
    let row = list.lines().find(|line| line.starts_with("tracks ")).unwrap_or_else(|| panic!("{list}"));
    let words: Vec<_> = row.split_whitespace().collect();
    assert_eq!(words[..6], ["tracks", "tracks", "-", "-", "-", "json"], "{list}");
    let hz = playground.conicflow(&["topic", "hz", "tracks", "--count", "1"]).expect_code(0);
    assert_eq!(hz.stdout, "tracks: nobody writes it now\n");
    signal(run.id(), Signal::INT);
    run.wait().expect_code(1);
}

#[test]
fn unknown_topics_and_pipelines_are_refused_with_a_hint() {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = playground.conicflow(&["topic", "list"]).expect_code(2);
    let expected = format!(
        "error: no pipeline runs that has its files in `{}`\n  \
         hint: start one with `conicflow run`, or set CONICFLOW_RUNTIME_DIR as it is where one runs\n",
        playground.runtime().display()
    );
    assert_eq!(ended.stderr, expected);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50"]);
    wait_for_lines(&mut run, &playground);
    let ended = playground.conicflow(&["topic", "echo", "track"]).expect_code(2);
    let expected = "error: pipeline `tracking` has no topic `track`\n  hint: did you mean `tracks`?\n";
    assert_eq!(ended.stderr, expected);
    let ended = playground.conicflow(&["topic", "hz", "depth", "--pipeline", "tracing"]).expect_code(2);
    assert!(
        ended.stderr.ends_with("no pipeline `tracing` runs\n  hint: did you mean `tracking`?\n"),
        "{}",
        ended.stderr
    );
}
