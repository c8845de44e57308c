//! Pauses the shown run on a browser's request: its recorded and simulated sources, but no camera.

use conicflow_dataflow::{PauseRequest, RunningPipeline, Sources, WatchError};
use conicflow_view::{Command, Display, Run};

/// Obeys a command for the pipeline of this name, and shows the result on the page; ignores commands that are not for a run.
pub fn obey(pipeline: &str, command: &Command, display: &Display) {
    let request = match command {
        Command::Play => PauseRequest::Resume,
        Command::Pause => PauseRequest::Pause,
        Command::Step { by: 1.. } => PauseRequest::Step,
        _ => return,
    };
    let pause = || RunningPipeline::find(Some(pipeline), "its name")?.pause(request);
    match pause() {
        Ok(sources) => show_run(sources, display),
        // The page shows beforehand that the run cannot be paused, or is over.
        Err(error @ WatchError::Unclear(_)) => tracing::debug!("{error}"),
        Err(error) => tracing::warn!("the run is not paused: {error}"),
    }
}

/// Shows on the page whether the run is paused.
pub fn show_run(sources: Sources, display: &Display) {
    let Sources { can_pause, live, paused } = sources;
    let run = Run { can_pause: !can_pause.is_empty(), live, paused };
    display.change_about(|about| about.run = Some(run));
}
