//! The ellipses of a message as sections of bodies: with their planes, ready for the mathematics.

use super::SectionFit;
use conicflow_geometry::{Line, Pinhole, PlaneMoments, Scan, ScanPlane, SectionShape, Vector3, fit_circle};
use conicflow_messages::{self as messages, Ellipse, Header};

/// What a scan plane cuts out of a body.
#[derive(Clone, Copy, Debug)]
pub(super) struct Section {
    pub scan: Scan,
    /// Number of the scan line.
    pub line: u32,
    pub plane: ScanPlane,
    /// Centre in the camera frame.
    pub center: Vector3,
    /// Centre in the plane.
    pub plane_center: [f64; 2],
    /// The paper's r2, or the radius of the circle through the points.
    pub radius: f64,
    /// How centre and radius were found.
    pub fit: SectionFit,
    /// Angle that the points span around the centre.
    pub arc: f64,
    /// The points.
    pub moments: PlaneMoments,
    /// Distance between this and the next scan line, at the depth of the points.
    pub spacing: f64,
}

impl Section {
    /// `None` where the points determine no circle and one is asked for.
    fn new(header: &Header, ellipse: &Ellipse, fit: SectionFit) -> Option<Self> {
        let camera = &header.camera;
        let camera = Pinhole { fx: camera.fx, fy: camera.fy, cx: camera.cx, cy: camera.cy };
        let scan = match ellipse.scan() {
            messages::Scan::Row => Scan::Row,
            messages::Scan::Column => Scan::Column,
        };
        let plane = camera.plane(scan, f64::from(ellipse.line));
        let moments = PlaneMoments::from_sums(ellipse.origin, ellipse.moments);
        let (plane_center, radius) = match fit {
            SectionFit::Ellipse => (ellipse.plane_center, ellipse.half_depth),
            SectionFit::Circle => fit_circle(&moments).map(|circle| (circle.center, circle.radius))?,
        };
        Some(Self {
            scan,
            line: ellipse.line,
            plane,
            center: plane.to_camera(plane_center),
            plane_center,
            radius,
            fit,
            arc: ellipse.arc,
            moments,
            spacing: ellipse.center[2].abs() * camera.line_pitch(scan),
        })
    }

    /// The section, given how the body is tilted to the plane; `None` where that cuts no ellipse.
    pub fn cut(&self, axis: &Vector3, half_angle: f64) -> Option<Cut> {
        let shape = SectionShape::new(&self.plane, axis, half_angle)?;
        match self.fit {
            SectionFit::Ellipse => {
                Some(Cut { center: self.plane_center, radius: self.radius / shape.depth, depth: None })
            }
            SectionFit::Circle => {
                let circle = shape.fit(&self.moments)?;
                Some(Cut { center: circle.center, radius: circle.radius, depth: Some(shape.depth) })
            }
        }
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
    /// Centre in the plane.
    pub center: [f64; 2],
    /// Semi-minor axis b.
    pub radius: f64,
    /// Half extent along the view, divided by b; `None` where centres stay as the extractor found them.
    depth: Option<f64>,
}

impl Cut {
    /// The centre of a section of radius `radius` with the same front.
    pub fn behind_front(&self, radius: f64) -> [f64; 2] {
        let shift = self.depth.map_or(0.0, |depth| (radius - self.radius) * depth);
        [self.center[0], self.center[1] + shift]
    }
}

/// The sections of a message, rows before columns, each in the order of the lines.
pub(super) fn read(header: &Header, ellipses: &[Ellipse], fit: SectionFit, sections: &mut Vec<Section>) {
    sections.clear();
    sections.extend(ellipses.iter().filter_map(|ellipse| Section::new(header, ellipse, fit)));
    sections.sort_by_key(|section| (section.scan == Scan::Column, section.line));
}
