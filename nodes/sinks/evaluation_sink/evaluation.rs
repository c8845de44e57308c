//! Scores the answers to rendered frames, one frame at a time.

use super::EvaluationConfig;
use super::errors::Errors;
use super::matching::{Expected, Fault, Matching, match_up};
use super::rendered;
use super::score::{Sample, Score, WrongAnswer};
use anyhow::Result;
use conicflow_lab::simulator::scene_values::SceneTemplate;
use conicflow_messages::{Header, Object};
use nalgebra::Vector3;
use serde_json::json;

/// Scores answers against rendered truth.
pub struct Evaluation {
    scene: Option<SceneTemplate>,
    config: EvaluationConfig,
    score: Score,
}

/// What came of one frame.
pub struct FrameScore<'a> {
    /// What is there.
    pub expected: Vec<Expected>,
    /// What was answered.
    pub answers: &'a [Object],
    /// Which belongs to which.
    pub matching: Matching,
}

impl Evaluation {
    /// An evaluation of frames that show random or built-in scenes, or the one that is given.
    pub fn new(config: EvaluationConfig, scene: Option<SceneTemplate>) -> Self {
        Self { scene, config, score: Score::default() }
    }

    /// Scores the answers to a frame.
    ///
    /// # Errors
    /// The frame shows a scene that is not known.
    pub fn add<'a>(&mut self, header: &Header, answers: &'a [Object]) -> Result<FrameScore<'a>> {
        let scene = rendered::scene_of(header, self.scene.as_ref())?;
        let expected = rendered::expected(header, &scene, &self.config.required, &self.config.tolerance);
        let matching = match_up(&expected, answers);
        let group = self.score.group(scene.group.unwrap_or(&scene.name));
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

impl FrameScore<'_> {
    /// The objects that had to be found and were not.
    pub fn missed(&self) -> impl Iterator<Item = &Expected> {
        let pairs = self.expected.iter().zip(&self.matching.answer_of);
        pairs.filter(|(object, answer)| object.required && answer.is_none()).map(|(object, _)| object)
    }

    /// What was missed and what was wrong, as one object of JSON.
    pub fn details(&self, header: &Header) -> serde_json::Value {
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
