//! The laboratory's simulated camera as a source of frames.

use crate::sinks::json_lines::JsonLines;
use conicflow_dataflow::{ConfigFault, Context, FileUse, Next, Output, SideInput, SideInputs, Source, StageError};
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::truth::TruthLine;
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Header, Velocity};
use std::path::{Path, PathBuf};

/// Commands from frames that are older than this are no longer obeyed: the controller has stopped.
const MAX_COMMAND_AGE_S: f64 = 0.5;

/// The node: a [`SyntheticCamera`] that keeps a frame rate.
pub struct SyntheticSource {
    camera: SyntheticCamera,
    rate_hz: f64,
    next: u64,
    total: Option<u64>,
    truth: Option<JsonLines>,
}

impl Source for SyntheticSource {
    const NAME: &'static str = "synthetic_source";
    const SUMMARY: &'static str = "Simulates a depth camera in a scene with known objects";
    type Config = SimulatorParameters;
    type Output = u16;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        // A single word is the name of a built-in scene.
        let is_file = |path: &PathBuf| path.to_str().and_then(Scene::built_in).is_none();
        FileUse::given(base, [("scene", &config.scene.clone().filter(is_file))])
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("truth_path", &config.truth_path)])
    }

    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError> {
        let (total, rate_hz) = (config.total(), config.rate_hz);
        let truth_path = config.truth_path.as_deref().map(|path| context.resolve(path));
        let truth = truth_path.map(|path| JsonLines::open(&path, context.resume_at > 0)).transpose()?;
        let camera = config.open(&context.base)?;
        Ok(Self { camera, rate_hz, next: context.resume_at, total, truth })
    }

    fn message_length(config: &SimulatorParameters, _: &Path) -> Option<usize> {
        Some(config.width as usize * config.height as usize)
    }

    fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    fn total(&self) -> Option<u64> {
        self.total
    }

    fn can_pause(&self) -> bool {
        true
    }

    /// The controller of the camera: its first velocity is used. Without one, or if it is from a frame more than half a second
    /// old, the camera stands still.
    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::latest::<Velocity>("command")] }
    }

    fn next(&mut self, side_inputs: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        if self.total.is_some_and(|total| self.next >= total) {
            return Ok(Next::End);
        }
        if let Some(velocity) = self.command(side_inputs) {
            self.camera.drive(&velocity);
        }
        let camera = self.camera.raster().camera;
        self.camera.shoot(self.next, output.loan(camera.width as usize * camera.height as usize)?);
        self.camera.describe(&mut output.header);
        if self.truth.is_some() {
            let line = self.truth_line();
            self.truth.as_mut().map(|file| file.write(&line)).transpose()?;
        }
        self.next += 1;
        Ok(Next::Message)
    }
}

impl SyntheticSource {
    /// Returns the camera's velocity for the next frame.
    fn command(&self, side_inputs: &SideInputs) -> Option<Velocity> {
        let command = side_inputs.get::<Velocity>("command")?;
        let age_s = self.camera.time_of(self.next) - command.header.stamp_ns as f64 * 1e-9;
        command.items.first().filter(|_| age_s <= MAX_COMMAND_AGE_S).copied()
    }

    /// Returns the true objects of the last frame.
    fn truth_line(&self) -> TruthLine {
        let mut header = Header::default();
        self.camera.describe(&mut header);
        let objects = self.camera.truth().iter().map(Into::into).collect();
        TruthLine {
            sequence: self.next,
            source: self.camera.scene_name().to_owned(),
            stamp_ns: header.stamp_ns,
            objects,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Message;

    fn small() -> SimulatorParameters {
        SimulatorParameters { width: 80, height: 60, ..SimulatorParameters::default() }
    }

    #[test]
    fn the_truth_file_has_one_line_per_frame_and_is_continued_after_a_restart() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path().join("truth.jsonl");
        let config = || SimulatorParameters { truth_path: Some(path.clone()), ..small() };
        let write = |first: u64| {
            let context = Context { resume_at: first, ..Context::default() };
            let mut source = SyntheticSource::new(config(), &context).unwrap();
            for number in first..first + 3 {
                source.camera.shoot(number, &mut [0; 80 * 60]);
                source.next = number;
                let line = source.truth_line();
                source.truth.as_mut().unwrap().write(&line).unwrap();
            }
        };
        write(0);
        write(3);
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines.iter().map(|line| &line["sequence"]).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
        assert_eq!(lines[3]["stamp_ns"], 100_000_000);
        assert_eq!(lines[3]["objects"].as_array().unwrap().len(), 3);
        write(0);
        assert_eq!(std::fs::read_to_string(&path).unwrap().lines().count(), 3, "a new run starts a new file");
    }

    #[test]
    fn the_source_knows_its_length_and_continues_where_it_stopped() {
        let context = Context { resume_at: 7, ..Context::default() };
        let source = SyntheticSource::new(SimulatorParameters { frames: 9, ..small() }, &context).unwrap();
        assert_eq!((source.total(), source.next), (Some(9), 7));
        assert_eq!(SyntheticSource::new(small(), &context).unwrap().total(), None);
    }

    #[test]
    fn commands_of_a_driver_that_has_stopped_are_ignored() {
        let velocity = Velocity { linear: [0.1, 0.0, 0.5], ..Velocity::default() };
        let velocities = [velocity];
        let mut source = SyntheticSource::new(small(), &Context::default()).unwrap();
        let mut command = |frame: u64, stamp_ms: u64, items: &[Velocity]| {
            let header = Header { stamp_ns: stamp_ms * 1_000_000, ..Header::default() };
            source.next = frame;
            source.command(&SideInputs::default().with("command", Message { header: &header, items }))
        };
        let obeyed = Some(velocity);
        assert_eq!(command(30, 967, &velocities), obeyed);
        assert_eq!(command(45, 1000, &velocities), obeyed, "half a second");
        assert_eq!(command(46, 1000, &velocities), None);
        assert_eq!(command(3, 1000, &velocities), obeyed, "of a clock that is ahead");
        assert_eq!(command(30, 967, &[]), None);
        assert_eq!(source.command(&SideInputs::default()), None);
    }
}
