//! The truth: the true objects, and which of them a detector has to find. For rendered frames it follows from the scene's name,
//! the time and the camera in the header. For recorded ones it comes from a file ([`super::recorded`]).

use crate::simulator::random_scene;
use crate::simulator::scene::Scene;
use crate::simulator::scene_values::{SceneTemplate, Values};
use crate::simulator::truth::{Truth, truth_at};
use anyhow::{Result, bail};
use conicflow_messages::{Header, Hinted, Object, ObjectKind};
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A true object, and the requirements on answers about it.
#[derive(Clone, Debug)]
pub struct TrueObject {
    /// Its name in the scene.
    pub name: String,
    /// The whole object: `center` is its middle.
    pub body: Object,
    /// Share of it that is not visible.
    pub hidden: f64,
    /// Whether it has to be found; else a right answer is neither counted nor wrong.
    pub required: bool,
    /// Whether it was measured well enough for errors to mean anything; else it only has to be detected.
    pub measured: bool,
    /// Largest errors of a right answer.
    pub tolerance: Tolerance,
}

/// Largest errors of a right answer about one object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// The shapes that it may be called.
    pub shapes: &'static [ObjectKind],
    /// Distance, in metres.
    pub position_m: f64,
    /// Least and greatest radius, in metres; of a cone, at its true middle.
    pub radius_m: [f64; 2],
    /// Angle between the axes, in radians.
    pub axis: f64,
    /// Difference of the half-angles, in radians.
    pub half_angle: f64,
}

/// Returns the list with this shape only.
pub const fn only(shape: ObjectKind) -> &'static [ObjectKind] {
    match shape {
        ObjectKind::Sphere => &[ObjectKind::Sphere],
        ObjectKind::Cylinder => &[ObjectKind::Cylinder],
        ObjectKind::Cone => &[ObjectKind::Cone],
    }
}

/// Criteria for the true objects that have to be found.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct VisibilityCriteria {
    /// Largest hidden share of what the object would cover alone; what lies outside the image is hidden.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_hidden: f64,
    /// Least number of columns and of rows from the first to the last visible pixel.
    #[schemars(range(min = 1))]
    pub min_extent_px: u32,
    /// Least visible part of the circumference, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
    /// Least angle between line of sight and axis, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub min_view_angle_deg: f64,
}

impl Default for VisibilityCriteria {
    fn default() -> Self {
        Self { max_hidden: 0.75, min_extent_px: 12, min_arc_deg: 30.0, min_view_angle_deg: 25.0 }
    }
}

impl VisibilityCriteria {
    /// Whether an object has to be found: enough of it is visible, enough of that is its side, and not along its axis.
    fn are_met_by(&self, truth: &Truth) -> bool {
        let [columns, rows] = truth.extent_px;
        !truth.bowl
            && !truth.part
            && truth.hidden <= self.max_hidden
            && columns.min(rows) >= self.min_extent_px
            && truth.object.arc >= self.min_arc_deg.to_radians()
            && view_angle(&truth.body) >= self.min_view_angle_deg.to_radians()
    }
}

/// Returns the angle between the line of sight and the axis, at most a right one; a right one for a sphere.
fn view_angle(body: &Object) -> f64 {
    if !body.shape().has_axis() {
        return std::f64::consts::FRAC_PI_2;
    }
    let (center, axis) = (Vector3::from(body.center), Vector3::from(body.axis));
    center.cross(&axis).norm().atan2(center.dot(&axis).abs())
}

/// Largest errors of a right answer about a rendered frame.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Tolerances {
    /// Distance of the centres of spheres, else of the true middle from the answer's axis, in metres.
    #[schemars(range(min = 0.0))]
    pub position_m: f64,
    /// Error of the radius, of a cone at its middle, as a share of it.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub radius: f64,
    /// Angle between the axes, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub axis_deg: f64,
    /// Error of a cone's half-angle, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub half_angle_deg: f64,
}

impl Default for Tolerances {
    fn default() -> Self {
        Self { position_m: 0.05, radius: 0.2, axis_deg: 20.0, half_angle_deg: 8.0 }
    }
}

impl Tolerances {
    fn of(&self, body: &Object) -> Tolerance {
        Tolerance {
            shapes: only(body.shape()),
            position_m: self.position_m,
            radius_m: [body.radius * (1.0 - self.radius), body.radius * (1.0 + self.radius)],
            axis: self.axis_deg.to_radians(),
            half_angle: self.half_angle_deg.to_radians(),
        }
    }
}

/// The truth of rendered frames.
#[derive(Clone, Debug, Default)]
pub struct RenderedTruth {
    /// The scene that is shown; none: the random or built-in one that a header names.
    pub scene: Option<SceneTemplate>,
    /// Criteria for the objects that have to be found.
    pub required: VisibilityCriteria,
    /// Largest errors of right answers.
    pub tolerance: Tolerances,
}

/// Reads a scene file, and checks that it is valid.
///
/// # Errors
/// The file cannot be read, or is not valid.
pub fn load_scene(path: &Path) -> Result<SceneTemplate> {
    let template = SceneTemplate::load(path)?;
    template.scene(&Values::new())?;
    Ok(template)
}

impl RenderedTruth {
    /// Returns the scene of a frame, with the camera at the pose in the header.
    ///
    /// # Errors
    /// The frame shows an unknown scene.
    pub fn scene_of(&self, header: &Header) -> Result<Scene> {
        let mut scene = self.scene_named(header.source.as_str().unwrap_or_default())?;
        if let Some(rows) = header.pose() {
            let there = Vector3::from_fn(|row, _| rows[row][3]);
            scene.camera_shift = there - scene.world_from_camera(header.stamp_ns as f64 * 1e-9).translation;
        }
        Ok(scene)
    }

    fn scene_named(&self, name: &str) -> Result<Scene> {
        if let Some(scene) = self.scene.as_ref().and_then(|template| template.of_source(name)) {
            return scene;
        }
        if let Some(scene) = random_scene::scene_named(name) {
            return Ok(scene);
        }
        match Scene::built_in(name) {
            Some(scene) => scene,
            None => bail!(Hinted::lasting(
                format!("the truth of the frames of `{}` is not known", name.escape_debug()),
                "`scene` names the scene file of the synthetic_source, `truth` the truth file of a recording"
            )),
        }
    }

    /// Returns the objects of a scene. Those that are not visible in the frame need not be found, but a track may know of them,
    /// from another camera or from earlier frames.
    pub fn objects(&self, header: &Header, scene: &Scene) -> Vec<TrueObject> {
        let truths = truth_at(scene, header.camera, header.stamp_ns as f64 * 1e-9).into_iter();
        let object = |truth: Truth| TrueObject {
            required: self.required.are_met_by(&truth),
            measured: true,
            tolerance: self.tolerance.of(&truth.body),
            name: truth.name,
            body: truth.body,
            hidden: truth.hidden,
        };
        truths.map(object).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::matching::tests::cone;
    use super::super::matching::{Fault, fault};
    use super::*;

    fn expected(body: Object) -> TrueObject {
        let tolerance = Tolerances::default().of(&body);
        TrueObject { name: "thing".into(), body, hidden: 0.0, required: true, measured: true, tolerance }
    }

    fn leaning(degrees: f64) -> [f64; 3] {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        [0.0, cosine, sine]
    }

    /// The defaults, in the units of the file: 5 cm, 20 %, 20 degrees and 8 degrees, to either side.
    #[test]
    fn an_answer_is_right_within_the_default_tolerances_and_no_farther() {
        let body = Object { half_angle: 12_f64.to_radians(), ..cone() };
        let half_angle = |degrees: f64| Object { half_angle: degrees.to_radians(), ..body };
        let radius = |radius: f64| Object { radius, ..body };
        let axis = |degrees: f64| Object { axis: leaning(degrees), ..body };
        let aside = |x: f64| Object { center: [x, 0.0, 1.0], ..body };
        for (fault_beyond, within, beyond) in [
            (Fault::Position, [aside(0.0499), aside(-0.0499)], [aside(0.0501), aside(-0.0501)]),
            (Fault::Radius, [radius(0.0801), radius(0.1199)], [radius(0.0799), radius(0.1201)]),
            (Fault::Radius, [radius(0.09), radius(0.11)], [radius(0.001), radius(0.5)]),
            (Fault::Axis, [axis(19.9), axis(-19.9)], [axis(20.1), axis(-20.1)]),
            (Fault::HalfAngle, [half_angle(4.1), half_angle(19.9)], [half_angle(3.9), half_angle(20.1)]),
        ] {
            within.iter().for_each(|answer| assert_eq!(fault(&expected(body), answer), None, "{answer:?}"));
            beyond
                .iter()
                .for_each(|answer| assert_eq!(fault(&expected(body), answer), Some(fault_beyond), "{answer:?}"));
        }
    }

    fn seen() -> Truth {
        Truth {
            name: "thing".into(),
            object: Object { arc: 2.0, ..cone() },
            body: cone(),
            hidden: 0.0,
            extent_px: [100, 100],
            bowl: false,
            part: false,
            velocity: [0.0; 3],
        }
    }

    fn is_required(truth: &Truth) -> bool {
        VisibilityCriteria::default().are_met_by(truth)
    }

    /// The defaults: three quarters hidden, 12 pixels, 30 degrees of the circumference, 25 degrees from the axis.
    #[test]
    fn what_is_seen_well_enough_has_to_be_found_and_nothing_else() {
        let of = |change: fn(&mut Truth)| {
            let mut truth = seen();
            change(&mut truth);
            is_required(&truth)
        };
        assert!(is_required(&seen()));
        assert!(of(|truth| truth.hidden = 0.75) && !of(|truth| truth.hidden = 0.76));
        assert!(of(|truth| truth.extent_px = [12, 90]) && !of(|truth| truth.extent_px = [11, 90]));
        assert!(of(|truth| truth.extent_px = [90, 12]) && !of(|truth| truth.extent_px = [90, 11]));
        assert!(of(|truth| truth.object.arc = 30_f64.to_radians()));
        assert!(!of(|truth| truth.object.arc = 29.9_f64.to_radians()));
        assert!(of(|truth| truth.body.axis = leaning(64.9)) && !of(|truth| truth.body.axis = leaning(65.1)));
        assert!(!of(|truth| truth.bowl = true), "its inside is no sphere");
        assert!(!of(|truth| truth.part = true), "it belongs to something that is no object");
    }

    /// By the third second the scene's camera has moved three metres; the camera in the header is elsewhere.
    #[test]
    fn the_camera_is_where_the_header_has_it_whatever_the_scene_says_at_that_time() {
        let scene = "name = 'moving'
            [camera]
            position = [0.5, 0.2, 1.0]
            direction = [0, 1, 0]
            motion.path = { points = [{ t_s = 0, offset = [0, 0, 0] }, { t_s = 8, offset = [8, 0, 0] }] }
            [[sphere]]
            name = 'ball'
            center = [0, 2, 1]
            radius = 0.1";
        let scene = Some(SceneTemplate::new(scene.into(), "test".into()));
        let truth = RenderedTruth { scene, ..RenderedTruth::default() };
        let world_from_camera = [[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, -0.3], [0.0, -1.0, 0.0, 0.9]];
        let source = conicflow_messages::Text::new("moving");
        let without = Header { stamp_ns: 3_000_000_000, source, ..Header::default() };
        let with = Header { flags: conicflow_messages::HAS_POSE, world_from_camera, ..without };
        for (header, place) in [(without, Vector3::new(3.5, 0.2, 1.0)), (with, Vector3::new(0.1, -0.3, 0.9))] {
            let there = truth.scene_of(&header).unwrap().world_from_camera(3.0).translation;
            assert!((there - place).norm() < 1e-9, "{there}");
        }
    }
}
