//! Splits a chain where a body ends: the incremental tests of the paper, O(1) per section.
//!
//! Two hypotheses are tracked in parallel. Axial: the centres lie on a line, and the radius is linear in the position along it.
//! Spherical: the centres are the feet of perpendiculars from one point on the pencil of scan planes, so `t k = Cy y + Cz` is
//! linear in the slope y of the plane and s is constant (they are concyclic with the camera, see `conicflow_geometry`), and the
//! radii lie on a circle. A section belongs to the body as long as one of the hypotheses predicts it. A hypothesis is dropped if
//! its own sections scatter too much; k consecutive sections that no hypothesis predicts end the body.

use super::parameters::ProfileConfig;
use super::sections::Section;
use conicflow_geometry::{LineMoments, PlaneMoments, Regression, fit_circle_profile, fit_line_profile};

/// Number of sections that are accepted before the hypotheses can predict.
const TRUSTED: usize = 5;
/// Gate of a predicted section, in standard deviations.
const GATE_SIGMAS: f64 = 3.0;

/// Splits a chain into bodies, each a list of indices.
pub(super) fn split(sections: &[Section], chain: &[usize], config: &ProfileConfig) -> Vec<Vec<usize>> {
    let (mut bodies, mut rest) = (Vec::new(), chain);
    while !rest.is_empty() {
        let (members, end) = grow(sections, rest, config);
        bodies.push(members);
        rest = &rest[end..];
    }
    bodies
}

/// Returns the sections at the start of `chain` that form one body, and where the next one starts.
fn grow(sections: &[Section], chain: &[usize], config: &ProfileConfig) -> (Vec<usize>, usize) {
    let (mut members, mut end) = (Vec::new(), 0);
    let mut sums = Sums::new(&sections[chain[0]]);
    for (position, &index) in chain.iter().enumerate() {
        let section = &sections[index];
        if sums.predicts(section, config) {
            sums.add(section);
            members.push(index);
            end = position + 1;
        } else if position - end + 1 >= config.profile.neighbors as usize {
            break;
        }
    }
    (members, end)
}

/// Running sums over the sections of a body.
#[derive(Debug)]
struct Sums {
    centers: LineMoments,
    sides: Regression,
    feet: Regression,
    /// Pairs of position and radius; the position is an angle times a fixed distance, so that no axis is needed.
    profile: PlaneMoments,
    distance: f64,
}

impl Sums {
    fn new(first: &Section) -> Self {
        let distance = first.plane_center[1];
        let start = [distance * first.plane.angle(), 0.0];
        let (sides, feet) = (Regression::default(), Regression::default());
        Self { centers: LineMoments::new(first.center), sides, feet, profile: PlaneMoments::new(start), distance }
    }

    fn add(&mut self, section: &Section) {
        let [s, t] = section.plane_center;
        self.centers.add(&section.center);
        self.sides.add(section.plane.slope(), s);
        self.feet.add(section.plane.slope(), t * section.plane.stretch());
        self.profile.add(self.place(section));
    }

    /// Returns position and radius of a section.
    fn place(&self, section: &Section) -> [f64; 2] {
        [self.distance * section.plane.angle(), section.radius]
    }

    fn predicts(&self, section: &Section, config: &ProfileConfig) -> bool {
        (self.sides.count() as usize) < TRUSTED
            || self.foresees_axial(section, config).unwrap_or(false)
            || self.foresees_spherical(section, config).unwrap_or(false)
    }

    fn foresees_axial(&self, section: &Section, config: &ProfileConfig) -> Option<bool> {
        let (line, profile) = (self.centers.fit()?, fit_line_profile(&self.profile)?);
        let [position, radius] = self.place(section);
        let scale = profile.value;
        let center = line.distance(&section.center)
            <= gate(line.prediction_sigma(line.position(&section.center)), config.profile.max_center_scatter * scale);
        let residual = (radius - profile.at(position)).abs();
        let alive = line.rms <= config.profile.max_center_scatter * scale
            && profile.rms <= config.profile.max_radius_scatter * scale;
        Some(
            alive
                && center
                && residual <= gate(profile.prediction_sigma(position), config.profile.max_radius_scatter * scale),
        )
    }

    fn foresees_spherical(&self, section: &Section, config: &ProfileConfig) -> Option<bool> {
        let (feet, profile) = (self.feet.fit()?, fit_circle_profile(&self.profile)?);
        let [position, radius] = self.place(section);
        let [s, t] = section.plane_center;
        let slope = section.plane.slope();
        let limit = config.profile.max_center_scatter * profile.radius;
        let side = (s - self.sides.mean()).abs() <= gate(self.sides.deviation(), limit);
        let foot = (t * section.plane.stretch() - feet.at(slope)).abs() <= gate(feet.prediction_sigma(slope), limit);
        let residual = ((position - profile.center).hypot(radius) - profile.radius).abs();
        let alive = profile.rms <= config.profile.max_radius_scatter * profile.radius;
        Some(alive && side && foot && residual <= gate(profile.rms, config.profile.max_radius_scatter * profile.radius))
    }
}

fn gate(sigma: f64, floor: f64) -> f64 {
    (GATE_SIGMAS * sigma).max(floor)
}
