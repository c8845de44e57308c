use super::fixtures::*;
use super::playback::{Clock, is_off_center};
use super::*;
use conicflow_dataflow::testing::collect;
use conicflow_detection::camera::Intrinsics;
use conicflow_messages::{Camera, NoiseModel};
use std::fs;
use std::path::PathBuf;
use std::time::SystemTime;
use tempfile::TempDir;

const XYZ: &[(&str, char, usize, usize)] = &[("x", 'F', 4, 1), ("y", 'F', 4, 1), ("z", 'F', 4, 1)];
const GIVEN: Intrinsics = Intrinsics { fx: 40.0, fy: 41.0, cx: 22.25, cy: 18.5 };

/// A folder for frames, inside of one that holds nothing else.
struct Folder {
    _outer: TempDir,
    path: PathBuf,
}

impl Folder {
    fn new() -> Self {
        let outer = tempfile::tempdir().unwrap();
        let path = fs::canonicalize(outer.path()).unwrap().join("frames");
        fs::create_dir(&path).unwrap();
        Self { _outer: outer, path }
    }

    fn at(&self, name: &str) -> PathBuf {
        let path = self.path.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    fn depth(self, names: &[&str]) -> Self {
        names.iter().for_each(|name| write_depth_png(&self.at(name)));
        self
    }

    fn colour(self, names: &[&str]) -> Self {
        names.iter().for_each(|name| write_colour_png(&self.at(name)));
        self
    }

    fn file(self, name: &str, bytes: impl AsRef<[u8]>) -> Self {
        fs::write(self.at(name), bytes).unwrap();
        self
    }

    fn cloud(self, name: &str, points: &[[f32; 3]]) -> Self {
        self.file(name, pcd_file(points, XYZ, "binary_compressed"))
    }

    fn open(&self) -> anyhow::Result<Recording> {
        Recording::open(&self.path, &Config::default())
    }

    fn open_given(&self) -> Recording {
        self.part(0, None).unwrap()
    }

    fn part(&self, first: u64, frames: Option<u64>) -> anyhow::Result<Recording> {
        Recording::open(&self.path, &Config { first, frames, intrinsics: Some(GIVEN), ..Config::default() })
    }

    fn open_error(&self) -> String {
        format!("{:#}", self.open().err().unwrap()).replace(&format!("{}/", self.path.display()), "")
    }
}

fn names(recording: &mut Recording) -> Vec<String> {
    (0..recording.len()).map(|index| recording.load(index).unwrap().name).collect()
}

fn pixels(recording: &mut Recording, index: usize) -> Vec<u16> {
    let camera = recording.load(index).unwrap().camera;
    let mut pixels = vec![7; (camera.width * camera.height) as usize];
    recording.decode(&mut pixels).unwrap();
    pixels
}

#[test]
fn a_folder_of_pngs_is_read_in_natural_order() {
    let ordered = [
        "img1.PNG",
        "img02.png",
        "img10.png",
        "img011.png",
        "img99999999999999999999.png",
        "img100000000000000000000.png",
    ];
    let backwards: Vec<_> = ordered.into_iter().rev().collect();
    let folder = Folder::new().depth(&backwards).file("notes.txt", "").file("._img1.png", "");
    let mut recording = folder.open_given();
    assert_eq!(names(&mut recording), ordered);
    assert_eq!(pixels(&mut recording, 1), units(&depth_m(), 0.001));
    let frame = recording.load(2).unwrap();
    assert_eq!((frame.camera, frame.depth_scale, frame.slot, frame.stamp_ns), (CAMERA, 0.001, 2, None));
}

#[test]
fn colour_images_and_other_16_bit_images_are_passed_over() {
    let folder = Folder::new()
        .depth(&["frame-000001.depth.png", "frame-000000.depth.png", "frame-000000.ir.png"])
        .colour(&["frame-000000.color.png"])
        .file("frame-000001.jpg", "");
    assert_eq!(names(&mut folder.open_given()), ["frame-000000.depth.png", "frame-000001.depth.png"]);
    let folder = Folder::new().depth(&["000001-depth.png", "000003-depth.png"]).file("000001-color.jpg", "");
    assert_eq!(names(&mut folder.open_given()), ["000001-depth.png", "000003-depth.png"]);
}

#[test]
fn a_folder_with_a_depth_folder_and_that_folder_itself_are_read() {
    let folder = Folder::new()
        .depth(&["depth/0.png", "depth/1.png"])
        .colour(&["rgb.png"])
        .file("camera_intrinsics.json", r#"{"intrinsic_matrix": [40, 0, 0, 0, 41, 0, 22.25, 18.5, 1]}"#);
    for path in [folder.path.clone(), folder.at("depth")] {
        let mut recording = Recording::open(&path, &Config::default()).unwrap();
        assert_eq!(recording.load(1).unwrap().camera, CAMERA);
        assert_eq!(names(&mut recording), ["0.png", "1.png"]);
    }
}

#[test]
fn a_single_file_is_read() {
    let folder = Folder::new().depth(&["a.png", "b.png"]);
    let config = Config { intrinsics: Some(GIVEN), ..Config::default() };
    let mut recording = Recording::open(&folder.at("b.png"), &config).unwrap();
    assert_eq!(names(&mut recording), ["b.png"]);
    let error = format!("{:#}", Recording::open(&folder.file("c.txt", "").at("c.txt"), &config).err().unwrap());
    assert!(
        error.ends_with(
            "c.txt` is no depth frame\n  hint: name a 16-bit PNG, a TIFF, NPY or PCD file, or a folder of them"
        ),
        "{error}"
    );
}

#[test]
fn tum_folders_have_their_stamps_and_scale() {
    let list =
        "# depth maps\n1305031102.160407 depth/b.png\n1305031102.194330 depth/a.png\n1305031102.3 depth/gone.png\n";
    let folder = Folder::new().depth(&["depth/a.png", "depth/b.png"]).file("depth.txt", list);
    for path in [folder.path.clone(), folder.at("depth"), folder.at("depth.txt")] {
        let config = Config { intrinsics: Some(GIVEN), ..Config::default() };
        let mut recording = Recording::open(&path, &config).unwrap();
        assert_eq!(names(&mut recording), ["b.png", "a.png"]);
        let frame = recording.load(1).unwrap();
        assert_eq!((frame.depth_scale, frame.stamp_ns), (1.0 / 5000.0, Some(1_305_031_102_194_330_000)));
        let reason = format!("{:#}", recording.unreadable().next().unwrap());
        assert!(reason.contains("depth/gone.png`: No such file"), "{reason}");
        let clock = Clock::new(&recording, 5.0);
        assert_eq!(clock.stamp_ns(&frame, 2), 1_305_031_102_194_330_000 + 4 * 33_923_000);
    }
}

#[test]
fn scale_and_intrinsics_come_from_the_nearest_authority() {
    let json = r#"{"width": 48, "height": 36, "fx": 40, "fy": 41, "cx": 22.25, "cy": 18.5, "depth_scale": 0.0005}"#;
    let folder = Folder::new().depth(&["a.png"]).file("camera.json", json);
    let frame = folder.open().unwrap().load(0).unwrap();
    assert_eq!((frame.camera, frame.depth_scale), (CAMERA, 0.0005));
    let other = Intrinsics { fx: 50.0, ..GIVEN };
    let config = Config { intrinsics: Some(other), depth_scale: Some(0.002), ..Config::default() };
    let frame = Recording::open(&folder.path, &config).unwrap().load(0).unwrap();
    assert_eq!((frame.camera.fx, frame.depth_scale), (50.0, 0.002));
}

#[test]
fn clouds_have_their_camera_and_keep_their_depth() {
    let expected = depth_m();
    let folder = Folder::new().cloud("a.pcd", &points(&expected)).colour(&["a.png"]);
    let mut recording = folder.open().unwrap();
    let frame = recording.load(0).unwrap();
    assert_eq!((frame.camera.width, frame.camera.height, frame.depth_scale), (48, 36, 0.0001));
    assert!((frame.camera.fx - 40.0).abs() < 1e-3 && (frame.camera.cy - 18.5).abs() < 1e-3);
    assert_eq!(pixels(&mut recording, 0), units(&expected, 0.0001));
}

#[test]
fn far_and_turned_clouds_and_clouds_in_millimetres_are_read() {
    let far: Vec<_> = depth_m().iter().map(|z| z * 4.0).collect();
    let turned: Vec<_> = points(&depth_m()).iter().map(|[x, y, z]| [*x, -y, -z]).collect();
    let folder = Folder::new().cloud("a.pcd", &points(&far)).cloud("b.pcd", &turned);
    let mut recording = folder.open().unwrap();
    assert_eq!(recording.load(0).unwrap().depth_scale, 0.00025);
    assert_eq!(pixels(&mut recording, 0), units(&far, 0.00025));
    assert_eq!(recording.load(1).unwrap().depth_scale, 0.0001);
    assert_eq!(pixels(&mut recording, 1), units(&depth_m(), 0.0001));
    let millimetres: Vec<_> = turned.iter().map(|point| point.map(|x| x * 1000.0)).collect();
    let folder = Folder::new().cloud("a.pcd", &millimetres);
    let config = Config { depth_scale: Some(0.001), intrinsics: Some(GIVEN), ..Config::default() };
    let mut recording = Recording::open(&folder.path, &config).unwrap();
    let worst = pixels(&mut recording, 0).into_iter().zip(units(&depth_m(), 0.0001)).map(|(a, b)| a.abs_diff(b)).max();
    assert!(worst <= Some(1));
}

#[test]
fn depths_that_cannot_be_sent_hold_no_measurement() {
    let mut depths = depth_m();
    (depths[500], depths[501], depths[502], depths[503]) = (40.0, f32::INFINITY, 0.0, -1.0);
    let folder = Folder::new().cloud("a.pcd", &points(&depths));
    let mut recording = folder.open().unwrap();
    assert_eq!(recording.load(0).unwrap().depth_scale, 0.00025);
    assert_eq!(pixels(&mut recording, 0)[500..504], [0; 4]);
    assert_eq!(recording.decode(&mut vec![0; 48 * 36]).unwrap(), 1, "infinity is no measurement");
}

#[test]
fn pixels_of_clouds_in_millimetres_count_as_too_far() {
    let points: Vec<_> = points(&depth_m()).iter().map(|point| point.map(|x| x * 1000.0)).collect();
    let folder = Folder::new().cloud("a.pcd", &points);
    let mut source = source(&folder, Config::default(), 0);
    let playback = &mut source;
    playback.recording.load(0).unwrap();
    let mut pixels = vec![0; 48 * 36];
    let too_far = playback.recording.decode(&mut pixels).unwrap();
    assert_eq!(too_far, 48 * 36 - 36, "all but the hole");
}

#[test]
fn unreadable_frames_leave_a_gap_in_time() {
    let flat = String::from_utf8_lossy(&pcd_file(&points(&depth_m()), XYZ, "ascii")).into_owned();
    let flat = flat.replace("WIDTH 48", "WIDTH 1728").replace("HEIGHT 36", "HEIGHT 1");
    let cloud = points(&depth_m());
    let folder = Folder::new().cloud("a1.pcd", &cloud).file("a2.pcd", &flat).cloud("a3.pcd", &cloud).file("a4.pcd", "");
    let mut recording = folder.open().unwrap();
    assert_eq!(names(&mut recording), ["a1.pcd", "a3.pcd"]);
    assert_eq!((recording.load(1).unwrap().slot, recording.slots()), (2, 3));
    let reasons: Vec<_> = recording.unreadable().map(|error| format!("{error:#}")).collect();
    assert!(reasons[0].contains("a2.pcd`: the cloud is not organised as an image: WIDTH 1728, HEIGHT 1\n  hint: "));
    assert!(reasons[1].contains("a4.pcd`: the header ends in line 1"));
    let only = Folder::new().file("a.pcd", &flat);
    assert!(only.open_error().starts_with("none of the 1 frames in"));
    let error = format!("{:#}", Recording::open(&only.at("a.pcd"), &Config::default()).err().unwrap());
    assert!(error.contains("a.pcd`: the cloud is not organised"), "{error}");
}

#[test]
fn a_damaged_frame_is_reported_and_the_next_one_is_read() {
    let mut damaged = png16(48, 36, &units(&depth_m(), 0.001));
    damaged.truncate(damaged.len() / 2);
    let folder = Folder::new().file("a.png", damaged).depth(&["b.png"]);
    let mut recording = folder.open_given();
    recording.load(0).unwrap();
    let error = format!("{:#}", recording.decode(&mut vec![0; 48 * 36]).unwrap_err());
    assert!(error.starts_with("the pixels of the PNG: "), "{error}");
    assert_eq!(pixels(&mut recording, 1), units(&depth_m(), 0.001));
    fs::remove_file(folder.at("b.png")).unwrap();
    assert!(format!("{:#}", recording.load(1).unwrap_err()).contains("b.png`: No such file"));
}

#[test]
fn recordings_that_cannot_be_opened_are_reported_with_a_hint() {
    assert!(Folder::new().depth(&["a.png"]).open_error().starts_with("no intrinsics for the frames in `"));
    let colour = Folder::new().colour(&["a.png"]).file("b.jpg", "");
    assert!(
        colour.open_error().contains("only other images and files: 1 of 8-bit colour PNG, 1 of JPEG\n"),
        "{}",
        colour.open_error()
    );
    let grey = Folder::new().file("a.png", png_bytes(4, 3, png::ColorType::Grayscale, png::BitDepth::Eight, &[9; 12]));
    assert!(grey.open_error().contains("only other images and files: 1 of 8-bit grey PNG\n"), "{}", grey.open_error());
    let others = Folder::new().file("a.pfm", "").file("b.pfm", "").file("README", "");
    assert!(
        others.open_error().contains("only other images and files: 2 of `.pfm`, 1 of no ending\n"),
        "{}",
        others.open_error()
    );
    assert!(Folder::new().open_error().contains("`, and no other files\n  hint: depth frames are "));
    let both = Folder::new().depth(&["a.png"]).cloud("a.pcd", &points(&depth_m()));
    assert!(both.open_error().contains("holds 16-bit PNGs and PCD files, expected one kind\n  hint: "));
    let sizes = Folder::new().depth(&["a.png"]).file("b.png", png16(4, 3, &[1; 12]));
    assert!(
        sizes.open_error().starts_with("`b.png` is 4x3, but the frames before it are 48x36\n  hint: "),
        "{}",
        sizes.open_error()
    );
    let list = Folder::new().file("depth.txt", "1.0");
    assert!(list.open_error().starts_with("`depth.txt`: line 1, `1.0`: expected"), "{}", list.open_error());
    let error = format!("{:#}", Recording::open(Path::new("/no/such/place"), &Config::default()).err().unwrap());
    assert!(
        error.starts_with("`/no/such/place` cannot be opened: No such file") && error.contains("\n  hint: "),
        "{error}"
    );
    let json = r#"{"width": 640, "height": 480, "fx": 40, "fy": 41, "cx": 22.25, "cy": 18.5}"#;
    let other = Folder::new().depth(&["a.png"]).file("camera.json", json);
    assert!(
        other.open_error().starts_with("`camera.json` is for images of 640x480, but the frames are 48x36\n  hint: ")
    );
}

#[test]
fn a_part_of_the_recording_is_played() {
    let folder = Folder::new().depth(&["0.png", "1.png", "2.png", "3.png"]);
    assert_eq!(names(&mut folder.part(1, Some(2)).unwrap()), ["1.png", "2.png"]);
    assert_eq!(folder.part(1, Some(2)).unwrap().load(0).unwrap().slot, 0);
    assert_eq!(names(&mut folder.part(3, None).unwrap()), ["3.png"]);
    assert_eq!(
        folder.part(4, None).err().unwrap().to_string(),
        "`first` is 4, but there are 4 frames, counted from 0\n  hint: the last is 3"
    );
}

#[test]
fn a_part_of_the_recording_counts_unreadable_frames_and_forgets_those_outside() {
    let folder = Folder::new().depth(&["1.png", "3.png", "4.png"]);
    let folder = folder.file("0.png", "no PNG").file("2.png", "no PNG").file("5.png", "no PNG");
    let mut middle = folder.part(1, Some(3)).unwrap();
    assert_eq!(names(&mut middle), ["1.png", "3.png"]);
    assert_eq!((middle.unreadable().len(), middle.slots()), (1, 3));
    let error = folder.part(5, None).err().unwrap().to_string();
    assert_eq!(error, "none of the frames from number 5 can be read\n  hint: `first` and `frames` choose others");
}

#[test]
fn the_stamps_of_a_single_frame_that_is_repeated_go_on_rising() {
    let folder = Folder::new().depth(&["depth/0.png"]).file("depth.txt", "7.5 depth/0.png\n");
    let mut source = source(&folder, Config { repeat: true, rate_hz: 10.0, ..Config::default() }, 0);
    let frame = source.recording.load(0).unwrap();
    let stamps = [0, 1, 2].map(|round| source.header(&frame, round).stamp_ns);
    assert_eq!([stamps[1] - stamps[0], stamps[2] - stamps[1]], [100_000_000; 2], "{stamps:?}");
}

fn source(folder: &Folder, config: Config, resume_at: u64) -> Playback {
    let config = Config { path: Some("frames".into()), intrinsics: Some(GIVEN), ..config };
    let base = folder.path.parent().unwrap().to_owned();
    Playback::open(&config, &base, resume_at, 0).unwrap()
}

#[test]
fn the_source_ends_goes_round_or_goes_on_where_it_stopped() {
    let folder = Folder::new().depth(&["0.png", "1.png", "2.png"]);
    let mut once = source(&folder, Config::default(), 0);
    assert_eq!(once.total(), Some(3));
    let turns: Vec<_> = std::iter::from_fn(|| once.advance()).collect();
    assert_eq!(turns, [(0, 0), (0, 1), (0, 2)]);
    let mut resumed = source(&folder, Config { repeat: true, ..Config::default() }, 5);
    assert_eq!(resumed.total(), None);
    assert_eq!([resumed.advance(), resumed.advance()], [Some((1, 2)), Some((2, 0))]);
    assert_eq!(source(&folder, Config::default(), 3).advance(), None);
}

#[test]
fn a_restart_counts_the_frames_that_were_passed_over() {
    let mut damaged = png16(48, 36, &units(&depth_m(), 0.001));
    damaged.truncate(damaged.len() / 2);
    let names = ["0.png", "2.png", "3.png", "5.png"];
    let folder = Folder::new().depth(&names).file("1.png", &damaged).file("4.png", "no PNG at all");
    let base = folder.path.parent().unwrap().to_owned();
    let config = || Config { path: Some("frames".into()), intrinsics: Some(GIVEN), rate_hz: 0.0, ..Config::default() };
    let context = |resume_at, unreadable: &[u64]| {
        let counted = unreadable.iter().map(|times| (UNREADABLE.to_owned(), *times)).collect();
        Context { base: base.clone(), resume_at, counted, ..Context::default() }
    };
    let all = collect::<ImageSource>(config(), context(0, &[]), 9).unwrap();
    assert_eq!(all.iter().map(|(header, _)| header.source.to_string()).collect::<Vec<_>>(), names);
    // 4.png is found to be unreadable when the recording is opened, 1.png when its turn comes.
    for (resume_at, unreadable, position) in [(0, &[][..], 0), (1, &[1], 1), (2, &[2], 3), (4, &[2], 5)] {
        let mut playback = ImageSource::new(config(), &context(resume_at, unreadable)).unwrap().0;
        let uncounted = playback.take_counts().find(|(what, _)| *what == UNREADABLE).unwrap().1;
        assert_eq!((playback.position, uncounted), (position, u64::from(unreadable.is_empty())), "{resume_at}");
    }
}

#[test]
fn frames_that_disappear_during_playback_are_reported_at_the_end() {
    let mut damaged = png16(48, 36, &units(&depth_m(), 0.001));
    damaged.truncate(damaged.len() / 2);
    let names = ["0.png", "2.png", "3.png", "4.png", "5.png"];
    let folder = Folder::new().depth(&names).file("1.png", &damaged);
    let play = |change: fn(&Folder)| {
        let mut playback = source(&folder, Config::default(), 0);
        change(&folder);
        let mut pixels = vec![0; 48 * 36];
        let mut sent = 0;
        while let Some(loaded) = playback.load().unwrap() {
            sent += u64::from(playback.decode(&loaded, &mut pixels).unwrap().is_some());
        }
        (sent, playback.finish().map_err(|error| error.to_string()))
    };
    assert_eq!(play(|_| ()), (5, Ok(())), "one was damaged from the beginning");
    let (sent, finished) = play(|folder| {
        fs::write(folder.at("3.png"), "no PNG any more").unwrap();
        let later = SystemTime::now() + Duration::from_secs(1);
        fs::File::options().write(true).open(folder.at("3.png")).unwrap().set_modified(later).unwrap();
        fs::remove_file(folder.at("4.png")).unwrap();
    });
    let error = finished.unwrap_err();
    let expected = "2 of 6 frames could not be read any more when their turn came, 3 were: `";
    assert!(
        sent == 3 && error.starts_with(expected) && error.contains("3.png`") && error.contains("\n  hint: "),
        "{error}"
    );
}

#[test]
fn the_survey_of_the_files_reports_its_progress() {
    let folder =
        Folder::new().depth(&["0.png", "1.png"]).file("0.pose.txt", matrix(0.0)).file("1.pose.txt", matrix(1.0));
    let config = Config { path: Some("frames".into()), intrinsics: Some(GIVEN), ..Config::default() };
    let mut reports = Vec::new();
    let mut progress = |seen, all| reports.push((seen, all));
    Playback::open_with_progress(&config, folder.path.parent().unwrap(), (0, 0), &mut progress).unwrap();
    assert_eq!(
        reports,
        [(1, 4), (2, 4), (3, 4), (4, 4), (1, 2), (2, 2)],
        "the frames and what is beside them, then the poses"
    );
}

#[test]
fn listing_and_sorting_names_reports_progress() {
    let folder = tempfile::tempdir().unwrap();
    (0..1500).for_each(|number| fs::write(folder.path().join(format!("{number}.png")), "").unwrap());
    let mut reports = Vec::new();
    let files = layout::sorted_files(folder.path(), "", &mut |seen, all| reports.push((seen, all))).unwrap();
    assert!(files.iter().map(|file| layout::file_name(file)).eq((0..1500).map(|number| format!("{number}.png"))));
    assert_eq!(reports[..2], [(0, 1024), (0, 1500)], "once while they are listed, then while they are compared");
}

#[test]
fn stamps_follow_the_rate() {
    let folder = Folder::new().depth(&["0.png", "1.png", "2.png"]);
    let stamp = |rate_hz, round| {
        let mut source = source(&folder, Config { rate_hz, ..Config::default() }, 0);
        let frame = source.recording.load(2).unwrap();
        source.header(&frame, round).stamp_ns
    };
    assert_eq!((stamp(10.0, 0), stamp(0.0, 0), stamp(10.0, 2)), (200_000_000, 66_666_667, 800_000_000));
}

#[test]
fn the_header_names_the_source_of_the_frame() {
    let folder = Folder::new().depth(&["frame-000012.depth.png"]);
    let mut source = source(&folder, Config::default(), 0);
    let frame = source.recording.load(0).unwrap();
    let header = source.header(&frame, 0);
    assert_eq!(header.source.as_str(), Some("frame-000012.depth.png"));
    assert_eq!((header.camera, header.depth_scale, header.noise), (CAMERA, 0.001, NoiseModel::KINECT_V1));
    assert_eq!(header.check("depth"), Ok(()));
}

#[test]
fn links_that_lead_nowhere_keep_their_places() {
    let folder = Folder::new().depth(&["a.png", "d.png"]).file("aa.pose.txt", "");
    let link = |name: &str| std::os::unix::fs::symlink("/nowhere/frame.png", folder.at(name)).unwrap();
    ["b.png", "c.png", "b.txt", "b.pose.txt"].into_iter().for_each(link);
    let mut recording = folder.open_given();
    assert_eq!(names(&mut recording), ["a.png", "d.png"]);
    assert_eq!((recording.load(1).unwrap().slot, recording.slots()), (3, 4));
    let reasons: Vec<_> = recording.unreadable().map(|error| format!("{error:#}")).collect();
    assert_eq!(reasons.len(), 2);
    assert!(reasons[0].contains("b.png`: a link that leads nowhere\n  hint: "), "{}", reasons[0]);
}

#[test]
fn a_recording_is_an_error_only_if_no_frame_can_be_read() {
    let folder = Folder::new().depth(&["0.png", "1.png"]);
    let mut source = source(&folder, Config::default(), 0);
    let error = anyhow::anyhow!("gone");
    assert!(source.pass_over(&error).is_ok());
    let error = source.pass_over(&error).unwrap_err().to_string();
    assert!(error.starts_with("none of the 2 frames can be read; the last: gone\n  hint: "), "{error}");
}

#[test]
fn faults_of_the_parameters_are_found_without_opening() {
    let keys = |config: Config| config.faults(Path::new("/no/such")).iter().map(|fault| fault.key).collect::<Vec<_>>();
    assert_eq!(keys(Config::default()), ["path"]);
    let bad = Intrinsics { fx: 0.0, ..GIVEN };
    let config = Config { path: Some("x".into()), depth_scale: Some(0.0), intrinsics: Some(bad), ..Config::default() };
    assert_eq!(keys(config), ["path", "depth_scale", "intrinsics"]);
    let config = Config { path: Some(".".into()), poses: PosesConfig::Path("no/such.log".into()), ..Config::default() };
    assert_eq!(config.faults(Path::new("/")).iter().map(|fault| fault.key).collect::<Vec<_>>(), ["poses"]);
    let text =
        "path = 'x'\nloop = true\nintrinsics = { fx = 1, fy = 2, cx = 3, cy = 4 }\nnoise = 'ideal'\nposes = 'a.log'";
    let config: Config = toml::from_str(text).unwrap();
    assert_eq!(config.poses, PosesConfig::Path("a.log".into()));
    assert!(config.repeat && config.intrinsics == Some(Intrinsics { fx: 1.0, fy: 2.0, cx: 3.0, cy: 4.0 }));
    assert!(toml::from_str::<Config>("intrinsics = { fx = 1, fy = 2, cx = 3 }").is_err());
}

#[test]
fn the_length_of_its_messages_is_known_before_the_source_starts() {
    let folder = Folder::new().depth(&["0.png", "1.png"]);
    let config = |path: &str| Config { path: Some(path.into()), intrinsics: Some(GIVEN), ..Config::default() };
    let length = |config: &Config| ImageSource::message_length(config, folder.path.parent().unwrap());
    let expected = Some((CAMERA.width * CAMERA.height) as usize);
    assert_eq!(length(&config("frames")), expected);
    assert_eq!(length(&config("frames/1.png")), expected);
    assert_eq!(length(&config("other")), None);
    let among_others = Folder::new().colour(&["a.png"]).file("b.txt", "").depth(&["c.png"]);
    let listed = Folder::new().depth(&["depth/1.png"]).file("depth.txt", "1.0 depth/0.png\n2.0 depth/1.png\n");
    let inner = Folder::new().colour(&["rgb.png"]).depth(&["depth/1.png"]);
    let paths =
        [&among_others.path, &listed.path, &listed.path.join("depth"), &listed.path.join("depth.txt"), &inner.path];
    for path in paths {
        assert_eq!(Recording::pixels_of(path), expected, "{}", path.display());
    }
}

#[test]
fn intrinsics_of_another_resolution_are_recognised() {
    let camera = |cx, cy| Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx, cy };
    assert!(!is_off_center(&camera(319.5, 239.5)) && !is_off_center(&camera(400.0, 180.0)));
    assert!(is_off_center(&camera(639.5, 359.5)), "of 1280x720");
    assert!(is_off_center(&camera(159.0, 119.5)), "of 320x240");
    assert!(is_off_center(&camera(319.5, 400.0)));
}

/// The camera at (x, 2, 3), looking along the world's x with z upwards.
fn matrix(x: f64) -> String {
    format!("0 0 1 {x}\n-1 0 0 2\n0 -1 0 3\n0 0 0 1\n")
}

/// Returns the camera's x in the world in each frame, if it is known.
fn places(folder: &Folder, poses: PosesConfig) -> Vec<Option<f64>> {
    let base = folder.path.parent().unwrap().to_owned();
    let config =
        Config { path: Some("frames".into()), intrinsics: Some(GIVEN), poses, rate_hz: 0.0, ..Config::default() };
    let sent = collect::<ImageSource>(config, Context { base, ..Context::default() }, 99).unwrap();
    assert!(sent.iter().all(|(header, _)| header.check("depth").is_ok()));
    sent.iter().map(|(header, _)| header.pose().map(|rows| rows[0][3])).collect()
}

fn error_of_poses(folder: &Folder, poses: &str) -> String {
    let base = folder.path.parent().unwrap();
    let poses = poses.to_owned().into();
    let config = Config { path: Some("frames".into()), intrinsics: Some(GIVEN), poses, ..Config::default() };
    let error = format!("{:#}", Playback::open(&config, base, 0, 0).err().unwrap());
    assert_eq!(error.matches("\n  hint: ").count(), 1, "{error}");
    error.replace(&format!("{}/", base.display()), "")
}

#[test]
fn seven_scenes_have_a_pose_beside_each_frame() {
    let folder = Folder::new()
        .depth(&["frame-000000.depth.png", "frame-000001.depth.png", "frame-000002.depth.png"])
        .colour(&["frame-000000.color.png"])
        .file("frame-000000.pose.txt", matrix(0.5))
        .file("frame-000002.pose.txt", matrix(2.5).replace(' ', "\t "));
    assert_eq!(places(&folder, PosesConfig::Auto), [Some(0.5), None, Some(2.5)]);
    assert_eq!(places(&folder, PosesConfig::None), [None; 3]);
    assert_eq!(places(&folder, PosesConfig::Path("frames".into())), [Some(0.5), None, Some(2.5)]);
    let mut source = source(&folder, Config::default(), 0);
    let loaded = source.load().unwrap().unwrap();
    let header = source.decode(&loaded, &mut vec![0; 48 * 36]).unwrap().unwrap();
    assert_eq!(header.pose().unwrap()[1], [-1.0, 0.0, 0.0, 2.0], "camera to world, not the other way");
    let lost = folder.file("frame-000002.pose.txt", matrix(2.5).replace("-1", "nan"));
    assert_eq!(places(&lost, PosesConfig::Auto), [Some(0.5), None, None]);
    let broken = lost.file("frame-000001.pose.txt", matrix(1.5).replace(" 3", ""));
    let error = error_of_poses(&broken, "auto");
    assert!(
        error.starts_with("the poses of `frames`: `frame-000001.pose.txt`: line 3, `0 -1 0`: expected 4"),
        "{error}"
    );
    assert_eq!(places(&broken, PosesConfig::None), [None; 3]);
}

#[test]
fn a_folder_of_poses_may_lie_elsewhere() {
    let folder =
        Folder::new().depth(&["0.png", "1.png"]).file("../pose/0.txt", matrix(0.5)).file("../pose/1.txt", matrix(1.5));
    assert_eq!(places(&folder, PosesConfig::Auto), [None; 2]);
    assert_eq!(places(&folder, PosesConfig::Path("pose".into())), [Some(0.5), Some(1.5)]);
    let other = Folder::new().depth(&["0.png"]).file("../pose/7.txt", matrix(0.5));
    let error = error_of_poses(&other, "pose");
    assert!(
        error.starts_with("the poses of `pose`: none of its poses belongs to any of the frames, of which `0.png`"),
        "{error}"
    );
    assert!(
        error_of_poses(&Folder::new().depth(&["0.png"]).file("../pose/7.dat", ""), "pose").contains("nor any `*.txt`")
    );
    let several = Folder::new().depth(&["0.png"]).file("../pose/0.txt", "0 0 1\n".to_owned() + &matrix(0.5));
    assert!(error_of_poses(&several, "pose").contains("`0.txt` has several poses, expected one"));
}

#[test]
fn tum_folders_have_poses_by_time() {
    let list = "1.00 depth/a.png\n1.05 depth/b.png\n2.00 depth/c.png\n";
    let truth = "# timestamp tx ty tz qx qy qz qw\n1.00 1 2 3 -0.5 0.5 -0.5 0.5\n1.10 2 2 3 -0.5 0.5 -0.5 0.5\n";
    let folder = Folder::new().depth(&["depth/a.png", "depth/b.png", "depth/c.png"]).file("depth.txt", list);
    assert_eq!(places(&folder, PosesConfig::Auto), [None; 3]);
    let folder = folder.file("groundtruth.txt", truth);
    assert_eq!(places(&folder, PosesConfig::Auto), [Some(1.0), Some(1.5), None], "the last is later than all poses");
    let mut source = source(&folder, Config::default(), 0);
    let frame = source.recording.load(0).unwrap();
    let turned = source.header(&frame, 0).world_from_camera;
    let expected = [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0]];
    assert!(turned.iter().flatten().zip(expected.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12), "{turned:?}");
    let folder = folder.file("groundtruth.txt", truth.replace("1.10 2", "1.10 x"));
    let error = error_of_poses(&folder, "auto");
    assert!(error.starts_with("the poses of `frames/groundtruth.txt`: line 3, `1.10 x 2 3"), "{error}");
    let folder = folder.file("groundtruth.txt", "9.0 1 2 3 0 0 0 1\n");
    assert!(
        error_of_poses(&folder, "frames/groundtruth.txt").contains("none of its poses belongs to any of the frames")
    );
    assert_eq!(places(&folder, PosesConfig::Auto), [None; 3], "one that does not go with the frames is left alone");
    let stampless = Folder::new().depth(&["a.png"]).file("groundtruth.txt", truth);
    assert!(
        error_of_poses(&stampless, "frames/groundtruth.txt").contains("its poses have times, and the frames have none")
    );
    assert_eq!(places(&stampless, PosesConfig::Auto), [None]);
}

#[test]
fn open3d_trajectories_are_in_the_order_of_the_frames() {
    let blocks =
        |count: usize| (0..count).map(|n| format!("{n} {n} {}\n{}", n + 1, matrix(n as f64))).collect::<String>();
    let folder = Folder::new().depth(&["depth/0.png", "depth/2.png", "depth/10.png"]).file("depth/1.png", "no PNG");
    let folder = folder.file("run.log", "it began\nit ended\n").file("trajectory.log", blocks(4));
    assert_eq!(
        places(&folder, PosesConfig::Auto),
        [Some(0.0), Some(2.0), Some(3.0)],
        "an unreadable frame has one, too"
    );
    let mut part = source(&folder, Config { first: 2, ..Config::default() }, 0);
    let frame = part.recording.load(0).unwrap();
    assert_eq!(part.header(&frame, 0).pose().map(|rows| rows[0][3]), Some(2.0), "counted from the first of all");
    let folder = folder.file("trajectory.log", format!("\u{feff}{}", blocks(4)));
    assert_eq!(places(&folder, PosesConfig::Auto)[1], Some(2.0), "a byte order mark is none of its text");
    let folder = folder.file("trajectory.log", blocks(3));
    let error = error_of_poses(&folder, "frames/trajectory.log");
    assert!(error.contains("the poses of `frames/trajectory.log`: 3 poses for 4 frames\n  hint: "), "{error}");
    assert_eq!(places(&folder, PosesConfig::Auto), [None; 3]);
    let folder = folder.file("other.log", blocks(4));
    assert!(
        error_of_poses(&folder, "auto").contains("has several trajectories, such as `other.log` and `trajectory.log`")
    );
    assert_eq!(places(&folder, PosesConfig::Path("frames/other.log".into()))[1], Some(2.0));
    let folder = folder.file("trajectory.log", blocks(4).replacen("-1", "1", 1));
    assert!(
        error_of_poses(&folder, "frames/trajectory.log").contains("from line 2 on is no pose: its left 3x3 part is no")
    );
    assert!(error_of_poses(&folder.file("empty.log", ""), "frames/empty.log").contains("there is nothing in it"));
}
