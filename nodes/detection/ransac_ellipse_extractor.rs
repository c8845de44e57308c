//! Depth images -> ellipses by random sample consensus: a stage to swap in, for comparison.

use conicflow_dataflow::{Context, Output, SideInputs, Stage, StageError};
use conicflow_lab::ransac::{self, RansacParameters};
use conicflow_messages::{Ellipse, Message};

/// The stage.
pub struct RansacEllipseExtractor(ransac::RansacEllipseExtractor);

impl Stage for RansacEllipseExtractor {
    const NAME: &'static str = "ransac_ellipse_extractor";
    const SUMMARY: &'static str =
        "Finds ellipses in the scan lines of a depth image by random sample consensus, for comparison";
    type Config = RansacParameters;
    type Input = u16;
    type Output = Ellipse;

    fn new(config: Self::Config, _: &Context) -> Result<Self, StageError> {
        Ok(Self(ransac::RansacEllipseExtractor::new(config)))
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, output: &mut Output<Ellipse>) -> Result<(), StageError> {
        output.extend(self.0.extract(input.header, input.items));
        output.count_all(self.0.rejections());
        Ok(())
    }
}
