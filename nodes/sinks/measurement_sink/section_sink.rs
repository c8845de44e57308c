//! The sink that measures ellipses against one true section: how often it was found, and mean and standard deviation of its
//! semi-axes. Its rows are those of an `[experiment]`, as the `measurement_sink`'s are.

use super::row::Row;
use crate::config_error;
use crate::sinks::json_lines::JsonLines;
use conicflow_dataflow::{Context, Output, Sides, Stage, StageError};
use conicflow_lab::running_stats::RunningStats;
use conicflow_messages::{Ellipse, Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Parameters of `section_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SectionConfig {
    /// Centre of the true section in the plane of its scan line: across the view and away from the camera, in metres.
    pub center: [f64; 2],
    /// Distance of the centres up to which an ellipse is about that section, in metres.
    #[schemars(range(min = 0.0))]
    pub max_offset_m: f64,
    /// File for the row, as a line of JSON; none: standard output.
    pub path: Option<PathBuf>,
}

impl Default for SectionConfig {
    fn default() -> Self {
        Self { center: [0.0, 2.0], max_offset_m: 0.25, path: None }
    }
}

/// The columns of its row.
pub const COLUMNS: [&str; 10] =
    ["object", "frames", "n", "others", "long_m", "long_sd_m", "short_m", "short_sd_m", "offset_m", "rms_m"];

/// Figures of one section, frame by frame.
#[derive(Clone, Debug, Default)]
pub struct Sections {
    frames: u64,
    others: u64,
    semi_axes: [RunningStats; 2],
    offset: RunningStats,
    rms: RunningStats,
}

impl Sections {
    /// Takes in the ellipses of a frame: the one nearest to the section, if it is near enough, is about it.
    pub fn add(&mut self, config: &SectionConfig, ellipses: &[Ellipse]) {
        self.frames += 1;
        let offset = |ellipse: &Ellipse| {
            let [s, t] = ellipse.plane_center;
            (s - config.center[0]).hypot(t - config.center[1])
        };
        let near = ellipses.iter().filter(|ellipse| offset(ellipse) <= config.max_offset_m);
        let nearest = near.min_by(|a, b| offset(a).total_cmp(&offset(b)));
        self.others += ellipses.len() as u64 - u64::from(nearest.is_some());
        let Some(found) = nearest else { return };
        self.semi_axes.iter_mut().zip(found.semi_axes).for_each(|(spread, semi_axis)| spread.add(semi_axis));
        self.offset.add(offset(found));
        self.rms.add(found.rms);
    }

    /// The figures.
    pub fn row(&self) -> Row {
        let mut row = Row::default();
        row.text("object", "section");
        row.count("frames", self.frames);
        row.count("n", self.offset.count());
        row.count("others", self.others);
        let [long, short] = &self.semi_axes;
        row.number("long_m", long.mean());
        row.number("long_sd_m", long.deviation());
        row.number("short_m", short.mean());
        row.number("short_sd_m", short.deviation());
        row.number("offset_m", self.offset.mean());
        row.number("rms_m", self.rms.mean());
        row
    }
}

/// The stage around [`Sections`].
pub struct SectionSink {
    config: SectionConfig,
    path: Option<PathBuf>,
    sections: Sections,
}

impl Stage for SectionSink {
    const NAME: &'static str = "section_sink";
    const SUMMARY: &'static str = "Measures ellipses against one true section: found, semi-axes, their deviations";
    type Config = SectionConfig;
    type Input = Ellipse;
    type Output = Nothing;

    fn new(config: SectionConfig, context: &Context) -> Result<Self, StageError> {
        config_error::refuse_restart(context, "measured")?;
        let path = config.path.as_ref().map(|path| context.resolve(path));
        Ok(Self { config, path, sections: Sections::default() })
    }

    fn step(&mut self, input: &Message<Ellipse>, _: &Sides, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.sections.add(&self.config, input.items);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let mut lines = match &self.path {
            Some(path) => JsonLines::open(path, false)?,
            None => JsonLines::standard_output(),
        };
        lines.write(&self.sections.row())?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_ellipse_is_the_section_and_the_others_are_not() {
        let ellipse =
            |s: f64, long: f64| Ellipse { plane_center: [s, 2.0], semi_axes: [long, 0.2], ..Ellipse::default() };
        let (config, mut sections) = (SectionConfig::default(), Sections::default());
        sections.add(&config, &[ellipse(0.2, 9.0), ellipse(0.01, 0.41), ellipse(1.0, 9.0)]);
        sections.add(&config, &[ellipse(0.01, 0.39)]);
        sections.add(&config, &[ellipse(0.3, 9.0)]);
        let number = |column: &str| sections.row().number_of(column).unwrap();
        assert_eq!(sections.row().0.iter().map(|(column, _)| column.as_str()).collect::<Vec<_>>(), COLUMNS);
        assert_eq!(["frames", "n", "others"].map(number), [3.0, 2.0, 3.0]);
        assert!((number("long_m") - 0.4).abs() < 1e-12 && (number("long_sd_m") - 0.02_f64.sqrt() / 10.0).abs() < 1e-12);
    }
}
