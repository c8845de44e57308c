//! The ellipses of a message as sections of bodies: with their planes, ready for the mathematics.

use super::parameters::SectionFit;
use conicflow_detection::camera::{pinhole, scan};
use conicflow_geometry::{Line, PlaneMoments, Scan, ScanPlane, SectionShape, Vector3, fit_circle};
use conicflow_messages::{Ellipse, Header};

/// What a scan plane cuts out of a body.
#[derive(Clone, Copy, Debug)]
pub(super) struct Section {
    /// Number of the scan line among those that were looked at.
    pub line: u32,
    pub plane: ScanPlane,
    /// Centre in the camera frame.
    pub center: Vector3,
    /// Centre in the plane.
    pub plane_center: [f64; 2],
    /// Half the extent across the view, or the radius of the circle through the points.
    pub radius: f64,
    /// How centre and radius were found.
    pub fit: SectionFit,
    /// Angle that the points span around the centre.
    pub arc: f64,
    /// The points.
    pub moments: PlaneMoments,
    /// Distance between this and the next line that was looked at, at the depth of the points.
    pub spacing: f64,
}

impl Section {
    /// Of an image of which every `step`th line was looked at. `None` where the points determine no circle and one is asked for.
    fn new(header: &Header, ellipse: &Ellipse, step: u32, fit: SectionFit) -> Option<Self> {
        let (camera, scan) = (pinhole(&header.camera), scan(ellipse));
        let plane = camera.plane(scan, f64::from(ellipse.line));
        let moments = PlaneMoments::from_sums(ellipse.origin, ellipse.moments);
        let (plane_center, radius) = match fit {
            SectionFit::Ellipse => (ellipse.plane_center, ellipse.half_width),
            SectionFit::Circle => fit_circle(&moments).map(|circle| (circle.center, circle.radius))?,
        };
        Some(Self {
            line: ellipse.line / step,
            plane,
            center: plane.to_camera(plane_center),
            plane_center,
            radius,
            fit,
            arc: ellipse.arc,
            moments,
            spacing: ellipse.center[2].abs() * camera.line_pitch(scan) * f64::from(step),
        })
    }

    /// The section, given the axis and half-angle of the body; `None` where that cuts no ellipse.
    pub fn cut(&self, axis: &Vector3, half_angle: f64) -> Option<Cut> {
        let shape = SectionShape::new(&self.plane, axis, half_angle)?;
        let (center, radius, lag) = match self.fit {
            SectionFit::Ellipse => (self.plane_center, self.radius / shape.width, 0.0),
            SectionFit::Circle => {
                let circle = shape.fit(&self.moments)?;
                (circle.center, circle.radius, shape.depth)
            }
        };
        Some(Cut { center, radius, offset: shape.center, lag })
    }

    /// Where the plane meets a line, as a position along `axis` counted from the line's point.
    pub fn position(&self, line: &Line, axis: &Vector3) -> f64 {
        let normal = self.plane.normal();
        -line.point.dot(&normal) / line.direction.dot(&normal) * line.direction.dot(axis)
    }

    /// Mean of the points, in the camera frame.
    pub fn mean(&self) -> Vector3 {
        self.plane.to_camera(self.moments.mean().unwrap_or(self.plane_center))
    }
}

/// A section of a body of known axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cut {
    /// Radius of the body where its axis pierces the plane.
    pub radius: f64,
    /// Centre of the section in the plane.
    center: [f64; 2],
    /// From the piercing point to the centre, per radius.
    offset: [f64; 2],
    /// From the front of the section to its centre, per radius; 0 where centres stay as the extractor found them.
    lag: f64,
}

impl Cut {
    /// Where the axis pierces the plane, if the body has the radius `radius` there and the section keeps its front.
    pub fn pierced(&self, radius: f64) -> [f64; 2] {
        let [s, t] = self.center;
        [s - radius * self.offset[0], t + (radius - self.radius) * self.lag - radius * self.offset[1]]
    }
}

/// The sections of a message, rows before columns, each in the order of the lines.
pub(super) fn read(header: &Header, ellipses: &[Ellipse], fit: SectionFit) -> Vec<Section> {
    let step = ellipses.iter().map(Ellipse::step).min().unwrap_or(1);
    let sections = ellipses.iter().filter_map(|ellipse| Section::new(header, ellipse, step, fit));
    let mut sections: Vec<_> = sections.collect();
    sections.sort_by_key(|section| (section.plane.scan() == Scan::Column, section.line));
    sections
}
