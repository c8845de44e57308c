//! Warnings of likely mistakes in a source's messages. Readers can only take such messages as they are, or ignore them, so the
//! source logs each mistake once, with a hint.

use conicflow_messages::{Header, Item, NoiseModel};

/// Smallest value of a Unix time in a unit other than nanoseconds, for the years 2001 to 2286, with the number of nanoseconds in
/// the unit. A clock that starts with the first frame may reach such values, too, so they alone prove nothing.
const UNITS: [(u64, u64, &str); 2] =
    [(1_000_000_000_000, 1_000_000, "milliseconds"), (1_000_000_000_000_000, 1000, "microseconds")]; // [derived]
/// Stamps that rise by less than this from frame to frame are in another unit: no camera takes 10,000 images a second. Chosen,
/// with a wide margin on both sides.
const LEAST_RISE_NS: u64 = 100_000;

/// Mistakes that were reported for a source, and the last stamp.
#[derive(Debug, Default)]
pub(super) struct SourceWarnings {
    stamp_ns: u64,
    reported: [bool; 4],
}

impl SourceWarnings {
    /// Returns the new warnings for a message with items of this `kind`.
    pub(super) fn about(&mut self, header: &Header, kind: &str) -> Vec<String> {
        let before = std::mem::replace(&mut self.stamp_ns, header.stamp_ns);
        let warnings =
            [of_stamp(before, header.stamp_ns), of_pose(header), of_check(header, kind), of_noise(header, kind)];
        let new = self.reported.iter_mut().zip(warnings).filter_map(|(reported, warning)| {
            let warning = warning.filter(|_| !*reported)?;
            *reported = true;
            Some(warning)
        });
        new.collect()
    }
}

fn of_stamp(before: u64, stamp_ns: u64) -> Option<String> {
    let is_close = stamp_ns > before && stamp_ns - before < LEAST_RISE_NS;
    let (_, factor, unit) = UNITS.into_iter().find(|(size, ..)| is_close && (*size..10 * size).contains(&stamp_ns))?;
    let hint = format!("multiply them by {factor}");
    Some(format!("stamps its messages in {unit} ({stamp_ns}), but `stamp_ns` is in nanoseconds\n  hint: {hint}"))
}

fn of_pose(header: &Header) -> Option<String> {
    // A recording may have lost the flag.
    let is_given = header.world_from_camera != [[0.0; 4]; 3] && !header.is_recorded();
    (is_given && header.pose().is_none()).then(|| {
        "tells where its camera is, but not by the flag `HAS_POSE`, so that nobody uses it\n  hint: `Header::set_pose` does both"
            .to_owned()
    })
}

fn of_check(header: &Header, kind: &str) -> Option<String> {
    let error = header.check(kind).err()?;
    Some(format!(
        "sends messages that no reader takes: {error}\n  hint: the header of each needs `camera`, with the size of its images and its \
         intrinsics, and `depth_scale`"
    ))
}

/// The header of a source that never sets the noise says the same as that of a camera without any.
fn of_noise(header: &Header, kind: &str) -> Option<String> {
    let is_exact = kind == u16::NAME && header.noise == NoiseModel::IDEAL && !header.is_recorded();
    is_exact.then(|| {
        "sends depth images without noise, which only simulators have\n  hint: set `noise` of the header; the node `noise_estimator` measures that of a sensor"
            .to_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Camera, RECORDED};

    fn header(stamp_ns: u64) -> Header {
        let camera = Camera { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
        Header { stamp_ns, camera, depth_scale: 0.001, noise: NoiseModel::KINECT_V1, ..Header::default() }
    }

    /// Warnings for messages with these stamps.
    fn about(stamps: &[u64]) -> Vec<String> {
        let mut warnings = SourceWarnings::default();
        stamps.iter().flat_map(|stamp| warnings.about(&header(*stamp), "depth")).collect()
    }

    #[test]
    fn stamps_in_another_unit_are_told_once_with_the_factor() {
        let [in_ms, in_us, in_ns] =
            [33, 33_000, 33_000_000].map(|rise| move |first: u64| [0, 1, 2, 3].map(|frame| first + frame * rise));
        let told = about(&in_ms(1_790_000_000_000));
        let expected = "stamps its messages in milliseconds (1790000000033), but `stamp_ns` is in nanoseconds\n  \
                        hint: multiply them by 1000000";
        assert_eq!(told, [expected]);
        assert!(about(&in_us(1_790_000_000_000_000))[0].ends_with("hint: multiply them by 1000"));
        assert!(about(&in_ns(1_790_000_000_000_000_000)).is_empty());
        assert!(about(&in_ns(1_000_000_000_000)).is_empty(), "a quarter of an hour after the first frame");
        assert!(about(&[0, 7, 7, 3]).is_empty() && about(&[1_790_000_000_000; 3]).is_empty(), "it may be made up");
    }

    #[test]
    fn depth_without_noise_is_reported_once() {
        let mut warnings = SourceWarnings::default();
        let exact = Header { noise: NoiseModel::IDEAL, ..header(0) };
        let reported = warnings.about(&exact, "depth");
        assert!(reported.len() == 1 && reported[0].starts_with("sends depth images without noise"), "{reported:?}");
        assert!(
            warnings.about(&exact, "depth").is_empty() && SourceWarnings::default().about(&exact, "objects").is_empty()
        );
        assert!(SourceWarnings::default().about(&Header { flags: RECORDED, ..exact }, "depth").is_empty());
    }

    #[test]
    fn a_pose_without_its_flag_and_an_image_without_its_camera_are_told_once_each() {
        let mut warnings = SourceWarnings::default();
        let mut posed = Header { world_from_camera: [[1.0, 0.0, 0.0, 2.0]; 3], ..header(0) };
        let told = warnings.about(&posed, "depth");
        assert!(told.len() == 1 && told[0].ends_with("hint: `Header::set_pose` does both"), "{told:?}");
        posed.camera = Camera::default();
        let told = warnings.about(&posed, "depth");
        let expected = "sends messages that no reader takes: malformed depth: an image of 0x0 pixels, ";
        assert!(told.len() == 1 && told[0].starts_with(expected) && told[0].contains("\n  hint: "), "{told:?}");
        assert!(warnings.about(&posed, "depth").is_empty());
        posed = Header { flags: RECORDED, camera: header(0).camera, ..posed };
        assert!(SourceWarnings::default().about(&posed, "depth").is_empty());
        posed.set_pose([[1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
        assert!(SourceWarnings::default().about(&posed, "depth").is_empty());
    }
}
