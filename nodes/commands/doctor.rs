//! `conicflow doctor`: tells what is wrong with this machine for running a pipeline, and removes what dead runs have left.

use crate::{NODES, REGISTRY};
use conicflow_dataflow::pipeline::Pipeline;
use conicflow_dataflow::{NO_RUN, Plan, Requirements, clean, examine};
use std::io::{Write, stdout};
use std::process::ExitCode;

/// Looks at this machine, after it removed what is dead if that is wanted; fails if something stays wrong.
///
/// # Errors
/// Standard output cannot be written.
pub fn doctor(pipeline: &Pipeline, machine: Option<&str>, remove: bool) -> anyhow::Result<ExitCode> {
    let mut output = stdout().lock();
    for removed in remove.then(clean).unwrap_or_default() {
        writeln!(output, "removed {removed}")?;
    }
    let machines: Vec<_> = match machine {
        None if !pipeline.machines.is_empty() => pipeline.machines.keys().map(|name| Some(name.as_str())).collect(),
        machine => vec![machine],
    };
    let plans: Vec<_> = machines.into_iter().map(|machine| Plan::of(pipeline, machine, None, NO_RUN)).collect();
    let findings = examine(&plans, &REGISTRY);
    for (index, finding) in findings.iter().enumerate() {
        writeln!(output, "{}problem: {finding}", if index == 0 { "" } else { "\n" })?;
    }
    if !findings.is_empty() {
        return Ok(ExitCode::FAILURE);
    }
    let megabytes =
        plans.iter().map(|plan| Requirements::of(plan, NODES).shared_memory()).max().unwrap_or(0).div_ceil(1 << 20);
    writeln!(output, "nothing is wrong; `{}` needs up to {megabytes} MB of shared memory", pipeline.name)?;
    Ok(ExitCode::SUCCESS)
}
