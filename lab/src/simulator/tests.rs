use super::*;
use conicflow_messages::{Item, NoiseModel};

fn small() -> SimulatorParameters {
    SimulatorParameters { width: 80, height: 60, ..SimulatorParameters::default() }
}

fn camera(config: &SimulatorParameters) -> SyntheticCamera {
    let scene = config.load_scene(Path::new("")).unwrap();
    SyntheticCamera::new(scene, config.camera(), config.noise, config.depth_scale, 30.0, config.seed)
}

#[test]
fn a_frame_does_not_depend_on_those_before_it() {
    let (mut steady, mut fresh) = (camera(&small()), camera(&small()));
    let frames: Vec<_> = (0..12).map(|number| steady.frame(number)).collect();
    assert_eq!(fresh.frame(11), frames[11]);
    assert_eq!(fresh.frame(4), frames[4]);
    assert_ne!(frames[4].1, frames[11].1);
}

#[test]
fn the_header_tells_camera_noise_pose_and_simulated_time() {
    let mut camera = camera(&small());
    let (mut header, _) = camera.frame(45);
    assert_eq!(header.check(u16::NAME), Ok(()));
    assert_eq!((header.stamp_ns, header.source.as_str()), (1_500_000_000, Some("bouncing_ball")));
    assert_eq!((header.noise, header.depth_scale), (NoiseModel::KINECT_V1, 0.001));
    let pose = header.pose().unwrap();
    assert_eq!([pose[0][3], pose[1][3], pose[2][3]], [0.0, 0.0, 1.0]);
    assert_eq!(header.camera.fx, 65.625);
    camera.with_noise_in_headers(NoiseModel::IDEAL).describe(&mut header);
    assert_eq!(header.noise, NoiseModel::IDEAL);
}

#[test]
fn intrinsics_scale_with_the_width_unless_they_are_given() {
    let kinect = SimulatorParameters::default().camera();
    assert_eq!((kinect.fx, kinect.fy, kinect.cx, kinect.cy), (525.0, 525.0, 319.5, 239.5));
    let large = SimulatorParameters { width: 1280, height: 960, ..SimulatorParameters::default() }.camera();
    assert_eq!((large.fx, large.cx, large.cy), (1050.0, 639.5, 479.5));
    let given = toml::from_str::<SimulatorParameters>("intrinsics = { fx = 100, fy = 110, cx = 1, cy = 2 }").unwrap();
    assert_eq!((given.camera().fx, given.camera().fy, given.camera().cx), (100.0, 110.0, 1.0));
}

/// The default pipeline's scene: for ten seconds a ball is in the image, in front of everything else.
#[test]
fn the_default_scene_keeps_its_objects_in_view() {
    let mut camera = camera(&small());
    let mut heights = Vec::new();
    for number in (0..300).step_by(3) {
        camera.frame(number);
        for truth in camera.truth() {
            assert!(truth.hidden < 0.25, "frame {number}: {:.2} of the {} is hidden", truth.hidden, truth.name);
            assert!(truth.name != "ball" || truth.hidden == 0.0, "frame {number}: {:.2}", truth.hidden);
            heights.extend((truth.name == "ball").then_some(truth.body.center[1]));
        }
    }
    let span = heights.iter().fold(0.0_f64, |most, y| most.max(y - heights[0]));
    assert!(span > 0.4, "the ball bounces: {span}");
}

#[test]
fn what_cannot_be_used_is_told_before_the_start() {
    let base = tempfile::tempdir().unwrap();
    assert_eq!(SimulatorParameters::default().faults(base.path()), []);
    let config = SimulatorParameters {
        scene: Some("garden.toml".into()),
        truth_path: Some(".".into()),
        ..SimulatorParameters::default()
    };
    let faults = config.faults(base.path());
    assert_eq!(faults.iter().map(|fault| fault.key).collect::<Vec<_>>(), ["scene", "truth_path"]);
    assert!(faults[0].what.contains("garden.toml") && faults[0].hint.contains("`bouncing_ball`"), "{faults:?}");
    std::fs::write(base.path().join("garden.toml"), "name = 'garden'\ncamera = 3\n").unwrap();
    let faults = config.faults(base.path());
    assert!(faults[0].what.contains("garden.toml:2:10") && faults[0].hint.contains("[[sphere]]"), "{faults:?}");
}

#[test]
fn a_velocity_is_taken_in_the_frame_that_it_is_told_in() {
    let velocity = |frame: Frame| Velocity { linear: [0.0, 0.0, 3.0], frame: frame.code(), ..Velocity::default() };
    let ahead = camera(&small()).scene.world_from_camera(0.0).rotation * Vector3::z();
    assert!(ahead.y > 0.9, "the camera of the built-in scene looks along the world's y: {ahead}");
    for (frame, axis) in [(Frame::Camera, ahead), (Frame::World, Vector3::z())] {
        let mut camera = camera(&small());
        camera.drive(&velocity(frame));
        assert!((camera.scene.camera_shift - axis * 0.1).norm() < 1e-12, "{frame:?}");
    }
}
