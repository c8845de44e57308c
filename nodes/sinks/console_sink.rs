//! The sink for people: what was found in each frame, as text on standard output.

use crate::sinks::decimator::Decimator;
use conicflow_dataflow::{Context, Output, SideInputs, Stage, StageError, Stop};
use conicflow_messages::{Ellipse, Hinted, Item, Message, Nothing, Object, ObjectKind, Scan, Track, TrackState};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt::{self, Write as _};
use std::io::{self, ErrorKind, Stdout, Write};
use std::marker::PhantomData;

/// Parameters of `console_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConsoleSinkConfig {
    /// Show one message in this many, of each camera; 1 shows all.
    #[schemars(range(min = 1))]
    pub every: u32,
    /// Show tracks that are not confirmed yet.
    pub tentative: bool,
}

impl Default for ConsoleSinkConfig {
    fn default() -> Self {
        Self { every: 1, tentative: false }
    }
}

/// An item that can be told in one line of text.
pub trait Describe: Item {
    /// Writes the line, without indent and line feed.
    ///
    /// # Errors
    /// Those of the place written to.
    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result;

    /// Whether it is too uncertain to be shown by default.
    fn is_tentative(&self) -> bool {
        false
    }
}

impl Describe for Object {
    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result {
        let [x, y, z] = self.center;
        write!(text, "{:<8} at ({x:6.3}, {y:6.3}, {z:6.3}) m", self.shape().name())?;
        match self.shape() {
            ObjectKind::Sphere => write!(text, "  radius {:.1} mm", self.radius * 1e3),
            ObjectKind::Cylinder => {
                write!(text, "  radius {:.1} mm  length {:.0} mm", self.radius * 1e3, self.length * 1e3)
            }
            ObjectKind::Cone => {
                let (top, base, length) = (self.top_radius * 1e3, self.base_radius * 1e3, self.length * 1e3);
                let half_angle_deg = self.half_angle.to_degrees();
                write!(
                    text,
                    "  radius {top:.1} to {base:.1} mm  half-angle {half_angle_deg:.1} deg  length {length:.0} mm"
                )
            }
        }
    }
}

impl Describe for Track {
    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result {
        write!(text, "#{:<4}", self.id)?;
        self.object.describe(text)?;
        let [x, y, z] = self.velocity;
        write!(text, "  velocity ({x:6.3}, {y:6.3}, {z:6.3}) m/s  {}", self.track_state().name())
    }

    fn is_tentative(&self) -> bool {
        self.track_state() == TrackState::Tentative
    }
}

impl Describe for Ellipse {
    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result {
        let [x, y, z] = self.center;
        let [long, short] = self.semi_axes.map(|axis| axis * 1e3);
        let scan = if self.direction() == Scan::Row { "row" } else { "column" };
        write!(text, "{scan} {:4}, {:4} to {:4}", self.line, self.first, self.last)?;
        write!(text, "  at ({x:6.3}, {y:6.3}, {z:6.3}) m  semi-axes {long:.1} x {short:.1} mm")
    }
}

/// Writes messages as text: one line for the frame and one, indented, for each item.
pub struct Console<W> {
    place: W,
    config: ConsoleSinkConfig,
    decimator: Decimator,
    text: String,
}

impl<W: Write> Console<W> {
    /// A console on `place`.
    pub fn new(place: W, config: ConsoleSinkConfig) -> Self {
        Self { place, decimator: Decimator::new(config.every.into(), 0), config, text: String::new() }
    }

    /// Shows a message, if it is its turn.
    ///
    /// # Errors
    /// Those of the place written to.
    pub fn show<T: Describe>(&mut self, message: &Message<T>) -> io::Result<()> {
        if !self.decimator.is_due(message.header) {
            return Ok(());
        }
        self.text.clear();
        self.describe(message).map_err(io::Error::other)?;
        self.place.write_all(self.text.as_bytes())?;
        self.place.flush()
    }

    fn describe<T: Describe>(&mut self, message: &Message<T>) -> fmt::Result {
        let tentative = self.config.tentative;
        let shown = || message.items.iter().filter(|item| tentative || !item.is_tentative());
        let (sequence, source) = (message.header.sequence, message.header.source.as_str().unwrap_or_default());
        writeln!(self.text, "frame {sequence}  {}  {}: {}", source.escape_debug(), T::NAME, shown().count())?;
        for item in shown() {
            self.text.push_str("  ");
            item.describe(&mut self.text)?;
            self.text.push('\n');
        }
        Ok(())
    }
}

/// Shows messages of ellipses, objects or tracks on standard output.
pub struct ConsoleSink<T> {
    console: Console<Stdout>,
    stop: Stop,
    items: PhantomData<T>,
}

impl<T: Describe> Stage for ConsoleSink<T> {
    const NAME: &'static str = "console_sink";
    const SUMMARY: &'static str = "Shows ellipses, objects or tracks as text on standard output";
    type Config = ConsoleSinkConfig;
    type Input = T;
    type Output = Nothing;

    fn new(config: ConsoleSinkConfig, context: &Context) -> Result<Self, StageError> {
        let console = Console::new(io::stdout(), config);
        Ok(Self { console, stop: context.stop.clone(), items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        match self.console.show(input) {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => self.stop.request(),
            Err(error) => return Err(unwritable(&error).into()),
            Ok(()) => {}
        }
        Ok(())
    }
}

fn unwritable(error: &io::Error) -> Hinted {
    let what = format!("cannot write to standard output: {error}");
    let hint = "send it elsewhere, such as `> /dev/null`, or leave the sink out".to_owned();
    Hinted { hint, ..Hinted::of_writing(what, error) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Header, Text};

    fn shown<T: Describe>(config: ConsoleSinkConfig, messages: &[&[T]]) -> String {
        let mut console = Console::new(Vec::new(), config);
        for (sequence, items) in (12..).zip(messages) {
            let header = Header { sequence, source: Text::new("img12.png"), ..Header::default() };
            console.show(&Message { header: &header, items }).unwrap();
        }
        String::from_utf8(console.place).unwrap()
    }

    fn cone() -> Object {
        Object {
            kind: ObjectKind::Cone.code(),
            center: [0.1, -0.2, 1.5],
            half_angle: std::f64::consts::FRAC_PI_8,
            base_radius: 0.05,
            top_radius: 0.025,
            length: 0.2,
            ..Object::default()
        }
    }

    #[test]
    fn objects_are_told_in_metres_and_millimetres() {
        let sphere = Object { kind: ObjectKind::Sphere.code(), center: [0.0, 0.0, 1.0], radius: 0.1, ..cone() };
        let expected = "frame 12  img12.png  objects: 2
  sphere   at ( 0.000,  0.000,  1.000) m  radius 100.0 mm
  cone     at ( 0.100, -0.200,  1.500) m  radius 25.0 to 50.0 mm  half-angle 22.5 deg  length 200 mm
frame 13  img12.png  objects: 0
";
        assert_eq!(shown(ConsoleSinkConfig::default(), &[&[sphere, cone()], &[]]), expected);
    }

    #[test]
    fn tentative_tracks_are_shown_on_request() {
        let object = Object { kind: ObjectKind::Cylinder.code(), radius: 0.04, ..cone() };
        let track =
            Track { id: 7, state: TrackState::Coasting.code(), velocity: [0.0, 0.5, 0.0], object, ..Track::default() };
        let tentative = Track { id: 8, state: TrackState::Tentative.code(), ..track };
        let text = shown(ConsoleSinkConfig::default(), &[&[track, tentative]]);
        assert_eq!(
            text,
            "frame 12  img12.png  tracks: 1
  #7   cylinder at ( 0.100, -0.200,  1.500) m  radius 40.0 mm  length 200 mm  velocity ( 0.000,  0.500,  0.000) m/s  coasting
"
        );
        let text = shown(ConsoleSinkConfig { tentative: true, ..ConsoleSinkConfig::default() }, &[&[track, tentative]]);
        assert!(text.starts_with("frame 12  img12.png  tracks: 2\n") && text.contains("#8   cylinder"), "{text}");
    }

    #[test]
    fn one_message_in_many_is_shown() {
        let config = ConsoleSinkConfig { every: 3, ..ConsoleSinkConfig::default() };
        let text = shown::<Ellipse>(config, &[[].as_slice(); 7]);
        let frames: Vec<_> = text.lines().map(|line| line.split_whitespace().nth(1).unwrap()).collect();
        assert_eq!(frames, ["12", "15", "18"]);
    }

    #[test]
    fn an_ellipse_is_told_with_its_scan_line() {
        let ellipse = Ellipse { line: 40, first: 5, last: 17, semi_axes: [0.05, 0.04], ..Ellipse::default() };
        let text = shown(ConsoleSinkConfig::default(), &[&[ellipse]]);
        assert!(
            text.contains("\n  row   40,    5 to   17  at ( 0.000,  0.000,  0.000) m  semi-axes 50.0 x 40.0 mm\n"),
            "{text}"
        );
    }

    #[test]
    fn a_reader_that_went_away_is_told_apart() {
        struct Gone;
        impl Write for Gone {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(ErrorKind::BrokenPipe.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let mut console = Console::new(Gone, ConsoleSinkConfig::default());
        let message = Message::<Object> { header: &Header::default(), items: &[] };
        assert_eq!(console.show(&message).unwrap_err().kind(), ErrorKind::BrokenPipe);
    }
}
