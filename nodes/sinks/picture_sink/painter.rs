//! Draws the content of a picture: shapes in the colour of their kind, tracks in that of their number. Higher confidence is
//! stronger, tentative tracks are dotted, coasting ones dashed. The legend names the frame and the depths of the colours.

use super::Config;
use super::canvas::{Box2, Canvas, Colour, Line, Size, dashes};
use super::depth_view::DepthView;
use super::labels::{self, Label};
use conicflow_messages::{Camera, Ellipse, Header, Item, Message, Object, ObjectKind, Scan, Track, TrackState};
use conicflow_view::outline::{self, Segment};

const ARC: Colour = [240, 215, 90];
const ARC_CENTER: Colour = [235, 90, 200];
/// Distance between the dots of an arc, in pixels.
const ARC_STEP: u32 = 4;
/// Colour under outlines and text, so that they are visible on any background.
const SHADOW: Colour = [5, 7, 10];
const PALE: Colour = [228, 233, 242];
/// Height of a picture, in pixels, from which text is large.
const LARGE_FROM_PX: u32 = 960;
/// Confidence of objects from a method that reports none.
const USUALLY_SURE: f64 = 0.8;

/// Colours of tracks that colour-blind people can distinguish, too (after Okabe and Ito 2008, lightened for a dark background).
const TRACK_COLOURS: [Colour; 7] =
    [[245, 170, 40], [95, 190, 245], [20, 190, 140], [250, 235, 90], [70, 140, 230], [240, 110, 40], [225, 140, 190]];

/// Items that a picture can show.
pub trait Drawn: Item {
    /// Draws the items over the picture.
    fn draw(items: &[Self], painter: &mut Painter);
}

impl Drawn for Object {
    fn draw(items: &[Self], painter: &mut Painter) {
        items.iter().for_each(|object| painter.object(object, None));
    }
}

impl Drawn for Track {
    fn draw(items: &[Self], painter: &mut Painter) {
        for track in items {
            let (seen, dash) = match track.track_state() {
                TrackState::Tentative => (0.55, Some([2.0, 4.0])),
                TrackState::Confirmed => (1.0, None),
                TrackState::Coasting => (0.6, Some([9.0, 6.0])),
            };
            let colour = TRACK_COLOURS[(track.id % TRACK_COLOURS.len() as u64) as usize];
            let name = format!("#{} {}", track.id, track.object.shape().name());
            let state = track.track_state();
            let note = (state != TrackState::Confirmed).then(|| state.name());
            let style = LineStyle { colour, sure: seen * sureness(&track.object), dash };
            painter.shape(&track.object, style, labels::lines(&name, &track.object, note));
        }
    }
}

impl Drawn for Ellipse {
    fn draw(items: &[Self], painter: &mut Painter) {
        painter.ellipses(items);
    }
}

fn kind_colour(kind: ObjectKind) -> Colour {
    match kind {
        ObjectKind::Sphere => [255, 135, 60],
        ObjectKind::Cylinder => [80, 225, 110],
        ObjectKind::Cone => [90, 175, 255],
    }
}

/// Confidence of an object for drawing, from 0 to 1.
fn sureness(object: &Object) -> f64 {
    if object.confidence > 0.0 { f64::from(object.confidence) } else { USUALLY_SURE }
}

/// The style of an outline.
#[derive(Clone, Copy, Debug)]
struct LineStyle {
    colour: Colour,
    sure: f64,
    /// Lengths of dashes and gaps in pixels, if it is dashed.
    dash: Option<[f64; 2]>,
}

/// Draws one picture after another; its buffers are reused.
pub struct Painter {
    camera: Camera,
    canvas: Canvas,
    view: DepthView,
    outline: Vec<Segment>,
    labels: Vec<Label>,
    line_width: f64,
    zoom: u32,
    shows_labels: bool,
    shows_legend: bool,
    title: Option<String>,
}

impl Painter {
    /// Creates a painter with the parameters of the sink.
    pub fn new(config: &Config) -> Self {
        Self {
            camera: Camera::default(),
            canvas: Canvas::default(),
            view: DepthView::new(config.near_m, config.far_m),
            outline: Vec::new(),
            labels: Vec::new(),
            line_width: config.line_width_px.into(),
            zoom: config.zoom,
            shows_labels: config.labels,
            shows_legend: config.legend,
            title: None,
        }
    }

    /// Returns the painter with a title above each picture.
    #[must_use]
    pub fn titled(self, title: String) -> Self {
        Self { title: Some(title), ..self }
    }

    /// Begins a black picture of the camera's size times the zoom.
    pub fn begin(&mut self, camera: &Camera) {
        self.camera = *camera;
        self.canvas.begin(camera.width * self.zoom, camera.height * self.zoom);
        self.view.begin();
        self.labels.clear();
    }

    pub(super) fn canvas(&self) -> &Canvas {
        &self.canvas
    }

    /// Paints the depth image, unless it has another size.
    pub fn depth(&mut self, depth: &Message<u16>) {
        let camera = &depth.header.camera;
        if (camera.width, camera.height) == (self.camera.width, self.camera.height) {
            let target = (self.zoom, &mut self.canvas);
            self.view.paint(depth.items, camera.width, depth.header.depth_scale, target);
        }
    }

    /// Draws the arcs of ellipses as dots, and their centres.
    pub fn ellipses(&mut self, ellipses: &[Ellipse]) {
        for ellipse in ellipses {
            self.arc(ellipse);
        }
        for ellipse in ellipses {
            if let Some([x, y]) = outline::project(&self.camera, &ellipse.center.into()) {
                self.canvas.dot(x.round() as i64, y.round() as i64, self.zoom, ARC_CENTER);
            }
        }
    }

    fn arc(&mut self, ellipse: &Ellipse) {
        let shift = ellipse.line * 2 % ARC_STEP;
        let inner = (ellipse.first..=ellipse.last).filter(|pixel| (pixel + shift).is_multiple_of(ARC_STEP));
        for pixel in inner.chain([ellipse.first, ellipse.last]) {
            let (line, pixel) = (i64::from(ellipse.line), i64::from(pixel));
            match ellipse.direction() {
                Scan::Row => self.canvas.dot(pixel, line, self.zoom, ARC),
                Scan::Column => self.canvas.dot(line, pixel, self.zoom, ARC),
            }
        }
    }

    /// Draws an object in the colour of its kind, with a note on its label if there is one.
    pub fn object(&mut self, object: &Object, note: Option<&str>) {
        let style = LineStyle { colour: kind_colour(object.shape()), sure: sureness(object), dash: None };
        self.shape(object, style, labels::lines(object.shape().name(), object, note));
    }

    fn shape(&mut self, object: &Object, style: LineStyle, lines: [String; 2]) {
        outline::trace(object, &self.camera, &mut self.outline);
        let LineStyle { colour, sure, dash } = style;
        let width = self.line_width * (0.6 + 0.6 * sure);
        let (hidden, seen) = (self.lines(true), self.lines(false));
        self.canvas.stroke(seen.iter().copied(), width + 2.4, SHADOW, 0.75);
        self.canvas.stroke(dashes(hidden.into_iter(), 3.0, 3.0).into_iter(), 1.0, colour, 0.25 + 0.4 * sure);
        let strength = 0.4 + 0.6 * sure;
        match dash {
            Some([on, off]) => {
                self.canvas.stroke(dashes(seen.iter().copied(), on, off).into_iter(), width, colour, strength);
            }
            None => self.canvas.stroke(seen.iter().copied(), width, colour, strength),
        }
        if self.shows_labels
            && let Some(around) = around(&seen)
        {
            self.labels.push(Label { lines, colour, sure, around });
        }
    }

    /// Returns the hidden or the visible lines of the outline, in pixels of the picture, clipped to it.
    fn lines(&self, hidden: bool) -> Vec<Line> {
        let zoom = f64::from(self.zoom);
        let at = |point: [f64; 2]| point.map(|pixel| (pixel + 0.5) * zoom - 0.5);
        let segments = self.outline.iter().filter(|segment| segment.hidden == hidden);
        segments
            .filter_map(|segment| self.canvas.clipped(at(segment.from), at(segment.to), 2.0 * self.line_width))
            .collect()
    }

    /// Finishes the picture: draws labels, which do not cover each other, and the legend below.
    pub fn finish(&mut self, header: &Header) {
        let (width, height) = self.canvas.size();
        let size = if height >= LARGE_FROM_PX { Size::Large } else { Size::Small };
        let (width, height) = (i64::from(width), i64::from(height));
        let title_lines = self.title.as_ref().map(|title| wrapped(title, width - size.width(" "), size));
        let title = size.line() * title_lines.as_ref().map_or(0, |lines| lines.len() as i64);
        let legend = i64::from(self.shows_legend) * size.line();
        let room = Box2 { left: 0, top: title, width, height: height - title - legend };
        labels::draw(&mut self.labels, room, size, &mut self.canvas);
        if let Some(lines) = &title_lines {
            self.canvas.fill(Box2 { left: 0, top: 0, width, height: title }, SHADOW, 0.75);
            for (number, line) in (0..).zip(lines) {
                self.canvas.text((size.width(" ") / 2, number * size.line()), line, (size, true, PALE, 1.0));
            }
        }
        if self.shows_legend {
            self.draw_legend(header, height - legend, size);
        }
    }

    /// Draws number and time of the frame, and the scale of the depth if there is room.
    fn draw_legend(&mut self, header: &Header, top: i64, size: Size) {
        let width = i64::from(self.canvas.size().0);
        self.canvas.fill(Box2 { left: 0, top, width, height: size.line() }, SHADOW, 0.75);
        let gap = size.width(" ");
        let begin = self.view.draw_scale(&mut self.canvas, (width - gap / 2, top), size);
        let (source, seconds) = (header.source.as_str().unwrap_or_default(), header.stamp_ns as f64 * 1e-9);
        let frame = format!("frame {}", header.sequence);
        let texts = [format!("{frame}  {seconds:.3} s  {source}"), format!("{frame}  {seconds:.3} s"), frame];
        if let Some(text) = texts.iter().find(|text| gap + size.width(text) < begin) {
            self.canvas.text((gap / 2, top), text.trim_end(), (size, false, PALE, 1.0));
        }
    }
}

/// Breaks a text into lines that fit into `room` pixels; a longer word is broken.
fn wrapped(text: &str, room: i64, size: Size) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let mut begin = lines.last().map_or("", |line| if line.is_empty() { "" } else { " " });
        if lines.last().is_some_and(|line| !line.is_empty() && size.width(&format!("{line} {word}")) > room) {
            lines.push(String::new());
            begin = "";
        }
        for letter in begin.chars().chain(word.chars()) {
            match lines.last_mut().filter(|line| line.is_empty() || size.width(&format!("{line}{letter}")) <= room) {
                Some(line) => line.push(letter),
                None => lines.push(letter.to_string()),
            }
        }
    }
    lines
}

/// Returns the bounding rectangle of lines.
fn around(lines: &[Line]) -> Option<Box2> {
    let first = lines.first()?.0;
    let (mut low, mut high) = (first, first);
    for point in lines.iter().flat_map(|line| [line.0, line.1]) {
        for axis in 0..2 {
            (low[axis], high[axis]) = (low[axis].min(point[axis]), high[axis].max(point[axis]));
        }
    }
    let [left, top] = low.map(|edge| edge.floor() as i64);
    let [right, bottom] = high.map(|edge| edge.ceil() as i64);
    Some(Box2 { left, top, width: right - left + 1, height: bottom - top + 1 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_title_is_wrapped_and_nothing_of_it_is_lost() {
        let title = "A: extractor.arcs=conic extractor.scan=rows assembler.profile.section_fit=ellipse";
        let room = Size::Small.width("extractor.arcs=conic extractor.");
        let lines = wrapped(title, room, Size::Small);
        assert!(lines.len() > 2 && lines.iter().all(|line| Size::Small.width(line) <= room), "{lines:?}");
        assert_eq!(lines[0], "A: extractor.arcs=conic");
        assert_eq!(lines.concat().replace(' ', ""), title.replace(' ', ""));
        assert_eq!(wrapped("B", 1, Size::Small), ["B"]);
    }
}
