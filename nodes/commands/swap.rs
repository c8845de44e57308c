//! `conicflow swap`: replaces one stage of a running pipeline, after checking the whole pipeline with the change.

use super::topic::PipelineName;
use crate::{NODES, REGISTRY};
use anyhow::{anyhow, bail};
use clap::Args;
use conicflow_dataflow::pipeline::suggestion;
use conicflow_dataflow::{Plan, PlannedStage, Requirements};
use conicflow_messages::Hinted;

/// The stage to replace, and its replacement.
#[derive(Args)]
pub struct SwapArguments {
    /// Name of the stage
    stage: String,
    /// Set a parameter of the stage; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Another node for the same inputs and output; the parameters of the former one go with it
    #[arg(long, value_name = "NAME")]
    node: Option<String>,
    #[command(flatten)]
    of: PipelineName,
}

/// Replaces a stage, and returns when the new one runs.
///
/// # Errors
/// The change is wrong, or the launcher could not make it; the stage continues as before then.
pub fn swap(arguments: &SwapArguments) -> anyhow::Result<()> {
    let running = arguments.of.find()?;
    let (plan, name) = (&running.plan, &arguments.stage);
    let stage = find_stage(plan, name)?;
    let node = arguments.node.iter().map(|node| format!("{name}.node={node}"));
    let sets = arguments.sets.iter().map(|set| format!("{name}.{set}"));
    let (changed, _) = plan.with(&node.chain(sets).collect::<Vec<_>>(), &REGISTRY)?;
    if changed.stage(name).is_none_or(|new| new.wiring != stage.wiring) {
        bail!(Hinted::new(
            format!("a swap cannot join stage `{name}` to other topics"),
            "end the run, and start it with the change"
        ));
    }
    if let Some(other) = changed.stages_unlike(plan).find(|other| other.name != *name) {
        bail!(Hinted::new(
            format!("this would change stage `{}`, too", other.name),
            "end the run, and start it with the change"
        ));
    }
    let successor = changed.stage(name).and_then(|successor| plan.conflict_with_existing(successor, NODES));
    successor.map_or(Ok(()), Err)?;
    Requirements::of(&changed, NODES).look_for_successor(stage)?;
    running.swap(name, changed)?;
    tracing::info!("stage `{name}` was replaced");
    Ok(())
}

fn find_stage<'a>(plan: &'a Plan, name: &str) -> anyhow::Result<&'a PlannedStage> {
    let stages = plan.stages.iter().filter(|stage| !stage.is_bridge());
    let names: Vec<_> = stages.map(|stage| stage.name.as_str()).collect();
    let hint = || suggestion(name, names.iter().copied(), "stages");
    let found = plan.stage(name).filter(|stage| !stage.is_bridge());
    found
        .ok_or_else(|| anyhow!(Hinted::new(format!("pipeline `{}` has no stage `{name}` here", plan.pipeline), hint())))
}
