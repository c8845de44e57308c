//! Estimates the noise of a sensor from a recording, and prints it as a line for the pipeline file.

use crate::faults::refuse_restart;
use conicflow_dataflow::{Context, Output, SideInputs, Stage, StageError};
use conicflow_lab::noise_estimator::{self, NoiseEstimatorParameters};
use conicflow_messages::{Message, Nothing};
use std::io::Write;

/// The stage.
pub struct NoiseEstimator(noise_estimator::NoiseEstimator);

impl Stage for NoiseEstimator {
    const NAME: &'static str = "noise_estimator";
    const SUMMARY: &'static str = "Finds the depth noise of a sensor from a recording, as a line for the pipeline file";
    type Config = NoiseEstimatorParameters;
    type Input = u16;
    type Output = Nothing;

    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError> {
        refuse_restart(context, "seen")?;
        Ok(Self(noise_estimator::NoiseEstimator::with(config)))
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        Ok(self.0.add(input.header, input.items)?)
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let mut out = std::io::stdout();
        write!(out, "{}{}", self.0.planes(), self.0.contours())?;
        let estimate = self.0.estimate()?;
        if let Some(misfit) = estimate.misfit() {
            tracing::warn!("{misfit}");
        }
        Ok(out.write_all(estimate.to_string().as_bytes())?)
    }
}
