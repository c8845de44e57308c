//! Tests that recordings by conicflow come back bit by bit, and of the files that are written.

use super::fixtures::*;
use super::replay::Replayed;
use super::*;
use crate::recording::files::Files;
use crate::recording::own;
use crate::recording::recorder::{Limits, Recorded, Recorder, file_at};
use crate::sinks::mcap_sink::{self, McapSink};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::testing::step;
use conicflow_dataflow::{AnyMessage, BUILT_IN, Context, SideInputs, Stage};
use conicflow_messages::Object;
use mcap::records::MessageHeader;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::{Duration, Instant};

#[test]
fn a_recording_of_conicflow_is_replayed_bit_for_bit() {
    for depth_scale in [0.001, 0.0002, 0.000_25, 0.000_123_456_7] {
        let place = RecordingFolder(tempfile::tempdir().unwrap());
        record(&place.0.path().join("run.mcap"), Limits::default(), depth_scale, 0..3);
        let frames = place.play(Config::default()).unwrap();
        assert_eq!(frames.len(), 3);
        for (number, (read, depths)) in (0..).zip(frames) {
            assert_eq!((read, &depths[..]), (replayed(header(number, depth_scale)), &ANY[..]), "{depth_scale}");
        }
        let config = Config { path: Some("run.mcap".into()), ..Config::default() };
        let mut lists = Replay::open(&config, place.0.path(), &BUILT_IN[2]).unwrap();
        for number in 0..3 {
            let Replayed { header: read, items, .. } = lists.next_message().unwrap().unwrap();
            let expected = [Object { radius: 0.1, ..Object::default() }; 2];
            assert_eq!(items, bytemuck::cast_slice::<_, u8>(&expected[..number as usize % 3]));
            assert_eq!(read, replayed(header(number, depth_scale)));
        }
        assert!(lists.next_message().unwrap().is_none());
        let none = Replay::open(&config, place.0.path(), &BUILT_IN[1]).err().unwrap();
        assert!(format!("{none:#}").contains("has no ellipses; it has"), "{none:#}");
    }
}

#[test]
fn a_file_that_disappears_or_shrinks_during_playback_is_a_lasting_error() {
    type Change = fn(&Path);
    let by_time = Limits { split_ns: Some(100_000_000), ..Limits::default() };
    let changes: [(Change, &str); 2] = [
        (|path| fs::remove_file(path).unwrap(), "run_1.mcap` is not there any more"),
        (|path| fs::File::options().write(true).open(path).unwrap().set_len(1000).unwrap(), "has become shorter"),
    ];
    for (change, expected) in changes {
        let place = tempfile::tempdir().unwrap();
        record(&place.path().join("new/run.mcap"), by_time, 0.001, 0..7);
        let config = Config { path: Some("new".into()), ..Config::default() };
        let mut replay = Replay::open(&config, place.path(), &DEPTH).unwrap();
        assert!(replay.next_message().unwrap().is_some());
        change(&place.path().join("new/run_1.mcap"));
        let error = all(&mut replay).unwrap_err();
        let text = format!("{error:#}");
        assert!(
            text.starts_with("after ") && text.contains(expected) && text.contains("hint: leave a recording"),
            "{text}"
        );
        assert!(conicflow_messages::lasts(error.as_ref()), "{text}");
    }
}

#[test]
fn a_killed_recorder_leaves_all_but_the_last_second() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.mcap");
    let recorder = Recorder::create(&path, Limits::default(), RUN, false).unwrap();
    let header = header(0, 0.001);
    let depth = AnyMessage { header: &header, item: &BUILT_IN[0], bytes: bytemuck::cast_slice(&ANY) };
    recorder.write("depth", &depth, None).unwrap();
    // Nothing follows, and `finish` is not called: the recorder's thread flushes.
    let deadline = Instant::now() + Duration::from_secs(60);
    while Files::find(&path).unwrap().survey().map_or(0, |channels| channels.len()) < 4 {
        assert!(Instant::now() < deadline, "it never came into the file");
        std::thread::yield_now();
    }
    let copy = RecordingFolder::of(&fs::read(&path).unwrap());
    assert_eq!(copy.play(Config::default()).unwrap(), [(replayed(header), ANY.to_vec())]);
}

#[test]
fn recordings_are_split_and_kept_to_a_limit() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("new/run.mcap");
    let names = || {
        let mut names: Vec<_> =
            fs::read_dir(place.path().join("new")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names.into_iter().map(|name| name.into_string().unwrap()).collect::<Vec<_>>()
    };
    let by_time = Limits { split_ns: Some(100_000_000), ..Limits::default() };
    assert_eq!(record(&path, by_time, 0.001, 0..7), Recorded::Written);
    assert_eq!(names(), ["run.mcap", "run_1.mcap"]);
    let config = Config { path: Some("new".into()), ..Config::default() };
    assert_eq!(all(&mut Replay::open(&config, place.path(), &DEPTH).unwrap()).unwrap().len(), 7);
    fs::remove_dir_all(place.path().join("new")).unwrap();
    // A complete file has an index, and so some kilobytes.
    let limited = Limits { total_bytes: Some(40_000), ..by_time };
    assert_eq!(record(&path, limited, 0.001, 0..30), Recorded::Written);
    let left = names();
    assert!(left.len() >= 2 && left.len() < 7 && !left.contains(&"run.mcap".to_owned()), "{left:?}");
    fs::remove_dir_all(place.path().join("new")).unwrap();
    let full = Limits { total_bytes: Some(1), ..Limits::default() };
    assert_eq!(record(&path, full, 0.001, 0..2), Recorded::Full);
    assert_eq!(names(), ["run.mcap"]);
}

#[test]
fn a_new_recording_of_several_files_replaces_an_earlier_one_and_a_restart_continues_it() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.mcap");
    let names = || {
        let entries = fs::read_dir(place.path()).unwrap();
        let names: BTreeSet<_> = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names
    };
    let split = Limits { split_ns: Some(1_000_000_000), ..Limits::default() };
    let others = ["run_x.mcap", "run_01.mcap", "runs_1.mcap", "run_2.txt", "run_3"];
    let of = |own: &[&str]| BTreeSet::from_iter(others.iter().chain(own).map(|name| (*name).to_owned()));
    assert_eq!(file_at(&path, &split), None);
    for name in others.iter().chain(&["run_7.mcap", "run_12.mcap"]) {
        fs::write(place.path().join(name), "earlier").unwrap();
    }
    assert_eq!(file_at(&path, &split), Some(place.path().join("run_7.mcap")));
    assert_eq!(file_at(&path, &Limits::default()), None, "it has one file");
    drop(Recorder::create(&path, split, RUN, true).unwrap());
    assert_eq!(names(), of(&["run_7.mcap", "run_12.mcap"]), "nothing came of it");
    let recorder = Recorder::create(&path, split, RUN, true).unwrap();
    assert!(place.path().join("run_13.mcap").is_file());
    recorder.finish().unwrap();
    record(&path, Limits::default(), 0.001, 0..2);
    assert_eq!(names(), of(&["run.mcap", "run_7.mcap", "run_12.mcap", "run_13.mcap"]), "they may be another's");
    record(&path, split, 0.001, 0..2);
    assert_eq!(names(), of(&["run.mcap"]));
    let wrong = place.path().join("run_5.mcap");
    fs::create_dir(&wrong).unwrap();
    let recorder = Recorder::create(&path, split, RUN, false).unwrap();
    let error = write_one(&recorder).unwrap_err().to_string();
    assert!(error.starts_with(&format!("cannot write the recording `{}`: ", path.display())), "{error}");
}

#[test]
fn a_restart_records_into_another_file() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.mcap");
    record(&path, Limits::default(), 0.001, 0..2);
    let header = header(2, 0.001);
    let message = AnyMessage { header: &header, item: &BUILT_IN[0], bytes: bytemuck::cast_slice(&ANY) };
    for _ in 0..2 {
        let recorder = Recorder::create(&path, Limits::default(), RUN, true).unwrap();
        recorder.write("depth", &message, None).unwrap();
    }
    drop(Recorder::create(&path, Limits::default(), RUN, true).unwrap());
    for name in ["run_1.mcap", "run_2.mcap"] {
        let config = Config { path: Some(name.into()), ..Config::default() };
        let messages = all(&mut Replay::open(&config, place.path(), &DEPTH).unwrap()).unwrap();
        assert_eq!(messages.len(), 1, "{name}");
    }
    assert!(!place.path().join("run_3.mcap").exists(), "of what was made on trial nothing is left");
    assert!(fs::metadata(&path).unwrap().len() > 1000, "it is left as it was");
    let length = || fs::metadata(&path).unwrap().len();
    let earlier = length();
    let recorder = Recorder::create(&path, Limits::default(), RUN + 1, false).unwrap();
    assert_eq!(recorder.finish().unwrap(), 0);
    drop(recorder);
    assert_eq!(length(), earlier, "nothing came");
    let recorder = Recorder::create(&path, Limits::default(), RUN + 1, false).unwrap();
    write_one(&recorder).unwrap();
    assert!(length() < 1000, "a new run begins anew");
    assert_eq!(recorder.finish().unwrap(), length());
}

/// Writes a depth image.
fn write_one(recorder: &Recorder) -> anyhow::Result<Recorded> {
    let header = header(2, 0.001);
    let message = AnyMessage { header: &header, item: &BUILT_IN[0], bytes: bytemuck::cast_slice(&ANY) };
    recorder.write("depth", &message, None)
}

#[test]
fn a_recording_without_messages_is_an_empty_file_if_it_was_finished_and_no_file_otherwise() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.mcap");
    drop(Recorder::create(&path, Limits::default(), RUN, false).unwrap());
    assert!(!path.exists());
    Recorder::create(&path, Limits::default(), RUN, false).unwrap().finish().unwrap();
    assert!(Files::find(&path).unwrap().survey_of_complete().unwrap().is_empty());
}

#[test]
fn a_restart_counts_and_removes_only_what_its_own_run_has_recorded() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.mcap");
    let file = |name: &str| place.path().join(name);
    record(&path, Limits::default(), 0.001, 0..30);
    fs::rename(&path, file("run_1.mcap")).unwrap();
    fs::write(file("run_4.mcap"), "of another program").unwrap();
    let other = Recorder::create(&path, Limits::default(), RUN + 1, false).unwrap();
    write_one(&other).unwrap();
    let own = other.finish().unwrap();
    let length = |name: &str| fs::metadata(file(name)).map_or(0, |about| about.len());
    let limits = |total| Limits { total_bytes: Some(total), ..Limits::default() };
    assert!(own < length("run_1.mcap"));
    let restart = Recorder::create(&path, limits(own + length("run_1.mcap")), RUN + 1, true).unwrap();
    assert_eq!(write_one(&restart).unwrap(), Recorded::Written);
    assert_eq!(restart.finish().unwrap(), 2 * own);
    assert_eq!(length("run_5.mcap"), own);
    // The restarted run's own files alone exceed the limit: the oldest of them is removed.
    let restart = Recorder::create(&path, limits(2 * own), RUN + 1, true).unwrap();
    assert_eq!(write_one(&restart).unwrap(), Recorded::Written);
    assert!(!path.exists() && length("run_1.mcap") > own && length("run_4.mcap") > 0 && length("run_5.mcap") == own);
}

#[test]
fn messages_that_a_lossless_sink_has_taken_are_in_the_file() {
    let place = tempfile::tempdir().unwrap();
    let config = || mcap_sink::Config { path: Some("run.mcap".into()), ..mcap_sink::Config::default() };
    let frames = |delivery| {
        let (base, delivery) = (place.path().to_owned(), Some(delivery));
        let mut sink = McapSink::<u16>::new(config(), &Context { base, delivery, ..Context::default() }).unwrap();
        let counts = (0..3).map(|number| {
            step(&mut sink, &(header(number, 0.001), ANY.to_vec()), &SideInputs::default()).unwrap();
            let copy = RecordingFolder::of(&fs::read(place.path().join("run.mcap")).unwrap());
            copy.play(Config::default()).map_or(0, |frames| frames.len())
        });
        counts.collect::<Vec<_>>()
    };
    assert_eq!(frames(Delivery::Lossless), [1, 2, 3]);
}

#[test]
fn recordings_that_cannot_be_written_are_reported() {
    let place = tempfile::tempdir().unwrap();
    fs::write(place.path().join("file"), "").unwrap();
    let error = |path: &Path| {
        let written = Recorder::create(path, Limits::default(), RUN, false).and_then(|recorder| {
            let header = header(0, 0.001);
            recorder.write(
                "depth",
                &AnyMessage { header: &header, item: &BUILT_IN[0], bytes: bytemuck::cast_slice(&ANY) },
                None,
            )?;
            recorder.finish()
        });
        written.unwrap_err().to_string()
    };
    assert!(error(&place.path().join("file/run.mcap")).contains("cannot write the recording"));
    assert!(error(place.path()).contains("cannot write the recording"));
    if Path::new("/dev/full").exists() {
        let full = error(Path::new("/dev/full"));
        assert!(full.contains("hint: free some space") && full.contains("No space left"), "{full}");
    } else {
        eprintln!("SKIPPED: this system has no /dev/full");
    }
}

#[test]
fn own_headers_of_another_version_are_refused() {
    let other = serde_json::to_string(&own::Schema::of(&BUILT_IN[2])).unwrap().replace("Object.v2", "Object.v0");
    let mut file = Foreign::new(None);
    let schema = BTreeMap::from([(own::SCHEMA.to_owned(), other)]);
    let channel_id = file.0.add_channel(0, "/left/objects/message", own::ENCODING, &schema).unwrap();
    let message = MessageHeader { channel_id, sequence: 0, log_time: 0, publish_time: 0 };
    file.0.write_to_known_channel(&message, &[0; 900]).unwrap();
    let place = RecordingFolder::of(&file.bytes());
    let config = Config { path: Some("run.mcap".into()), ..Config::default() };
    let error = format!("{:#}", Replay::open(&config, place.0.path(), &BUILT_IN[2]).err().unwrap());
    assert!(
        error.contains("they are `conicflow.Object.v0`") && error.contains("hint: replay them with the version"),
        "{error}"
    );
}
