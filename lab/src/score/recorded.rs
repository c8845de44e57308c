//! The truth of recorded frames, from a file with objects that were measured by hand.
//!
//! ```json
//! {"units": "m", "scenes": {"learn34.pcd": [
//!   {"type": "cylinder", "what": "tin", "radius_m": 0.0977, "axis_point_m": [x, y, z], "axis_dir": [x, y, z]},
//!   {"type": "sphere_like", "what": "upturned bowl", "radius_m": 0.0822, "centre_m": [x, y, z]}]}}
//! ```
//! Camera frame. `scenes` has a list for each frame, by the name of its file without folders; an empty list means that nothing is
//! to be found there. Instead, `objects` is one list for all frames, or `frames` gives one ball in each frame: `[{"file":
//! "depth/000000.png", "sphere": {"centre_mm": [x, y, z], "radius_mm": r}}]`. There a frame without `sphere` is not judged, and
//! `"radius": {"accept_range_mm": [least, most]}` beside it is the range of right radii.
//!
//! A `cone` or `cone_frustum` is described like a cylinder, with `axis_dir` from its apex to its base, `radius_m` at the middle
//! of the visible part, and `half_angle_deg`.
//!
//! `"seen_side_from_to_m": [from, to]` of a `cylinder` or a cone is the visible part of its side, along `axis_dir` from
//! `axis_point_m`; by default -50 to 50 mm. Something `sphere_like` need not be found; a sphere there is right within 20 % of the
//! radius.
//!
//! An entry may have a `quality`, which is `"good"`, `"partial"`, `"fair"` or `"poor"`. A `"poor"` object only has to be
//! detected: within 50 mm of its position, half of its radius and half a radian of its axis. Some objects are not exactly of a
//! shape: a `sphere_like` one that is `"fair"` or `"poor"` may be called a cone, and a `"poor"` `cone_frustum` any shape.
//!
//! Beside `scenes`, two tables describe what was not measured, by pixels `[x0, y0, x1, y1]` of the frame:
//!
//! ```json
//! {"visible_unmeasured": {"learn34.pcd": [{"what": "handle", "box": [376, 195, 428, 300]}]},
//!  "not_wanted":         {"learn34.pcd": [{"what": "carton", "box": [345, 50, 515, 330]}]}}
//! ```
//! `visible_unmeasured` are round things: an answer whose centre is in such a box, and that matches no object, is neither right
//! nor wrong. `not_wanted` are things that tempt a detector: an answer there is wrong, as one outside of all boxes is, and the
//! report names the thing. Where boxes of both kinds overlap, the round thing counts: handles are in front of cartons.

use super::pixel_box::{BoxEntry, PixelBox, one_line};
use super::truth::{Tolerance, TrueObject, only};
use anyhow::{Context as _, Result, bail};
use conicflow_messages::{Camera, Hinted, Object, ObjectKind, read_text};
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Tolerances against a measured truth.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RecordedTolerances {
    /// Error of the radius, in metres; that of a cone at the middle of the visible part.
    #[schemars(range(min = 0.0))]
    pub radius_m: f64,
    /// Distance of the middle of the visible part from the answer's axis, in metres.
    #[schemars(range(min = 0.0))]
    pub position_m: f64,
    /// Angle between the axes, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub axis_deg: f64,
    /// Distance of the centres of spheres, in metres.
    #[schemars(range(min = 0.0))]
    pub center_m: f64,
    /// Error of a cone's half-angle, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub half_angle_deg: f64,
}

impl Default for RecordedTolerances {
    fn default() -> Self {
        Self { radius_m: 0.004, position_m: 0.005, axis_deg: 4.0, center_m: 0.03, half_angle_deg: 3.0 }
    }
}

impl RecordedTolerances {
    fn of(&self, body: &Object) -> Tolerance {
        let radius_m = [body.radius - self.radius_m, body.radius + self.radius_m];
        let (shapes, axis) = (only(body.shape()), self.axis_deg.to_radians());
        let alike = Tolerance { shapes, position_m: self.position_m, radius_m, axis, half_angle: 1e-9 };
        match body.shape() {
            ObjectKind::Sphere => Tolerance { position_m: self.center_m, axis: 0.1, ..alike },
            ObjectKind::Cylinder => alike,
            ObjectKind::Cone => Tolerance { half_angle: self.half_angle_deg.to_radians(), ..alike },
        }
    }
}

/// Longest truth file that is read, in bytes.
const MOST_BYTES: u64 = 1 << 28; // [algorithmic]

/// Tolerance for objects that only have to be detected.
fn of_poor(body: &Object) -> Tolerance {
    let radius_m = [0.5 * body.radius, 1.5 * body.radius];
    Tolerance { shapes: only(body.shape()), position_m: 0.05, radius_m, axis: 0.5, half_angle: 0.25 }
}

#[derive(Deserialize)]
struct TruthFile {
    units: Units,
    scenes: Option<BTreeMap<String, Vec<Entry>>>,
    objects: Option<Vec<Entry>>,
    frames: Option<Vec<FrameEntry>>,
    radius: Option<RadiusNote>,
    #[serde(default)]
    visible_unmeasured: BTreeMap<String, Vec<BoxEntry>>,
    #[serde(default)]
    not_wanted: BTreeMap<String, Vec<BoxEntry>>,
}

/// The units of a file; the keys of its entries contain the unit, too, and have to agree.
#[derive(Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Units {
    M,
    Mm,
}

#[derive(Deserialize)]
struct RadiusNote {
    accept_range_mm: Option<[f64; 2]>,
}

#[derive(Deserialize)]
struct Entry {
    #[serde(rename = "type")]
    kind: String,
    #[serde(default, deserialize_with = "one_line")]
    what: String,
    quality: Option<Quality>,
    radius_m: f64,
    axis_point_m: Option<[f64; 3]>,
    axis_dir: Option<[f64; 3]>,
    centre_m: Option<[f64; 3]>,
    half_angle_deg: Option<f64>,
    widens: Option<String>,
    seen_side_from_to_m: Option<[f64; 2]>,
}

/// How well the object could be measured.
#[derive(Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Quality {
    Good,
    Fair,
    Partial,
    Poor,
}

#[derive(Deserialize)]
struct FrameEntry {
    file: String,
    sphere: Option<BallEntry>,
}

#[derive(Deserialize)]
struct BallEntry {
    centre_mm: [f64; 3],
    radius_mm: f64,
}

/// The true objects of a recording.
#[derive(Clone, Debug)]
pub struct RecordedTruth {
    /// Path of the file.
    origin: String,
    /// The objects of each frame, by the name of its file; `None` if they were not measured.
    by_frame: BTreeMap<String, Option<Vec<TrueObject>>>,
    everywhere: Option<Vec<TrueObject>>,
    /// Round things that were not measured, by the name of the frame's file.
    unmeasured: BTreeMap<String, Vec<PixelBox>>,
    /// Things that tempt a detector, by the name of the frame's file.
    not_wanted: BTreeMap<String, Vec<PixelBox>>,
}

impl RecordedTruth {
    /// Reads a truth file.
    ///
    /// # Errors
    /// The file cannot be read, or is not valid; the error names line and column.
    pub fn load(path: &Path, tolerances: &RecordedTolerances) -> Result<Self> {
        let place = || format!("truth file `{}`", path.display());
        let text = read_text(path, MOST_BYTES).with_context(place)?;
        let truth = Self::parse(&text, tolerances).with_context(place)?;
        Ok(Self { origin: path.display().to_string(), ..truth })
    }

    fn parse(text: &str, tolerances: &RecordedTolerances) -> Result<Self> {
        let file: TruthFile = serde_json::from_str(text)?;
        let wanted = if file.frames.is_some() { Units::Mm } else { Units::M };
        if file.units != wanted {
            bail!(Hinted::new(
                "`units` is not what the keys of its entries say",
                "metres for objects, mm for `frames`"
            ));
        }
        let everywhere = file.objects.as_deref().map(|entries| truths(entries, "", tolerances)).transpose()?;
        let (unmeasured, not_wanted) = (boxes(&file.visible_unmeasured)?, boxes(&file.not_wanted)?);
        let (origin, by_frame) = (String::new(), BTreeMap::new());
        let mut truth = Self { origin, by_frame, everywhere, unmeasured, not_wanted };
        for (name, entries) in file.scenes.iter().flatten() {
            truth.insert(name, Some(truths(entries, name, tolerances).with_context(|| format!("scene `{name}`"))?))?;
        }
        let range_mm = file.radius.and_then(|radius| radius.accept_range_mm);
        for frame in file.frames.iter().flatten() {
            let ball = frame.sphere.as_ref().map(|ball| ball.truth(range_mm, tolerances)).transpose()?;
            truth.insert(&frame.file, ball.map(|ball| vec![ball]))?;
        }
        if truth.by_frame.is_empty() && truth.everywhere.is_none() {
            bail!(Hinted::new("it has none of `scenes`, `objects` and `frames`", "say what is in the frames"));
        }
        let named = truth.unmeasured.keys().chain(truth.not_wanted.keys());
        if let Some(stranger) = named.into_iter().find(|name| truth.objects(name).is_none()) {
            bail!(Hinted::new(
                format!(
                    "`visible_unmeasured` or `not_wanted` has boxes of `{stranger}`, of which it does not say what is to be \
                     found"
                ),
                "`scenes` has a list for each frame, an empty one where nothing is to be found"
            ));
        }
        Ok(truth)
    }

    /// Adds the objects of a frame; the folder in its name is ignored.
    fn insert(&mut self, file: &str, truths: Option<Vec<TrueObject>>) -> Result<()> {
        let name = file_name(file);
        if self.by_frame.insert(name.to_owned(), truths).is_some() {
            bail!(Hinted::new(
                format!("it has two entries for `{name}`"),
                "folders do not count: write a truth file for each"
            ));
        }
        Ok(())
    }

    /// Returns the path of the truth file.
    pub fn origin(&self) -> &str {
        &self.origin
    }

    /// Names the unmeasured round thing at the centre of an answer, if there is one.
    pub fn unmeasured_at(&self, source: &str, camera: &Camera, answer: &Object) -> Option<&str> {
        what_at(&self.unmeasured, source, camera, answer)
    }

    /// Names the tempting thing at the centre of an answer, if one is known.
    pub fn not_wanted_at(&self, source: &str, camera: &Camera, answer: &Object) -> Option<&str> {
        what_at(&self.not_wanted, source, camera, answer)
    }

    /// Returns the name of one of the frames in the file.
    pub fn some_frame(&self) -> Option<&str> {
        self.by_frame.keys().next().map(String::as_str)
    }

    /// Returns the names of the frames with known objects.
    pub fn judged_frames(&self) -> impl Iterator<Item = &str> {
        self.by_frame.iter().filter(|(_, truths)| truths.is_some()).map(|(name, _)| name.as_str())
    }

    /// Returns the objects of a frame; `None` if they were not measured.
    pub fn objects(&self, source: &str) -> Option<&[TrueObject]> {
        match self.by_frame.get(file_name(source)) {
            Some(frame) => frame.as_deref(),
            None => self.everywhere.as_deref(),
        }
    }
}

/// Returns the objects of a list with unique names: one without a name gets its type, number and frame as name, and a second one
/// of a name its number, too.
fn truths(entries: &[Entry], frame: &str, tolerances: &RecordedTolerances) -> Result<Vec<TrueObject>> {
    let mut truths: Vec<TrueObject> = Vec::new();
    for (number, entry) in (1..).zip(entries) {
        let place = if frame.is_empty() { String::new() } else { format!(" of {}", file_name(frame).escape_debug()) };
        let unnamed = || format!("{} {number}{place}", entry.kind.escape_debug());
        let is_taken = truths.iter().any(|truth| truth.name == entry.what);
        let name = match &entry.what {
            what if what.is_empty() => unnamed(),
            what if is_taken => format!("{what} {number}"),
            what => what.clone(),
        };
        truths.push(entry.truth(name, tolerances)?);
    }
    Ok(truths)
}

/// Returns the boxes of each frame; entries without a box are left out.
fn boxes(entries: &BTreeMap<String, Vec<BoxEntry>>) -> Result<BTreeMap<String, Vec<PixelBox>>> {
    let of_frame = |(name, entries): (&String, &Vec<BoxEntry>)| {
        let boxes = entries.iter().filter_map(|entry| entry.pixel_box().transpose()).collect::<Result<_>>();
        Ok((file_name(name).to_owned(), boxes.with_context(|| format!("boxes of `{name}`"))?))
    };
    entries.iter().map(of_frame).collect()
}

fn what_at<'a>(
    boxes: &'a BTreeMap<String, Vec<PixelBox>>,
    source: &str,
    camera: &Camera,
    answer: &Object,
) -> Option<&'a str> {
    let boxes = boxes.get(file_name(source))?;
    boxes.iter().find(|known| known.shows(camera, &answer.center)).map(|known| known.what.as_str())
}

fn check_radius(radius: f64, what: &str) -> Result<()> {
    if radius > 0.0 && radius.is_finite() {
        return Ok(());
    }
    bail!(Hinted::new(format!("the radius of `{what}` is {radius}"), "a radius is more than 0"))
}

/// Returns the last part of a path; the separator is `/` on every system.
pub(super) fn file_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

impl Entry {
    fn truth(&self, name: String, tolerances: &RecordedTolerances) -> Result<TrueObject> {
        let radius = self.radius_m;
        check_radius(radius, &self.what)?;
        let body = match (self.kind.as_str(), self.axis_point_m, self.axis_dir, self.centre_m) {
            ("cylinder", Some(point), Some(axis), _) => self.cylinder(point, axis)?,
            ("cone" | "cone_frustum", Some(point), Some(axis), _) => self.cone(point, axis)?,
            ("sphere" | "sphere_like", _, _, Some(center)) => sphere(center, radius),
            (kind, ..) => bail!(Hinted::new(
                format!("an entry `{}` of type `{kind}` is not understood", self.what),
                "a `cylinder`, a `cone` or a `cone_frustum` has `axis_point_m` and `axis_dir`, a `sphere` or `sphere_like` has \
                 `centre_m`"
            )),
        };
        let required = self.kind != "sphere_like";
        let mut tolerance = tolerances.of(&body);
        if !required {
            tolerance.radius_m = [0.8 * radius, 1.2 * radius];
        }
        if self.quality == Some(Quality::Poor) {
            tolerance = of_poor(&body);
        }
        tolerance.shapes = match (self.kind.as_str(), self.quality) {
            ("sphere_like", Some(Quality::Fair | Quality::Poor)) => &[ObjectKind::Sphere, ObjectKind::Cone],
            ("cone_frustum", Some(Quality::Poor)) => &ObjectKind::ALL,
            _ => tolerance.shapes,
        };
        let measured = self.quality != Some(Quality::Poor);
        Ok(TrueObject { name, body, hidden: 0.0, required, measured, tolerance })
    }

    /// Returns a cylinder that widens along its axis.
    fn cone(&self, point: [f64; 3], axis: [f64; 3]) -> Result<Object> {
        let Some(half_angle) = self.half_angle_deg.filter(|degrees| (0.0..90.0).contains(degrees)) else {
            bail!(Hinted::new(
                format!("the cone `{}` has no `half_angle_deg` from 0 to 90", self.what),
                "between its axis and its side"
            ));
        };
        if self.widens.as_ref().is_some_and(|widens| !widens.starts_with("along axis_dir")) {
            bail!(Hinted::new(
                format!("the cone `{}` does not widen along its `axis_dir`", self.what),
                "turn `axis_dir` about"
            ));
        }
        let (body, half_angle) = (self.cylinder(point, axis)?, half_angle.to_radians());
        let [top, base] = [-0.5, 0.5].map(|share| (body.radius + share * body.length * half_angle.tan()).max(0.0));
        Ok(Object { kind: ObjectKind::Cone.code(), half_angle, top_radius: top, base_radius: base, ..body })
    }

    fn cylinder(&self, point: [f64; 3], axis: [f64; 3]) -> Result<Object> {
        let Some(axis) = Vector3::from(axis).try_normalize(1e-9) else {
            bail!(Hinted::new(
                format!("the `axis_dir` of `{}` is {axis:?}, which is no direction", self.what),
                "any length but zero will do"
            ));
        };
        let [from, to] = self.seen_side_from_to_m.unwrap_or([-0.05, 0.05]);
        if from >= to {
            bail!(Hinted::new(
                format!("the `seen_side_from_to_m` of `{}` goes from {from} to {to}", self.what),
                "it rises along `axis_dir`"
            ));
        }
        Ok(Object {
            kind: ObjectKind::Cylinder.code(),
            center: (Vector3::from(point) + axis * (0.5 * (from + to))).into(),
            axis: axis.into(),
            radius: self.radius_m,
            length: to - from,
            ..Object::default()
        })
    }
}

fn sphere(center: [f64; 3], radius: f64) -> Object {
    Object { kind: ObjectKind::Sphere.code(), center, radius, ..Object::default() }
}

impl BallEntry {
    fn truth(&self, range_mm: Option<[f64; 2]>, tolerances: &RecordedTolerances) -> Result<TrueObject> {
        check_radius(self.radius_mm, "ball")?;
        let body = sphere(self.centre_mm.map(|coordinate| 1e-3 * coordinate), 1e-3 * self.radius_mm);
        let mut tolerance = tolerances.of(&body);
        if let Some(range_mm @ [least, most]) = range_mm {
            // The sensor may show another radius, so that the true one need not lie in the range.
            let is_about_it = most > 0.5 * self.radius_mm && least < 2.0 * self.radius_mm;
            if least >= most || !is_about_it {
                bail!(Hinted::new(
                    format!("`accept_range_mm` goes from {least} to {most}, and the radius is {}", self.radius_mm),
                    "give the least radius that is right, then the greatest, in mm"
                ));
            }
            tolerance.radius_m = range_mm.map(|limit| 1e-3 * limit);
        }
        Ok(TrueObject { name: "ball".into(), body, hidden: 0.0, required: true, measured: true, tolerance })
    }
}

#[cfg(test)]
mod tests {
    use super::super::matching::{Fault, fault};
    use super::*;

    fn parse(text: &str) -> Result<RecordedTruth> {
        RecordedTruth::parse(text, &RecordedTolerances::default())
    }

    #[test]
    fn scenes_are_found_by_the_name_of_their_file() {
        let truth = parse(
            r#"{"units": "m", "how": "by hand", "scenes": {"a.pcd": [
                {"type": "cylinder", "what": "tin\u001b[31m\n  a", "radius_m": 0.05, "axis_point_m": [0, 0, 1],
                    "axis_dir": [0, 2, 0]},
                {"type": "sphere_like", "radius_m": 0.08, "centre_m": [0.1, 0, 1]}], "b.pcd": [], "clouds/d.pcd": [
                {"type": "sphere", "what": "orb", "radius_m": 0.1, "centre_m": [0, 0, 1]},
                {"type": "sphere", "what": "orb", "radius_m": 0.1, "centre_m": [0, 0, 5]}]}}"#,
        )
        .unwrap();
        let [tin, bowl] = truth.objects("a.pcd").unwrap() else { panic!() };
        assert_eq!((tin.name.as_str(), tin.body.axis, tin.required), ("tin\\u{1b}[31m\\n  a", [0.0, 1.0, 0.0], true));
        assert!((tin.tolerance.radius_m[1] - 0.054).abs() < 1e-12);
        assert_eq!((bowl.body.shape(), bowl.required), (ObjectKind::Sphere, false));
        assert_eq!(bowl.name, "sphere_like 2 of a.pcd", "what has no name is told apart");
        assert_eq!(truth.objects("b.pcd").map(<[TrueObject]>::len), Some(0));
        let names = truth.objects("d.pcd").unwrap().iter().map(|truth| truth.name.as_str());
        assert!(names.eq(["orb", "orb 2"]), "a frame that is named with its folder");
        assert!(truth.objects("c.pcd").is_none());
    }

    #[test]
    fn a_ball_has_its_place_in_each_frame_that_was_measured() {
        let truth = parse(
            r#"{"units": "mm", "radius": {"accept_range_mm": [195, 222]}, "frames": [
                {"frame": 0, "file": "depth/000000.png", "sphere": {"centre_mm": [500, -500, 2300], "radius_mm": 208}},
                {"frame": 1, "file": "depth/000001.png"}]}"#,
        )
        .unwrap();
        let [ball] = truth.objects("000000.png").unwrap() else { panic!() };
        assert!((Vector3::from(ball.body.center) - Vector3::new(0.5, -0.5, 2.3)).norm() < 1e-12);
        assert!((ball.body.radius - 0.208).abs() < 1e-12);
        let [least, most] = ball.tolerance.radius_m;
        assert!((least - 0.195).abs() < 1e-12 && (most - 0.222).abs() < 1e-12);
        assert!(truth.objects("000001.png").is_none());
    }

    #[test]
    fn one_list_can_hold_for_all_frames_and_poor_entries_only_have_to_be_seen() {
        let truth = parse(
            r#"{"units": "m", "objects": [
                {"type": "cylinder", "quality": "poor", "radius_m": 0.04, "axis_point_m": [0, 0, 1], "axis_dir": [0, 1, 0]},
                {"type": "sphere", "quality": "poor", "radius_m": 0.04, "centre_m": [0, 0, 1]}]}"#,
        )
        .unwrap();
        for poor in truth.objects("anything").unwrap() {
            assert!(!poor.measured);
            assert_eq!((poor.tolerance.radius_m, poor.tolerance.position_m), ([0.02, 0.06], 0.05));
        }
    }

    #[test]
    fn the_middle_of_a_cylinder_is_that_of_the_part_that_is_seen() {
        let truth = parse(
            r#"{"units": "m", "objects": [{"type": "cylinder", "radius_m": 0.04, "axis_point_m": [0, 0, 1],
                "axis_dir": [0, 2, 0], "seen_side_from_to_m": [-0.1, 0.3]}]}"#,
        )
        .unwrap();
        let body = truth.objects("anything").unwrap()[0].body;
        assert!((Vector3::from(body.center) - Vector3::new(0.0, 0.1, 1.0)).norm() < 1e-12, "{:?}", body.center);
        assert!((body.length - 0.4).abs() < 1e-12);
    }

    #[test]
    fn a_cone_widens_along_its_axis() {
        let cone = |angle: &str| {
            parse(&format!(
                r#"{{"units": "m", "objects": [{{"type": "cone", "what": "parking cone", "radius_m": 0.1 {angle},
                    "axis_point_m": [0, 0, 1], "axis_dir": [0, 1, 0], "seen_side_from_to_m": [-0.2, 0.2]}}]}}"#
            ))
        };
        let truth = cone(r#", "half_angle_deg": 10"#).unwrap();
        let [expected] = truth.objects("any").unwrap() else { panic!() };
        let answer = |degrees: f64| Object { half_angle: degrees.to_radians(), ..expected.body };
        let widening = 0.2 * 10.0_f64.to_radians().tan();
        assert!((expected.body.base_radius - 0.1 - widening).abs() < 1e-12);
        assert!((expected.body.top_radius - 0.1 + widening).abs() < 1e-12);
        assert_eq!(fault(expected, &answer(12.0)), None);
        assert_eq!(fault(expected, &answer(14.0)), Some(Fault::HalfAngle));
        assert!(format!("{:#}", cone("").unwrap_err()).contains("has no `half_angle_deg` from 0 to 90\n  hint: "));
    }

    /// The defaults: 4 mm for the radius, 5 mm from the axis and 30 mm from the centre of a sphere, 4 degrees for the axis and 3
    /// for the half-angle.
    #[test]
    fn an_answer_is_right_within_the_default_tolerances_and_no_farther() {
        let entry = |text: &str| {
            let text = format!(r#"{{"units": "m", "objects": [{{{text}, "radius_m": 0.1}}]}}"#);
            parse(&text).unwrap().objects("any").unwrap()[0].clone()
        };
        let place = r#""axis_point_m": [0, 0, 1], "axis_dir": [0, 1, 0]"#;
        let ball = entry(r#""type": "sphere", "centre_m": [0, 0, 1]"#);
        let tin = entry(&format!(r#""type": "cylinder", {place}"#));
        let cone = entry(&format!(r#""type": "cone", "half_angle_deg": 10, {place}"#));
        let aside = |body: Object, x: f64| Object { center: [x, 0.0, 1.0], ..body };
        let wider = |body: Object, more: f64| Object { radius: body.radius + more, ..body };
        let leaning = |body: Object, degrees: f64| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            Object { axis: [sine, cosine, 0.0], ..body }
        };
        let opened = |body: Object, degrees: f64| Object { half_angle: degrees.to_radians(), ..body };
        for (truth, within, beyond, expected) in [
            (&ball, aside(ball.body, 0.029), aside(ball.body, 0.031), Fault::Position),
            (&ball, wider(ball.body, -0.0039), wider(ball.body, -0.0041), Fault::Radius),
            (&tin, aside(tin.body, 0.0049), aside(tin.body, 0.0051), Fault::Position),
            (&tin, wider(tin.body, 0.0039), wider(tin.body, 0.0041), Fault::Radius),
            (&tin, leaning(tin.body, 3.9), leaning(tin.body, 4.1), Fault::Axis),
            (&cone, aside(cone.body, 0.0049), aside(cone.body, 0.0051), Fault::Position),
            (&cone, leaning(cone.body, 3.9), leaning(cone.body, 4.1), Fault::Axis),
            (&cone, opened(cone.body, 12.9), opened(cone.body, 13.1), Fault::HalfAngle),
        ] {
            assert_eq!((fault(truth, &within), fault(truth, &beyond)), (None, Some(expected)), "{beyond:?}");
        }
    }

    #[test]
    fn what_is_no_shape_exactly_may_be_called_another_and_a_good_cone_may_not() {
        let entry = |kind: &str, quality: &str| {
            let quality = if quality.is_empty() { String::new() } else { format!(r#""quality": "{quality}","#) };
            let text = format!(
                r#"{{"units": "m", "objects": [{{"type": "{kind}", {quality} "radius_m": 0.07, "half_angle_deg": 28,
                    "widens": "along axis_dir (upwards)", "axis_point_m": [0, 0, 1], "axis_dir": [0, -1, 0],
                    "centre_m": [0, 0, 1]}}]}}"#
            );
            parse(&text).unwrap().objects("any").unwrap()[0].clone()
        };
        let is_right = |truth: &TrueObject| {
            ObjectKind::ALL.map(|shape| fault(truth, &Object { kind: shape.code(), ..truth.body }).is_none())
        };
        let [sphere, cylinder, cone] = ObjectKind::ALL.map(|shape| ObjectKind::ALL.map(|other| other == shape));
        let (bowl, any) = ([true, false, true], [true; 3]);
        for (kind, quality, right, required) in [
            ("cylinder", "good", cylinder, true),
            ("cylinder", "poor", cylinder, true),
            ("cone_frustum", "", cone, true),
            ("cone_frustum", "fair", cone, true),
            ("cone_frustum", "poor", any, true),
            ("sphere", "poor", sphere, true),
            ("sphere_like", "", sphere, false),
            ("sphere_like", "fair", bowl, false),
            ("sphere_like", "poor", bowl, false),
        ] {
            let truth = entry(kind, quality);
            assert_eq!((is_right(&truth), truth.required), (right, required), "{quality} {kind}");
        }
        let fair = entry("sphere_like", "fair").tolerance.radius_m;
        assert!((fair[1] - fair[0]) / 2.0 >= 0.008, "no tighter than 8 mm: {fair:?}");
        assert!((fair[0] - 0.056).abs() < 1e-12 && (fair[1] - 0.084).abs() < 1e-12, "20 % of 70 mm: {fair:?}");
    }

    #[test]
    fn a_sphere_is_right_however_little_the_axes_of_others_may_lean() {
        let tolerances = RecordedTolerances { axis_deg: 0.0, half_angle_deg: 0.0, ..RecordedTolerances::default() };
        let text = r#"{"units": "m", "objects": [{"type": "sphere", "radius_m": 0.1, "centre_m": [0, 0, 1]}]}"#;
        let truth = RecordedTruth::parse(text, &tolerances).unwrap();
        let [ball] = truth.objects("any").unwrap() else { panic!() };
        assert_eq!(fault(ball, &ball.body), None);
    }

    #[test]
    fn a_file_is_named_by_what_it_tells_and_by_what_is_wrong_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.json");
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            RecordedTruth::load(&path, &RecordedTolerances::default())
        };
        let truth = load(r#"{"units": "m", "scenes": {"clouds/b.pcd": [], "c.pcd": []}}"#).unwrap();
        assert_eq!((truth.origin(), truth.some_frame()), (path.to_str().unwrap(), Some("b.pcd")));
        let error = format!("{:#}", load("{").unwrap_err());
        assert!(error.starts_with(&format!("truth file `{}`: EOF", path.display())), "{error}");
    }

    #[test]
    fn boxes_are_those_of_their_frame() {
        let camera = Camera { width: 640, height: 480, fx: 600.0, fy: 600.0, cx: 320.0, cy: 240.0 };
        let truth = parse(
            r#"{"units": "m", "scenes": {"a.png": [], "b.png": []},
                "visible_unmeasured": {"a.png": [{"kind": "other_round", "what": "handle", "box": [370, 190, 430, 300]}]},
                "not_wanted": {"b.png": [{"what": "rock"}, {"what": "carton", "box": [0, 0, 639, 479]}]}}"#,
        )
        .unwrap();
        let answer = |x: f64, z: f64| Object { center: [x, 0.0, z], radius: 0.01, ..Object::default() };
        let unmeasured = |source, x, z| truth.unmeasured_at(source, &camera, &answer(x, z));
        assert_eq!(unmeasured("depth/a.png", 0.1, 1.0), Some("handle"), "seen at u = 380");
        assert_eq!(unmeasured("a.png", 0.08, 1.0), None, "seen at u = 368");
        assert_eq!(unmeasured("a.png", -0.1, -1.0), None, "behind the camera");
        assert_eq!(unmeasured("b.png", 0.1, 1.0), None, "the box of another frame");
        assert_eq!(truth.not_wanted_at("b.png", &camera, &answer(0.1, 1.0)), Some("carton"));
        assert_eq!(truth.not_wanted_at("a.png", &camera, &answer(0.1, 1.0)), None);
    }

    #[test]
    fn what_is_not_understood_is_told() {
        for (text, what) in [
            (r#"{"units": "m"}"#, "none of `scenes`"),
            (r#"{"units": "mm", "objects": []}"#, "`units`"),
            (r#"{"units": "m", "objects": [{"type": "torus", "what": "ring", "radius_m": 1}]}"#, "`torus`"),
            (r#"{"units": "m", "objects": [{"type": "cylinder"}]}"#, "radius_m"),
            (
                r#"{"units": "m", "objects": [{"type": "sphere", "what": "orb", "radius_m": -1, "centre_m": [0, 0, 1]}]}"#,
                "the radius of `orb` is -1\n  hint: ",
            ),
            (
                r#"{"units": "mm", "frames": [{"file": "a", "sphere": {"centre_mm": [0, 0, 1], "radius_mm": 0}}]}"#,
                "the radius of `ball` is 0",
            ),
            (
                r#"{"units": "mm", "radius": {"accept_range_mm": [222, 195]}, "frames": [
                    {"file": "a", "sphere": {"centre_mm": [0, 0, 1], "radius_mm": 208}}]}"#,
                "`accept_range_mm` goes from 222 to 195, and the radius is 208\n  hint: ",
            ),
            (
                r#"{"units": "mm", "radius": {"accept_range_mm": [0.195, 0.222]}, "frames": [
                    {"file": "a", "sphere": {"centre_mm": [0, 0, 1], "radius_mm": 208}}]}"#,
                "`accept_range_mm` goes from 0.195 to 0.222, and the radius is 208\n  hint: ",
            ),
            (r#"{"units": "m", "objects": [{"type": "sphere", "radius_m": 1, "quality": "pour"}]}"#, "`pour`"),
            (r#"{"units": "m", "scenes": {"a/0.pcd": [], "b/0.pcd": []}}"#, "two entries for `0.pcd`"),
            (
                r#"{"units": "m", "scenes": {"0.png": []}, "visible_unmeasured": {"1.png": []}}"#,
                "has boxes of `1.png`, of which it does not say what is to be found\n  hint: ",
            ),
            (
                r#"{"units": "m", "scenes": {"0.png": []}, "not_wanted": {"0.png": [{"what": "carton", "box": [9, 0, 3, 5]}]}}"#,
                "boxes of `0.png`: the box [9.0, 0.0, 3.0, 5.0] of `carton` has no inside\n  hint: ",
            ),
            (
                r#"{"units": "m", "objects": [{"type": "cone_frustum", "what": "mug", "radius_m": 1, "axis_point_m": [0, 0, 1],
                    "axis_dir": [0, 1, 0], "half_angle_deg": 7, "widens": "downwards"}]}"#,
                "the cone `mug` does not widen along its `axis_dir`\n  hint: ",
            ),
            (
                r#"{"units": "m", "objects": [{"type": "cylinder", "what": "tin", "radius_m": 1, "axis_point_m": [0, 0, 1],
                    "axis_dir": [0, 0, 0]}]}"#,
                "the `axis_dir` of `tin` is [0.0, 0.0, 0.0], which is no direction\n  hint: ",
            ),
            (
                r#"{"units": "m", "objects": [{"type": "cylinder", "what": "tin", "radius_m": 1, "axis_point_m": [0, 0, 1],
                    "axis_dir": [0, 1, 0], "seen_side_from_to_m": [0.1, -0.1]}]}"#,
                "of `tin` goes from 0.1 to -0.1\n  hint: ",
            ),
            (
                r#"{"units": "m", "objects": [{"type": "cylinder", "what": "tin", "radius_m": 1, "axis_point_m": [0, 0, 1],
                    "axis_dir": [0, 1, 0], "seen_side_from_to_m": [0.1, 0.1]}]}"#,
                "of `tin` goes from 0.1 to 0.1\n  hint: ",
            ),
        ] {
            let error = format!("{:#}", parse(text).unwrap_err());
            assert!(error.contains(what), "{error}");
        }
    }
}
