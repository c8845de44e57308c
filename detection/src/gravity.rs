//! The direction of up, for stages that use gravity or the ground.

use conicflow_messages::ConfigFault;
use nalgebra::Vector3;

/// Returns the unit vector upwards: `up` if given, else the world's z if frames carry a pose, else the negative y of the camera's
/// optical frame, as for a camera that is held level.
pub fn unit(up: Option<[f64; 3]>, has_pose: bool) -> Vector3<f64> {
    let level = if has_pose { Vector3::z() } else { -Vector3::y() };
    up.and_then(|up| Vector3::from(up).try_normalize(1e-9)).unwrap_or(level) // [algorithmic]
}

/// Returns the fault of a vector `up` that is no direction; `key` names its parameter.
pub fn fault(key: &'static str, up: Option<[f64; 3]>) -> Option<ConfigFault> {
    let up = up.filter(|up| !Vector3::from(*up).norm().is_normal())?;
    Some(ConfigFault {
        key,
        what: format!("`up` is {up:?}, which is no direction"),
        hint: "[0, 0, 1] is the z axis; without `up` it is the world's z, or -y of a camera without pose".to_owned(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_without_pose_does_not_take_its_view_for_up() {
        assert_eq!(unit(None, true), Vector3::z());
        assert_eq!(unit(None, false), -Vector3::y());
        assert_eq!(unit(Some([0.0, 2.0, 0.0]), false), Vector3::y());
    }

    #[test]
    fn what_is_no_direction_is_a_fault() {
        assert_eq!(fault("up", None), None);
        assert_eq!(fault("up", Some([0.0, 0.1, 0.0])), None);
        for up in [[0.0; 3], [f64::NAN, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0]] {
            assert!(fault("up", Some(up)).is_some_and(|fault| fault.key == "up"), "{up:?}");
        }
    }
}
