//! The laboratory: tools that measure the detection, and methods to compare it with. No robot needs it.
//!
//! - [`simulator`]: a depth camera in scenes with known objects, and thousands of random scenes;
//! - [`paper`]: the method of Georgiev, Al-Hami and Lakaemper (2013), as the baseline: ellipses that grow point by point, and
//!   objects section by section;
//! - [`ransac`]: ellipses by random sample consensus, with which the paper compares itself;
//! - [`noise_estimator`]: the noise of a sensor from a recording;
//! - [`flip`]: images rotated and mirrored, which should not matter to a detector;
//! - [`bound`]: the best possible accuracy for an object;
//! - [`score`]: comparison of found with true objects; [`experiment`]: tables and plots of the scores.

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
