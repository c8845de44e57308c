//! Objects -> tracks: the tracker of the detection as a stage.

use conicflow_dataflow::{ConfigFault, Context, Output, SideInputs, Stage, StageError};
use conicflow_detection::TrackerParameters;
use conicflow_detection::track::Worlds;
use conicflow_messages::{Message, Object, ObjectKind, Track};
use std::path::Path;

/// The stage.
pub struct KalmanTracker(Worlds);

impl Stage for KalmanTracker {
    const NAME: &'static str = "kalman_tracker";
    const SUMMARY: &'static str =
        "Follows objects from frame to frame with Kalman filters: identity, velocity, steady shape";
    type Config = TrackerParameters;
    type Input = Object;
    type Output = Track;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        config.faults()
    }

    fn new(config: TrackerParameters, context: &Context) -> Result<Self, StageError> {
        Ok(Self(Worlds::with_first_id(config, first_id(context.resume_at))))
    }

    fn step(&mut self, input: &Message<Object>, _: &SideInputs, output: &mut Output<Track>) -> Result<(), StageError> {
        let tracker = self.0.update(input.header, input.items);
        output.extend(tracker.tracks());
        for kind in tracker.newly_confirmed() {
            output.count(confirmed_counter(*kind), 1);
        }
        Ok(())
    }
}

/// Returns the first track identity after a restart. It is above all earlier ones, as no frame has more than 65,536 new objects.
fn first_id(resume_at: u64) -> u64 {
    (resume_at << 16) + 1
}

fn confirmed_counter(kind: ObjectKind) -> &'static str {
    match kind {
        ObjectKind::Sphere => "tracks confirmed: sphere",
        ObjectKind::Cylinder => "tracks confirmed: cylinder",
        ObjectKind::Cone => "tracks confirmed: cone",
    }
}
