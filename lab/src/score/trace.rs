//! Writes the observations of each frame as CSV: the true and the found position of each object, in the world frame.

use super::observation::{Observation, Sighting, State};
use anyhow::{Result, anyhow};
use conicflow_messages::{Hinted, LateFile};
use std::fs::File;
use std::path::Path;

/// The columns of the file.
#[rustfmt::skip]
pub const TITLES: [&str; 13] = [
    "time_s", "object", "camera_x_m", "camera_y_m", "camera_z_m", "x_true_m", "y_true_m", "z_true_m", "x_m", "y_m", "z_m",
    "radius_m", "id",
];

/// The file. Content of an earlier run stays until the first frame.
pub struct Trace {
    file: LateFile,
    lines: Option<csv::Writer<File>>,
}

impl Trace {
    /// Creates the file, and its folder if that is missing.
    ///
    /// # Errors
    /// The file or the folder cannot be created.
    pub fn create(path: &Path) -> Result<Self> {
        let file = LateFile::open(path).map_err(|error| {
            let hint = "`trace_path` wants a file in a place that you may write to";
            anyhow!(Hinted::new(format!("cannot write `{}`: {error}", path.display()), hint))
        })?;
        Ok(Self { file, lines: None })
    }

    /// Writes a frame, one line for each object; objects that were not found have empty cells.
    ///
    /// # Errors
    /// A line cannot be written.
    pub fn write(&mut self, observations: &[Observation]) -> std::io::Result<()> {
        let lines = match &mut self.lines {
            Some(lines) => lines,
            none => {
                let mut lines = csv::Writer::from_writer(self.file.begin()?.try_clone()?);
                lines.write_record(TITLES)?;
                none.insert(lines)
            }
        };
        for Observation { time_s, camera, name, truth, seen, .. } in observations {
            let Some(State { position: place, .. }) = truth else { continue };
            let number = |number: &f64| format!("{number:.6}");
            let mut cells = vec![number(time_s), name.clone()];
            cells.extend(camera.iter().chain(place).map(number));
            if let Some(Sighting { state, id, .. }) = seen {
                cells.extend(state.position.iter().chain([&state.radius_m]).map(number));
                cells.extend(id.map(|id| id.to_string()));
            }
            cells.resize(TITLES.len(), String::new());
            lines.write_record(&cells)?;
        }
        Ok(())
    }

    /// Writes the last lines to the file.
    ///
    /// # Errors
    /// The lines cannot be written.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.lines.as_mut().map_or(Ok(()), csv::Writer::flush)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_name_with_a_comma_is_one_cell() {
        let zero = Vector3::zeros();
        let truth = Some(State { position: zero, distance_m: 1.0, radius_m: 0.1, half_angle: 0.0, axis: zero });
        let observation = Observation { time_s: 0.5, name: "ball, \"red\"".into(), truth, ..Observation::default() };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.csv");
        let mut trace = Trace::create(&path).unwrap();
        trace.write(&[observation]).unwrap();
        trace.flush().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let line = "0.500000,\"ball, \"\"red\"\"\",0.000000,0.000000,0.000000,0.000000,0.000000,0.000000,,,,,";
        assert_eq!(text.lines().collect::<Vec<_>>(), [&TITLES.join(","), line]);
    }
}
