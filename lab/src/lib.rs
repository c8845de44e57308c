//! The laboratory: what the detection is measured with, and what it is compared with. No robot needs it.
//!
//! - [`simulator`]: a depth camera in scenes whose objects are known, and random scenes by the thousand;
//! - [`paper`]: the method of Georgiev, Al-Hami and Lakaemper (2013), as the baseline: ellipses that grow point by point, and
//!   objects section by section;
//! - [`ransac`]: ellipses by random sample consensus, which the paper compares itself with;
//! - [`noise_estimator`]: the noise of a sensor from a recording;
//! - [`flip`]: images turned and mirrored, as no detector should mind;
//! - [`bound`]: how well an object can be measured at all;
//! - [`score`]: what was found of what is there, and how well; [`experiment`]: tables and plots of that.

mod bisection;
pub mod bound;
pub mod experiment;
pub mod flip;
pub mod noise_estimator;
pub mod paper;
pub mod quantile;
pub mod random;
pub mod ransac;
pub mod rendered;
pub mod running_stats;
mod scan_line;
pub mod score;
pub mod simulator;
