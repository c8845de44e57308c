//! The truth of rendered frames. It is a function of what the header tells: the scene's name, the time and the camera.

use super::matching::{Expected, Tolerance};
use super::{Duties, Tolerances};
use anyhow::{Result, bail};
use conicflow_lab::simulator::random_scene::{parse_name, random_scene};
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::scene_values::SceneTemplate;
use conicflow_lab::simulator::truth::{Truth, truth_at};
use conicflow_messages::{Header, Object, ObjectKind};
use nalgebra::Vector3;

/// The scene of a frame: the one that is given, else the random or built-in one that the header names; with the camera
/// where the header has it.
pub fn scene_of(header: &Header, given: Option<&SceneTemplate>) -> Result<Scene> {
    let mut scene = scene_named(header, given)?;
    if let Some(rows) = header.pose() {
        let there = Vector3::from_fn(|row, _| rows[row][3]);
        scene.camera_shift = there - scene.world_from_camera(header.stamp_ns as f64 * 1e-9).translation;
    }
    Ok(scene)
}

fn scene_named(header: &Header, given: Option<&SceneTemplate>) -> Result<Scene> {
    let name = header.source.as_str().unwrap_or_default();
    if let Some(scene) = given.and_then(|template| template.of_source(name)) {
        return scene;
    }
    if let Some((group, seed)) = parse_name(name) {
        return Ok(random_scene(group, seed));
    }
    match Scene::built_in(name) {
        Some(scene) => scene,
        None => bail!(
            "the truth of the frames of `{}` is not known\n  hint: `scene` names the scene file of the \
             synthetic_source, `truth` the truth file of a recording",
            name.escape_debug()
        ),
    }
}

/// What a detector owes to a frame of a scene. Nothing for what cannot be seen there; but a track may know of it, from
/// another camera or from before.
pub fn expected(header: &Header, scene: &Scene, duties: &Duties, tolerances: &Tolerances) -> Vec<Expected> {
    let truths = truth_at(scene, header.camera, header.stamp_ns as f64 * 1e-9);
    let expected = truths.into_iter().map(|truth| Expected {
        required: is_required(&truth, duties),
        tolerance: tolerance(&truth.body, tolerances),
        name: truth.name,
        body: truth.body,
        hidden: truth.hidden,
    });
    expected.collect()
}

/// Whether an object can be asked for: enough of it is seen, enough of that is its side, and not along its axis.
fn is_required(truth: &Truth, duties: &Duties) -> bool {
    let [columns, rows] = truth.extent_px;
    !truth.bowl
        && truth.hidden <= duties.max_hidden
        && columns.min(rows) >= duties.min_extent_px
        && truth.object.arc >= duties.min_arc_deg.to_radians()
        && view_angle(&truth.body) >= duties.min_view_angle_deg.to_radians()
}

/// Angle between the line of sight and the axis, at most a right one; of a sphere a right one.
fn view_angle(body: &Object) -> f64 {
    if body.shape() == ObjectKind::Sphere {
        return std::f64::consts::FRAC_PI_2;
    }
    let (center, axis) = (Vector3::from(body.center), Vector3::from(body.axis));
    center.cross(&axis).norm().atan2(center.dot(&axis).abs())
}

fn tolerance(body: &Object, tolerances: &Tolerances) -> Tolerance {
    let share = tolerances.radius;
    Tolerance {
        position_m: tolerances.position_m,
        radius_m: [body.radius * (1.0 - share), body.radius * (1.0 + share)],
        axis: tolerances.axis_deg.to_radians(),
        half_angle: tolerances.half_angle_deg.to_radians(),
    }
}
