use super::super::truth::truth_at;
use super::*;
use conicflow_messages::{Camera, ObjectKind};

const CAMERA: Camera = Camera { width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 79.5, cy: 59.5 };

#[test]
fn a_scene_is_a_function_of_group_and_seed() {
    for group in SceneGroup::all() {
        let [one, same, other] = [7, 7, 8].map(|seed| format!("{:?}", random_scene(group, seed)));
        assert_eq!(one, same);
        assert_ne!(one.replace("/7", "/8"), other);
        assert_eq!(parse_name(&random_scene(group, 31).name), Some((group, 31)));
    }
    assert_eq!(parse_name("tabletop"), None);
    assert_eq!(parse_name("garden/3"), None);
}

#[test]
fn objects_are_in_view_and_at_the_distances_of_their_group() {
    for group in SceneGroup::all() {
        let truths: Vec<_> = (0..40).flat_map(|seed| truth_at(&random_scene(group, seed), CAMERA, 0.0)).collect();
        assert_eq!(truths.is_empty(), group == SceneGroup::Empty, "{group:?}");
        let seen = truths.iter().filter(|truth| truth.hidden < 0.75).count();
        assert!(seen * 4 >= truths.len() * 3, "{group:?}: {seen} of {} seen", truths.len());
        for truth in &truths {
            let z = truth.body.center[2];
            assert!((0.4..=3.8).contains(&z), "{group:?}: {} at {z:.2} m", truth.name);
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
