//! Scores answers frame by frame: what was found, how well, what was missed and what was wrong.

use super::errors::Errors;
use super::matching::{Answer, Fault, MatchedFrame, Matcher};
use super::notes::Notes;
use super::recorded::RecordedTruth;
use super::tables;
use super::truth::RenderedTruth;
use anyhow::Result;
use conicflow_messages::{Header, ObjectKind};
use nalgebra::Vector3;

/// Where the truth comes from.
pub enum TruthSource {
    /// From the scene that a frame shows.
    Rendered(Box<RenderedTruth>),
    /// From a truth file.
    Recorded(RecordedTruth),
}

/// Scores answers against the truth.
pub struct Evaluation {
    truth: TruthSource,
    score: Score,
    notes: Notes,
}

/// All that was counted.
#[derive(Clone, Debug, Default)]
pub struct Score {
    /// Number of frames that were judged.
    pub frames: u64,
    /// Names of the groups, in the order of their first frames.
    pub groups: Vec<String>,
    /// The true objects that had to be found, and the answers that were right about nothing.
    pub samples: Vec<Sample>,
    /// Number of right answers about objects that need not be found.
    pub extra: u64,
}

/// A true object that had to be found, or a wrong answer.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Number of its group.
    pub group: usize,
    /// Its shape; of a wrong answer the one that it claims.
    pub shape: ObjectKind,
    /// Distance of its middle from the camera, in metres.
    pub distance: f64,
    /// Hidden share of a true object.
    pub hidden: Option<f64>,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a true object, or of an answer.
#[derive(Clone, Copy, Debug)]
pub enum Outcome {
    /// The object was found; errors of the answer that is right about it.
    Found(Errors),
    /// The object was not found.
    Missed,
    /// The answer is wrong; what comes nearest to it.
    Wrong(Fault),
}

impl Sample {
    /// The errors of what was found.
    pub fn errors(&self) -> Option<&Errors> {
        if let Outcome::Found(errors) = &self.outcome { Some(errors) } else { None }
    }

    /// What is wrong with a wrong answer.
    pub fn fault(&self) -> Option<Fault> {
        if let Outcome::Wrong(fault) = self.outcome { Some(fault) } else { None }
    }
}

impl Score {
    fn group(&mut self, name: &str) -> usize {
        self.groups.iter().position(|known| known == name).unwrap_or_else(|| {
            self.groups.push(name.to_owned());
            self.groups.len() - 1
        })
    }

    fn add(&mut self, group: &str, frame: &MatchedFrame) {
        let group = self.group(group);
        self.frames += 1;
        for (truth, answer) in frame.pairs() {
            if !truth.required {
                self.extra += u64::from(answer.is_some());
                continue;
            }
            let outcome = match answer {
                Some(answer) => Outcome::Found(Errors::of(&truth.body, &answer.object)),
                None => Outcome::Missed,
            };
            let (shape, distance) = (truth.body.shape(), Vector3::from(truth.body.center).norm());
            self.samples.push(Sample { group, shape, distance, hidden: Some(truth.hidden), outcome });
        }
        for (object, fault) in frame.wrong() {
            let (shape, distance) = (object.shape(), Vector3::from(object.center).norm());
            self.samples.push(Sample { group, shape, distance, hidden: None, outcome: Outcome::Wrong(fault) });
        }
    }
}

impl Evaluation {
    /// An evaluation of frames whose truth is known from somewhere.
    pub fn new(truth: TruthSource) -> Self {
        Self { truth, score: Score::default(), notes: Notes::default() }
    }

    /// Scores the answers to a frame; `None` where the truth file has nothing about it.
    ///
    /// # Errors
    /// The frame shows a scene that is not known.
    pub fn add<'a>(&mut self, header: &Header, answers: &'a [Answer]) -> Result<Option<MatchedFrame<'a>>> {
        let mut matcher = Matcher::default();
        match &self.truth {
            TruthSource::Rendered(truth) => {
                let scene = truth.scene_of(header)?;
                let group = scene.name.split('/').next().unwrap_or_default();
                let frame = matcher.match_up(truth.objects(header, &scene), answers);
                self.score.add(group, &frame);
                Ok(Some(frame))
            }
            TruthSource::Recorded(truth) => {
                let source = header.source.as_str().unwrap_or_default();
                let Some(truths) = truth.objects(source) else {
                    self.notes.add_unjudged(source);
                    return Ok(None);
                };
                let frame = matcher.match_up(truths.to_vec(), answers);
                self.score.add("", &frame);
                self.notes.add(source, &frame);
                Ok(Some(frame))
            }
        }
    }

    /// All that was counted.
    pub fn score(&self) -> &Score {
        &self.score
    }

    /// What came of all frames: tables of rendered ones; of recorded ones what was found and what not, frame by frame.
    ///
    /// # Errors
    /// Frames came, and the truth file has none of them.
    pub fn report(&self) -> Result<String> {
        match &self.truth {
            TruthSource::Rendered(_) => Ok(tables::report(&self.score)),
            TruthSource::Recorded(truth) => self.notes.report(&self.score, truth),
        }
    }
}
