//! Finds problems of this machine with running pipelines, and removes leftovers of dead runs.
//!
//! Checks change nothing: they create no folder and touch no process. Each check is a file of its own, and returns findings.

mod finding;
mod folder;
mod listening;
mod orphans;

pub use finding::Finding;

use crate::launcher::{RunFolder, user_folder};
use crate::plan::Plan;
use crate::ports::capacity::in_words;
use crate::ports::shared_memory::leftovers::{Leftover, Litter, clear, leftovers, litter};
use crate::preflight::Requirements;
use crate::registry::Registry;
use conicflow_messages::Hinted;
use std::collections::HashSet;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

/// Checks this machine for a pipeline with these plans, one for each machine of the file that this may be. `metrics` has the
/// addresses at which their launchers serve metrics.
pub fn examine(plans: &[Plan], metrics: &[SocketAddr], registry: &Registry) -> Vec<Finding> {
    let mut findings = folder::examine();
    let usable = findings.is_empty();
    let idle: Vec<_> = plans.iter().filter(|plan| !is_running(&plan.pipeline)).collect();
    findings.extend(
        idle.iter().flat_map(|plan| Requirements::of(plan, registry.nodes).insufficient()).map(|short| short.into()),
    );
    if let Some(network) = &registry.network {
        findings.extend(listening::examine(&idle, network));
        findings.extend(listening::warnings(&plans.iter().collect::<Vec<_>>(), network));
    }
    // A running pipeline uses its address itself.
    if !idle.is_empty() {
        findings.extend(metrics.iter().filter_map(|address| listening::metrics(*address, plans.len() == 1)));
    }
    findings.extend(orphans::examine());
    if usable {
        findings.extend(dead_in_folder());
        findings.extend(cut_off_runs());
    }
    findings.extend(files());
    without_repetition(findings)
}

/// Drops repeated findings, as several plans may have the same.
fn without_repetition(findings: Vec<Finding>) -> Vec<Finding> {
    let mut seen = HashSet::new();
    findings.into_iter().filter(|finding| seen.insert(finding.to_string())).collect()
}

/// Removes leftovers of this user's dead runs, and returns descriptions of them. Files in use by a live process of any user stay.
pub fn clean() -> Vec<String> {
    let mut removed = Vec::new();
    // Leftovers that the folder leads to are removed first, in their proper order.
    if folder::examine().is_empty() {
        let shared_memory = user_folder().join("shm");
        removed.extend(clear(&shared_memory).ok().and_then(|litter| describe(litter, &shared_memory)));
        removed.extend(clear_records());
    }
    let gone: Vec<_> = leftovers().unwrap_or_default().into_iter().filter(Leftover::remove).collect();
    if !gone.is_empty() {
        removed.push(format!("{} in /dev/shm that nobody had open", several(&gone)));
    }
    removed
}

fn clear_records() -> Vec<String> {
    let mut folders = RunFolder::all(&user_folder()).unwrap_or_default();
    folders.retain(|folder| folder.cut_off().is_some() && folder.discard().is_ok());
    let removed =
        |folder: RunFolder| format!("the records of a run that was cut off, in `{}`", folder.path().display());
    folders.into_iter().map(removed).collect()
}

fn describe(litter: Litter, folder: &Path) -> Option<String> {
    match litter {
        Litter::None => None,
        Litter::Processes(1) => Some(format!("what a dead process had in `{}`", folder.display())),
        Litter::Processes(dead) => Some(format!("what {dead} dead processes had in `{}`", folder.display())),
        Litter::Files => Some(format!("what dead processes had in `{}`", folder.display())),
    }
}

fn is_running(pipeline: &str) -> bool {
    RunFolder::all(&user_folder())
        .is_ok_and(|all| all.iter().any(|folder| folder.path().ends_with(pipeline) && folder.is_running()))
}

fn dead_in_folder() -> Option<Finding> {
    let folder = user_folder().join("shm");
    let left = describe(litter(&folder), &folder)?;
    let what = format!("{left} was not removed");
    Some(Hinted::new(what, "the next run removes it, or now `conicflow doctor --clean`").into())
}

fn cut_off_runs() -> Vec<Finding> {
    let cut_off =
        RunFolder::all(&user_folder()).unwrap_or_default().into_iter().filter(|folder| folder.cut_off().is_some());
    let finding = |folder: RunFolder| {
        let what = format!("the run whose records are in `{}` was cut off", folder.path().display());
        Hinted::new(what, "the next run of this pipeline removes them, or now `conicflow doctor --clean`").into()
    };
    cut_off.map(finding).collect()
}

fn files() -> Option<Finding> {
    let found = leftovers().ok().filter(|found| !found.is_empty())?;
    let oldest = found.iter().map(|file| file.age).max().unwrap_or_default();
    let what = format!("{} of dead runs in /dev/shm that nobody has open, up to {} old", several(&found), age(oldest));
    let hint = "`conicflow doctor --clean` removes them; no run finds them any more if its runtime folder was deleted";
    Some(Hinted::new(what, hint).into())
}

fn several(files: &[Leftover]) -> String {
    let bytes = files.iter().map(|file| file.bytes).sum();
    format!("{} {} ({})", files.len(), if files.len() == 1 { "file" } else { "files" }, in_words(bytes))
}

fn age(time: Duration) -> String {
    match time.as_secs() {
        seconds @ 0..3600 => format!("{} min", seconds / 60),
        seconds @ 3600..172_800 => format!("{} h", seconds / 3600),
        seconds => format!("{} days", seconds / 86_400),
    }
}
