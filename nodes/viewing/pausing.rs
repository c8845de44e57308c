//! Pauses the run that a page shows, as a browser wishes: its recorded and simulated sources, and no camera.

use conicflow_dataflow::{PauseRequest, RunningPipeline, Sources, WatchError};
use conicflow_view::{Command, Display, Run};

/// Does what is asked of the pipeline of this name, and tells what follows; other commands are not for a run.
pub fn obey(pipeline: &str, command: &Command, display: &Display) {
    let request = match command {
        Command::Play => PauseRequest::Resume,
        Command::Pause => PauseRequest::Pause,
        Command::Step { by: 1.. } => PauseRequest::Step,
        _ => return,
    };
    let asked = || RunningPipeline::find(Some(pipeline), "its name")?.pause(request);
    match asked() {
        Ok(sources) => tell(sources, display),
        // The page shows that it cannot be paused, or is over, before anybody can wish it.
        Err(error @ WatchError::Unclear(_)) => tracing::debug!("{error}"),
        Err(error) => tracing::warn!("the run is not paused: {error}"),
    }
}

/// Tells whether the run that is shown is paused.
pub fn tell(sources: Sources, display: &Display) {
    let Sources { can_pause, live, paused } = sources;
    let run = Run { can_pause: !can_pause.is_empty(), live, paused };
    display.tell(|about| about.run = Some(run));
}
