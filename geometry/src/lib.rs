//! The mathematics of conicflow: scan planes, moments, conic, circle and line fits, profiles, surfaces.
//!
//! No input or output, double precision, SI units, angles in radians. "The paper" is Georgiev, Al-Hami, Lakaemper,
//! "Real-time 3D scene description using Spheres, Cones and Cylinders" (2013).
//!
//! | the paper | here |
//! |---|---|
//! | scan row `s`, 1.5-D subspace | [`ScanPlane`], coordinates `(s, t)` |
//! | `S_{x^p y^q}`, `addPoint`, `removeLastPoint` | [`PlaneMoments`], [`PlaneMoments::add`], the copy from before |
//! | `S1`, `S2`, `S3`, `fitModel` | [`fit_ellipse`] (the paper's 6x6 `S` is misprinted; we follow Halir & Flusser) |
//! | `calculateError` | [`Conic::rms`] |
//! | ellipse `E = (c, r1, r2)` | [`Ellipse`]: `center`, `half_extents[0]`, `half_extents[1]` |
//! | incremental line through centres (collinear) | [`LineMoments`], [`PencilMoments`], [`Line`] |
//! | centres of a sphere's sections (concyclic) | [`Regression`] of `t k` over the row's slope, see [`ScanPlane::slope`] |
//! | `f_cylinder(z) = r`, `f_cone(z) = alpha z` | [`fit_line_profile`]; `z` of a cone counts from its apex |
//! | `f_circle(z) = sqrt(r^2 - (z - z_i)^2)` | [`fit_circle_profile`] |
//! | fitted 3-D model | [`Sphere`], [`Conical`] |
//!
//! Beyond the paper: moments free of the noise's bias ([`RaySums`]), pooled over the arcs of an object
//! ([`SpaceMoments`]), to which a [`Surface`] is fitted without seeing a point again ([`fit_surface`]).

mod arc_fit;
mod camera;
mod circle;
mod contour;
mod departure;
mod ellipse;
mod information;
mod line;
mod moments;
mod pooled;
mod profile;
mod regression;
mod section;
#[cfg(test)]
mod simulated;
mod space;
mod surface;
mod unbiased;
mod vector;

pub use arc_fit::{ArcFit, ArcMoments, bulge};
pub use camera::{Pinhole, Scan, ScanPlane};
pub use circle::{Circle, fit_circle};
pub use contour::{Contour, ContourBias, ContourNoise, ContourPoint, ContourTerm};
pub use departure::departure;
pub use ellipse::{Conic, Ellipse, fit_ellipse};
pub use information::Information;
pub use line::{Line, LineMoments, PencilMoments, line_rms};
pub use moments::{MOMENTS, PlaneMoments};
pub use pooled::{GradientNoise, Prediction, SurfaceFit, fit_surface, fit_with_contour};
pub use profile::{CircleProfile, fit_circle_profile, fit_line_profile};
pub use regression::{Fit, Regression};
pub use section::SectionShape;
pub use space::{Coefficients, QUADRIC_TERMS, QuadricMoments, SpaceMoments};
pub use surface::{Conical, Sphere, Surface, across, gradient, meets, section_about, section_of};
pub use unbiased::{ArcSums, LineSums, RayPart, RaySums};
pub use vector::Vector3;
