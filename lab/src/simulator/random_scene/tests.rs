use super::super::scene::Role;
use super::super::truth::truth_at;
use super::*;
use crate::simulator::SyntheticCamera;
use crate::simulator::random_scenes::RandomScenes;
use crate::simulator::sensor::SensorConfig;
use conicflow_detection::noise::NoiseName;
use conicflow_messages::{Camera, ObjectKind};
use std::collections::BTreeSet;

const CAMERA: Camera = Camera { width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 79.5, cy: 59.5 };

#[test]
fn a_scene_is_a_function_of_group_and_seed() {
    for group in SceneGroup::all() {
        let [one, same, other] = [7, 7, 8].map(|seed| format!("{:?}", random_scene(group, seed)));
        assert_eq!(one, same);
        assert_ne!(one.replace("/7", "/8"), other);
        for scene in [random_scene(group, 31), rolled_scene(group, 31, -22.5)] {
            assert_eq!(format!("{:?}", scene_named(&scene.name)), format!("{:?}", Some(scene)));
        }
    }
    for name in ["tabletop", "garden/3", "tabletop/3/a", "tabletop/3/80", "tabletop/3/NaN", "tabletop/3/45/1"] {
        assert!(scene_named(name).is_none(), "{name}");
    }
}

#[test]
fn a_camera_that_is_rolled_sees_the_same_things_turned() {
    let centers = |roll_deg| {
        let truths = (0..5).flat_map(|seed| truth_at(&rolled_scene(SceneGroup::Standing, seed, roll_deg), CAMERA, 0.0));
        truths.map(|truth| truth.body.center.map(f64::from)).collect::<Vec<_>>()
    };
    let (upright, rolled) = (centers(0.0), centers(45.0));
    assert!(upright.len() == rolled.len() && upright.len() > 5, "{upright:?}, {rolled:?}");
    for ([x, y, z], [u, v, w]) in upright.into_iter().zip(rolled) {
        assert!((x.hypot(y) - u.hypot(v)).abs() < 1e-4 && (z - w).abs() < 1e-4, "it stays as far from the camera");
        let turned = (x * v - y * u).atan2(x * u + y * v).to_degrees();
        assert!(
            (-55.0..-35.0).contains(&turned),
            "a camera that is rolled to its right sees things turn to the left: {turned}"
        );
    }
}

#[test]
fn objects_are_in_view_and_at_the_distances_of_their_group() {
    for group in SceneGroup::all() {
        let truths = (0..40).flat_map(|seed| truth_at(&random_scene(group, seed), CAMERA, 0.0));
        let truths: Vec<_> = truths.filter(|truth| !truth.part).collect();
        assert_eq!(truths.is_empty(), group == SceneGroup::Empty, "{group:?}");
        let seen = truths.iter().filter(|truth| truth.hidden < 0.75).count();
        assert!(seen * 4 >= truths.len() * 3, "{group:?}: {seen} of {} seen", truths.len());
        let farthest = if group == SceneGroup::Hall { 6.5 } else { 3.8 };
        for truth in &truths {
            let z = truth.body.center[2];
            assert!((0.4..=farthest).contains(&z), "{group:?}: {} at {z:.2} m", truth.name);
        }
    }
}

#[test]
fn hidden_objects_are_hidden_to_all_degrees() {
    let hidden = |seed| truth_at(&random_scene(SceneGroup::Occluded, seed), CAMERA, 0.0).into_iter().map(|t| t.hidden);
    let shares: Vec<f64> = (0..60).flat_map(hidden).collect();
    for from in [0.1, 0.3, 0.5] {
        let count = shares.iter().filter(|share| (from..from + 0.2).contains(*share)).count();
        assert!(count >= 8, "{count} of {} between {from} and {:.1}", shares.len(), from + 0.2);
    }
}

#[test]
fn cups_are_cones_of_three_to_eight_degrees_and_all_shapes_occur() {
    let scenes = (0..60).map(|seed| random_scene(SceneGroup::Tabletop, seed));
    let truths: Vec<_> = scenes.flat_map(|scene| truth_at(&scene, CAMERA, 0.0)).collect();
    for shape in ObjectKind::ALL {
        assert!(truths.iter().filter(|truth| truth.body.shape() == shape).count() >= 15, "{shape:?}");
    }
    for cup in truths.iter().filter(|truth| truth.body.shape() == ObjectKind::Cone) {
        assert!((3.0..=8.0).contains(&cup.body.half_angle.to_degrees()));
    }
}

/// The documentation's figures are of these scenes, so neither they nor the results of the simple noise model may change.
#[test]
fn the_usual_scenes_are_the_same_to_the_bit() {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64; // FNV-1a
    let scenes = RandomScenes { seeds: [0, 1], ..RandomScenes::default() };
    for number in 0..scenes.frames() {
        let scene = random_scene(SceneGroup::Empty, 0);
        let sensor = SensorConfig::default();
        let mut camera = SyntheticCamera::new(scene, CAMERA, sensor, 0.001, 30.0, 0).before(scenes.clone());
        let (_, pixels) = camera.frame(number);
        for byte in pixels.iter().flat_map(|pixel| pixel.to_le_bytes()) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        }
    }
    assert_eq!(hash, 0x498c_1743_f842_382f, "{hash:#x}");
}

#[test]
fn rooms_have_parts_that_nobody_asks_for_and_glass_that_gives_no_depth() {
    let names = |group| {
        let truths = (0..20).flat_map(move |seed| truth_at(&random_scene(group, seed), CAMERA, 0.0));
        truths
            .map(|truth| (truth.name.trim_end_matches(|c: char| c.is_ascii_digit() || c == ' ').to_owned(), truth.part))
    };
    let furnished: BTreeSet<_> = names(SceneGroup::Furnished).collect();
    for part in ["calf", "chair leg", "curved wall", "handle", "head", "post edge"] {
        assert!(furnished.contains(&(part.to_owned(), true)), "{part}: {furnished:?}");
    }
    let kitchen: BTreeSet<_> = names(SceneGroup::Kitchen).collect();
    for (name, part) in [("label", false), ("mug", false), ("bowl", false), ("glass", true), ("dark inside", true)] {
        assert!(kitchen.contains(&(name.to_owned(), part)), "{name}: {kitchen:?}");
    }
    let seed =
        (0..20).find(|&seed| format!("{:?}", random_scene(SceneGroup::Kitchen, seed)).contains("Glass")).unwrap();
    let scene = random_scene(SceneGroup::Kitchen, seed);
    let glass: Vec<_> = scene.bodies.iter().map(|body| body.role == Role::Glass).collect();
    let mut camera = SyntheticCamera::new(scene, CAMERA, SensorConfig::Named(NoiseName::Ideal), 0.001, 30.0, 0);
    let (_, pixels) = camera.frame(0);
    let owners = camera.raster().owner.iter().map(|owner| glass.get(usize::from(*owner)).copied().unwrap_or(false));
    let through: Vec<u16> = owners.zip(&pixels).filter(|(glass, _)| *glass).map(|(_, pixel)| *pixel).collect();
    assert!(!through.is_empty() && through.iter().all(|pixel| *pixel == 0));
}

#[test]
fn what_is_lived_in_has_much_that_is_no_object_and_things_with_rims_and_handles() {
    let scenes: Vec<_> = (0..30).map(|seed| random_scene(SceneGroup::LivedIn, seed)).collect();
    let bare = |name: &str| name.trim_end_matches(|c: char| c.is_ascii_digit() || c == ' ').to_owned();
    let bodies: BTreeSet<_> = scenes.iter().flat_map(|scene| &scene.bodies).map(|body| bare(&body.name)).collect();
    let truths: Vec<_> = scenes.iter().flat_map(|scene| truth_at(scene, CAMERA, 0.0)).collect();
    let truths: BTreeSet<_> = truths.iter().map(|truth| (bare(&truth.name), truth.part)).collect();
    let lumps = ["shirt", "trouser leg", "head", "chair back", "cushion", "bag", "leaf"];
    for name in lumps.into_iter().chain(["oval bottle", "carton", "fruit", "cloth", "paper"]) {
        assert!(bodies.contains(name), "{name}: {bodies:?}");
        assert!(!truths.iter().any(|(truth, _)| truth == name), "a {name} is no object");
    }
    for part in ["rim", "band", "lid", "handle", "neck", "cap"] {
        assert!(truths.contains(&(part.to_owned(), true)), "{part}: {truths:?}");
    }
}

#[test]
fn in_a_hall_people_with_hair_stand_near_and_afar_and_hair_is_no_object() {
    let scenes: Vec<_> = (0..30).map(|seed| random_scene(SceneGroup::Hall, seed)).collect();
    let middles = |part: &str| -> Vec<f64> {
        let bodies = scenes.iter().flat_map(|scene| &scene.bodies).filter(|body| body.name.starts_with(part));
        bodies.map(|body| body.shape.anchor().y).collect()
    };
    let hair = middles("hair");
    assert!(hair.len() > 30 && hair.iter().any(|y| *y < 2.5) && hair.iter().any(|y| *y > 5.0), "{hair:?}");
    let truths: Vec<_> = scenes.iter().flat_map(|scene| truth_at(scene, CAMERA, 0.0)).collect();
    assert!(!truths.iter().any(|truth| truth.name.starts_with("hair")), "hair is no object");
    assert!(truths.iter().filter(|truth| !truth.part).count() > 15, "{truths:?}");
}
