//! The ellipses of a message as sections of bodies, with their planes.

use super::parameters::SectionFit;
use conicflow_detection::camera::{pinhole, scan};
use conicflow_geometry::{Line, PlaneMoments, Scan, ScanPlane, SectionShape, Vector3, fit_circle};
use conicflow_messages::{Ellipse, Header};

/// A section of a body by a scan plane.
#[derive(Clone, Copy, Debug)]
pub(super) struct Section {
    /// Index of the scan line among those in use.
    pub line: u32,
    pub plane: ScanPlane,
    /// Centre in the camera frame.
    pub center: Vector3,
    /// Centre in the plane.
    pub plane_center: [f64; 2],
    /// Half the extent across the view, or the radius of the circle through the points.
    pub radius: f64,
    /// The fit of centre and radius.
    pub fit: SectionFit,
    /// Angle that the points span around the centre, in radians.
    pub arc: f64,
    /// The points.
    pub moments: PlaneMoments,
    /// Distance to the next scan line in use, at the depth of the points, in metres.
    pub spacing: f64,
}

impl Section {
    /// Creates the section for an image in which every `step`th line is used. `None` if a circle is wanted, but the points do not
    /// determine one.
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

    /// Returns the section for this axis and half-angle of the body; `None` if that cuts no ellipse.
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

    /// Returns where the plane meets a line, as a position along `axis` from the line's point.
    pub fn position(&self, line: &Line, axis: &Vector3) -> f64 {
        let normal = self.plane.normal();
        -line.point.dot(&normal) / line.direction.dot(&normal) * line.direction.dot(axis)
    }

    /// Returns the mean of the points, in the camera frame.
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
    /// Vector from the piercing point to the centre, per radius.
    offset: [f64; 2],
    /// Distance from the front of the section to its centre, per radius; 0 if centres stay as the extractor found them.
    lag: f64,
}

impl Cut {
    /// Returns where the axis pierces the plane, for a body with this radius there, if the section keeps its front.
    pub fn pierced(&self, radius: f64) -> [f64; 2] {
        let [s, t] = self.center;
        [s - radius * self.offset[0], t + (radius - self.radius) * self.lag - radius * self.offset[1]]
    }
}

/// Reads the sections of a message, rows before columns, each sorted by line.
pub(super) fn read(header: &Header, ellipses: &[Ellipse], fit: SectionFit) -> Vec<Section> {
    let step = ellipses.iter().map(Ellipse::step).min().unwrap_or(1);
    let sections = ellipses.iter().filter_map(|ellipse| Section::new(header, ellipse, step, fit));
    let mut sections: Vec<_> = sections.collect();
    sections.sort_by_key(|section| (section.plane.scan() == Scan::Column, section.line));
    sections
}
