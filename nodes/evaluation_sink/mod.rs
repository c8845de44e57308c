//! The sink that scores a detector: objects or tracks against what was really there, as tables on standard output.
//!
//! Of rendered frames the truth is a function of what the header tells: the scene's name, the time and the camera
//! ([`rendered`]). An answer is right by the rule of [`matching`], its [`errors`] are gathered in a [`score`].

pub mod errors;
pub mod matching;
pub mod rendered;
pub mod score;

use crate::synthetic_source::scene::Scene;
use anyhow::{Context as _, Result};
use conicflow_dataflow::{Config, ConfigFault, Context, Output, Sides, Stage, StageError};
use conicflow_messages::{Header, Item, Message, Nothing, Object, Track, TrackState};
use errors::Errors;
use matching::{Expected, Fault, Matching, match_up};
use nalgebra::Vector3;
use schemars::JsonSchema;
use score::{Sample, Score, WrongAnswer};
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Parameters of `evaluation_sink`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Scene file that the source shows; random and built-in scenes are known by the names in the frames.
    pub scene: Option<PathBuf>,
    /// Which true objects have to be found; right answers about others are not counted.
    pub required: Duties,
    /// How far off an answer may be and still be right.
    pub tolerance: Tolerances,
    /// File for what was missed and what was wrong, one line of JSON per frame; none: not written.
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

impl Config for EvaluationConfig {
    fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let error = self.load_scene(base).err();
        let fault = |error: anyhow::Error| ConfigFault {
            key: "scene",
            what: format!("{error:#}"),
            hint: "name the file that the synthetic_source shows".into(),
        };
        error.into_iter().map(fault).collect()
    }
}

impl EvaluationConfig {
    fn load_scene(&self, base: &Path) -> Result<Option<Scene>> {
        self.scene.as_deref().map(|path| Scene::load(&base.join(path))).transpose()
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

/// Scores answers against rendered truth.
pub struct Evaluation {
    scene: Option<Scene>,
    config: EvaluationConfig,
    score: Score,
}

/// What came of one frame.
pub struct FrameScore {
    /// What is there.
    pub expected: Vec<Expected>,
    /// What was answered.
    pub answers: Vec<Object>,
    /// Which belongs to which.
    pub matching: Matching,
}

impl Evaluation {
    /// An evaluation of frames that show random or built-in scenes, or the one that is given.
    pub fn new(config: EvaluationConfig, scene: Option<Scene>) -> Self {
        Self { scene, config, score: Score::default() }
    }

    /// Scores the answers to a frame.
    ///
    /// # Errors
    /// The frame shows a scene that is not known.
    pub fn add(&mut self, header: &Header, answers: Vec<Object>) -> Result<FrameScore> {
        let scene = rendered::scene_of(header, self.scene.as_ref())?;
        let expected = rendered::expected(header, &scene, &self.config.required, &self.config.tolerance);
        let matching = match_up(&expected, &answers);
        let group = self.score.group(scene.name.split_once('/').map_or(scene.name.as_str(), |(group, _)| group));
        self.score.frames += 1;
        for (object, answer) in expected.iter().zip(&matching.answer_of) {
            self.count(group, object, answer.map(|index| &answers[index]));
        }
        for (index, fault) in &matching.wrong {
            let answer = &answers[*index];
            let (shape, distance) = (answer.shape(), Vector3::from(answer.center).norm());
            self.score.wrong.push(WrongAnswer { group, shape, distance, fault: *fault });
        }
        Ok(FrameScore { expected, answers, matching })
    }

    fn count(&mut self, group: usize, object: &Expected, answer: Option<&Object>) {
        if !object.required {
            self.score.extra += u64::from(answer.is_some());
            return;
        }
        self.score.samples.push(Sample {
            group,
            shape: object.body.shape(),
            distance: Vector3::from(object.body.center).norm(),
            hidden: object.hidden,
            errors: answer.map(|answer| Errors::of(object, answer)),
        });
    }

    /// All that was counted.
    pub fn score(&self) -> &Score {
        &self.score
    }
}

impl FrameScore {
    /// The objects that had to be found and were not.
    pub fn missed(&self) -> impl Iterator<Item = &Expected> {
        let pairs = self.expected.iter().zip(&self.matching.answer_of);
        pairs.filter(|(object, answer)| object.required && answer.is_none()).map(|(object, _)| object)
    }

    fn details(&self, header: &Header) -> serde_json::Value {
        let tell = |object: &Object| {
            json!({
                "kind": object.shape().name(), "center": object.center, "radius": object.radius, "axis": object.axis,
                "half_angle_deg": object.half_angle.to_degrees(), "length": object.length, "rows": object.rows,
            })
        };
        let missed =
            |object: &Expected| json!({"name": object.name, "hidden": object.hidden, "is": tell(&object.body)});
        let wrong = |(index, fault): &(usize, Fault)| json!({"why": fault.name(), "is": tell(&self.answers[*index])});
        json!({
            "sequence": header.sequence,
            "scene": header.source.as_str(),
            "missed": self.missed().map(missed).collect::<Vec<_>>(),
            "wrong": self.matching.wrong.iter().map(wrong).collect::<Vec<_>>(),
        })
    }
}

/// Scores messages of objects or tracks.
pub struct EvaluationSink<T> {
    evaluation: Evaluation,
    details: Option<BufWriter<File>>,
    items: PhantomData<T>,
}

impl<T: Answer> Stage for EvaluationSink<T> {
    const NAME: &'static str = "evaluation_sink";
    const SUMMARY: &'static str = "scores objects or tracks against the truth of rendered frames, as tables";
    type Config = EvaluationConfig;
    type Input = T;
    type Output = Nothing;

    fn new(config: EvaluationConfig, context: &Context) -> Result<Self, StageError> {
        let scene = config.load_scene(&context.base)?;
        let open = |path: &PathBuf| {
            let path = context.resolve(path);
            File::create(&path).map(BufWriter::new).with_context(|| format!("cannot write `{}`", path.display()))
        };
        let details = config.details_path.as_ref().map(open).transpose()?;
        Ok(Self { evaluation: Evaluation::new(config, scene), details, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &Sides, output: &mut Output<Nothing>) -> Result<(), StageError> {
        let answers = input.items.iter().filter_map(Answer::object).copied().collect();
        let frame = self.evaluation.add(input.header, answers)?;
        output.count("missed", frame.missed().count() as u64);
        output.count("wrong", frame.matching.wrong.len() as u64);
        if let Some(details) = &mut self.details {
            writeln!(details, "{}", frame.details(input.header))?;
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        if let Some(details) = &mut self.details {
            details.flush()?;
        }
        Ok(std::io::stdout().write_all(self.evaluation.score().report().as_bytes())?)
    }
}
