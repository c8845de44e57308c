//! Parameters of the assembly of objects.

use conicflow_messages::{ConfigFault, ObjectKind};
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

/// Smallest and largest radius of a shape.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct RadiusLimits {
    /// Smallest radius, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 100.0)))]
    pub min_m: f64,
    /// Largest radius, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 100.0)))]
    pub max_m: f64,
}

/// Smallest and largest radius and visible length of a cylinder or cone.
#[derive(Clone, Copy, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct AxialLimits {
    /// Smallest radius, in metres; of a cone in the middle of its visible part.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 100.0)))]
    pub min_m: f64,
    /// Largest radius, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 100.0)))]
    pub max_m: f64,
    /// Smallest visible length, in metres.
    #[serde(default)]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 100.0)))]
    pub min_length_m: f64,
    /// Largest visible length, in metres.
    #[serde(default = "unlimited_m")]
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 100.0)))]
    pub max_length_m: f64,
}

/// Returns a length beyond the range of any camera, in metres.
fn unlimited_m() -> f64 {
    100.0
}

/// Requirements on an object for it to be reported.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PooledParameters {
    /// Fewest scan lines of an object; lines are counted among those that the extractor searches, here and below.
    #[cfg_attr(feature = "schema", schemars(range(min = 7, max = 1000)))]
    pub min_lines: u32,
    /// Smallest visual angle of an object across its scan lines, in degrees: a finer image shows more of what is too small to
    /// recognise.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 45.0)))]
    pub min_view_deg: f64,
    /// Number of scan lines without a part of the object that are always bridged; one less while the first lines are put
    /// together.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 64)))]
    pub max_gap_lines: u32,
    /// Smallest share of the scan lines from first to last that support the object.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub min_coverage: f64,
    /// Smallest visible part of the circumference, in degrees.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 180.0)))]
    pub min_arc_deg: f64,
    /// Shortest visible part of a cylinder or cone, in radii.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 10.0)))]
    pub min_length_radii: f64,
    /// Least height of the visible part of a sphere, in radii.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 2.0)))]
    pub min_cap_radii: f64,
    /// Smallest half-angle of a cone, in degrees; a smaller one does not distinguish it from a cylinder.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 45.0)))]
    pub min_half_angle_deg: f64,
    /// Time for the ellipses of one image, in milliseconds of the clock, after which the search for objects ends; 0: no limit.
    /// Default: 30 where the stage takes the newest message (`latest`), so that it keeps up with 30 images a second; no limit
    /// where it takes each (`lossless`), nor in the library. Strongly curved ellipses come first, but later where growth from the
    /// same surface failed before. With a limit the same image may give other objects on a busy machine.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 10_000.0)))]
    pub budget_ms: Option<f64>,
    /// Number of images for which an object's evidence on the errors of silhouettes counts after it was last seen in its place;
    /// 0: each image is processed as if it were the first.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub contour_memory: f64,
}

impl Default for PooledParameters {
    fn default() -> Self {
        Self {
            min_lines: 10,
            min_view_deg: 1.4,
            max_gap_lines: 4,
            min_coverage: 0.3,
            min_arc_deg: 30.0,
            min_length_radii: 0.5,
            min_cap_radii: 0.5,
            min_half_angle_deg: 2.5,
            budget_ms: None,
            contour_memory: 100.0,
        }
    }
}

/// Parameters of the assembly.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct AssemblerParameters {
    /// Largest half-angle of a cone, in degrees.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 45.0)))]
    pub max_half_angle_deg: f64,
    /// Limits on the radius of a sphere.
    pub sphere: RadiusLimits,
    /// Limits on the radius and the visible length of a cylinder.
    pub cylinder: AxialLimits,
    /// Limits on the radius, in the middle of its visible part, and the visible length of a cone.
    pub cone: AxialLimits,
    /// Least `confidence`, the probability that a candidate is an object; less probable ones are not reported.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub min_confidence: f64,
    /// Requirements on an object for it to be reported.
    pub pooled: PooledParameters,
}

impl Default for AssemblerParameters {
    fn default() -> Self {
        let (min_m, max_m) = (0.015, 0.5);
        let axial = AxialLimits { min_m, max_m, min_length_m: 0.0, max_length_m: unlimited_m() };
        Self {
            max_half_angle_deg: 30.0,
            // [measured] Rooms contain more that is no object than the scenes to which the odds were fitted: of the reported
            // candidates with a confidence from 0.5 to 0.55 in recordings three are wrong, and none is right.
            min_confidence: 0.55,
            sphere: RadiusLimits { min_m, max_m },
            cylinder: axial,
            cone: axial,
            pooled: PooledParameters::default(),
        }
    }
}

impl AssemblerParameters {
    /// Returns the contradictions between parameters that are each in range.
    pub fn faults(&self) -> Vec<ConfigFault> {
        let axial = [("cylinder", &self.cylinder), ("cone", &self.cone)];
        let mut faults: Vec<_> = fault("sphere", "m", self.sphere.min_m, self.sphere.max_m).into_iter().collect();
        for (key, limits) in axial {
            faults.extend(fault(key, "m", limits.min_m, limits.max_m));
            faults.extend(fault(key, "length_m", limits.min_length_m, limits.max_length_m));
        }
        faults
    }

    /// Returns the fault of a half-angle `min_half_angle_deg` in the table `key` that is larger than the largest one of a cone.
    pub fn fault_of_half_angle(&self, key: &'static str, least: f64) -> Option<ConfigFault> {
        let most = self.max_half_angle_deg;
        (least > most).then(|| ConfigFault {
            key,
            what: format!("min_half_angle_deg, {least}, is more than max_half_angle_deg, {most}"),
            hint: "what is steeper than the one and flatter than the other is a cone".to_owned(),
        })
    }

    /// Returns the number of scan lines without a part of the object that are always bridged.
    pub(crate) fn max_gap(&self) -> i64 {
        i64::from(self.pooled.max_gap_lines)
    }

    /// Returns the range of radii of a shape, in metres.
    pub fn radii_m(&self, shape: ObjectKind) -> RangeInclusive<f64> {
        match shape {
            ObjectKind::Sphere => self.sphere.min_m..=self.sphere.max_m,
            ObjectKind::Cylinder => self.cylinder.min_m..=self.cylinder.max_m,
            ObjectKind::Cone => self.cone.min_m..=self.cone.max_m,
        }
    }

    /// Returns the range of visible lengths of a shape, in metres; unlimited for a sphere.
    pub fn lengths_m(&self, shape: ObjectKind) -> RangeInclusive<f64> {
        match shape {
            ObjectKind::Sphere => f64::NEG_INFINITY..=f64::INFINITY,
            ObjectKind::Cylinder => self.cylinder.min_length_m..=self.cylinder.max_length_m,
            ObjectKind::Cone => self.cone.min_length_m..=self.cone.max_length_m,
        }
    }

    /// Returns when the processing of an image that begins now is given up; `None`: never.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let budget = Duration::try_from_secs_f64(self.pooled.budget_ms? / 1e3).unwrap_or_default();
        (!budget.is_zero()).then(|| Instant::now() + budget)
    }
}

/// Returns the fault of limits `min_UNIT` and `max_UNIT` of a shape where the least exceeds the largest.
fn fault(key: &'static str, unit: &str, min: f64, max: f64) -> Option<ConfigFault> {
    (min > max).then(|| ConfigFault {
        key,
        what: format!("min_{unit}, {min}, is more than max_{unit}, {max}"),
        hint: "both are in metres".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deadline_lies_as_far_ahead_as_the_budget_says() {
        let deadline = |budget_ms: Option<f64>| {
            let mut parameters = AssemblerParameters::default();
            parameters.pooled.budget_ms = budget_ms;
            parameters.deadline()
        };
        let before = Instant::now();
        let (soon, late) = (deadline(Some(2.5)).unwrap(), deadline(Some(4000.0)).unwrap());
        let ahead = |ms: u64| before + Duration::from_micros(ms)..=Instant::now() + Duration::from_micros(ms);
        assert!(ahead(2500).contains(&soon) && ahead(4_000_000).contains(&late));
        assert_eq!([deadline(Some(0.0)), deadline(None)], [None, None]);
    }

    #[test]
    fn limits_of_which_the_least_is_more_than_the_most_are_a_fault_of_their_shape() {
        let of = |change: &dyn Fn(&mut AssemblerParameters)| {
            let mut parameters = AssemblerParameters::default();
            change(&mut parameters);
            parameters.faults().iter().map(|fault| (fault.key, fault.what.clone())).collect::<Vec<_>>()
        };
        assert_eq!(of(&|_| ()), []);
        assert_eq!(
            of(&|limits| (limits.cone.min_m, limits.cone.min_length_m) = (0.5, 100.0)),
            [],
            "exactly one will do"
        );
        let radius = "min_m, 0.6, is more than max_m, 0.5".to_owned();
        assert_eq!(of(&|limits| limits.sphere.min_m = 0.6), [("sphere", radius.clone())]);
        assert_eq!(of(&|limits| limits.cylinder.min_m = 0.6), [("cylinder", radius.clone())]);
        let length = "min_length_m, 2, is more than max_length_m, 1".to_owned();
        let both = |limits: &mut AssemblerParameters| {
            limits.cone = AxialLimits { min_m: 0.6, max_m: 0.5, min_length_m: 2.0, max_length_m: 1.0 };
        };
        assert_eq!(of(&both), [("cone", radius), ("cone", length)]);
    }

    #[test]
    fn what_is_steeper_than_any_cone_may_be_none() {
        let parameters = AssemblerParameters { max_half_angle_deg: 30.0, ..AssemblerParameters::default() };
        let fault = |least: f64| parameters.fault_of_half_angle("pooled", least).map(|fault| fault.key);
        assert_eq!([29.0, 30.0, 31.0].map(fault), [None, None, Some("pooled")]);
    }

    #[test]
    fn without_limits_of_its_length_an_object_has_any_length_that_a_camera_sees() {
        let parameters: AssemblerParameters = toml::from_str("cone = { min_m = 0.1, max_m = 0.2 }").unwrap();
        assert!([0.0, 99.0].iter().all(|length| parameters.lengths_m(ObjectKind::Cone).contains(length)));
    }

    #[test]
    fn gaps_are_as_wide_as_they_may_be() {
        let pooled = PooledParameters { max_gap_lines: 7, ..PooledParameters::default() };
        assert_eq!(AssemblerParameters { pooled, ..AssemblerParameters::default() }.max_gap(), 7);
    }
}
