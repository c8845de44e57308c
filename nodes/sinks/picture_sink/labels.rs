//! Labels beside outlines: kind, confidence and radius; no label covers another.

use super::canvas::{Box2, Canvas, Colour, Size};
use conicflow_messages::{Object, ObjectKind};

const GROUND: Colour = [9, 12, 18];
const PALE: Colour = [228, 233, 242];
/// Space beside the text, in pixels.
const PAD: i64 = 4;
/// Width of the stripe in the colour of the outline, in pixels.
const STRIPE: i64 = 3;
/// Distance of a label from its outline, in pixels.
const GAP: i64 = 5;
/// Width of a picture, in pixels, below which labels have one line.
const NARROW_PX: i64 = 300;

/// The text beside an outline.
pub(super) struct Label {
    pub(super) lines: [String; 2],
    pub(super) colour: Colour,
    /// Confidence, from 0 to 1.
    pub(super) sure: f64,
    /// The bounding rectangle of the outline.
    pub(super) around: Box2,
}

/// `cylinder 98 %` and `r 169.9 ± 0.4 mm`.
pub(super) fn lines(name: &str, object: &Object, note: Option<&str>) -> [String; 2] {
    let mut first = name.to_owned();
    if object.confidence > 0.0 {
        first += &format!(" {:.0} %", 100.0 * object.confidence);
    }
    if let Some(note) = note {
        first = format!("{first} {note}");
    }
    let size = match object.shape() {
        ObjectKind::Cone => {
            let half_angle = with_sigma(object.half_angle.to_degrees(), object.sigma.half_angle.to_degrees());
            format!("base r {:.0} mm, {half_angle}°", 1e3 * object.base_radius)
        }
        _ => format!("r {} mm", with_sigma(1e3 * object.radius, 1e3 * object.sigma.radius)),
    };
    [first, size]
}

/// Formats a number with its standard deviation, to the digits that are significant.
fn with_sigma(number: f64, sigma: f64) -> String {
    let digits = usize::from(sigma < 1.95);
    if sigma > 0.0 { format!("{number:.digits$} ± {sigma:.digits$}") } else { format!("{number:.digits$}") }
}

/// Draws labels into a part of a picture, those of highest confidence first; leaves out labels without room.
pub(super) fn draw(labels: &mut [Label], room: Box2, size: Size, canvas: &mut Canvas) {
    labels.sort_by(|a, b| b.sure.total_cmp(&a.sure));
    let mut taken: Vec<Box2> = Vec::new();
    for (number, label) in labels.iter().enumerate() {
        let lines = &label.lines[..if room.width < NARROW_PX { 1 } else { 2 }];
        let text = lines.iter().map(|line| size.width(line)).max().unwrap_or(0);
        let (width, height) = (text + 2 * PAD + STRIPE, lines.len() as i64 * size.line() + 2);
        if width > room.width || height > room.height {
            continue;
        }
        let inside = |(left, top): (i64, i64)| Box2 {
            left: left.clamp(room.left, room.left + room.width - width),
            top: top.clamp(room.top, room.top + room.height - height),
            width,
            height,
        };
        let places: Vec<_> = places(&label.around, width, height).into_iter().map(inside).collect();
        let is_free = |place: &&Box2| !taken.iter().any(|other| place.overlaps(other));
        let hides = |place: &Box2, of: &dyn Fn(usize) -> bool| {
            labels.iter().enumerate().any(|(other, known)| of(other) && place.overlaps(&known.around))
        };
        let free = || places.iter().filter(is_free);
        let place = free().find(|place| !hides(place, &|_| true));
        let place = place.or_else(|| free().find(|place| !hides(place, &|other| other != number)));
        if let Some(place) = place.or_else(|| free().next()) {
            draw_one(label, lines, (*place, size), canvas);
            taken.push(*place);
        }
    }
}

/// Returns positions for the upper left corner of a label around a rectangle, the best one first.
fn places(around: &Box2, width: i64, height: i64) -> Vec<(i64, i64)> {
    let Box2 { left, top, width: wide, height: high } = *around;
    let (right, bottom) = (left + wide, top + high);
    let (middle, beside) = (left + (wide - width) / 2, top + (high - height) / 2);
    let (above, below) = (top - height - GAP, bottom + GAP);
    let mut places: Vec<_> = [0, -3, 3, -6, 6].map(|tenths| (middle + tenths * width / 10, above)).into();
    places.extend([(right + GAP, beside), (left - width - GAP, beside), (middle, below)]);
    places.extend([(right + GAP, top - height), (left - width - GAP, top - height)]);
    places.extend([(right + GAP, bottom), (left - width - GAP, bottom)]);
    for away in 1..=6 {
        let shift = away * (height + 3);
        places.extend([(middle, above - shift), (right + GAP, beside - shift), (right + GAP, beside + shift)]);
        places.extend([
            (left - width - GAP, beside - shift),
            (left - width - GAP, beside + shift),
            (middle, below + shift),
        ]);
    }
    places
}

fn draw_one(label: &Label, lines: &[String], (place, size): (Box2, Size), canvas: &mut Canvas) {
    let strength = 0.5 + 0.5 * label.sure;
    lead(label, &place, strength, canvas);
    canvas.fill(place, GROUND, 0.8);
    let stripe = Box2 { width: STRIPE, top: place.top + 2, height: place.height - 4, ..place };
    canvas.fill(stripe, label.colour, strength);
    for (index, line) in (0..).zip(lines) {
        let at = (place.left + STRIPE + PAD, place.top + 1 + index * size.line());
        let (is_bold, colour) = if index == 0 { (true, label.colour) } else { (false, PALE) };
        canvas.text(at, line, (size, is_bold, colour, strength));
    }
}

/// Draws a thin line from a label to its outline, unless it is next to it.
fn lead(label: &Label, place: &Box2, strength: f64, canvas: &mut Canvas) {
    let near = |low: i64, length: i64, wanted: i64| wanted.clamp(low, low + length - 1);
    let around = &label.around;
    let to_x = near(around.left, around.width, place.left + place.width / 2);
    let to_y = near(around.top, around.height, place.top + place.height / 2);
    let (from_x, from_y) = (near(place.left, place.width, to_x), near(place.top, place.height, to_y));
    let (from, to) = ([from_x as f64, from_y as f64], [to_x as f64, to_y as f64]);
    if (to[0] - from[0]).hypot(to[1] - from[1]) > 3.0 * GAP as f64 {
        canvas.stroke([(from, to)].into_iter(), 1.0, label.colour, 0.7 * strength);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::ObjectSigma;

    #[test]
    fn a_label_has_the_kind_the_confidence_and_the_size() {
        let sigma = ObjectSigma { radius: 0.000_42, half_angle: 0.3_f64.to_radians(), ..ObjectSigma::default() };
        let can =
            Object { kind: ObjectKind::Cylinder.code(), confidence: 0.984, radius: 0.1699, sigma, ..Object::default() };
        assert_eq!(lines("#3 cylinder", &can, Some("coasting")), ["#3 cylinder 98 % coasting", "r 169.9 ± 0.4 mm"]);
        let sphere = Object { kind: ObjectKind::Sphere.code(), radius: 0.1, ..Object::default() };
        assert_eq!(lines("sphere", &sphere, None), ["sphere", "r 100.0 mm"]);
        let vague = Object { sigma: ObjectSigma { radius: 0.003, ..sigma }, ..sphere };
        assert_eq!(lines("sphere", &vague, None)[1], "r 100 ± 3 mm");
        let half_angle = 13.5_f64.to_radians();
        let cone = Object { kind: ObjectKind::Cone.code(), base_radius: 0.14, half_angle, sigma, ..Object::default() };
        assert_eq!(lines("cone", &cone, None)[1], "base r 140 mm, 13.5 ± 0.3°");
    }

    fn label(number: i64, around: Box2) -> Label {
        let sphere = Object { radius: 0.1 * number as f64, ..Object::default() };
        Label { lines: lines("sphere", &sphere, None), colour: [255; 3], sure: 0.9, around }
    }

    /// Counts the pixels that are not black: overlapping labels would cover fewer.
    #[test]
    fn labels_of_close_objects_do_not_overlap_and_stay_inside() {
        let at = |left: i64, top: i64| Box2 { left, top, width: 30, height: 30 };
        let room = Box2 { left: 0, top: 0, width: 400, height: 300 };
        let painted = |arounds: &[Box2]| {
            let mut canvas = Canvas::default();
            canvas.begin(400, 320);
            canvas.fill(Box2 { height: 320, ..room }, [255, 0, 0], 1.0);
            let mut labels: Vec<_> = (1..).zip(arounds).map(|(number, around)| label(number, *around)).collect();
            draw(&mut labels, room, Size::Small, &mut canvas);
            let darkened =
                canvas.bytes().as_chunks::<3>().0.iter().enumerate().filter(|(_, pixel)| **pixel != [255, 0, 0]);
            let places: Vec<_> = darkened.map(|(index, _)| index / 400).collect();
            assert!(places.iter().all(|row| *row < 300));
            places.len()
        };
        let alone = painted(&[at(10, 5)]);
        assert!(alone > 1500, "{alone}");
        let together = painted(&[at(10, 5), at(12, 8), at(20, 2), at(380, 290)]);
        assert!(together >= 4 * alone, "{together} of {alone} each");
    }

    #[test]
    fn a_label_for_which_there_is_no_room_is_left_out() {
        let mut canvas = Canvas::default();
        canvas.begin(40, 40);
        let room = Box2 { left: 0, top: 0, width: 40, height: 40 };
        draw(&mut [label(1, Box2 { left: 3, top: 3, width: 9, height: 9 })], room, Size::Small, &mut canvas);
        assert!(canvas.bytes().iter().all(|byte| *byte == 0));
    }
}
