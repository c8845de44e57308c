//! `tf2_msgs/TFMessage`: poses of coordinate frames at given times, and the lookup of the pose of one frame in another.

use crate::{Reader, Stamped, Undecodable, Writer};
use nalgebra::{Isometry3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// Maximum number of transforms in a message; robots have some hundred frames.
const MOST_TRANSFORMS: u32 = 65_536;
/// Maximum number of coordinate frames.
const MOST_FRAMES: usize = 65_536;
/// Maximum number of live poses per coordinate frame: at 1000 Hz, those of four seconds.
const MOST_LIVE_POSES: usize = 4096;
/// Tolerance of a quaternion's squared norm, which may be rounded to single precision or by hand.
const UNIT_TOLERANCE: f64 = 1e-2;

/// The known frames of a recording or a robot.
#[derive(Clone, Debug, Default)]
pub struct Transforms {
    frames: BTreeMap<String, Known>,
    /// Whether old poses are dropped.
    is_live: bool,
}

/// A frame and its poses in its parent frame.
#[derive(Clone, Debug)]
struct Known {
    parent: String,
    /// By time; a fixed frame has a single pose that is always valid.
    poses: BTreeMap<u64, Isometry3<f64>>,
    is_fixed: bool,
}

impl Transforms {
    /// Creates the transforms of a live robot, which keep only the newest poses of each frame.
    pub fn live() -> Self {
        Self { is_live: true, ..Self::default() }
    }

    /// Adds a message of `/tf`, or of `/tf_static` (`is_fixed`), whose transforms are always valid.
    ///
    /// # Errors
    /// It is no such message, or a transform in it is invalid.
    pub fn add(&mut self, message: &[u8], is_fixed: bool) -> Result<(), Undecodable> {
        let mut reader = Reader::new(message)?;
        let count = reader.u32()?;
        if count > MOST_TRANSFORMS {
            return Err(Undecodable::new(format!("{count} transforms in a message")));
        }
        for _ in 0..count {
            let Stamped { stamp_ns, frame_id } = reader.stamped()?;
            let child = reader.text()?;
            let ([x, y, z], [i, j, k, w]) = (reader.f64s()?, reader.f64s()?);
            let rotation = Quaternion::new(w, i, j, k);
            if !([x, y, z].iter().all(|number| number.is_finite())
                && (rotation.norm_squared() - 1.0).abs() < UNIT_TOLERANCE)
            {
                return Err(Undecodable::new(format!("the transform of `{child}` in `{frame_id}` is none")));
            }
            let pose = Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::new_normalize(rotation));
            if self.frames.len() >= MOST_FRAMES && !self.frames.contains_key(&name(child)) {
                return Err(Undecodable::new(format!("`{child}` is more than {MOST_FRAMES} frames of coordinates")));
            }
            self.insert(child, frame_id, (stamp_ns, pose), is_fixed);
        }
        Ok(())
    }

    fn insert(&mut self, child: &str, parent: &str, (stamp_ns, pose): (u64, Isometry3<f64>), is_fixed: bool) {
        let new = || Known { parent: parent.to_owned(), poses: BTreeMap::new(), is_fixed };
        // Old programs write names with a leading slash.
        let known = self.frames.entry(name(child)).or_insert_with(new);
        if is_fixed || known.is_fixed || known.parent != parent {
            *known = new();
        }
        known.poses.insert(stamp_ns, pose);
        if self.is_live && known.poses.len() > MOST_LIVE_POSES {
            known.poses.pop_first();
        }
    }

    /// The names of the known frames.
    pub fn names(&self) -> BTreeSet<&str> {
        self.frames.iter().flat_map(|(child, known)| [child.as_str(), known.parent.trim_start_matches('/')]).collect()
    }

    /// Returns the pose of the frame `source` in the frame `target` at a time, row-major `[R | t]`; `None` if it is unknown.
    pub fn pose(&self, target: &str, source: &str, stamp_ns: u64) -> Option<[[f64; 4]; 3]> {
        let (of_target, of_source) = (self.in_root(target, stamp_ns)?, self.in_root(source, stamp_ns)?);
        if of_target.0 != of_source.0 {
            return None;
        }
        let target_from_source = of_target.1.inv_mul(&of_source.1);
        let (rotation, t) = (target_from_source.rotation.to_rotation_matrix(), target_from_source.translation.vector);
        Some(std::array::from_fn(|row| [rotation[(row, 0)], rotation[(row, 1)], rotation[(row, 2)], t[row]]))
    }

    /// Returns the root frame above `frame`, and the pose of `frame` in it.
    fn in_root(&self, frame: &str, stamp_ns: u64) -> Option<(String, Isometry3<f64>)> {
        let (mut at, mut root_from_frame) = (name(frame), Isometry3::identity());
        // Bounds the loop if the frames form a cycle.
        for _ in 0..=self.frames.len() {
            let Some(known) = self.frames.get(&at) else { return Some((at, root_from_frame)) };
            root_from_frame = known.at(stamp_ns)? * root_from_frame;
            at = name(&known.parent);
        }
        None
    }
}

fn name(frame: &str) -> String {
    frame.trim_start_matches('/').to_owned()
}

impl Known {
    /// Returns the pose at a time, interpolated between the poses before and after it.
    fn at(&self, stamp_ns: u64) -> Option<Isometry3<f64>> {
        let before = self.poses.range(..=stamp_ns).next_back();
        if self.is_fixed {
            return self.poses.values().next().copied();
        }
        let (&begin, first) = before?;
        let (&end, second) = self.poses.range(stamp_ns..).next()?;
        if begin == end {
            return Some(*first);
        }
        let share = (stamp_ns - begin) as f64 / (end - begin) as f64;
        first.try_lerp_slerp(second, share, f64::EPSILON)
    }
}

/// Encodes a message with the pose of the frame `child` in the frame of `stamped`, row-major `[R | t]`.
pub fn write_transform(stamped: Stamped<'_>, child: &str, pose: &[[f64; 4]; 3], memory: Vec<u8>) -> Vec<u8> {
    let mut writer = Writer::new(memory);
    writer.length(1).stamped(stamped).text(child);
    write_pose(&mut writer, pose.map(|row| row[3]), &rotation_of(pose));
    writer.finish()
}

fn rotation_of(pose: &[[f64; 4]; 3]) -> UnitQuaternion<f64> {
    let [x, y, z] = [0, 1, 2].map(|column| Vector3::new(pose[0][column], pose[1][column], pose[2][column]));
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_basis_unchecked(&[x, y, z]))
}

/// Writes a position and a rotation, as in poses and transforms.
pub(crate) fn write_pose(writer: &mut Writer, place: [f64; 3], rotation: &UnitQuaternion<f64>) {
    writer.f64s(&place).f64s(&[rotation.i, rotation.j, rotation.k, rotation.w]);
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: [[f64; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    /// The optical frame of a camera that looks along x: z forward, x right, y down.
    const OPTICAL: [[f64; 4]; 3] = [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]];

    fn at(x: f64) -> [[f64; 4]; 3] {
        let mut pose = NONE;
        pose[0][3] = x;
        pose
    }

    fn add(
        transforms: &mut Transforms,
        (parent, child): (&str, &str),
        stamp_ns: u64,
        pose: &[[f64; 4]; 3],
        fixed: bool,
    ) {
        let message = write_transform(Stamped { stamp_ns, frame_id: parent }, child, pose, Vec::new());
        transforms.add(&message, fixed).unwrap();
    }

    fn robot() -> Transforms {
        let mut transforms = Transforms::default();
        add(&mut transforms, ("/map", "odom"), 0, &at(10.0), true);
        add(&mut transforms, ("odom", "base"), 100, &at(1.0), false);
        add(&mut transforms, ("odom", "base"), 200, &at(2.0), false);
        add(&mut transforms, ("base", "optical"), 5, &OPTICAL, true);
        transforms
    }

    #[test]
    fn poses_are_chained_through_all_frames_between() {
        let transforms = robot();
        let mut expected = OPTICAL;
        expected[0][3] = 11.25;
        let close = |pose: Option<[[f64; 4]; 3]>, expected: [[f64; 4]; 3]| {
            let pose = pose.unwrap();
            pose.iter().flatten().zip(expected.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-12)
        };
        assert!(close(transforms.pose("map", "optical", 125), expected));
        expected[0][3] = 2.0;
        assert!(close(transforms.pose("odom", "/optical", 200), expected));
        let mut inverse = NONE;
        inverse[0][3] = -11.0;
        assert!(close(transforms.pose("base", "map", 100), inverse));
        assert_eq!(transforms.names(), BTreeSet::from(["base", "map", "odom", "optical"]));
    }

    #[test]
    fn a_frame_without_a_chain_of_transforms_has_no_pose() {
        let mut transforms = robot();
        for (target, source, stamp_ns) in [("map", "optical", 99), ("map", "optical", 201), ("map", "other", 150)] {
            assert_eq!(transforms.pose(target, source, stamp_ns), None, "{source} in {target} at {stamp_ns}");
        }
        add(&mut transforms, ("optical", "map"), 0, &NONE, true);
        assert_eq!(transforms.pose("map", "optical", 150), None, "a circle");
    }

    #[test]
    fn a_live_store_keeps_the_newest_poses_of_a_limited_number_of_frames() {
        let mut transforms = Transforms::live();
        for stamp_ns in 0..MOST_LIVE_POSES as u64 + 1 {
            add(&mut transforms, ("map", "base"), stamp_ns, &at(stamp_ns as f64), false);
        }
        assert_eq!(transforms.pose("map", "base", 0), None);
        assert_eq!(transforms.pose("map", "base", MOST_LIVE_POSES as u64).unwrap()[0][3], MOST_LIVE_POSES as f64);
        let many = (0..=MOST_FRAMES).map(|number| {
            let message = write_transform(Stamped::default(), &number.to_string(), &NONE, Vec::new());
            transforms.add(&message, false)
        });
        assert!(many.last().unwrap().unwrap_err().what.contains("more than 65536 frames"));
    }

    #[test]
    fn a_transform_without_a_rotation_is_refused() {
        let mut message = write_transform(Stamped { stamp_ns: 0, frame_id: "map" }, "base", &NONE, Vec::new());
        let length = message.len();
        message[length - 8..].copy_from_slice(&2.0_f64.to_le_bytes());
        let error = Transforms::default().add(&message, false).unwrap_err().to_string();
        assert_eq!(error, "the transform of `base` in `map` is none");
        let many = Writer::new(Vec::new()).u32(1 << 20).clone().finish();
        assert_eq!(Transforms::default().add(&many, false).unwrap_err().to_string(), "1048576 transforms in a message");
    }
}
