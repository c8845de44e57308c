//! Tests with recordings of other programs.

use super::fixtures::*;
use super::*;
use crate::recording::recorder::Limits;
use crate::sources::WrittenIn;
use conicflow_dataflow::Stop;
use conicflow_detection::camera::Intrinsics;
use conicflow_messages::{Camera, HAS_POSE, Header, NoiseModel, RECORDED, Text};
use conicflow_ros::{
    CAMERA_INFO, COMPRESSED_IMAGE, CameraInfo, IMAGE, Stamped, TF_MESSAGE, Writer, write_metres, write_transform,
    write_units,
};
use mcap::Compression;
use std::fs;

#[test]
fn frames_come_with_their_camera_stamp_and_numbers() {
    let frames = play(&usual(None), Config::default()).unwrap();
    assert_eq!(frames.len(), 5);
    for (number, (header, depths)) in (0..).zip(&frames) {
        assert_eq!((header.sequence, header.stamp_ns, header.camera), (number, stamp_ns(number), CAMERA));
        assert_eq!((header.depth_scale, header.noise, header.flags), (0.001, NoiseModel::KINECT_V1, RECORDED));
        assert_eq!((header.source, depths), (Text::new(IMAGES), &pixels(number)));
    }
}

#[test]
fn parameters_take_precedence_over_the_recording() {
    let intrinsics = Intrinsics { fx: 40.0, fy: 41.0, cx: 2.0, cy: 1.0 };
    let noise = Some(serde_json::from_value("ideal".into()).unwrap());
    let config = Config { depth_scale: Some(0.0002), intrinsics: Some(intrinsics), noise, ..Config::default() };
    let header = play(&usual(None), config).unwrap()[0].0;
    assert_eq!((header.camera, header.depth_scale), (intrinsics.camera(SIZE), 0.0002));
    assert_eq!(header.noise, NoiseModel::IDEAL);
}

#[test]
fn chunks_may_be_compressed() {
    let plain = play(&usual(None), Config::default()).unwrap();
    for file in [usual(Some(Compression::Lz4)), with_zstd(&usual(None))] {
        assert_eq!(play(&file, Config::default()).unwrap(), plain);
    }
    let other = replace(&with_zstd(&usual(None)), b"zstd", b"zpaq");
    assert!(error_of(&other, Config::default()).contains("compressed by `zpaq`, expected `lz4` or `zstd`\n  hint: "));
}

/// The bytes with each occurrence of `from` changed.
fn replace(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut changed = bytes.to_vec();
    for at in 0..bytes.len() - from.len() {
        if bytes[at..].starts_with(from) {
            changed[at..at + to.len()].copy_from_slice(to);
        }
    }
    changed
}

/// Returns the same file with chunks compressed by zstd, and without an index.
fn with_zstd(file: &[u8]) -> Vec<u8> {
    const CHUNK: u8 = 0x06;
    const DATA_END: u8 = 0x0f;
    /// Offset of the compression's name in a chunk record, after times, size and checksum.
    const BEGIN: usize = 28;
    let (mut changed, mut at) = (file[..8].to_vec(), 8);
    loop {
        let (kind, length) = (file[at], u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize);
        let record = &file[at + 9..at + 9 + length];
        at += 9 + length;
        if kind == CHUNK {
            assert_eq!(record[BEGIN..BEGIN + 4], [0; 4], "a chunk that is not compressed");
            let records = &record[BEGIN + 12..];
            let small = ruzstd::encoding::compress_to_vec(records, ruzstd::encoding::CompressionLevel::Fastest);
            let chunk = [&record[..BEGIN], &4_u32.to_le_bytes(), b"zstd", &(small.len() as u64).to_le_bytes(), &small];
            let chunk = chunk.concat();
            changed.push(CHUNK);
            changed.extend((chunk.len() as u64).to_le_bytes());
            changed.extend(chunk);
        } else if kind == DATA_END {
            changed.extend([DATA_END, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x02, 20, 0, 0, 0, 0, 0, 0, 0]);
            changed.extend([0; 20]);
            changed.extend(mcap::MAGIC);
            return changed;
        } else if kind == 0x01 {
            changed.extend(&file[at - 9 - length..at]);
        }
    }
}

#[test]
fn a_file_that_was_cut_is_played_up_to_its_last_whole_message() {
    let whole = play(&usual(None), Config::default()).unwrap();
    for file in [usual(None), usual(Some(Compression::Lz4)), with_zstd(&usual(None))] {
        let mut most = 0;
        for length in (0..file.len()).rev().step_by(7) {
            match play(&file[..length], Config::default()) {
                Ok(frames) => {
                    assert_eq!(frames, whole[..frames.len()]);
                    most = most.max(frames.len());
                }
                Err(error) => {
                    let text = format!("{error:#}");
                    assert!(text.contains("\n  hint: "), "{text}");
                }
            }
        }
        assert_eq!(most, 5);
    }
    // Half a chunk: its whole messages count.
    let mut file = Foreign::new(None).info(INFO).images(IMAGES, 0..3).bytes();
    let second = write_units(stamped(1), SIZE, &pixels(1), Vec::new());
    let at = file.windows(second.len()).position(|bytes| bytes == second).unwrap();
    file.truncate(at + second.len());
    assert_eq!(play(&file, Config::default()).unwrap(), whole[..2]);
}

#[test]
fn a_damaged_chunk_is_left_out_and_counted() {
    let whole = play(&usual(None), Config::default()).unwrap();
    for file in [usual(None), usual(Some(Compression::Lz4)), with_zstd(&usual(None))] {
        let chunks = chunks(&file);
        assert!(chunks.len() > 2, "{chunks:?}");
        for chunk in &chunks[1..] {
            let mut damaged = file.clone();
            // All of the chunk but its header, so that lz4 fails, and not only the checksum.
            damaged[chunk.start + 70..chunk.end].iter_mut().for_each(|byte| *byte = !*byte);
            let place = RecordingFolder::of(&damaged);
            let mut replay = place.open(Config::default()).unwrap();
            let frames = all(&mut replay).unwrap();
            let stamps: Vec<_> = frames.iter().map(|(header, _)| header.stamp_ns).collect();
            let expected = whole.iter().filter(|(header, _)| stamps.contains(&header.stamp_ns));
            assert!(expected.map(|(_, depths)| depths).eq(frames.iter().map(|(_, depths)| depths)), "what is whole");
            assert!((2..5).contains(&frames.len()), "{stamps:?}");
            assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("damaged places", 1)]);
            // From any frame on, as the page plays it.
            for frame in 0..5 {
                replay.seek(stamp_ns(frame));
                assert!(all(&mut replay).unwrap().iter().all(|frame| is_of(&whole, frame)), "what is whole");
            }
        }
    }
}

#[test]
fn a_chunk_with_a_wrong_checksum_is_left_out_wherever_playback_begins() {
    let whole = play(&usual(None), Config::default()).unwrap();
    let mut damaged = usual(None);
    let image = write_units(stamped(3), SIZE, &pixels(3), Vec::new());
    let at = damaged.windows(image.len()).position(|bytes| bytes == image).unwrap();
    damaged[at + image.len() - 1] ^= 1;
    let place = RecordingFolder::of(&damaged);
    let mut replay = place.open(Config::default()).unwrap();
    for from in [None, Some(0), Some(2), Some(3)] {
        if let Some(from) = from {
            replay.seek(stamp_ns(from));
        }
        let frames = all(&mut replay).unwrap();
        assert!(frames.iter().all(|frame| is_of(&whole, frame)), "what is whole, from {from:?}");
        assert!(frames.iter().all(|(header, _)| header.stamp_ns != stamp_ns(3)));
        assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("damaged places", 1)], "from {from:?}");
    }
    replay.seek(stamp_ns(4));
    assert!(all(&mut replay).unwrap().len() <= 1);
}

/// Whether these frames include one with this time and these depths.
fn is_of(frames: &[(Header, Vec<u16>)], (header, depths): &(Header, Vec<u16>)) -> bool {
    frames.iter().any(|(own, same)| own.stamp_ns == header.stamp_ns && same == depths)
}

/// Returns the ranges of the chunks in a file.
fn chunks(file: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (mut chunks, mut at) = (Vec::new(), 8);
    while at + 9 < file.len() {
        let end = at + 9 + u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize;
        if file[at] == 0x06 {
            chunks.push(at..end);
        }
        at = end;
    }
    chunks
}

#[test]
fn damage_is_an_error_or_the_end_and_never_a_panic() {
    let rounds = std::env::var("CONICFLOW_MUTATIONS").ok().and_then(|rounds| rounds.parse().ok()).unwrap_or(300);
    let mut random = fastrand::Rng::with_seed(1);
    for file in [usual(Some(Compression::Lz4)), with_zstd(&usual(None))] {
        for _ in 0..rounds {
            let mut damaged = file.clone();
            for _ in 0..random.usize(1..4) {
                let at = random.usize(..damaged.len());
                damaged[at] = random.u8(..);
            }
            let place = RecordingFolder::of(&damaged);
            let played = place.open(Config::default()).and_then(|mut replay| {
                let frames = all(&mut replay)?;
                replay.seek(stamp_ns(2));
                Ok((frames, all(&mut replay)?))
            });
            match played {
                Ok((frames, rest)) => assert!(frames.iter().chain(&rest).all(|(_, depths)| depths.len() == 12)),
                Err(error) => {
                    let text = format!("{error:#}");
                    assert!(!text.contains("may this user read it"), "the file can be read: {text}");
                }
            }
        }
    }
}

#[test]
fn metres_become_units_of_the_finest_scale() {
    let depths = [1.0, 2.0, f32::NAN, 0.0, 6.5, -1.0, f32::INFINITY, 0.5, 0.5, 0.5, 0.5, 0.5];
    let image = write_metres(stamped(0), SIZE, depths.into_iter(), Vec::new());
    let file = Foreign::new(None).info(INFO).put(IMAGES, IMAGE, 0, &image).bytes();
    let (header, units) = play(&file, Config::default()).unwrap().remove(0);
    assert_eq!((header.depth_scale, &units[..8]), (0.0001, &[10_000, 20_000, 0, 0, 65_000, 0, 0, 5_000][..]));
}

#[test]
fn pixels_that_are_too_far_are_counted() {
    let far = |z: f32| write_metres(stamped(0), SIZE, [z; 12].into_iter(), Vec::new());
    let half = write_metres(stamped(0), SIZE, (0..12).map(|pixel| 2.8 * pixel as f32), Vec::new());
    let file = Foreign::new(None).info(INFO).put(IMAGES, IMAGE, 0, &half).put(IMAGES, IMAGE, 1, &far(1500.0)).bytes();
    let place = RecordingFolder::of(&file);
    let mut replay = place.open(Config::default()).unwrap();
    let frames = all(&mut replay).unwrap();
    assert_eq!(frames[0].1[..7], [0, 11_200, 22_400, 33_600, 44_800, 56_000, 0], "16.38 m at most");
    assert_eq!((&frames[1].1, frames[1].0.depth_scale), (&vec![0; 12], 0.000_25));
    assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("points too far", 6 + 12)]);
    let millimetres = Config { depth_scale: Some(0.001), ..Config::default() };
    assert_eq!(place.play(millimetres).unwrap()[1].1, [15_000; 12]);
}

/// A message of `compressedDepth`, as a PNG.
fn compressed(frame: u64) -> Vec<u8> {
    let mut file = vec![0; 12];
    let mut encoder = png::Encoder::new(&mut file, SIZE.0, SIZE.1);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let bytes: Vec<u8> = pixels(frame).into_iter().flat_map(u16::to_be_bytes).collect();
    encoder.write_header().unwrap().write_image_data(&bytes).unwrap();
    let mut writer = Writer::new(Vec::new());
    writer.stamped(stamped(frame)).text("16UC1; compressedDepth png").bytes(file.len(), file.iter().copied());
    writer.finish()
}

#[test]
fn compressed_depth_has_the_camera_of_the_raw_images() {
    let name = format!("{IMAGES}/compressedDepth");
    let mut file = Foreign::new(None);
    for frame in 0..2 {
        file.put(&name, COMPRESSED_IMAGE, frame, &compressed(frame)).info(INFO);
    }
    let file = file.bytes();
    let frames = play(&file, Config::default()).unwrap();
    assert_eq!((frames.len(), &frames[1].1, frames[1].0.camera), (2, &pixels(1), CAMERA));
    assert_eq!(play(&file, topic(IMAGES)).unwrap(), frames, "named without its last part");
    // The same images twice: the raw ones are used.
    let both =
        Foreign::new(None).info(INFO).put(&name, COMPRESSED_IMAGE, 0, &compressed(0)).images(IMAGES, 0..3).bytes();
    assert_eq!(play(&both, Config::default()).unwrap().len(), 3);
    assert_eq!(play(&both, topic(&name)).unwrap().len(), 1);
}

#[test]
fn of_several_topics_one_has_to_be_named() {
    let mut file = Foreign::new(None);
    file.info(INFO).images(IMAGES, 0..1).info("/left/camera_info").images("/left/depth", 0..2);
    let mut infrared = Writer::new(Vec::new());
    infrared.stamped(stamped(0)).u32(3).u32(4).text("mono16").u8(0).u32(8).bytes(24, [0; 24].into_iter());
    file.put("/left/infra", IMAGE, 0, &infrared.finish());
    let file = file.bytes();
    assert_eq!(
        error_of(&file, Config::default()).split_once("`: ").unwrap().1,
        format!(
            "several topics carry depth images: `{IMAGES}`, `/left/depth`\n  hint: say which, such as `topic = \"{IMAGES}\"`"
        )
    );
    assert_eq!(play(&file, topic("/left/depth")).unwrap().len(), 2);
    assert_eq!(play(&file, topic("/left/infra")).unwrap().len(), 1, "named, it is taken for depth");
    let wrong = error_of(&file, topic("/right/depth"));
    assert!(wrong.contains("the topic `/right/depth` is not in the recording, or has no messages"), "{wrong}");
    assert!(wrong.ends_with(&format!("\n  hint: topics with such: `{IMAGES}`, `/left/depth`")), "{wrong}");
    assert!(
        error_of(&file, topic(INFO)).contains("carries `sensor_msgs/msg/CameraInfo` in `cdr`; expected depth images")
    );
}

#[test]
fn parameters_that_do_not_fit_the_recording_are_reported_before_it_is_played() {
    let faults = |bytes: &[u8], config: Config| {
        let place = RecordingFolder::of(bytes);
        let faults = Config { path: Some("run.mcap".into()), ..config }.faults(place.0.path());
        faults.into_iter().map(|fault| format!("`{}`: {}\n  hint: {}", fault.key, fault.what, fault.hint)).collect()
    };
    let fine: Vec<String> = faults(&usual(None), Config::default());
    assert!(fine.is_empty(), "{fine:?}");
    let two = Foreign::new(None).info(INFO).images(IMAGES, 0..1).images("/left/depth", 0..2).bytes();
    let reported: Vec<String> = faults(&two, Config::default());
    assert!(
        reported.len() == 1 && reported[0].starts_with("`topic`: several topics carry depth images: "),
        "{reported:?}"
    );
    let named: Vec<String> = faults(&two, topic(IMAGES));
    assert!(named.is_empty(), "{named:?}");
    // The user may mean the lists of a recording by conicflow.
    let place = RecordingFolder(tempfile::tempdir().unwrap());
    record(&place.0.path().join("run.mcap"), Limits::default(), 0.001, 0..2);
    let own =
        Config { path: Some("run.mcap".into()), topic: Some("/left/objects/message".into()), ..Config::default() };
    assert!(own.faults(place.0.path()).is_empty());
}

#[test]
fn an_image_of_absurd_size_is_reported_as_such() {
    let mut huge = write_units(stamped(0), SIZE, &pixels(0), Vec::new());
    // Height and width follow the stamp and the name of the frame.
    let at = huge.windows(8).position(|bytes| bytes == [3, 0, 0, 0, 4, 0, 0, 0]).unwrap();
    huge[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    let file = Foreign::new(None).info(INFO).put(IMAGES, IMAGE, 0, &huge).bytes();
    let error = error_of(&file, Config::default());
    assert!(
        error.contains(&format!("the first image of `{IMAGES}`: an image of 4x4294967295 pixels, expected")),
        "{error}"
    );
}

#[test]
fn the_error_of_a_recording_without_depth_lists_its_contents() {
    let other = Foreign::new(None).info(INFO).bytes();
    let text = error_of(&other, Config::default());
    assert!(
        text.contains(&format!("has no depth images; it has\n    `{INFO}` with `sensor_msgs/msg/CameraInfo` in cdr"))
    );
    let mut colours = Writer::new(Vec::new());
    colours.stamped(stamped(0)).u32(3).u32(4).text("rgb8");
    let colours = colours.finish();
    for (first, expected) in [
        (&colours[..], ", whose pixels are `rgb8`"),
        (&colours[..colours.len() - 3], ", of which the first one makes no sense: "),
    ] {
        let file = Foreign::new(None).put(IMAGES, IMAGE, 0, first).bytes();
        for config in [Config::default(), topic(IMAGES)] {
            let error = error_of(&file, config);
            assert!(error.contains(expected), "{error}");
        }
    }
    let ros1 = Foreign::new(None).put_as(IMAGES, ("sensor_msgs/Image", "ros1"), 0, &[0; 8]).bytes();
    assert!(error_of(&ros1, Config::default()).contains("messages of ROS 1, expected those of ROS 2\n  hint: "));
    assert!(error_of(&Foreign::new(None).bytes(), Config::default()).contains("no messages at all"));
    assert!(error_of(b"no MCAP at all, but long enough", Config::default()).contains("\n  hint: "));
}

#[test]
fn a_distorted_image_is_refused_and_the_rectified_one_named() {
    let mut distorted = Writer::new(Vec::new());
    distorted.stamped(stamped(0)).u32(3).u32(4).text("plumb_bob").u32(2).f64s(&[0.1, 0.0]);
    distorted.f64s(&[50.0, 0.0, 1.5, 0.0, 51.0, 1.0, 0.0, 0.0, 1.0]).f64s(&[0.0; 9]);
    distorted.f64s(&[45.0, 0.0, 1.5, 0.0, 0.0, 46.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let info = (0..7).fold(distorted, |mut info, _| info.u32(0).clone()).finish();
    let raw = "/camera/depth/image_raw";
    let mut file = Foreign::new(None);
    file.put(INFO, CAMERA_INFO, 0, &info).images(raw, 0..1);
    let only_raw = error_of(&file.bytes(), Config::default());
    assert!(only_raw.contains(&format!("the images of `{raw}` are distorted (`{INFO}`: [0.1, 0.0])")), "{only_raw}");
    assert!(only_raw.ends_with("hint: rectify them by image_proc of ROS, and record that topic"), "{only_raw}");
    let mut file = Foreign::new(None);
    let file = file.put(INFO, CAMERA_INFO, 0, &info).images(raw, 0..1).images("/camera/depth/image_rect", 0..1).bytes();
    assert!(error_of(&file, topic(raw)).ends_with("hint: `topic = \"/camera/depth/image_rect\"` is rectified"));
    assert_eq!(play(&file, topic("/camera/depth/image_rect")).unwrap()[0].0.camera.fx, 45.0, "the projection's");
    // The hint proposes the one that can be played, in the syntax of the place.
    assert!(error_of(&file, Config::default()).ends_with("such as `topic = \"/camera/depth/image_rect\"`"));
    let written_in = WrittenIn::CommandLine;
    let shell = error_of(&file, Config { written_in, ..Config::default() });
    assert!(shell.ends_with("hint: say which, such as `--topic /camera/depth/image_rect`"), "{shell}");
    let shell = error_of(&file, Config { written_in, ..topic(raw) });
    assert!(shell.ends_with("hint: `--topic /camera/depth/image_rect` is rectified"), "{shell}");
}

#[test]
fn without_a_camera_there_are_no_frames() {
    let none = Foreign::new(None).images(IMAGES, 0..1).bytes();
    let text = error_of(&none, Config::default());
    assert!(
        text.contains(&format!(
            "no CameraInfo beside `{IMAGES}`, expected at `{INFO}`; there is none in the recording"
        ))
    );
    assert!(text.contains("hint: write `intrinsics = "), "{text}");
    let elsewhere = Foreign::new(None).info("/calibration").images(IMAGES, 0..1).bytes();
    assert_eq!(play(&elsewhere, Config::default()).unwrap()[0].0.camera, CAMERA, "the only one");
    let small = Foreign::new(None)
        .info(INFO)
        .put(IMAGES, IMAGE, 0, &write_units(stamped(0), (6, 2), &pixels(0), Vec::new()))
        .bytes();
    assert!(error_of(&small, Config::default()).contains("is for images of 4x3, those of"));
}

#[test]
fn an_unreadable_image_is_skipped_and_counted() {
    let mut file = Foreign::new(None);
    file.info(INFO).images(IMAGES, 0..2).put(IMAGES, IMAGE, 2, &[0, 1, 0, 0, 9]);
    file.put(IMAGES, IMAGE, 3, &write_units(stamped(3), (3, 4), &pixels(3), Vec::new())).images(IMAGES, 4..5);
    let place = RecordingFolder::of(&file.bytes());
    let mut replay = place.open(Config::default()).unwrap();
    let stamps: Vec<_> = all(&mut replay).unwrap().iter().map(|(header, _)| header.stamp_ns).collect();
    assert_eq!(stamps, [0, 1, 4].map(stamp_ns));
    assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("frames unreadable", 2)]);
    let none = Foreign::new(None).info(INFO).images(IMAGES, 0..1).bytes();
    let late = Config { from_s: 5.0, ..Config::default() };
    assert!(
        error_of(&none, late).starts_with(&format!("none of the messages of `{IMAGES}` can be read, or is between"))
    );
}

#[test]
fn unreadable_messages_at_the_beginning_are_skipped_and_counted() {
    let none = Camera { width: 0, height: 0, fx: 0.0, fy: 0.0, cx: 0.0, cy: 0.0 };
    let unready = CameraInfo::write(stamped(0), &none, Vec::new());
    let cut = &write_units(stamped(0), SIZE, &pixels(0), Vec::new())[..60];
    let counted = |file: &[u8], config: Config| {
        let place = RecordingFolder::of(file);
        let mut replay = place.open(config).unwrap();
        let stamps: Vec<_> = all(&mut replay).unwrap().iter().map(|(header, _)| header.stamp_ns).collect();
        assert_eq!(stamps, [1, 2].map(stamp_ns));
        replay.take_counts().collect::<Vec<_>>()
    };
    for bad in [&[][..], cut] {
        let file = Foreign::new(None).info(INFO).put(IMAGES, IMAGE, 0, bad).images(IMAGES, 1..3).bytes();
        assert_eq!(counted(&file, Config::default()), [("frames unreadable", 1)]);
        assert_eq!(counted(&file, topic(IMAGES)), [("frames unreadable", 1)]);
    }
    let name = format!("{IMAGES}/compressedDepth");
    let mut file = Foreign::new(None);
    file.info(INFO).put(&name, COMPRESSED_IMAGE, 0, &[]);
    for frame in 1..3 {
        file.put(&name, COMPRESSED_IMAGE, frame, &compressed(frame));
    }
    assert_eq!(counted(&file.bytes(), Config::default()), [("frames unreadable", 1)]);
    for bad in [&[][..], &unready] {
        let mut file = Foreign::new(None);
        file.put(INFO, CAMERA_INFO, 0, bad).images(IMAGES, 1..2).info(INFO).images(IMAGES, 2..3);
        assert_eq!(counted(&file.bytes(), Config::default()), [("CameraInfo unreadable", 1)]);
    }
    let never = Foreign::new(None).put(INFO, CAMERA_INFO, 0, &unready).images(IMAGES, 1..3).bytes();
    assert!(error_of(&never, Config::default()).contains(&format!("`{INFO}` has no intrinsics: the camera was not")));
}

#[test]
fn a_camera_that_changes_is_followed() {
    let other = Camera { fx: 60.0, ..CAMERA };
    let small = Camera { width: 6, height: 2, ..other };
    let info = |camera: &Camera| CameraInfo::write(stamped(0), camera, Vec::new());
    let mut file = Foreign::new(None);
    file.info(INFO).images(IMAGES, 0..2).put(INFO, CAMERA_INFO, 2, &info(&other)).images(IMAGES, 2..4);
    // The first of these frames comes before its camera is known.
    for frame in 4..6 {
        file.put(IMAGES, IMAGE, frame, &write_units(stamped(frame), (6, 2), &pixels(frame), Vec::new()));
        file.put(INFO, CAMERA_INFO, frame, &info(&small));
    }
    let place = RecordingFolder::of(&file.bytes());
    let mut replay = place.open(Config { repeat: true, ..Config::default() }).unwrap();
    for _ in 0..2 {
        let cameras: Vec<_> = (0..5).map(|_| replay.next_message().unwrap().unwrap().header.camera).collect();
        assert_eq!(cameras, [CAMERA, CAMERA, other, other, small]);
    }
    assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("frames unreadable", 2)]);
    let intrinsics = Some(Intrinsics { fx: 40.0, fy: 41.0, cx: 2.0, cy: 1.0 });
    let given = place.play(Config { intrinsics, ..Config::default() }).unwrap();
    assert!(given.len() == 4 && given.iter().all(|(header, _)| header.camera.fx == 40.0), "the parameters'");
}

#[test]
fn an_invalid_transform_is_skipped_and_counted() {
    let pose = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let fixed = write_transform(Stamped { stamp_ns: 0, frame_id: "map" }, "optical", &pose, Vec::new());
    let wrong = write_transform(Stamped { stamp_ns: 0, frame_id: "map" }, "arm", &[[f64::NAN; 4]; 3], Vec::new());
    let mut file = Foreign::new(None);
    file.info(INFO).put("/tf", TF_MESSAGE, 0, &wrong).put("/tf", TF_MESSAGE, 0, &[0; 3]);
    let place = RecordingFolder::of(&file.put("/tf_static", TF_MESSAGE, 0, &fixed).images(IMAGES, 0..2).bytes());
    let config = Config { world: Some("map".to_owned()), path: Some("run.mcap".into()), ..Config::default() };
    let mut replay = place.open(config.clone()).unwrap();
    assert!(all(&mut replay).unwrap().iter().all(|(header, _)| header.pose() == Some(&pose)));
    assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("transforms unreadable", 2)]);
    let mut resumed = Replay::resume(&config, place.0.path(), &DEPTH, 1, &Stop::default()).unwrap();
    assert_eq!((resumed.take_counts().count(), all(&mut resumed).unwrap().len()), (0, 1), "counted before");
}

#[test]
fn a_file_whose_summary_lacks_topics_is_read_to_its_end() {
    let whole = play(&usual(None), Config::default()).unwrap();
    let complete = || mcap::WriteOptions::new().compression(None).chunk_size(Some(300));
    for options in [complete().repeat_channels(false), complete().repeat_channels(false).repeat_schemas(false)] {
        let mut file = Foreign(mcap::Writer::with_options(std::io::Cursor::new(Vec::new()), options).unwrap());
        let place = RecordingFolder::of(&file.info(INFO).images(IMAGES, 0..5).bytes());
        let mut replay = place.open(Config::default()).unwrap();
        assert_eq!(all(&mut replay).unwrap(), whole);
        replay.seek(stamp_ns(3));
        assert_eq!(all(&mut replay).unwrap().len(), 2);
    }
}

#[test]
fn poses_are_taken_from_tf_if_they_are_requested() {
    let pose = |x: f64| [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let moved = |frame, x| {
        write_transform(Stamped { stamp_ns: stamp_ns(frame), frame_id: "map" }, "base", &pose(x), Vec::new())
    };
    let fixed = write_transform(Stamped { stamp_ns: 0, frame_id: "base" }, "optical", &pose(0.5), Vec::new());
    let mut file = Foreign::new(None);
    file.info(INFO).images(IMAGES, 0..4).put("/tf_static", TF_MESSAGE, 0, &fixed);
    file.put("/tf", TF_MESSAGE, 1, &moved(0, 1.0)).put("/tf", TF_MESSAGE, 2, &moved(2, 3.0));
    let place = RecordingFolder::of(&file.bytes());
    let mut replay = place.open(Config { world: Some("map".to_owned()), ..Config::default() }).unwrap();
    let x: Vec<_> = all(&mut replay).unwrap().iter().map(|(header, _)| header.pose().map(|pose| pose[0][3])).collect();
    assert_eq!(x, [Some(1.5), Some(2.5), Some(3.5), None]);
    assert_eq!(replay.take_counts().collect::<Vec<_>>(), [("frames without pose", 1)]);
    assert_eq!(place.play(Config::default()).unwrap()[0].0.flags & HAS_POSE, 0, "nobody asked");
    let unknown = place.play(Config { world: Some("moon".to_owned()), ..Config::default() }).unwrap_err().to_string();
    assert_eq!(unknown, "`world`: the recording has no frame `moon`\n  hint: frames: `base`, `map`, `optical`");
}

#[test]
fn playing_a_part_reads_only_the_chunks_that_it_needs() {
    let file = Foreign::new(None).info(INFO).images(IMAGES, 0..9).bytes();
    let image = |frame| write_units(stamped(frame), SIZE, &pixels(frame), Vec::new());
    let at = |frame| file.windows(image(0).len()).position(|bytes| bytes == image(frame)).unwrap();
    let damaged = chunks(&file).into_iter().find(|chunk| chunk.contains(&at(4))).unwrap();
    assert!(damaged.start > at(1) && damaged.end < at(7), "they are in several chunks");
    for (part, expected) in [
        (Config { to_s: Some(0.15), ..Config::default() }, &[0, 1][..]),
        (Config { from_s: 0.65, ..Config::default() }, &[7, 8]),
    ] {
        let mut bytes = file.clone();
        bytes[damaged.start + 70..damaged.end].iter_mut().for_each(|byte| *byte = !*byte);
        let place = RecordingFolder::of(&bytes);
        let mut replay = place.open(Config { repeat: true, ..part }).unwrap();
        for round in 0..2 {
            let frames = expected.iter().map(|_| replay.next_message().unwrap().unwrap());
            let pixels_of: Vec<_> = frames.map(|frame| frame.items_as::<u16>()).collect();
            assert_eq!(pixels_of, expected.iter().map(|frame| pixels(*frame)).collect::<Vec<_>>(), "{round}");
        }
        assert_eq!(replay.take_counts().collect::<Vec<_>>(), [], "what is damaged is not looked at");
    }
}

#[test]
fn a_part_is_played_repeatedly() {
    let place = RecordingFolder::of(&usual(None));
    let part = Config { from_s: 0.1, to_s: Some(0.35), ..Config::default() };
    let stamps = |frames: &[(Header, Vec<u16>)]| {
        frames.iter().map(|(header, _)| (header.sequence, (header.stamp_ns - BEGIN_NS) / 1_000_000)).collect::<Vec<_>>()
    };
    assert_eq!(stamps(&place.play(part.clone()).unwrap()), [(0, 100), (1, 200), (2, 300)]);
    let mut replay = place.open(Config { repeat: true, ..part.clone() }).unwrap();
    let twice: Vec<_> = (0..5).map(|_| replay.next_message().unwrap().unwrap().header).collect();
    let numbers: Vec<_> =
        twice.iter().map(|header| (header.sequence, (header.stamp_ns - BEGIN_NS) / 1_000_000)).collect();
    assert_eq!(numbers, [(0, 100), (1, 200), (2, 300), (3, 400), (4, 500)]);
    let rounds = |frames: &[u64], count: usize| {
        let mut file = Foreign::new(None);
        file.info(INFO);
        for frame in frames {
            file.images(IMAGES, *frame..frame + 1);
        }
        let place = RecordingFolder::of(&file.bytes());
        let mut replay = place.open(Config { repeat: true, ..Config::default() }).unwrap();
        let headers = (0..count).map(|_| replay.next_message().unwrap().unwrap().header);
        headers.map(|header| (header.sequence, (header.stamp_ns - BEGIN_NS) / 1_000_000)).collect::<Vec<_>>()
    };
    assert_eq!(rounds(&[0], 3), [(0, 0), (1, 33), (2, 66)], "a frame alone");
    assert_eq!(rounds(&[1, 1], 4), [(0, 100), (1, 100), (2, 133), (3, 133)], "equal stamps");
    let out_of_order = [(0, 0), (1, 600), (2, 200), (3, 900), (4, 1500), (5, 1100)];
    assert_eq!(rounds(&[0, 6, 2], 6), out_of_order, "stamps that do not rise");
    let config = Config { path: Some("run.mcap".into()), repeat: true, ..part };
    let mut resumed = Replay::resume(&config, place.0.path(), &DEPTH, 4, &Stop::default()).unwrap();
    assert_eq!(resumed.next_message().unwrap().unwrap().header, twice[4], "after a restart");
}

#[test]
fn a_folder_is_played_in_natural_order_and_other_formats_are_refused_with_their_conversion() {
    let place = RecordingFolder(tempfile::tempdir().unwrap());
    let folder = place.0.path().join("bag");
    fs::create_dir(&folder).unwrap();
    fs::write(folder.join("metadata.yaml"), "").unwrap();
    fs::write(folder.join("bag_10.mcap"), Foreign::new(None).info(INFO).images(IMAGES, 3..5).bytes()).unwrap();
    fs::write(folder.join("bag_9.mcap"), Foreign::new(None).info(INFO).images(IMAGES, 0..3).bytes()).unwrap();
    let config = |path: &str| Config { path: Some(path.into()), ..Config::default() };
    let stamps: Vec<_> = place.play(config("bag")).unwrap().iter().map(|(header, _)| header.stamp_ns).collect();
    assert_eq!(stamps, [0, 1, 2, 3, 4].map(stamp_ns));
    fs::write(folder.join("bag_11.mcap"), &usual(None)[..40]).unwrap();
    assert_eq!(place.play(config("bag")).unwrap().len(), 5, "a file that has nothing yet is left out");
    let error = |path: &str| format!("{:#}", place.play(config(path)).unwrap_err());
    assert!(
        error("run.bag")
            .contains("is a ROS 1 recording, expected MCAP\n  hint: pip install rosbags && rosbags-convert --src ")
    );
    fs::create_dir(place.0.path().join("old")).unwrap();
    assert!(error("old").contains("no MCAP files in"));
    fs::write(place.0.path().join("old/old_0.db3"), "").unwrap();
    let converted = error("old");
    assert!(
        converted.contains("is a rosbag2 recording in SQLite") && converted.contains("/old' --dst '"),
        "{converted}"
    );
    assert!(error("run.mcap.zstd").contains("is compressed as a whole\n  hint: zstd -d '"));
}
