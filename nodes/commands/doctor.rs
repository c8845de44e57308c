//! `conicflow doctor`: reports what is wrong with this machine for running a pipeline, and removes leftovers of dead runs.

use crate::sources::v4l2_source::{Driver, LinuxVideo, V4l2Source};
use crate::{NODES, REGISTRY};
use conicflow_dataflow::pipeline::Pipeline;
use conicflow_dataflow::{NO_RUN, Plan, PlannedStage, Requirements, Source, clean, examine};
use std::io::{Write, stdout};
use std::process::ExitCode;

/// Examines this machine, after removing leftovers if `remove` is set; fails if a problem remains.
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
    let metrics: Vec<_> = machines.iter().filter_map(|machine| Some(pipeline.metrics_on(*machine)?.listen)).collect();
    let plans: Vec<_> = machines.into_iter().map(|machine| Plan::of(pipeline, machine, None, NO_RUN)).collect();
    let findings = examine(&plans, &metrics, &REGISTRY);
    for (index, finding) in findings.iter().enumerate() {
        writeln!(output, "{}problem: {finding}", if index == 0 { "" } else { "\n" })?;
    }
    write!(output, "{}", cameras(&LinuxVideo, &plans))?;
    if !findings.is_empty() {
        return Ok(ExitCode::FAILURE);
    }
    let megabytes =
        plans.iter().map(|plan| Requirements::of(plan, NODES).shared_memory()).max().unwrap_or(0).div_ceil(1 << 20);
    writeln!(output, "nothing is wrong; `{}` needs up to {megabytes} MB of shared memory", pipeline.name)?;
    Ok(ExitCode::SUCCESS)
}

/// Lists the depth cameras that `v4l2_source` can read, one per line; reports if there is none although a stage needs one.
fn cameras(driver: &impl Driver, plans: &[Plan]) -> String {
    let devices = driver.devices();
    let wants = |stage: &PlannedStage| stage.runs.name() == V4l2Source::NAME;
    if devices.is_empty() && plans.iter().flat_map(|plan| &plan.stages).any(wants) {
        return "no depth camera that `v4l2_source` could read\n".to_owned();
    }
    devices.iter().map(|camera| format!("depth camera {camera}\n")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::v4l2_source::{DepthFormat, Found, Layout, Mode};
    use conicflow_dataflow::pipeline::SourceText;
    use std::io;
    use std::path::Path;

    struct Bus(Vec<Found>);

    impl Driver for Bus {
        type Stream = <LinuxVideo as Driver>::Stream;

        fn devices(&self) -> Vec<Found> {
            self.0.clone()
        }

        fn open(&self, _: &Path, _: &Mode) -> io::Result<(Layout, Self::Stream)> {
            Err(io::ErrorKind::Unsupported.into())
        }
    }

    #[test]
    fn depth_cameras_are_listed_with_formats_and_rates() {
        let mode = |width, height, rates_hz| Mode { format: DepthFormat::Z16, width, height, rates_hz };
        let modes = vec![mode(848, 480, vec![30.0, 90.0]), mode(640, 480, Vec::new())];
        let camera = Found { path: "/dev/video2".into(), name: "Depth Camera 435".to_owned(), modes };
        assert_eq!(
            cameras(&Bus(vec![camera]), &[]),
            "depth camera `/dev/video2` (Depth Camera 435): z16 848x480 at 30, 90 Hz; z16 640x480\n"
        );
        let text = "name = \"a\"\n[stage.camera]\nnode = \"v4l2_source\"\noutput = \"depth\"\nfov_deg = 80\n";
        let source = SourceText { name: "a.toml".to_owned(), text: text.to_owned() };
        let (pipeline, _) = Pipeline::read_on(None, source, Path::new("."), &[], &REGISTRY).unwrap();
        let plan = Plan::of(&pipeline, None, None, NO_RUN);
        assert_eq!(cameras(&Bus(Vec::new()), &[plan]), "no depth camera that `v4l2_source` could read\n");
        assert_eq!(cameras(&Bus(Vec::new()), &[]), "");
    }
}
