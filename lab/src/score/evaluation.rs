//! Scores answers frame by frame: what was found, how well, what was missed and what was wrong.

use super::matching::{Answer, MatchedFrame, Matcher};
use super::notes::Notes;
use super::recorded::RecordedTruth;
use super::row::Row;
use super::samples::Score;
use super::truth::RenderedTruth;
use super::{summary, tables};
use anyhow::Result;
use conicflow_messages::Header;

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
