//! The graph of a running pipeline for the page: its stages and topics as planned, and the rates and counts that the stages
//! report.

use conicflow_dataflow::{Observation, PipelineActivity, Plan, PlannedStage, RunningPipeline, Runs, Sources, observe};
use serde_json::{Value as Json, json};

/// Observes running pipelines repeatedly.
#[derive(Default)]
pub struct GraphWatch {
    before: Option<Observation>,
}

impl GraphWatch {
    /// Returns the graph and the sources of the first pipeline that `is_wanted`; `None` if it does not run, or was not observed
    /// before.
    pub fn observe_graph(&mut self, is_wanted: impl Fn(&PipelineActivity) -> bool) -> Option<(Json, Sources)> {
        // A user who may not read the runs' folder sees no graph; other code that needs the folder reports the error.
        let now = observe().ok()?;
        let activities = self.before.as_ref().map(|before| now.since(before));
        self.before = Some(now);
        let activity = activities?.into_iter().find(is_wanted)?;
        let running = RunningPipeline::all().ok()?;
        let running = running.into_iter().find(|running| running.plan.pipeline == activity.pipeline)?;
        Some((graph(&running.plan, &activity), running.sources()))
    }

    /// Forgets the last observation, as no browser is connected; the next one is a first one.
    pub fn rest(&mut self) {
        self.before = None;
    }
}

fn graph(plan: &Plan, activity: &PipelineActivity) -> Json {
    json!({ "stages": plan.stages.iter().map(stage).collect::<Vec<_>>(), "activity": activity })
}

/// Describes a stage with the names of its input topics, the driving one first, and of its output topics.
fn stage(stage: &PlannedStage) -> Json {
    let wiring = &stage.wiring;
    let mut inputs: Vec<_> = wiring.inputs().map(|topic| topic.name.as_str()).collect();
    let mut outputs: Vec<_> = wiring.output.iter().map(|topic| topic.name.as_str()).collect();
    if let Runs::Bridge(plan) = &stage.runs {
        inputs.extend(plan.outgoing.iter().map(|edge| edge.topic.name.as_str()));
        outputs.extend(plan.incoming.iter().map(|edge| edge.topic.name.as_str()));
    }
    let drives = usize::from(wiring.input.is_some());
    json!({ "name": stage.name, "node": stage.runs.name(), "inputs": inputs, "drives": drives, "outputs": outputs })
}
