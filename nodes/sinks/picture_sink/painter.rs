//! What a picture shows and in which colours: shapes by their kind, tracks by their number.

use super::Config;
use super::canvas::{Canvas, Colour};
use super::depth_view::DepthView;
use conicflow_messages::{Camera, Ellipse, Item, Message, Object, ObjectKind, Scan, Track, TrackState};
use conicflow_view::outline::{self, Segment};

const ARC: Colour = [240, 215, 90];
const ARC_CENTER: Colour = [235, 90, 200];
/// Every so many pixels of an arc are dotted.
const ARC_STEP: u32 = 4;

/// Colours of tracks, told apart also by the colour-blind (after Okabe and Ito 2008, lightened for a dark ground).
const TRACK_COLOURS: [Colour; 7] =
    [[245, 170, 40], [95, 190, 245], [20, 190, 140], [250, 235, 90], [70, 140, 230], [240, 110, 40], [225, 140, 190]];

/// Items that a picture can show.
pub trait Drawn: Item {
    /// Draws them over what is there.
    fn draw(items: &[Self], painter: &mut Painter);
}

impl Drawn for Object {
    fn draw(items: &[Self], painter: &mut Painter) {
        for object in items {
            let pen = Pen { colour: kind_colour(object.shape()), width: painter.line_width };
            painter.object(object, pen, || object_label(object));
        }
    }
}

impl Drawn for Track {
    /// Tentative tracks are drawn thin, coasting ones dark.
    fn draw(items: &[Self], painter: &mut Painter) {
        for track in items {
            let colour = TRACK_COLOURS[(track.id % TRACK_COLOURS.len() as u64) as usize];
            let pen = match track.track_state() {
                TrackState::Tentative => Pen { colour, width: 1 },
                TrackState::Confirmed => Pen { colour, width: painter.line_width },
                TrackState::Coasting => Pen { colour: dark(colour), width: painter.line_width },
            };
            painter.object(&track.object, pen, || format!("{}: {}", track.id, object_label(&track.object)));
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

fn dark(colour: Colour) -> Colour {
    colour.map(|part| part / 5 * 2)
}

/// `cyl 98`: the kind and the radius in millimetres.
fn object_label(object: &Object) -> String {
    format!("{:.3} {:.0}", object.shape().name(), object.radius.min(99.0) * 1000.0)
}

/// How an outline is drawn.
#[derive(Clone, Copy, Debug)]
struct Pen {
    colour: Colour,
    width: u32,
}

/// Draws one picture after the other; its buffers are kept.
pub struct Painter {
    camera: Camera,
    canvas: Canvas,
    view: DepthView,
    outline: Vec<Segment>,
    line_width: u32,
    labels: bool,
}

impl Painter {
    pub(super) fn new(config: &Config) -> Self {
        Self {
            camera: Camera::default(),
            canvas: Canvas::default(),
            view: DepthView::new(config.near_m, config.far_m),
            outline: Vec::new(),
            line_width: config.line_width_px,
            labels: config.labels,
        }
    }

    /// Begins a black picture as large as the camera's.
    pub(super) fn begin(&mut self, camera: &Camera) {
        self.camera = *camera;
        self.canvas.begin(camera.width, camera.height);
    }

    pub(super) fn size(&self) -> (u32, u32) {
        self.canvas.size()
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.canvas.bytes()
    }

    /// Paints the depth image, unless it is of another size.
    pub(super) fn depth(&mut self, depth: &Message<u16>) {
        let camera = &depth.header.camera;
        if (camera.width, camera.height) == self.canvas.size() {
            self.view.paint(depth.items, depth.header.depth_scale, &mut self.canvas);
        }
    }

    /// Dots the arcs of ellipses, and their centres.
    pub(super) fn ellipses(&mut self, ellipses: &[Ellipse]) {
        for ellipse in ellipses {
            self.arc(ellipse);
        }
        for ellipse in ellipses {
            if let Some(center) = outline::project(&self.camera, &ellipse.center.into()) {
                self.canvas.square(center, 1, ARC_CENTER);
            }
        }
    }

    fn arc(&mut self, ellipse: &Ellipse) {
        let shift = ellipse.line * 2 % ARC_STEP;
        let inner = (ellipse.first..=ellipse.last).filter(|pixel| (pixel + shift).is_multiple_of(ARC_STEP));
        for pixel in inner.chain([ellipse.first, ellipse.last]) {
            let (line, pixel) = (i64::from(ellipse.line), i64::from(pixel));
            match ellipse.direction() {
                Scan::Row => self.canvas.dot(pixel, line, ARC),
                Scan::Column => self.canvas.dot(line, pixel, ARC),
            }
        }
    }

    fn object(&mut self, object: &Object, pen: Pen, label: impl FnOnce() -> String) {
        outline::trace(object, &self.camera, &mut self.outline);
        self.outline.sort_by_key(|segment| !segment.hidden);
        for segment in &self.outline {
            let (colour, width) = if segment.hidden { (dark(pen.colour), 1) } else { (pen.colour, pen.width) };
            self.canvas.line(segment.from, segment.to, width, colour);
        }
        if self.labels
            && let Some([x, y]) = label_place(&self.outline)
        {
            self.canvas.text(x, y, &label(), pen.colour);
        }
    }
}

/// Above the upper left of an outline.
fn label_place(outline: &[Segment]) -> Option<[f64; 2]> {
    let corner = |[x, y]: [f64; 2], segment: &Segment| [x.min(segment.from[0]), y.min(segment.from[1])];
    let first = outline.first()?.from;
    let [x, y] = outline.iter().fold(first, corner);
    Some([x, y - 4.0])
}
