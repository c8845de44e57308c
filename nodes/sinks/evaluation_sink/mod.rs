//! The sink that scores a detector: objects or tracks against what was really there, as tables on standard output.
//!
//! Of rendered frames the truth is a function of what the header tells: the scene's name, the time and the camera
//! ([`rendered`]); of recorded ones it comes from a file ([`recorded`]). An answer is right by the rule of [`matching`],
//! its [`errors`] are gathered in a [`score`].

pub mod errors;
pub mod evaluation;
pub mod matching;
pub mod recorded;
pub mod recorded_score;
pub mod rendered;
pub mod score;

use crate::config_error;
use crate::sinks::json_lines::JsonLines;
use anyhow::Result;
use conicflow_dataflow::{ConfigFault, Context, Output, Sides, Stage, StageError};
use conicflow_lab::simulator::scene_values::{SceneTemplate, Values};
use conicflow_messages::{Item, Message, Nothing, Object, Track, TrackState};
use evaluation::Evaluation;
use recorded::{RecordedTolerances, RecordedTruth};
use recorded_score::RecordedScore;
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
    /// Truth file of a recording: what was measured in its frames; none: the frames are rendered.
    pub truth: Option<PathBuf>,
    /// Which true objects of rendered frames have to be found; right answers about others are not counted.
    pub required: Duties,
    /// How far off an answer about a rendered frame may be and still be right.
    pub tolerance: Tolerances,
    /// The same for a recording, with `truth`.
    pub recorded_tolerance: RecordedTolerances,
    /// File for what was missed and what was wrong, one line of JSON per frame that is judged; its folder is made if need be;
    /// none: not written.
    pub details_path: Option<PathBuf>,
}

/// Which true objects have to be found.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Duties {
    /// Largest hidden share of what the object would cover alone; what lies outside the image is hidden.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_hidden: f64,
    /// Least number of columns and of rows from the first to the last visible pixel.
    #[schemars(range(min = 1))]
    pub min_extent_px: u32,
    /// Least visible part of the circumference, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
    /// Least angle between line of sight and axis, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub min_view_angle_deg: f64,
}

impl Default for Duties {
    fn default() -> Self {
        Self { max_hidden: 0.75, min_extent_px: 12, min_arc_deg: 30.0, min_view_angle_deg: 25.0 }
    }
}

/// How far off an answer may be.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Tolerances {
    /// Distance of the centres of spheres, else of the true middle from the answer's axis, in metres.
    #[schemars(range(min = 0.0))]
    pub position_m: f64,
    /// Error of the radius, of a cone at its middle, as a share of it.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub radius: f64,
    /// Angle between the axes, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub axis_deg: f64,
    /// Error of a cone's half-angle, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub half_angle_deg: f64,
}

impl Default for Tolerances {
    fn default() -> Self {
        Self { position_m: 0.05, radius: 0.2, axis_deg: 20.0, half_angle_deg: 8.0 }
    }
}

impl EvaluationConfig {
    /// What types and ranges cannot tell: values that exclude each other, files that are missing.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let scene = self.load_scene(base).err().map(|error| config_error::of_file("scene", &error));
        let truth = self.load_truth(base).err().map(|error| config_error::of_file("truth", &error));
        let both = (self.scene.is_some() && self.truth.is_some()).then(|| ConfigFault {
            key: "truth",
            what: "cannot be used together with `scene`".into(),
            hint: "leave one of them out".into(),
        });
        scene.into_iter().chain(truth).chain(both).collect()
    }
}

/// Reads a scene file, and makes sure that it is one.
pub fn load_scene(path: &Path) -> Result<SceneTemplate> {
    let template = SceneTemplate::load(path)?;
    template.scene(&Values::new())?;
    Ok(template)
}

impl EvaluationConfig {
    fn load_scene(&self, base: &Path) -> Result<Option<SceneTemplate>> {
        self.scene.as_deref().map(|path| load_scene(&base.join(path))).transpose()
    }

    fn load_truth(&self, base: &Path) -> Result<Option<RecordedTruth>> {
        let load = |path: &Path| RecordedTruth::load(&base.join(path), &self.recorded_tolerance);
        self.truth.as_deref().map(load).transpose()
    }
}

/// An item that claims that an object is there.
pub trait Answer: Item {
    /// The object, if the claim is meant.
    fn object(&self) -> Option<&Object>;
}

impl Answer for Object {
    fn object(&self) -> Option<&Object> {
        Some(self)
    }
}

impl Answer for Track {
    fn object(&self) -> Option<&Object> {
        (self.track_state() == TrackState::Confirmed).then_some(&self.object)
    }
}

/// Scores messages of objects or tracks.
pub struct EvaluationSink<T> {
    judge: Judge,
    details: Option<JsonLines>,
    answers: Vec<Object>,
    items: PhantomData<T>,
}

/// Where the truth comes from.
enum Judge {
    Rendered(Box<Evaluation>),
    Recorded(Box<RecordedScore>),
}

impl<T: Answer> Stage for EvaluationSink<T> {
    const NAME: &'static str = "evaluation_sink";
    const SUMMARY: &'static str =
        "Scores objects or tracks against the truth of rendered or recorded frames, as tables";
    type Config = EvaluationConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn new(config: EvaluationConfig, context: &Context) -> Result<Self, StageError> {
        config_error::refuse_restart(context, "counted")?;
        let (scene, truth) = (config.load_scene(&context.base)?, config.load_truth(&context.base)?);
        let open = |path: &PathBuf| JsonLines::open(&context.resolve(path), false);
        let details = config.details_path.as_ref().map(open).transpose()?;
        let judge = match truth {
            Some(truth) => Judge::Recorded(Box::new(RecordedScore::new(truth))),
            None => Judge::Rendered(Box::new(Evaluation::new(config, scene))),
        };
        Ok(Self { judge, details, answers: Vec::new(), items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &Sides, output: &mut Output<Nothing>) -> Result<(), StageError> {
        self.answers.clear();
        self.answers.extend(input.items.iter().filter_map(Answer::object));
        let frame = match &mut self.judge {
            Judge::Rendered(evaluation) => Some(evaluation.add(input.header, &self.answers)?),
            Judge::Recorded(score) => score.add(input.header.source.as_str().unwrap_or_default(), &self.answers),
        };
        let Some(frame) = frame else { return Ok(()) };
        output.count("missed", frame.missed().count() as u64);
        output.count("wrong", frame.matching.wrong.len() as u64);
        if let Some(details) = &mut self.details {
            details.write(&frame.details(input.header))?;
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let report = match &self.judge {
            Judge::Rendered(evaluation) => evaluation.score().report(),
            Judge::Recorded(score) => {
                score.check()?;
                score.report()
            }
        };
        Ok(std::io::stdout().write_all(report.as_bytes())?)
    }
}

#[cfg(test)]
mod tests;
