//! The parameters of the tracker.

use super::ballistic::Ballistic;
use crate::gravity;
use conicflow_messages::ConfigFault;
use serde::{Deserialize, Serialize};

/// Parameters of `kalman_tracker`.
///
/// The `floor_*` are standard deviations that are added (as squares) to those of each detection, for errors that these do not
/// include; the `drift_*` are the rates of random walks of parameters that are nearly constant.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TrackerParameters {
    /// Strength of the random acceleration that objects usually undergo, in m/s^2 per square root of Hz. Further models have a
    /// tenth of it, for objects that stand or move evenly, and ten times of it.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub acceleration: f64,
    /// Standard deviation of the speed at the first detection, per axis, in m/s; a tenth of it for an object that moves evenly.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub initial_speed_mps: f64,
    /// Standard deviation of a sudden change of velocity (a bounce, a push), per axis, in m/s; 0: none is expected.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub manoeuvre_mps: f64,
    /// Balls may fall and bounce: `{ gravity_mps2 = 9.81, floor_m = 0, restitution = 0.8 }`; none: they go straight on while
    /// unseen.
    pub ballistic: Option<Ballistic>,
    /// Squared Mahalanobis distance up to which a detection may belong to a track; 16.3 leaves out one in a thousand.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub gate: f64,
    /// Difference of radius between track and detection that is accepted whatever their sigma, as a share of the radius.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub max_radius_change: f64,
    /// Angle between the axes of track and detection that is accepted whatever their sigma, in degrees.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 90.0)))]
    pub max_axis_change_deg: f64,
    /// Number of detections that confirm a track, within `confirm_window` frames.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 32)))]
    pub confirm_hits: u32,
    /// Number of frames within which `confirm_hits` detections confirm a track.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 32)))]
    pub confirm_window: u32,
    /// Longest time for which a confirmed track continues without a detection, in seconds; where frames are farther apart, it
    /// continues to the next one.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub max_coast_s: f64,
    /// Frame rate that is assumed where the time stamps do not advance, in Hz.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 1e6)))]
    pub assumed_rate_hz: f64,
    /// Added to the sigma of the centre, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.000001, max = 1e6)))]
    pub floor_center_m: f64,
    /// Added to the sigma of the centre along the axis, as a share of the length: the middle moves with what is visible.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub floor_along_axis: f64,
    /// Added to the sigma of the radius, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.000001, max = 1e6)))]
    pub floor_radius_m: f64,
    /// Added to the sigma of the axis, in degrees.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub floor_axis_deg: f64,
    /// Added to the sigma of the half-angle, in degrees.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub floor_half_angle_deg: f64,
    /// Added to the sigma of the length, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub floor_length_m: f64,
    /// Share of the variance of a detection (its floor included) that later detections have in common, so that averaging does not
    /// reduce it: the same pixels cut the same edge, frame after frame. It is part of the sigma of a track's centre, radius and
    /// half-angle.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub common_share: f64,
    /// Drift of the radius, in metres per square root of a second.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub drift_radius_m: f64,
    /// Drift of the axis in each of the two directions across it, in degrees per square root of a second.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub drift_axis_deg: f64,
    /// Drift of the half-angle, in degrees per square root of a second.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub drift_half_angle_deg: f64,
    /// Drift of the visible length, in metres per square root of a second.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1e6)))]
    pub drift_length_m: f64,
}

impl Default for TrackerParameters {
    fn default() -> Self {
        Self {
            acceleration: 0.5,
            initial_speed_mps: 1.5,
            manoeuvre_mps: 2.0,
            ballistic: None,
            gate: 16.3,
            max_radius_change: 0.25,
            max_axis_change_deg: 30.0,
            confirm_hits: 3,
            confirm_window: 5,
            max_coast_s: 1.0,
            assumed_rate_hz: 30.0,
            floor_center_m: 0.0005,
            floor_along_axis: 0.1,
            floor_radius_m: 0.0005,
            floor_axis_deg: 0.5,
            floor_half_angle_deg: 0.5,
            floor_length_m: 0.01,
            common_share: 0.35,
            drift_radius_m: 0.0002,
            drift_axis_deg: 10.0,
            drift_half_angle_deg: 0.1,
            drift_length_m: 0.05,
        }
    }
}

impl TrackerParameters {
    /// Returns the contradictions between parameters that are each in range.
    pub fn faults(&self) -> Vec<ConfigFault> {
        let up = self.ballistic.and_then(|ballistic| gravity::fault("ballistic", ballistic.up));
        up.into_iter().chain(self.fault_of_hits()).collect()
    }

    fn fault_of_hits(&self) -> Option<ConfigFault> {
        let (hits, window) = (self.confirm_hits, self.confirm_window);
        let what = format!("{hits} sights cannot fall within {window} frames");
        let hint = format!("set `confirm_window` to at least {hits}, or `confirm_hits` to at most {window}");
        (hits > window).then_some(ConfigFault { key: "confirm_hits", what, hint })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_hits_than_frames_are_refused() {
        let config = TrackerParameters { confirm_hits: 6, ..TrackerParameters::default() };
        let faults = config.faults();
        assert_eq!((faults.len(), faults[0].key), (1, "confirm_hits"));
        assert!(TrackerParameters::default().faults().is_empty());
    }

    #[test]
    fn up_has_to_be_a_direction() {
        let ballistic = Some(Ballistic { up: Some([0.0; 3]), ..Ballistic::default() });
        let faults = TrackerParameters { ballistic, ..TrackerParameters::default() }.faults();
        assert_eq!((faults.len(), faults[0].key), (1, "ballistic"));
    }

    #[test]
    fn unknown_keys_are_refused() {
        assert!(toml::from_str::<TrackerParameters>("gate = 9.0").is_ok());
        assert!(toml::from_str::<TrackerParameters>("gates = 9.0").is_err());
    }
}
