//! The header of every message: which frame it belongs to, which camera took it, and when it passed which stage.

use crate::{Malformed, Text};
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Name and version of [`Header`]'s memory layout.
pub const HEADER_TYPE_NAME: &str = "conicflow.Header.v2";

/// Flag: the writer sends nothing more; such a message has no items.
pub const END_OF_STREAM: u32 = 1;
/// Flag: [`Header::world_from_camera`] is known.
pub const HAS_POSE: u32 = 2;
/// Flag: the frame comes from a recording; [`Header::source`] is the name of its file.
pub const RECORDED: u32 = 4;

/// Maximum length of a source's name in bytes; longer names are cut.
pub const MAX_SOURCE_BYTES: usize = 256;

/// Maximum number of hops; later ones are not recorded.
pub const MAX_HOPS: usize = 8;

/// Maximum width and height of an image, in pixels.
pub const MAX_SIDE_PX: u32 = 16_384;
/// Maximum number of pixels of an image: stages allocate memory for what a header claims.
pub const MAX_PIXELS: u64 = 1 << 26;

/// The header that precedes the items of every message.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// Number of this start of the source, which distinguishes a restarted source from one that goes on.
    pub epoch: u64,
    /// Number of the frame, from 0 and without gaps as the source sent them; of a replayed recording, as recorded.
    pub sequence: u64,
    /// Number of this message among those of the stage that wrote it, from 0: gaps are messages that this edge has lost.
    pub number: u64,
    /// Time of capture in nanoseconds: since the Unix epoch if the sensor has that time, else since the first frame.
    pub stamp_ns: u64,
    /// The camera that saw the frame.
    pub camera: Camera,
    /// Metres per unit of a depth pixel.
    pub depth_scale: f64,
    /// The depth noise of the sensor.
    pub noise: NoiseModel,
    /// Pose of the camera, row-major `[R | t]` with a rotation R and t in metres; valid if [`HAS_POSE`] is set.
    /// [`Header::set_pose`] sets both.
    pub world_from_camera: [[f64; 4]; 3],
    /// Name of the frame's file or of the source; for a robot's camera, its coordinate frame.
    pub source: Text<MAX_SOURCE_BYTES>,
    /// [`END_OF_STREAM`], [`HAS_POSE`], [`RECORDED`].
    pub flags: u32,
    /// Number of entries of `hops` in use.
    pub hop_count: u32,
    /// The stages that have processed the frame, the source first.
    pub hops: [Hop; MAX_HOPS],
}

/// When a frame passed a stage, on the monotonic clock of that machine.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Hop {
    /// Name of the stage in the pipeline file.
    pub stage: Text<32>,
    /// When the stage received the message (a source: the frame).
    pub received_ns: u64,
    /// When the stage sent its own message.
    pub sent_ns: u64,
}

/// A pinhole camera without distortion; pixel centres lie at whole numbers.
///
/// A pixel (u, v) of depth z is the point `z ((u - cx) / fx, (v - cy) / fy, 1)`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Width of the image in pixels.
    pub width: u32,
    /// Height of the image in pixels.
    pub height: u32,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point, x, in pixels.
    pub cx: f64,
    /// Principal point, y, in pixels.
    pub cy: f64,
}

/// Standard deviation of a depth measurement along z, as a function of the depth.
///
/// `sigma(z)^2 = (floor + growth (z - knee)^2)^2 + (step z^2)^2 / 12`: the axial noise of a Kinect v1 after Nguyen, Izadi and
/// Lovell (2012), plus the quantisation error of the disparity.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct NoiseModel {
    /// Noise at the knee, in metres.
    pub floor_m: f64,
    /// Growth with the squared distance from the knee, in 1/metre.
    pub growth_per_m: f64,
    /// Depth of least noise, in metres.
    pub knee_m: f64,
    /// Depth between two neighbouring disparities, divided by the squared depth, in 1/metre.
    pub step_per_m: f64,
}

impl NoiseModel {
    /// A sensor without noise.
    pub const IDEAL: Self = Self { floor_m: 0.0, growth_per_m: 0.0, knee_m: 0.0, step_per_m: 0.0 };

    /// Kinect v1 and its siblings: focal length 580 px, base line 75 mm, disparity in eighths of a pixel.
    pub const KINECT_V1: Self =
        Self { floor_m: 0.0012, growth_per_m: 0.0019, knee_m: 0.4, step_per_m: 1.0 / (8.0 * 580.0 * 0.075) };

    /// Variance of a depth `z` (metres), in square metres.
    pub fn variance(&self, z: f64) -> f64 {
        let axial = self.floor_m + self.growth_per_m * (z - self.knee_m).powi(2);
        let step = self.step_per_m * z * z;
        axial * axial + step * step / 12.0
    }

    /// Returns the model with standard deviations `factor` times those of this one.
    #[must_use]
    pub fn times(&self, factor: f64) -> Self {
        let Self { floor_m, growth_per_m, knee_m, step_per_m } = *self;
        Self { floor_m: factor * floor_m, growth_per_m: factor * growth_per_m, knee_m, step_per_m: factor * step_per_m }
    }

    /// Standard deviation of a depth `z`, both in metres.
    pub fn sigma(&self, z: f64) -> f64 {
        self.variance(z).sqrt()
    }
}

/// Valid focal lengths, in pixels.
pub const FOCAL_LENGTHS_PX: RangeInclusive<f64> = 1.0..=1e6;
/// Maximum distance of a principal point from the first pixel, in pixels.
pub const FARTHEST_PRINCIPAL_POINT_PX: f64 = 1e6;
/// Valid depth units, in metres.
pub const DEPTH_SCALES_M: RangeInclusive<f64> = 1e-9..=1.0;
/// Largest coefficient of a noise model, in its unit of metres.
const LARGEST_NOISE: f64 = 1e3;
/// Maximum distance of a camera from the origin of its world, in metres: farther than the Moon.
const FARTHEST_M: f64 = 1e9;

impl Camera {
    /// Whether the intrinsics are in the valid range.
    pub fn has_intrinsics(&self) -> bool {
        let principal_point = -FARTHEST_PRINCIPAL_POINT_PX..=FARTHEST_PRINCIPAL_POINT_PX;
        [self.fx, self.fy].iter().all(|focal| FOCAL_LENGTHS_PX.contains(focal))
            && [self.cx, self.cy].iter().all(|place| principal_point.contains(place))
    }

    /// Whether the size of the image is in the valid range.
    fn has_size(&self) -> bool {
        let side = |pixels| (1..=MAX_SIDE_PX).contains(&pixels);
        side(self.width) && side(self.height) && u64::from(self.width) * u64::from(self.height) <= MAX_PIXELS
    }
}

impl Header {
    /// Whether this message ends its writer's stream.
    pub fn ends_stream(&self) -> bool {
        self.flags & END_OF_STREAM != 0
    }

    /// Pose of the camera in the world, row-major `[R | t]`, if the source knows it.
    pub fn pose(&self) -> Option<&[[f64; 4]; 3]> {
        (self.flags & HAS_POSE != 0).then_some(&self.world_from_camera)
    }

    /// Sets the pose of the camera in the world, row-major `[R | t]` with a rotation R and t in metres.
    pub fn set_pose(&mut self, world_from_camera: [[f64; 4]; 3]) {
        self.world_from_camera = world_from_camera;
        self.flags |= HAS_POSE;
    }

    /// Whether the frame comes from a file with sensor data.
    pub fn is_recorded(&self) -> bool {
        self.flags & RECORDED != 0
    }

    /// The hops so far, the source first.
    pub fn trace(&self) -> &[Hop] {
        &self.hops[..(self.hop_count as usize).min(MAX_HOPS)]
    }

    /// Time in milliseconds, to the microsecond, from when the source had the frame until `now_ns` on the monotonic clock of this
    /// machine; `None` if the frame has no such time.
    pub fn latency_ms(&self, now_ns: u64) -> Option<f64> {
        let elapsed_ns = now_ns.checked_sub(self.trace().first()?.received_ns)?;
        Some((elapsed_ns / 1000) as f64 / 1000.0)
    }

    /// The stage that had the frame first, which stands for its camera.
    pub fn origin(&self) -> Text<32> {
        self.trace().first().map_or_else(Text::default, |hop| hop.stage)
    }

    /// The stage that wrote this message.
    pub fn writer(&self) -> Text<32> {
        self.trace().last().map_or_else(Text::default, |hop| hop.stage)
    }

    /// When the stage that wrote this message sent it, on the monotonic clock of this machine; 0 if no hop is recorded.
    pub fn sent_ns(&self) -> u64 {
        self.trace().last().map_or(0, |hop| hop.sent_ns)
    }

    /// Records that a stage has passed the frame on; beyond [`MAX_HOPS`] nothing is recorded.
    pub fn add_hop(&mut self, hop: Hop) {
        if let Some(slot) = self.hops.get_mut(self.hop_count as usize) {
            *slot = hop;
            self.hop_count += 1;
        }
    }

    /// Checks a header from another process.
    ///
    /// # Errors
    /// The fault of the header; `kind` names the message in the error.
    pub fn check(&self, kind: &str) -> Result<(), Malformed> {
        let fault = |what: &str| Err(Malformed::new(kind, what));
        let camera = &self.camera;
        let noise = &self.noise;
        if self.flags & !(END_OF_STREAM | HAS_POSE | RECORDED) != 0 {
            return fault("unknown flags in the header");
        }
        if self.hop_count as usize > MAX_HOPS || self.trace().iter().any(|hop| hop.stage.as_str().is_none()) {
            return fault("broken trace of hops in the header");
        }
        if self.source.as_str().is_none() {
            return fault("the source's name is not UTF-8");
        }
        if self.ends_stream() {
            return Ok(());
        }
        if !camera.has_size() {
            let (width, height) = (camera.width, camera.height);
            let allowed = format!("allowed are 1 to {MAX_SIDE_PX} along a side and {MAX_PIXELS} in all");
            return Err(Malformed::new(kind, format!("an image of {width}x{height} pixels, {allowed}")));
        }
        if !camera.has_intrinsics() {
            return fault("camera intrinsics that no camera has");
        }
        if !DEPTH_SCALES_M.contains(&self.depth_scale) {
            return fault("a depth scale that is not from 1e-9 to 1 m");
        }
        let coefficients = [noise.floor_m, noise.growth_per_m, noise.knee_m, noise.step_per_m];
        if !coefficients.iter().all(|coefficient| (-LARGEST_NOISE..=LARGEST_NOISE).contains(coefficient)) {
            return fault("a noise model that no sensor has");
        }
        if !self.world_from_camera.as_flattened().iter().all(|number| (-FARTHEST_M..=FARTHEST_M).contains(number)) {
            return fault("a camera pose that no camera has");
        }
        if self.pose().is_some_and(|rows| !is_rotation(rows)) {
            return fault("a camera pose that is no rotation");
        }
        Ok(())
    }
}

/// Whether the left 3x3 part of `[R | t]` is a rotation, up to the rounding of hand-written numbers: its rows have length 1, are
/// perpendicular and right-handed. Stages invert it by transposing.
pub fn is_rotation(rows: &[[f64; 4]; 3]) -> bool {
    const TOLERANCE: f64 = 1e-3;
    let dot = |a: &[f64; 4], b: &[f64; 4]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let [x, y, z] = rows;
    let unit = rows.iter().all(|row| (dot(row, row) - 1.0).abs() <= TOLERANCE);
    let perpendicular = [dot(x, y), dot(y, z), dot(z, x)].iter().all(|cosine| cosine.abs() <= TOLERANCE);
    let cross = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0], 0.0];
    unit && perpendicular && dot(&cross, z) > 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_noise_of_the_kinect_is_that_of_the_papers() {
        let model = NoiseModel::KINECT_V1;
        let step = 4.0 / (8.0 * 580.0 * 0.075);
        let expected = ((0.0012 + 0.0019 * 1.6_f64.powi(2)).powi(2) + step * step / 12.0).sqrt();
        assert!((model.sigma(2.0) - expected).abs() < 1e-12);
        assert_eq!(NoiseModel::IDEAL.sigma(3.0), 0.0);
        assert!((model.times(1.5).sigma(2.0) / model.sigma(2.0) - 1.5).abs() < 1e-12);
    }

    #[test]
    fn a_header_of_garbage_is_refused() {
        let mut header = Header { depth_scale: 0.001, ..Header::default() };
        header.camera = Camera { width: 2, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        assert_eq!(header.check("depth"), Ok(()));
        for spoil in [
            |h: &mut Header| h.camera.fx = f64::NAN,
            |h: &mut Header| h.camera.width = 0,
            |h: &mut Header| h.camera.height = 0,
            |h: &mut Header| h.camera.height = u32::MAX,
            |h: &mut Header| (h.camera.width, h.camera.height) = (MAX_SIDE_PX, MAX_SIDE_PX),
            |h: &mut Header| h.camera.fx = 1e308,
            |h: &mut Header| h.camera.fy = 0.5,
            |h: &mut Header| h.camera.cy = -1e308,
            |h: &mut Header| h.depth_scale = -1.0,
            |h: &mut Header| h.depth_scale = 1e308,
            |h: &mut Header| h.depth_scale = 0.0,
            |h: &mut Header| h.noise.growth_per_m = -1e4,
            |h: &mut Header| h.world_from_camera[0][3] = 1e10,
            |h: &mut Header| h.flags = 0x80,
            |h: &mut Header| h.hop_count = 9,
            |h: &mut Header| h.noise.floor_m = f64::INFINITY,
            |h: &mut Header| (h.flags, h.world_from_camera[1][2]) = (HAS_POSE, f64::NAN),
        ] {
            let mut spoilt = header;
            spoil(&mut spoilt);
            assert!(spoilt.check("depth").is_err());
        }
        header.camera.height = MAX_SIDE_PX + 1;
        let expected =
            "malformed depth: an image of 2x16385 pixels, allowed are 1 to 16384 along a side and 67108864 in all";
        assert_eq!(header.check("depth").map_err(|error| error.to_string()), Err(expected.to_owned()));
    }

    #[test]
    fn a_pose_is_a_rotation_or_not_flagged() {
        let camera = Camera { width: 2, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        let check = |flags: u32, rows: [[f64; 3]; 3]| {
            let world_from_camera = rows.map(|[x, y, z]| [x, y, z, 7.0]);
            Header { depth_scale: 0.001, camera, flags, world_from_camera, ..Header::default() }.check("depth")
        };
        let turned = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];
        let rounded = [[0.866, 0.0, 0.5], [0.0, 1.0, 0.0], [-0.5, 0.0, 0.866]];
        for rows in [turned, rounded] {
            assert_eq!(check(HAS_POSE, rows), Ok(()));
        }
        let mirrored = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]];
        let scaled = turned.map(|row| row.map(|number| 1.01 * number));
        let sheared = [[1.0, 0.0, 0.0], [0.01, 1.0, 0.0], [0.0, 0.0, 1.0]];
        for rows in [[[0.0; 3]; 3], mirrored, scaled, sheared] {
            let error = check(HAS_POSE, rows).unwrap_err().to_string();
            assert_eq!(error, "malformed depth: a camera pose that is no rotation", "{rows:?}");
        }
        assert_eq!(check(0, [[0.0; 3]; 3]), Ok(()));
    }

    #[test]
    fn swaps_and_reversals_of_axes_are_rotations_unless_they_mirror() {
        for (order, even) in [[0, 1, 2], [1, 2, 0], [2, 0, 1]].map(|order| (order, true)).into_iter().chain([
            ([0, 2, 1], false),
            ([2, 1, 0], false),
            ([1, 0, 2], false),
        ]) {
            for turned in 0..8_u32 {
                let mut rows = [[0.0; 4]; 3];
                (0..3).for_each(|row| rows[row][order[row]] = if turned & 1 << row == 0 { 1.0 } else { -1.0 });
                assert_eq!(is_rotation(&rows), even == (turned.count_ones() % 2 == 0), "{rows:?}");
            }
        }
    }

    #[test]
    fn a_frame_is_recorded_where_its_flag_says_so() {
        let flagged = |flags: u32| Header { flags, ..Header::default() };
        assert!(flagged(RECORDED | HAS_POSE).is_recorded() && !flagged(HAS_POSE | END_OF_STREAM).is_recorded());
    }

    #[test]
    fn the_trace_stops_growing() {
        let mut header = Header::default();
        for _ in 0..20 {
            header.add_hop(Hop::default());
        }
        assert_eq!(header.trace().len(), MAX_HOPS);
    }

    #[test]
    fn the_first_hop_is_the_origin_and_the_last_one_the_writer() {
        let mut header = Header::default();
        assert_eq!((header.origin(), header.writer(), header.sent_ns()), (Text::default(), Text::default(), 0));
        for (stage, sent_ns) in [("camera", 7), ("extractor", 9)] {
            header.add_hop(Hop { stage: Text::new(stage), received_ns: 5, sent_ns });
            assert_eq!(header.origin(), Text::new("camera"));
            assert_eq!((header.writer(), header.sent_ns()), (Text::new(stage), sent_ns));
        }
    }

    #[test]
    fn latency_counts_from_when_the_source_had_the_frame() {
        let mut header = Header::default();
        assert_eq!(header.latency_ms(5_000_000), None);
        header.add_hop(Hop { received_ns: 1_000_000, sent_ns: 2_000_000, ..Hop::default() });
        header.add_hop(Hop { received_ns: 3_000_000, sent_ns: 4_000_000, ..Hop::default() });
        assert_eq!(header.latency_ms(2_400_999), Some(1.4));
        assert_eq!(header.latency_ms(999_999), None, "a clock of another machine");
    }
}
