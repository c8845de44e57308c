//! The graph of a running pipeline for the page: its stages and what joins them, as planned, and what they do, as they tell.

use conicflow_dataflow::{Observation, PipelineActivity, Plan, PlannedStage, RunningPipeline, Runs, Sources, observe};
use serde_json::{Value as Json, json};

/// Looks at running pipelines again and again.
#[derive(Default)]
pub struct GraphWatch {
    before: Option<Observation>,
}

impl GraphWatch {
    /// The graph of the first pipeline that is the wanted one, and its sources; none where it does not run, or was not looked at
    /// before.
    pub fn look(&mut self, is_wanted: impl Fn(&PipelineActivity) -> bool) -> Option<(Json, Sources)> {
        // Who cannot look at the runs' folder sees no graph; whatever else needs the folder tells why.
        let now = observe().ok()?;
        let seen = self.before.as_ref().map(|before| now.since(before));
        self.before = Some(now);
        let activity = seen?.into_iter().find(is_wanted)?;
        let running = RunningPipeline::all().ok()?;
        let running = running.into_iter().find(|running| running.plan.pipeline == activity.pipeline)?;
        Some((graph(&running.plan, &activity), running.sources()))
    }

    /// Nobody looks: the next look is a first one.
    pub fn rest(&mut self) {
        self.before = None;
    }
}

fn graph(plan: &Plan, activity: &PipelineActivity) -> Json {
    json!({ "stages": plan.stages.iter().map(stage).collect::<Vec<_>>(), "activity": activity })
}

/// A stage with the names of the topics that it reads, the driving one first, and writes.
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
