//! Scores answers frame by frame: correct ones, their errors, missed objects and wrong answers.

use super::matching::{Answer, MatchedFrame, Matcher};
use super::notes::Notes;
use super::recorded::RecordedTruth;
use super::row::Row;
use super::samples::Score;
use super::truth::RenderedTruth;
use super::{summary, tables};
use anyhow::Result;
use conicflow_messages::Header;

/// The source of the truth.
pub enum TruthSource {
    /// The scene that a frame shows.
    Rendered(Box<RenderedTruth>),
    /// A truth file.
    Recorded(RecordedTruth),
}

/// Scores answers against the truth.
pub struct Evaluation {
    truth: TruthSource,
    score: Score,
    notes: Notes,
}

impl Evaluation {
    /// Creates an evaluation with this source of the truth.
    pub fn new(truth: TruthSource) -> Self {
        Self { truth, score: Score::default(), notes: Notes::default() }
    }

    /// Scores the answers to a frame; `None` if the truth file does not have it.
    ///
    /// # Errors
    /// The frame shows an unknown scene.
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

    /// Returns all counts.
    pub fn score(&self) -> &Score {
        &self.score
    }

    /// Returns all counts in one row.
    pub fn row(&self) -> Row {
        summary::row(&self.score)
    }

    /// Returns the report on all frames: tables for rendered ones; for recorded ones, what was found and missed in each.
    ///
    /// # Errors
    /// There were frames, but none of them is in the truth file.
    pub fn report(&self) -> Result<String> {
        match &self.truth {
            TruthSource::Rendered(_) => Ok(tables::report(&self.score)),
            TruthSource::Recorded(truth) => self.notes.report(&self.score, truth),
        }
    }
}
