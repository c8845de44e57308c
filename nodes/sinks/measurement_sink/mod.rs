//! The sink that measures: what was found of each true object of a rendered scene, in mean and standard deviation, and how
//! well identities were kept. Each object gives one row of figures, which `conicflow run` makes a table of where the
//! pipeline file has an `[experiment]`; else the rows go to standard output.
//!
//! An answer belongs to a true object if it is right by the rule of [`crate::sinks::evaluation_sink::matching`], within wide
//! tolerances: a radius that is far off is to be measured, not to be turned down. The identity that an object had is kept
//! where it is still right, as CLEAR-MOT has it (Bernardin and Stiefelhagen 2008).
//!
//! Recorded frames have no truth here: of them each track, or each shape, gives a row ([`recorded`]).

mod matching;
mod recorded;
mod row;
mod section_sink;
mod sighting;
mod tally;
#[cfg(test)]
mod tests;
mod trace;

pub use row::{Figure, Row};
pub use section_sink::COLUMNS as SECTION;
pub use section_sink::{SectionConfig, SectionSink, Sections};
pub use sighting::Sighted;
pub use tally::COLUMNS as MEASURED;
pub use trace::TITLES as TRACED;

use crate::config_error;
use crate::sinks::evaluation_sink::rendered::{expected, scene_of};
use crate::sinks::evaluation_sink::{Duties, Tolerances, load_scene};
use crate::sinks::json_lines::JsonLines;
use anyhow::Result;
use conicflow_dataflow::{ConfigFault, Context, Output, Sides, Stage, StageError};
use conicflow_lab::simulator::scene_values::SceneTemplate;
use conicflow_messages::{Header, Message, Nothing};
use matching::Matcher;
use recorded::Recorded;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sighting::{Sighting, world_from_camera};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use tally::{Tally, Total};
use trace::Trace;

/// Parameters of `measurement_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MeasurementConfig {
    /// Scene file that the source shows; random and built-in scenes are known by the names in the frames.
    pub scene: Option<PathBuf>,
    /// Which true objects are measured, where enough of them is seen.
    pub required: Duties,
    /// How far off an answer may be and still be about an object.
    pub tolerance: Tolerances,
    /// Frames before this time are left out, for a filter to settle, in seconds; of recorded frames since the first.
    #[schemars(range(min = 0.0))]
    pub from_s: f64,
    /// File for the rows, as lines of JSON; none: standard output.
    pub path: Option<PathBuf>,
    /// File for each frame's sights, as CSV, world frame; none: not written.
    pub trace_path: Option<PathBuf>,
}

impl Default for MeasurementConfig {
    fn default() -> Self {
        Self {
            scene: None,
            required: Duties { max_hidden: 0.95, min_extent_px: 4, min_arc_deg: 5.0, min_view_angle_deg: 10.0 },
            tolerance: Tolerances { position_m: 0.3, radius: 0.8, axis_deg: 30.0, half_angle_deg: 15.0 },
            from_s: 0.0,
            path: None,
            trace_path: None,
        }
    }
}

impl MeasurementConfig {
    /// What types and ranges cannot tell: values that exclude each other, files that are missing.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let scene = self.scene.as_ref().and_then(|path| load_scene(&base.join(path)).err());
        scene.map(|error| config_error::of_file("scene", &error)).into_iter().collect()
    }
}

/// Measures objects or tracks against a scene.
pub struct Measurement {
    config: MeasurementConfig,
    scene: Option<SceneTemplate>,
    matcher: Matcher,
    tallies: Vec<Tally>,
    total: Total,
    recorded: Recorded,
    /// Time of the first recorded frame.
    first_s: Option<f64>,
}

impl Measurement {
    /// A measurement of a scene; without one the frames name theirs.
    pub fn new(config: MeasurementConfig, scene: Option<SceneTemplate>) -> Self {
        Self {
            config,
            scene,
            matcher: Matcher::default(),
            tallies: Vec::new(),
            total: Total::default(),
            recorded: Recorded::default(),
            first_s: None,
        }
    }

    /// Takes in the answers to a frame; what was seen of each true object that had to be.
    ///
    /// # Errors
    /// The frame shows a scene that is not known.
    pub fn add(&mut self, header: &Header, answers: &[Sighted]) -> Result<Vec<Sighting>> {
        let time_s = header.stamp_ns as f64 * 1e-9;
        if header.is_recorded() {
            let first_s = *self.first_s.get_or_insert(time_s);
            if time_s - first_s >= self.config.from_s {
                self.recorded.add(answers);
            }
            return Ok(Vec::new());
        }
        let scene = scene_of(header, self.scene.as_ref())?;
        let truths = expected(header, &scene, &self.config.required, &self.config.tolerance);
        let matches = self.matcher.match_up(&truths, answers);
        if time_s < self.config.from_s {
            return Ok(Vec::new());
        }
        self.total.wrong += matches.wrong;
        let pose = world_from_camera(header);
        let mut sightings = Vec::new();
        for (truth, answer) in truths.iter().zip(&matches.answer_of).filter(|(truth, _)| truth.required) {
            let sighting = Sighting::new(time_s, truth, answer.map(|index| &answers[index]), &pose);
            self.tally(&truth.name).add(&sighting);
            sightings.push(sighting);
        }
        Ok(sightings)
    }

    fn tally(&mut self, name: &str) -> &mut Tally {
        let index = self.tallies.iter().position(|tally| tally.name == name).unwrap_or_else(|| {
            self.tallies.push(Tally::new(name));
            self.tallies.len() - 1
        });
        &mut self.tallies[index]
    }

    /// One row for each object that was there, in the order of their first frames; of several one more for all. Of
    /// recorded frames one for each track, or each shape.
    pub fn rows(&self) -> Vec<Row> {
        if self.first_s.is_some() {
            return self.recorded.rows();
        }
        let mut rows: Vec<Row> = self.tallies.iter().map(Tally::row).collect();
        if rows.len() != 1 {
            rows.push(self.total.row(&self.tallies));
        }
        rows
    }
}

/// The stage around a [`Measurement`].
pub struct MeasurementSink<T> {
    measurement: Measurement,
    answers: Vec<Sighted>,
    trace: Option<Trace>,
    path: Option<PathBuf>,
    items: PhantomData<T>,
}

impl<T> Stage for MeasurementSink<T>
where
    T: conicflow_messages::Item,
    for<'a> Sighted: From<&'a T>,
{
    const NAME: &'static str = "measurement_sink";
    const SUMMARY: &'static str =
        "Measures objects or tracks against the rendered truth: mean, standard deviation, identities";
    type Config = MeasurementConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn new(config: MeasurementConfig, context: &Context) -> Result<Self, StageError> {
        config_error::refuse_restart(context, "measured")?;
        let scene = config.scene.as_ref().map(|path| load_scene(&context.resolve(path))).transpose()?;
        let trace = config.trace_path.as_ref().map(|path| Trace::create(&context.resolve(path))).transpose()?;
        let path = config.path.as_ref().map(|path| context.resolve(path));
        let measurement = Measurement::new(config, scene);
        Ok(Self { measurement, answers: Vec::new(), trace, path, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &Sides, output: &mut Output<Nothing>) -> Result<(), StageError> {
        self.answers.clear();
        self.answers.extend(input.items.iter().map(Sighted::from).filter(|answer| answer.is_meant));
        let sightings = self.measurement.add(input.header, &self.answers)?;
        output.count("missed", sightings.iter().filter(|sighting| sighting.seen.is_none()).count() as u64);
        match &mut self.trace {
            Some(trace) => Ok(trace.write(&sightings)?),
            None => Ok(()),
        }
    }

    fn finish(&mut self) -> Result<(), StageError> {
        if let Some(trace) = &mut self.trace {
            trace.flush()?;
        }
        let mut lines = match &self.path {
            Some(path) => JsonLines::open(path, false)?,
            None => JsonLines::standard_output(),
        };
        for row in self.measurement.rows() {
            lines.write(&row)?;
        }
        Ok(())
    }
}
