//! The scorer: compares the answers of a detector or tracker with the truth.
//!
//! In the order of the data: the true objects and which of them have to be found ([`truth`], [`recorded`]); the matching of
//! answers with them ([`matching`]); errors in units of standard deviations ([`sigmas`]). An [`evaluation`] counts these and
//! reports them in tables, in notes on a recording, and in one row, the [`summary`]. A [`measurement`] takes an [`observation`]
//! of each object from each frame, sums these up and gives each object a [`row`] of figures. [`sections`] do so for ellipses, and
//! a [`trace`] keeps each observation. A [`limit`] compares the scatter of an object's answers with the least possible one.
//! [`pairing`] compares two answers to a frame without a truth.

pub mod evaluation;
pub mod limit;
pub mod matching;
pub mod measurement;
mod notes;
mod object_stats;
pub mod observation;
pub mod pairing;
mod pixel_box;
pub mod recorded;
pub mod row;
pub mod samples;
pub mod sections;
pub mod sigmas;
pub mod summary;
mod tables;
pub mod trace;
pub mod truth;

pub use evaluation::{Evaluation, TruthSource};
pub use limit::Limit;
pub use matching::{Answer, Claim};
pub use measurement::Measurement;
pub use object_stats::columns as measured_columns;
pub use recorded::{RecordedTolerances, RecordedTruth};
pub use row::{Figure, Row};
pub use sections::Sections;
pub use sigmas::Sigmas;
pub use trace::Trace;
pub use truth::{RenderedTruth, Tolerances, VisibilityCriteria};

#[cfg(test)]
mod evaluation_tests;
#[cfg(test)]
mod measurement_tests;
