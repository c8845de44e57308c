//! The sink for people: what was found in each frame, as text on standard output; in colours where that is a terminal.

use crate::sinks::decimator::Decimator;
use conicflow_dataflow::{CLEAR_LINE, Context, Output, SideInputs, Stage, StageError, Stop};
use conicflow_messages::{
    Ellipse, Header, Hinted, Item, Message, Nothing, Object, ObjectKind, Text, Track, TrackState,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::{self, Write as _};
use std::io::{self, ErrorKind, IsTerminal as _, Stdout, Write};
use std::marker::PhantomData;
use std::time::Instant;

/// Parameters of `console_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConsoleSinkConfig {
    /// Show one message in this many, of each camera; 1 shows all.
    #[schemars(range(min = 1))]
    pub every: u32,
    /// Show tracks that are not confirmed yet.
    pub tentative: bool,
    /// Show each message in one line.
    pub brief: bool,
    /// Show no more than one message in so many seconds, of each camera, and the last at the end; 0 shows all.
    #[schemars(range(min = 0.0, max = 3600.0))]
    pub period_s: f64,
}

impl Default for ConsoleSinkConfig {
    fn default() -> Self {
        Self { every: 1, tentative: false, brief: false, period_s: 0.0 }
    }
}

/// An item that can be described in one line of text.
pub trait Describe: Item {
    /// Writes the description, without indent and line feed.
    ///
    /// # Errors
    /// The text cannot be written.
    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result;

    /// Writes kind and size, as short as possible.
    ///
    /// # Errors
    /// The text cannot be written.
    fn sketch(&self, text: &mut impl fmt::Write) -> fmt::Result;

    /// The item's colour on a terminal: the parameters of an escape sequence.
    fn colour(&self) -> &'static str;

    /// Whether the item is too uncertain to be shown by default.
    fn is_tentative(&self) -> bool {
        false
    }
}

/// Returns the colour of an object's shape as in pictures, as close as 256 colours come; objects of confidence below 0.5 are
/// faint.
fn colour_of(object: &Object) -> &'static str {
    let is_doubtful = object.confidence > 0.0 && object.confidence < 0.5;
    match object.shape() {
        _ if is_doubtful => "2",
        ObjectKind::Sphere => "38;5;208",
        ObjectKind::Cylinder => "38;5;78",
        ObjectKind::Cone => "38;5;75",
    }
}

impl Describe for Object {
    fn sketch(&self, text: &mut impl fmt::Write) -> fmt::Result {
        let [x, y, z] = self.center;
        let distance_m = x.hypot(y).hypot(z);
        write!(text, "{} r {:.0} mm at {distance_m:.2} m", self.shape().name(), self.radius * 1e3)
    }

    fn colour(&self) -> &'static str {
        colour_of(self)
    }

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
    fn sketch(&self, text: &mut impl fmt::Write) -> fmt::Result {
        write!(text, "#{} ", self.id)?;
        self.object.sketch(text)?;
        let state = self.track_state();
        if state == TrackState::Confirmed { Ok(()) } else { write!(text, " {}", state.name()) }
    }

    fn colour(&self) -> &'static str {
        if self.track_state() == TrackState::Confirmed { colour_of(&self.object) } else { "2" }
    }

    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result {
        write!(text, "#{:<3} ", self.id)?;
        self.object.describe(text)?;
        let [x, y, z] = self.velocity;
        write!(text, "  velocity ({x:6.3}, {y:6.3}, {z:6.3}) m/s  {}", self.track_state().name())
    }

    fn is_tentative(&self) -> bool {
        self.track_state() == TrackState::Tentative
    }
}

impl Describe for Ellipse {
    fn sketch(&self, text: &mut impl fmt::Write) -> fmt::Result {
        let [long, short] = self.semi_axes.map(|axis| axis * 1e3);
        let scan = self.direction().name();
        write!(text, "{scan} {} {long:.0} x {short:.0} mm", self.line)
    }

    fn colour(&self) -> &'static str {
        "0"
    }

    fn describe(&self, text: &mut impl fmt::Write) -> fmt::Result {
        let [x, y, z] = self.center;
        let [long, short] = self.semi_axes.map(|axis| axis * 1e3);
        let scan = self.direction().name();
        write!(text, "{scan} {:4}, {:4} to {:4}", self.line, self.first, self.last)?;
        write!(text, "  at ({x:6.3}, {y:6.3}, {z:6.3}) m  semi-axes {long:.1} x {short:.1} mm")
    }
}

/// The properties of the text's destination.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Screen {
    /// Whether it is a terminal, which may show the progress of the run in the line where the text begins.
    pub is_terminal: bool,
    /// Whether the text is coloured.
    pub in_colours: bool,
}

impl Screen {
    /// Standard output: coloured if it is a terminal, unless `NO_COLOR` is set (no-color.org).
    pub fn standard_output() -> Self {
        let is_terminal = io::stdout().is_terminal();
        let wants_colours = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
        Self { is_terminal, in_colours: is_terminal && wants_colours }
    }
}

/// Writes messages as text: one line about the frame, and an indented one for each item; or everything in one line.
pub struct Console<W> {
    place: W,
    config: ConsoleSinkConfig,
    screen: Screen,
    decimator: Decimator,
    /// When a message of each camera was last shown.
    shown: BTreeMap<Text<32>, Instant>,
    /// The newest message of each camera that waits until its period has passed.
    held: BTreeMap<Text<32>, String>,
    text: String,
}

impl<W: Write> Console<W> {
    /// Creates a console that writes to `place`.
    pub fn new(place: W, config: ConsoleSinkConfig, screen: Screen) -> Self {
        let decimator = Decimator::new(config.every.into(), 0);
        Self { place, decimator, config, screen, shown: BTreeMap::new(), held: BTreeMap::new(), text: String::new() }
    }

    /// Shows a message if it is due.
    ///
    /// # Errors
    /// The text cannot be written.
    pub fn show<T: Describe>(&mut self, message: &Message<T>) -> io::Result<()> {
        if !self.decimator.is_due(message.header) {
            return Ok(());
        }
        self.text.clear();
        self.text.push_str(if self.screen.is_terminal { CLEAR_LINE } else { "" });
        self.describe(message).map_err(io::Error::other)?;
        let origin = message.header.origin();
        if !self.is_time(message.header) {
            std::mem::swap(self.held.entry(origin).or_default(), &mut self.text);
            return Ok(());
        }
        self.held.remove(&origin);
        self.place.write_all(self.text.as_bytes())?;
        self.place.flush()
    }

    /// Shows the message of each camera that still waits.
    ///
    /// # Errors
    /// The text cannot be written.
    pub fn finish(&mut self) -> io::Result<()> {
        for text in std::mem::take(&mut self.held).into_values() {
            self.place.write_all(text.as_bytes())?;
        }
        self.place.flush()
    }

    /// Whether the period since the last message of the same camera has passed.
    fn is_time(&mut self, header: &Header) -> bool {
        let now = Instant::now();
        let last = self.shown.get(&header.origin());
        let is_time = last.is_none_or(|last| (now - *last).as_secs_f64() >= self.config.period_s);
        if is_time && self.config.period_s > 0.0 {
            self.shown.insert(header.origin(), now);
        }
        is_time
    }

    fn describe<T: Describe>(&mut self, message: &Message<T>) -> fmt::Result {
        let (tentative, brief) = (self.config.tentative, self.config.brief);
        let shown = || message.items.iter().filter(|item| tentative || !item.is_tentative());
        let (sequence, source) = (message.header.sequence, message.header.source.as_str().unwrap_or_default());
        let frame = format!("frame {sequence}  {}", source.escape_debug());
        if brief {
            for (index, item) in shown().enumerate() {
                self.text.push_str(if index == 0 { "" } else { ", " });
                self.coloured(item.colour(), |text| item.sketch(text))?;
            }
            self.text.push_str(if shown().next().is_none() { "nothing" } else { "" });
            self.text.push_str("  ");
            self.coloured("2", |text| write!(text, "{frame}"))?;
            self.text.push('\n');
            return Ok(());
        }
        write!(self.text, "{}: {}  ", T::NAME, shown().count())?;
        self.coloured("2", |text| write!(text, "{frame}"))?;
        self.text.push('\n');
        for item in shown() {
            self.text.push_str("  ");
            self.coloured(item.colour(), |text| item.describe(text))?;
            self.text.push('\n');
        }
        Ok(())
    }

    /// Writes text in a colour, if colours are on.
    fn coloured(&mut self, colour: &str, write: impl FnOnce(&mut String) -> fmt::Result) -> fmt::Result {
        if !self.screen.in_colours {
            return write(&mut self.text);
        }
        write!(self.text, "\x1b[{colour}m")?;
        write(&mut self.text)?;
        self.text.push_str("\x1b[0m");
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
        let console = Console::new(io::stdout(), config, Screen::standard_output());
        Ok(Self { console, stop: context.stop.clone(), items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        let shown = self.console.show(input);
        self.is_read_or_stops(shown)
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let shown = self.console.finish();
        self.is_read_or_stops(shown)
    }
}

impl<T> ConsoleSink<T> {
    /// Stops the stage without an error if the reader of standard output is gone.
    fn is_read_or_stops(&self, shown: io::Result<()>) -> Result<(), StageError> {
        match shown {
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

    fn shown<T: Describe>(config: ConsoleSinkConfig, messages: &[&[T]]) -> String {
        let mut console = Console::new(Vec::new(), config, Screen::default());
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
    fn objects_are_printed_in_metres_and_millimetres() {
        let sphere = Object { kind: ObjectKind::Sphere.code(), center: [0.0, 0.0, 1.0], radius: 0.1, ..cone() };
        let expected = "objects: 2  frame 12  img12.png
  sphere   at ( 0.000,  0.000,  1.000) m  radius 100.0 mm
  cone     at ( 0.100, -0.200,  1.500) m  radius 25.0 to 50.0 mm  half-angle 22.5 deg  length 200 mm
objects: 0  frame 13  img12.png
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
            "tracks: 1  frame 12  img12.png
  #7   cylinder at ( 0.100, -0.200,  1.500) m  radius 40.0 mm  length 200 mm  velocity ( 0.000,  0.500,  0.000) m/s  coasting
"
        );
        let text = shown(ConsoleSinkConfig { tentative: true, ..ConsoleSinkConfig::default() }, &[&[track, tentative]]);
        assert!(text.starts_with("tracks: 2  frame 12  img12.png\n") && text.contains("#8   cylinder"), "{text}");
    }

    #[test]
    fn one_message_in_many_is_shown() {
        let config = ConsoleSinkConfig { every: 3, ..ConsoleSinkConfig::default() };
        let text = shown::<Ellipse>(config, &[[].as_slice(); 7]);
        let frames: Vec<_> = text.lines().map(|line| line.split_whitespace().nth(3).unwrap()).collect();
        assert_eq!(frames, ["12", "15", "18"]);
    }

    #[test]
    fn a_brief_line_has_the_kind_and_the_position() {
        let sphere = Object { kind: ObjectKind::Sphere.code(), center: [0.0, 0.6, 0.8], radius: 0.0995, ..cone() };
        let track = Track { id: 7, state: TrackState::Coasting.code(), object: sphere, ..Track::default() };
        let config = || ConsoleSinkConfig { brief: true, ..ConsoleSinkConfig::default() };
        let text = shown(config(), &[&[sphere, cone()], &[]]);
        let expected =
            "sphere r 100 mm at 1.00 m, cone r 0 mm at 1.52 m  frame 12  img12.png\nnothing  frame 13  img12.png\n";
        assert_eq!(text, expected);
        assert_eq!(shown(config(), &[&[track]]), "#7 sphere r 100 mm at 1.00 m coasting  frame 12  img12.png\n");
    }

    #[test]
    fn each_kind_has_its_colour_and_doubtful_objects_are_faint() {
        let screen = Screen { in_colours: true, ..Screen::default() };
        let mut console = Console::new(Vec::new(), ConsoleSinkConfig::default(), screen);
        let sphere = |confidence| Object { kind: ObjectKind::Sphere.code(), confidence, ..Object::default() };
        let items = [sphere(0.9), sphere(0.4), sphere(0.0)];
        console.show(&Message { header: &Header::default(), items: &items }).unwrap();
        let text = String::from_utf8(console.place).unwrap();
        let lines: Vec<_> = text.lines().collect();
        assert!(lines[0].starts_with("objects: 3  \x1b[2mframe 0") && lines[0].ends_with("\x1b[0m"), "{text:?}");
        let begins =
            |line: &str, with: &str| line.starts_with(&format!("  \x1b[{with}msphere ")) && line.ends_with("\x1b[0m");
        assert!(begins(lines[1], "38;5;208") && begins(lines[2], "2") && begins(lines[3], "38;5;208"), "{text:?}");
    }

    #[test]
    fn on_a_terminal_the_text_takes_the_place_of_the_progress() {
        let terminal = Screen { is_terminal: true, ..Screen::default() };
        let mut console = Console::new(Vec::new(), ConsoleSinkConfig::default(), terminal);
        for _ in 0..2 {
            console.place.extend(b"default: 1 s, 9 frames");
            console.show(&Message::<Object> { header: &Header::default(), items: &[] }).unwrap();
        }
        let text = String::from_utf8(console.place).unwrap();
        assert_eq!(text, "default: 1 s, 9 frames\r\x1b[Kobjects: 0  frame 0  \n".repeat(2));
    }

    #[test]
    fn each_camera_is_shown_once_in_a_period_and_at_the_end() {
        let config = ConsoleSinkConfig { period_s: 3600.0, ..Default::default() };
        let mut console = Console::new(Vec::new(), config, Screen::default());
        for (sequence, camera) in [(0, "left"), (0, "right"), (1, "left"), (2, "left"), (1, "right")] {
            let mut header = Header { sequence, source: Text::new(camera), ..Header::default() };
            header.add_hop(conicflow_messages::Hop { stage: Text::new(camera), ..Default::default() });
            console.show(&Message::<Object> { header: &header, items: &[] }).unwrap();
        }
        let text = |console: &Console<Vec<u8>>| String::from_utf8(console.place.clone()).unwrap();
        assert_eq!(text(&console), "objects: 0  frame 0  left\nobjects: 0  frame 0  right\n");
        console.place.clear();
        console.finish().unwrap();
        assert_eq!(text(&console), "objects: 0  frame 2  left\nobjects: 0  frame 1  right\n");
        console.finish().unwrap();
        assert_eq!(text(&console).lines().count(), 2, "once");
    }

    #[test]
    fn an_ellipse_is_printed_with_its_scan_line() {
        let ellipse = Ellipse { line: 40, first: 5, last: 17, semi_axes: [0.05, 0.04], ..Ellipse::default() };
        let text = shown(ConsoleSinkConfig::default(), &[&[ellipse]]);
        assert!(
            text.contains("\n  row   40,    5 to   17  at ( 0.000,  0.000,  0.000) m  semi-axes 50.0 x 40.0 mm\n"),
            "{text}"
        );
    }

    #[test]
    fn a_closed_output_is_distinguished_from_other_errors() {
        struct Gone;
        impl Write for Gone {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(ErrorKind::BrokenPipe.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let mut console = Console::new(Gone, ConsoleSinkConfig::default(), Screen::default());
        let message = Message::<Object> { header: &Header::default(), items: &[] };
        assert_eq!(console.show(&message).unwrap_err().kind(), ErrorKind::BrokenPipe);
    }
}
