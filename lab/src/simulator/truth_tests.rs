use super::super::scene_file::BUILT_IN;
use super::super::sensor::{Sensor, SensorConfig};
use super::super::shapes::Sphere;
use super::*;
use crate::random::CounterRng;
use conicflow_detection::noise::NoiseName;

const CAMERA: Camera = Camera { width: 160, height: 120, fx: 131.25, fy: 131.25, cx: 79.5, cy: 59.5 };

/// Returns the distance of a point from the surface of an object; flat ends are part of the surface.
fn distance(body: &Object, point: &Vector3<f64>) -> f64 {
    let (center, axis, apex) = (Vector3::from(body.center), Vector3::from(body.axis), Vector3::from(body.apex));
    let along = (point - center).dot(&axis);
    let from_axis = |origin: Vector3<f64>| (point - origin - axis * (point - origin).dot(&axis)).norm();
    let side = match body.shape() {
        ObjectKind::Sphere => return (point - center).norm() - body.radius,
        ObjectKind::Cylinder => from_axis(center) - body.radius,
        ObjectKind::Cone => {
            let height = (point - apex).dot(&axis);
            from_axis(apex) * body.half_angle.cos() - height * body.half_angle.sin()
        }
    };
    let beyond_end = along.abs() - 0.5 * body.length;
    assert!(beyond_end < 1e-3 && side < 1e-3, "{point:?} is outside of {body:?}");
    side.max(beyond_end)
}

fn find<'a>(truths: &'a [Truth], name: &str) -> &'a Truth {
    truths.iter().find(|truth| truth.name == name).unwrap()
}

fn scene(objects: &str) -> Scene {
    let head = "name = 'test'\n[camera]\nposition = [0, 0, 0]\ndirection = [0, 1, 0]\n";
    Scene::parse(&format!("{head}{objects}"), "test.toml").unwrap()
}

/// The pixels of the ideal sensor, deprojected, lie on the true surfaces, in all built-in scenes and at several times.
#[test]
fn every_measured_point_lies_on_its_true_surface() {
    for (name, time_s) in BUILT_IN.iter().flat_map(|(name, _)| [0.0, 1.3, 7.0].map(|time_s| (name, time_s))) {
        let scene = Scene::built_in(name).unwrap().unwrap();
        let shapes: Vec<Shape> = scene.shapes_in_camera(time_s).collect();
        let raster = Raster::of(CAMERA, &shapes);
        let mut pixels = vec![0; raster.depth.len()];
        let mut sensor = Sensor::new(SensorConfig::Named(NoiseName::Ideal), 0.001);
        sensor.measure(&raster, &shapes, &CounterRng::new(0, 0), &mut pixels);
        let truths = truth_of(&scene, time_s, &raster, &shapes);
        let mut counts = vec![0; truths.len()];
        for (u, v) in (0..120).flat_map(|v| (0..160).map(move |u| (u, v))) {
            let owner = usize::from(raster.owner[raster.index(u, v)]);
            let Some(body) = scene.bodies.get(owner) else { continue };
            let Some(place) = truths.iter().position(|truth| truth.name == body.name) else { continue };
            let point = ray(&CAMERA, u, v) * (f64::from(pixels[raster.index(u, v)]) * 0.001);
            let off = distance(&truths[place].body, &point).abs();
            assert!(off < 1e-3, "{name}: `{}` at ({u}, {v}) is {off} m off", body.name);
            counts[place] += 1;
        }
        assert!(truths.iter().zip(&counts).all(|(truth, &count)| truth.object.points == count));
    }
}

#[test]
fn a_frustum_of_equal_radii_is_a_cylinder_and_a_cup_a_cone_upside_down() {
    let scene = scene(
        "[[cone]]\nname = 'can'\nbase = [0, 2, -0.2]\nbase_radius = 0.1\ntop_radius = 0.1\nlength = 0.4\n\
         [[cone]]\nname = 'cup'\nbase = [0.5, 2, -0.2]\nbase_radius = 0.1\ntop_radius = 0.2\nlength = 0.4\n",
    );
    let truths = truth_at(&scene, CAMERA, 0.0);
    assert_eq!(find(&truths, "can").body.shape(), ObjectKind::Cylinder);
    let cup = &find(&truths, "cup").body;
    assert_eq!(cup.shape(), ObjectKind::Cone);
    assert_eq!((cup.base_radius, cup.top_radius), (0.2, 0.1));
    assert!((Vector3::from(cup.axis) + Vector3::y()).norm() < 1e-12, "from the apex, below, up to the base");
    assert!((Vector3::from(cup.apex) - Vector3::new(0.5, 0.6, 2.0)).norm() < 1e-12);
    assert!((cup.half_angle - 0.25_f64.atan()).abs() < 1e-12);
    assert!((cup.radius - 0.15).abs() < 1e-12);
}

#[test]
fn hidden_counts_what_others_cover() {
    let can = "[[cylinder]]\nname = 'can'\nbase = [0, 2, -0.3]\nradius = 0.2\nlength = 0.6\n";
    let half = "[[box]]\nname = 'box'\ncenter = [-0.5, 1, 0]\nsize = [1, 0.1, 2]\n";
    let below = "[[box]]\nname = 'box'\ncenter = [0, 1, -0.5]\nsize = [2, 0.001, 1]\n";
    let free = truth_at(&scene(can), CAMERA, 0.0).remove(0);
    assert_eq!(free.hidden, 0.0);
    assert!((free.object.length - 0.6).abs() < 0.03 && free.body.length == 0.6);
    assert!((free.object.arc - 2.0 * 0.1_f64.acos()).abs() < 0.7, "{}", free.object.arc);
    let left = truth_at(&scene(&format!("{can}{half}")), CAMERA, 0.0).remove(0);
    assert!((left.hidden - 0.5).abs() < 0.03, "{}", left.hidden);
    assert!((left.object.arc / free.object.arc - 0.5).abs() < 0.05);
    let upper = truth_at(&scene(&format!("{can}{below}")), CAMERA, 0.0).remove(0);
    assert!((upper.object.length - 0.3).abs() < 0.03, "the upper half is seen: {}", upper.object.length);
    assert!(
        (upper.object.center[1] + 0.15).abs() < 0.02,
        "its middle is above the camera's: {:?}",
        upper.object.center
    );
    assert!(upper.object.rows < free.object.rows && upper.object.points < free.object.points);
}

#[test]
fn hidden_counts_what_lies_outside_the_image() {
    let edge = -79.5 / 131.25 * 2.0;
    let text = format!(
        "[[sphere]]\nname = 'cut'\ncenter = [{edge}, 2, 0]\nradius = 0.2\n\
         [[sphere]]\nname = 'behind'\ncenter = [0, -2, 0]\nradius = 0.2\n"
    );
    let truths = truth_at(&scene(&text), CAMERA, 0.0);
    assert!((find(&truths, "cut").hidden - 0.5).abs() < 0.05, "{}", find(&truths, "cut").hidden);
    let behind = find(&truths, "behind");
    assert_eq!((behind.hidden, behind.object.points, behind.object.arc), (1.0, 0, 0.0));
}

#[test]
fn velocity_is_over_ground_in_the_cameras_axes() {
    let ball =
        "[[sphere]]\nname = 'ball'\ncenter = [0, 2, 0]\nradius = 0.2\nmotion.linear = { velocity = [1, 2, 3] }\n";
    let velocity = Vector3::from(truth_at(&scene(ball), CAMERA, 0.4)[0].velocity);
    assert!((velocity - Vector3::new(1.0, -3.0, 2.0)).norm() < 1e-9);
}

#[test]
fn a_path_has_its_velocity_from_its_first_frame_on_and_where_it_begins_again() {
    let points = "points = [{ t_s = 0, offset = [0, 0, 0] }, { t_s = 2, offset = [1, 0, 0] }]";
    let text = format!(
        "[[sphere]]\nname = 'ball'\ncenter = [0, 2, 0]\nradius = 0.2\nmotion.path = {{ {points}, then = 'repeat' }}\n"
    );
    for time in [0.0, 1.0, 2.0, 4.0] {
        let velocity = Vector3::from(truth_at(&scene(&text), CAMERA, time)[0].velocity);
        assert!((velocity - Vector3::x() * 0.5).norm() < 1e-9, "{time}: {velocity}");
    }
}

#[test]
fn a_line_keeps_its_numbers_and_leaves_out_what_a_shape_has_not() {
    let scene = Scene::built_in("bouncing_ball").unwrap().unwrap();
    let truths = truth_at(&scene, CAMERA, 0.0);
    let objects: Vec<TruthObject> = truths.iter().map(Into::into).collect();
    let line = TruthLine { sequence: 3, source: scene.name.clone(), stamp_ns: 100_000_000, objects };
    let text = serde_json::to_string(&line).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (written, truth) in json["objects"].as_array().unwrap().iter().zip(&truths) {
        assert_eq!((&written["name"], &written["points"]), (&truth.name.clone().into(), &truth.object.points.into()));
        let center: [f64; 3] = serde_json::from_value(written["center"].clone()).unwrap();
        assert!((Vector3::from(center) - Vector3::from(truth.object.center)).norm() < 1e-12);
        assert!(["sigma", "rms", "confidence", "part"].iter().all(|key| written.get(key).is_none()), "{written}");
    }
    let named = |name: &str| json["objects"].as_array().unwrap().iter().find(|o| o["name"] == name).unwrap().clone();
    assert_eq!(named("ball")["radius"], 0.1);
    assert!(named("ball").get("axis").is_none() && named("ball")["kind"] == "sphere");
    assert!(named("trash can").get("apex").is_none() && named("trash can")["kind"] == "cylinder");
    assert!(named("parking cone").get("radius").is_none() && named("parking cone")["half_angle"].is_f64());
}

#[test]
fn a_sphere_is_seen_on_less_than_half_of_its_circumference() {
    let shape = Shape::Sphere(Sphere { center: Vector3::new(0.0, 0.0, 1.0), radius: 0.3 });
    let raster = Raster::of(CAMERA, &[shape]);
    let seen = look(&raster, &[shape])[0];
    let expected = 2.0 * 0.3_f64.acos();
    assert!((seen.angle.width() - expected).abs() < 0.2, "{}, expected {expected}", seen.angle.width());
}
