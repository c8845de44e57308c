//! Each frame's observations as CSV: where each object was and where it was seen, in the world frame.

use super::observation::{Observation, State};
use crate::csv;
use anyhow::{Result, anyhow};
use conicflow_messages::Hinted;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// The columns of the file, with commas between them.
pub const TITLES: &str =
    "time_s,object,camera_x_m,camera_y_m,camera_z_m,x_true_m,y_true_m,z_true_m,x_m,y_m,z_m,radius_m,id";

/// The file.
pub struct Trace(BufWriter<File>);

impl Trace {
    /// Makes the file, and its folder where it is missing.
    ///
    /// # Errors
    /// One of them cannot be made.
    pub fn create(path: &Path) -> Result<Self> {
        let create = || -> std::io::Result<Self> {
            path.parent().map_or(Ok(()), std::fs::create_dir_all)?;
            let mut file = BufWriter::new(File::create(path)?);
            writeln!(file, "{TITLES}")?;
            Ok(Self(file))
        };
        create().map_err(|error| {
            let hint = "`trace_path` wants a file in a place that you may write to";
            anyhow!(Hinted::new(format!("cannot write `{}`: {error}", path.display()), hint))
        })
    }

    /// Writes a frame, one line for each object that was there; what was not seen leaves its cells empty.
    ///
    /// # Errors
    /// A line cannot be written.
    pub fn write(&mut self, observations: &[Observation]) -> std::io::Result<()> {
        for Observation { time_s, camera, name, truth, seen, .. } in observations {
            let Some(State { position: place, .. }) = truth else { continue };
            write!(self.0, "{time_s:.6},{},{:.6},{:.6},{:.6},", csv::cell(name), camera.x, camera.y, camera.z)?;
            write!(self.0, "{:.6},{:.6},{:.6},", place.x, place.y, place.z)?;
            let Some(seen) = seen else {
                writeln!(self.0, ",,,,")?;
                continue;
            };
            let place = seen.state.position;
            let id = seen.id.map(|id| id.to_string()).unwrap_or_default();
            writeln!(self.0, "{:.6},{:.6},{:.6},{:.6},{id}", place.x, place.y, place.z, seen.state.radius_m)?;
        }
        Ok(())
    }

    /// Hands the last lines to the system.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
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
        let records = csv::records(&std::fs::read_to_string(&path).unwrap());
        assert_eq!((records[1].len(), records[1][1].as_str()), (records[0].len(), "ball, \"red\""));
    }
}
