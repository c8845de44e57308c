//! Scores answers frame by frame: what was found, how well, what was missed and what was wrong.

use super::matching::{Answer, Comparison, Fault, MatchedFrame, Matcher, compare};
use super::notes::Notes;
use super::recorded::RecordedTruth;
use super::row::Row;
use super::sigmas::Sigmas;
use super::truth::RenderedTruth;
use super::{summary, tables};
use anyhow::Result;
use conicflow_messages::{Header, Object, ObjectKind};
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
    /// Number of answers about what nobody measured.
    pub neither: u64,
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
    /// Its radius, in metres.
    pub radius_m: f64,
    /// Hidden share of a true object.
    pub hidden: Option<f64>,
    /// How the answer compares that is right about a true object, and its errors in standard deviations.
    pub found: Option<(Comparison, Sigmas)>,
    /// Of a wrong answer what comes nearest to it.
    pub fault: Option<Fault>,
}

impl Sample {
    fn of(group: usize, object: &Object) -> Self {
        let (shape, distance) = (object.shape(), Vector3::from(object.center).norm());
        Self { group, shape, distance, radius_m: object.radius, hidden: None, found: None, fault: None }
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
        self.neither += frame.neither.len() as u64;
        for (truth, answer) in &frame.pairs {
            if !truth.required {
                self.extra += u64::from(answer.is_some());
                continue;
            }
            let found = answer
                .as_ref()
                .map(|Answer { object, .. }| (compare(&truth.body, object), Sigmas::of(&truth.body, object)));
            self.samples.push(Sample { hidden: Some(truth.hidden), found, ..Sample::of(group, &truth.body) });
        }
        for (object, fault) in &frame.wrong {
            self.samples.push(Sample { fault: Some(*fault), ..Sample::of(group, object) });
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
    pub fn add(&mut self, header: &Header, answers: &[Answer]) -> Result<Option<MatchedFrame>> {
        let mut matcher = Matcher::default();
        match &self.truth {
            TruthSource::Rendered(truth) => {
                let scene = truth.scene_of(header)?;
                let group = scene.group.unwrap_or(&scene.name);
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
                let mut frame = matcher.match_up(truths.to_vec(), answers);
                frame.excuse(|object| truth.unmeasured_at(source, &header.camera, object));
                self.score.add("", &frame);
                self.notes.add(source, &frame, |object| truth.not_wanted_at(source, &header.camera, object));
                Ok(Some(frame))
            }
        }
    }

    /// All that was counted.
    pub fn score(&self) -> &Score {
        &self.score
    }

    /// All that was counted, in one row.
    pub fn row(&self) -> Row {
        summary::row(&self.score)
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
