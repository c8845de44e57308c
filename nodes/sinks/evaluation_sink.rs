//! Scores a detector: compares objects or tracks with the truth, and prints tables to standard output. It also writes one row, of
//! which `conicflow run` makes a table if the pipeline file has an `[experiment]`. The scoring itself is in
//! [`conicflow_lab::score`].

use super::json_lines::JsonLines;
use super::measurement_sink::write_rows;
use crate::faults::{refuse_restart, stage_error};
use anyhow::Result;
use conicflow_dataflow::{ConfigFault, Context, FileUse, Output, SideInputs, Stage, StageError};
use conicflow_lab::score::truth::load_scene;
use conicflow_lab::score::{
    Claim, Evaluation, RecordedTolerances, RecordedTruth, RenderedTruth, Tolerances, TruthSource, VisibilityCriteria,
};
use conicflow_messages::{Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::io::Write as _;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Parameters of `evaluation_sink`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Scene file that the source shows; random and built-in scenes are known by the names in the frames.
    pub scene: Option<PathBuf>,
    /// Truth file of a recording, with the measured objects of its frames; none: the frames are rendered.
    pub truth: Option<PathBuf>,
    /// Criteria for the true objects of rendered frames that have to be found; right answers about others are not counted.
    pub required: VisibilityCriteria,
    /// Largest errors of a right answer about a rendered frame.
    pub tolerance: Tolerances,
    /// Largest errors of a right answer about a frame of a recording (`truth`).
    pub recorded_tolerance: RecordedTolerances,
    /// File for the counts and medians of all frames as one line of JSON, of which an experiment makes a table; none: not
    /// written.
    pub path: Option<PathBuf>,
    /// File for missed objects and wrong answers, one line of JSON per judged frame; its folder is created if need be; none: not
    /// written.
    pub details_path: Option<PathBuf>,
}

impl EvaluationConfig {
    fn rendered(&self, base: &Path) -> Result<RenderedTruth> {
        let scene = self.scene.as_ref().map(|path| load_scene(&base.join(path))).transpose()?;
        Ok(RenderedTruth { scene, required: self.required, tolerance: self.tolerance })
    }

    fn recorded(&self, base: &Path) -> Result<Option<RecordedTruth>> {
        let load = |path: &PathBuf| RecordedTruth::load(&base.join(path), &self.recorded_tolerance);
        self.truth.as_ref().map(load).transpose()
    }

    /// Returns an evaluation against the configured truth, with paths relative to `base`.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn open(&self, base: &Path) -> Result<Evaluation> {
        let rendered = self.rendered(base)?;
        let recorded = self.recorded(base)?.map(TruthSource::Recorded);
        Ok(Evaluation::new(recorded.unwrap_or_else(|| TruthSource::Rendered(Box::new(rendered)))))
    }
}

/// Scores messages of objects or tracks.
pub struct EvaluationSink<T> {
    evaluation: Evaluation,
    details: Option<JsonLines>,
    path: Option<PathBuf>,
    items: PhantomData<T>,
}

impl<T: Claim> Stage for EvaluationSink<T> {
    const NAME: &'static str = "evaluation_sink";
    const SUMMARY: &'static str =
        "Scores objects or confirmed tracks against the truth of rendered or recorded frames, as tables";
    type Config = EvaluationConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        if let Err(error) = config.rendered(base) {
            faults.push(ConfigFault::of_file("scene", error.as_ref()));
        }
        if let Err(error) = config.recorded(base) {
            faults.push(ConfigFault::of_file("truth", error.as_ref()));
        }
        if config.scene.is_some() && config.truth.is_some() {
            let what = "cannot be used together with `scene`";
            faults.push(ConfigFault::new("truth", what, "leave one of them out"));
        }
        faults
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("scene", &config.scene), ("truth", &config.truth)])
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("path", &config.path), ("details_path", &config.details_path)])
    }

    fn new(config: EvaluationConfig, context: &Context) -> Result<Self, StageError> {
        refuse_restart(context, "counted")?;
        let open = |path: &PathBuf| JsonLines::open(&context.resolve(path), false);
        let details = config.details_path.as_ref().map(open).transpose()?;
        let (evaluation, path) = (config.open(&context.base)?, config.path.as_ref().map(|path| context.resolve(path)));
        Ok(Self { evaluation, details, path, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, output: &mut Output<Nothing>) -> Result<(), StageError> {
        let answers: Vec<_> = input.items.iter().filter_map(Claim::answer).collect();
        let Some(frame) = self.evaluation.add(input.header, &answers).map_err(stage_error)? else { return Ok(()) };
        output.count("missed", frame.missed().count() as u64);
        output.count("wrong", frame.wrong.len() as u64);
        if let Some(details) = &mut self.details {
            details.write(&frame.details(input.header)).map_err(stage_error)?;
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.details.iter().for_each(JsonLines::warn_if_earlier);
        std::io::stdout().write_all(self.evaluation.report()?.as_bytes())?;
        Ok(self.path.as_deref().map_or(Ok(()), |path| write_rows(Some(path), &[self.evaluation.row()]))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Camera, Header, Object, Text};

    #[test]
    fn details_are_written_into_a_new_folder() {
        let base = tempfile::tempdir().unwrap();
        let context = Context { base: base.path().into(), ..Context::default() };
        let config = EvaluationConfig { details_path: Some("new/details.jsonl".into()), ..EvaluationConfig::default() };
        let camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };
        let header = Header { camera, source: Text::new("standing/3"), depth_scale: 0.001, ..Header::default() };
        let inputs = vec![(header, Vec::<Object>::new())];
        conicflow_dataflow::testing::pass::<EvaluationSink<Object>>(config, context, &inputs).unwrap();
        assert!(std::fs::read_to_string(base.path().join("new/details.jsonl")).unwrap().contains("\"missed\":[{"));
    }

    #[test]
    fn unusable_files_are_reported_before_the_start() {
        let base = tempfile::tempdir().unwrap();
        let config = EvaluationConfig {
            scene: Some("garden.toml".into()),
            truth: Some("truth.json".into()),
            ..EvaluationConfig::default()
        };
        let faults = |config| EvaluationSink::<Object>::faults(config, base.path());
        let keys: Vec<_> = faults(&config).into_iter().map(|fault| fault.key).collect();
        assert_eq!(keys, ["scene", "truth", "truth"]);
        assert!(faults(&EvaluationConfig::default()).is_empty());
    }
}
