//! Finds stages that outlived their launcher, which should not happen.

use super::finding::Finding;
use crate::launcher::{LAST_STAGES_GRACE, LAUNCHER, PIPELINE, RUNTIME_DIR, STAGE, user_folder};
use conicflow_messages::Hinted;
use rustix::process::geteuid;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, Instant};

const ORPHAN_CHECK_PERIOD: Duration = Duration::from_millis(100);

/// Processes of this user and folder whose launcher is no longer their parent. Those of a launcher that has just died get the
/// time to end by themselves.
pub(super) fn examine() -> Vec<Finding> {
    let deadline = Instant::now() + LAST_STAGES_GRACE;
    let mut found = orphans();
    while !found.is_empty() && Instant::now() < deadline {
        sleep(ORPHAN_CHECK_PERIOD);
        found = orphans();
    }
    found
}

fn orphans() -> Vec<Finding> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let mut processes: Vec<u32> = entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect();
    processes.sort_unstable();
    processes.into_iter().filter_map(orphan).collect()
}

fn orphan(process: u32) -> Option<Finding> {
    let folder = Path::new("/proc").join(process.to_string());
    let own =
        fs::metadata(&folder).is_ok_and(|about| about.uid() == geteuid().as_raw()) && is_in_own_numbering(&folder);
    let environment = own.then(|| fs::read(folder.join("environ")).ok())??;
    let variable = |name: &str| value(&environment, name);
    let same_folder = variable(RUNTIME_DIR).is_some_and(|folder| Path::new(&folder) == user_folder());
    let (pipeline, stage, launcher) = (variable(PIPELINE)?, variable(STAGE)?, variable(LAUNCHER)?);
    // A process that a stage has started has that stage as its parent, and ends when it chooses to.
    let stat = fs::read_to_string(folder.join("stat")).ok()?;
    let parent = living_parent(&stat)?;
    let lost = same_folder && parent != launcher && !started_by_stage(&parent);
    let what = format!("stage `{stage}` of pipeline `{pipeline}` runs on without its launcher, as process {process}");
    let hint = format!("`kill {process}` ends it, or `kill -9 {process}` if it does not listen");
    lost.then(|| Hinted::new(what, hint).into())
}

/// Whether a process is in our namespace of process ids: ids of a container have no meaning here.
fn is_in_own_numbering(process: &Path) -> bool {
    let numbering = |process: &Path| fs::read_link(process.join("ns/pid")).ok();
    numbering(process).is_some_and(|its| Some(its) == numbering(Path::new("/proc/self")))
}

fn started_by_stage(process: &str) -> bool {
    let environment = fs::read(Path::new("/proc").join(process).join("environ"));
    environment.is_ok_and(|environment| value(&environment, STAGE).is_some())
}

fn value(environment: &[u8], name: &str) -> Option<String> {
    let entries = environment.split(|byte| *byte == 0).map(String::from_utf8_lossy);
    entries.into_iter().find_map(|entry| entry.strip_prefix(name)?.strip_prefix('=').map(str::to_owned))
}

/// The parent's id in the text of `/proc/PID/stat`; `None` for a zombie.
fn living_parent(stat: &str) -> Option<String> {
    let mut after_name = stat.rsplit_once(')')?.1.split_whitespace();
    let state = after_name.next()?;
    after_name.next().filter(|_| state != "Z").map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parent_stands_behind_a_name_that_may_hold_anything() {
        assert_eq!(living_parent("12 (a) R 1) S 7 12 12 0"), Some("7".to_owned()));
        assert_eq!(living_parent("12 (gone) Z 7 12 12 0"), None);
        assert_eq!(living_parent(""), None);
    }

    #[test]
    fn a_variable_is_found_by_its_whole_name() {
        let environment = b"CONICFLOW_STAGES=x\0CONICFLOW_STAGE=source\0HOME=/";
        assert_eq!(value(environment, "CONICFLOW_STAGE"), Some("source".to_owned()));
        assert_eq!(value(environment, "STAGE"), None);
    }
}
