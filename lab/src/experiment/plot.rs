//! Plots as SVG: lines of an experiment's rows or of a trace. Columns with a standard deviation get bars, the truth is a black
//! line in front, and the paper's figures are open circles.

use super::axes::Axis;
use super::definition::{Experiment, Plot};
use super::output_file;
use crate::score::{Figure, Row};
use anyhow::{Context as _, Result};
use indexmap::{IndexMap, IndexSet};
use std::collections::BTreeMap;
use std::fmt::{self, Write};
use std::path::Path;

const WIDTH: f64 = 780.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 760.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 410.0;
/// Position where the legend begins, below the axes.
const LEGEND: f64 = BOTTOM + 62.0;
/// Height of a line of the legend.
const LEGEND_STEP: f64 = 18.0;
/// Upper estimate of the width of a letter.
const LETTER: f64 = 7.0;
/// Width of the mark before the text of an entry in the legend.
const MARK: f64 = 32.0;
/// Distance between dots at the same position, if they have bars.
const ASIDE: f64 = 9.0;
/// The column with the time in a trace.
const TIME: &str = "time_s";
/// Endings of columns' names, and their units.
const UNITS: [(&str, &str); 6] =
    [("_mps", "m/s"), ("_ms", "ms"), ("_deg", "degrees"), ("_hz", "Hz"), ("_m", "m"), ("_s", "s")];
/// Colours that most colour-blind people can distinguish (Okabe and Ito 2008).
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

/// A line or series of points in one colour.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Line {
    /// Its name in the legend; an empty one is left out.
    name: String,
    /// A point that is NaN interrupts the line.
    points: Vec<[f64; 2]>,
    /// Standard deviations of the points; 0 if unknown.
    deviations: Vec<f64>,
    style: Style,
}

/// The style of a line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Style {
    /// Connected dots, with bars.
    #[default]
    Measured,
    /// Open circles that are not connected.
    Paper,
    /// A black line in front.
    Truth,
}

/// Draws the plot of an experiment.
///
/// # Errors
/// A file cannot be read or written.
pub fn draw(experiment: &Experiment, rows: &[Row], base: &Path) -> Result<()> {
    let Some(plot) = &experiment.plot else { return Ok(()) };
    let lines = match &plot.trace {
        Some(trace) => lines(plot, &read_csv(&base.join(trace))?),
        None => {
            let rows: Vec<Row> = rows.iter().filter(|row| is_drawn(plot, row)).cloned().collect();
            [lines(plot, &rows), paper_lines(experiment, plot, &rows)].concat()
        }
    };
    // The description after the semicolon has no room here.
    let title = experiment.title.split(';').next().unwrap_or_default();
    let text = svg(title, plot, &lines).unwrap_or_default();
    output_file::write(base, &plot.path, text)
}

fn is_drawn(plot: &Plot, row: &Row) -> bool {
    plot.only.iter().all(|(column, cell)| row.get(column) == Some(cell))
}

fn lines(plot: &Plot, rows: &[Row]) -> Vec<Line> {
    let columns = |is_wanted: fn(&str) -> bool| plot.y.iter().filter(move |column| is_wanted(column)).cloned();
    let number = |row: &Row, column: &str| row.number_of(column);
    let measured = Plot { y: columns(|column| !is_true(column)).collect(), ..plot.clone() };
    let mut truths: Vec<String> =
        columns(is_true).chain(measured.y.iter().filter_map(|column| beside(column, "true"))).collect();
    truths.dedup();
    let mut lines = gather(&measured, rows, "", &number);
    let mut known: Vec<Line> = Vec::new();
    for mut line in gather(&Plot { y: truths, ..plot.clone() }, rows, "", &number) {
        line.style = Style::Truth;
        line.name = line.name.split(", ").next().unwrap_or_default().to_owned();
        line.deviations.clear();
        line.points.dedup();
        // The same truth of several lines is drawn once, and truths of the same name have one entry in the legend.
        if known.iter().all(|other| other.points != line.points) {
            if known.iter().any(|other| other.name == line.name) {
                line.name.clear();
            }
            known.push(line);
        }
    }
    lines.extend(known);
    lines
}

/// Returns the paper's figures as circles, one for each position that has one.
fn paper_lines(experiment: &Experiment, plot: &Plot, rows: &[Row]) -> Vec<Line> {
    let Some(paper) = &experiment.paper else { return Vec::new() };
    let shared_columns = plot.lines.iter().filter(|column| paper.r#match.contains(column)).cloned().collect();
    let plot = Plot { lines: shared_columns, ..plot.clone() };
    let mut lines = gather(&plot, rows, "the paper, ", &|row, column| match paper.figure(row, column) {
        Some(Figure::Number(number)) => Some(*number),
        _ => None,
    });
    for line in &mut lines {
        line.style = Style::Paper;
        line.deviations.clear();
        line.points.dedup();
    }
    lines
}

fn gather(plot: &Plot, rows: &[Row], prefix: &str, number: &dyn Fn(&Row, &str) -> Option<f64>) -> Vec<Line> {
    let mut lines: IndexMap<String, Line> = IndexMap::new();
    let step_s = step_s(rows);
    for column in &plot.y {
        let deviations = beside(column, "sd");
        // The true position is known also while the object is not seen.
        let true_x = beside(&plot.x, "true").filter(|_| is_true(column));
        let mut times: BTreeMap<String, f64> = BTreeMap::new();
        for row in rows {
            let x = true_x.as_ref().and_then(|column| row.number_of(column)).or_else(|| row.number_of(&plot.x));
            let (Some(x), Some(y)) = (x, number(row, column)) else { continue };
            let name = format!("{prefix}{}", name(plot, row, column));
            let line = lines.entry(name.clone()).or_insert_with(|| Line { name: name.clone(), ..Line::default() });
            if let (Some(step_s), Some(time_s)) = (step_s, row.number_of(TIME))
                && times.insert(name, time_s).is_some_and(|before_s| time_s - before_s > 1.5 * step_s)
            {
                line.points.push([f64::NAN; 2]);
                line.deviations.push(0.0);
            }
            line.points.push([x, y]);
            let deviation = deviations.as_ref().and_then(|column| number(row, column));
            line.deviations.push(deviation.unwrap_or(0.0));
        }
    }
    lines.into_values().collect()
}

/// Returns the time between consecutive frames of a trace.
fn step_s(rows: &[Row]) -> Option<f64> {
    let times = || rows.iter().filter_map(|row| row.number_of(TIME));
    times().zip(times().skip(1)).map(|(before, after)| after - before).filter(|step| *step > 0.0).reduce(f64::min)
}

/// Returns a column's name in words and its unit, if its name ends with one.
fn quantity(column: &str) -> (String, Option<&'static str>) {
    let end = UNITS.iter().find_map(|(end, unit)| Some((column.strip_suffix(end)?, *unit)));
    let (words, unit) = end.map_or((column, None), |(words, unit)| (words, Some(unit)));
    let name = words.strip_suffix("_true").map_or(words.to_owned(), |words| format!("true {words}"));
    (name.replace('_', " "), unit)
}

/// Returns the column with the truth (`true`) or the standard deviation (`sd`) of another, by this program's naming.
fn beside(column: &str, word: &str) -> Option<String> {
    let (words, end) = UNITS.iter().find_map(|(end, _)| Some((column.strip_suffix(end)?, end)))?;
    (!is_true(column)).then(|| format!("{words}_{word}{end}"))
}

/// Whether a column contains the truth.
fn is_true(column: &str) -> bool {
    quantity(column).0.starts_with("true ")
}

/// Returns the label of an axis with these columns: each quantity once, measured or true, with its unit.
fn axis_label(columns: &[String]) -> String {
    let label = |column: &String| {
        let (name, unit) = quantity(column);
        let name = name.strip_prefix("true ").unwrap_or(&name).to_owned();
        unit.map_or(name.clone(), |unit| format!("{name} in {unit}"))
    };
    let labels: IndexSet<String> = columns.iter().map(label).collect();
    labels.into_iter().collect::<Vec<_>>().join(", ")
}

fn name(plot: &Plot, row: &Row, column: &str) -> String {
    let labels = plot.lines.iter().filter_map(|key| match row.get(key)? {
        Figure::Text(text) => Some(text.clone()),
        Figure::Number(number) => Some(format!("{key} {number}")),
    });
    let is_reported = plot.y.len() > 1 || plot.lines.is_empty() || is_true(column);
    let column = is_reported.then(|| quantity(column).0);
    column.into_iter().chain(labels).collect::<Vec<_>>().join(", ")
}

/// Reads a CSV file as the sinks write it.
fn read_csv(path: &Path) -> Result<Vec<Row>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read `{}`", path.display()))?;
    let mut records = csv::Reader::from_reader(text.as_bytes());
    let titles = records.headers()?.clone();
    let row = |record: csv::StringRecord| {
        let mut row = Row::default();
        for (title, cell) in titles.iter().zip(&record).filter(|(_, cell)| !cell.is_empty()) {
            match cell.parse() {
                Ok(number) => row.number(title, number),
                Err(_) => row.text(title, cell),
            }
        }
        row
    };
    Ok(records.records().map(|record| record.map(row)).collect::<Result<_, _>>()?)
}

fn svg(title: &str, plot: &Plot, lines: &[Line]) -> Result<String, fmt::Error> {
    let along = |index: usize| lines.iter().flat_map(move |line| line.points.iter().map(move |point| point[index]));
    let bars = lines.iter().flat_map(|line| line.bars().flat_map(|[_, low, high]| [low, high]));
    let x = Axis::holding(along(0), [LEFT, RIGHT], plot.logarithmic);
    let y = Axis::holding(along(1).chain(bars), [BOTTOM, TOP], plot.logarithmic);
    let [width, height] = paper_size(lines);
    let mut text = String::new();
    writeln!(
        text,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <text x=\"{LEFT}\" y=\"24\" font-size=\"15\">{}</text>",
        escaped(title)
    )?;
    if let (Some(x), Some(y)) = (x, y) {
        frame(&mut text, plot, &x, &y)?;
        let columns = legend_columns(lines);
        let with_bars = lines.iter().filter(|line| line.bars().next().is_some()).count();
        let (mut entries, mut aside) = (0, -0.5 * ASIDE * with_bars.saturating_sub(1) as f64);
        for (index, line) in lines.iter().enumerate() {
            let (column, row) = ((entries % columns) as f64, (entries / columns) as f64);
            let mark = [LEFT + 10.0 + column * legend_width(lines), LEGEND + LEGEND_STEP * row];
            entries += usize::from(!line.name.is_empty());
            // Bars at the same position would hide each other.
            let has_bars = line.bars().next().is_some();
            draw_line(&mut text, line, index, mark, [&x, &y], if has_bars { aside } else { 0.0 })?;
            aside += if has_bars { ASIDE } else { 0.0 };
        }
    }
    text += "</svg>\n";
    Ok(text)
}

/// Returns the width of a legend's entry with its mark.
fn legend_width(lines: &[Line]) -> f64 {
    let longest = lines.iter().map(|line| line.name.chars().count()).max().unwrap_or(0);
    MARK + LETTER * longest as f64
}

/// Returns the number of legend entries side by side.
fn legend_columns(lines: &[Line]) -> usize {
    (((RIGHT - LEFT) / legend_width(lines)) as usize).max(1)
}

/// Returns width and height of a drawing with room for its legend below the axes.
fn paper_size(lines: &[Line]) -> [f64; 2] {
    let entries = lines.iter().filter(|line| !line.name.is_empty()).count();
    let rows = entries.div_ceil(legend_columns(lines)) as f64;
    [WIDTH.max(LEFT + 10.0 + legend_width(lines)), LEGEND + LEGEND_STEP * rows]
}

fn frame(text: &mut String, plot: &Plot, x: &Axis, y: &Axis) -> fmt::Result {
    let (width, height) = (RIGHT - LEFT, BOTTOM - TOP);
    writeln!(
        text,
        "<rect x=\"{LEFT}\" y=\"{TOP}\" width=\"{width}\" height=\"{height}\" fill=\"none\" stroke=\"#888\"/>"
    )?;
    for (number, label) in x.ticks() {
        let Some(place) = x.place(number) else { continue };
        writeln!(text, "<path d=\"M{place:.1} {TOP}V{BOTTOM}\" stroke=\"#ddd\"/>")?;
        writeln!(text, "<text x=\"{place:.1}\" y=\"{}\" text-anchor=\"middle\">{label}</text>", BOTTOM + 16.0)?;
    }
    for (number, label) in y.ticks() {
        let Some(place) = y.place(number) else { continue };
        writeln!(text, "<path d=\"M{LEFT} {place:.1}H{RIGHT}\" stroke=\"#ddd\"/>")?;
        writeln!(text, "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>", LEFT - 6.0, place + 4.0)?;
    }
    let (middle, below) = (0.5 * (LEFT + RIGHT), BOTTOM + 38.0);
    let label = plot.x_label.clone().unwrap_or_else(|| axis_label(std::slice::from_ref(&plot.x)));
    writeln!(text, "<text x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{}</text>", escaped(&label))?;
    let across = 0.5 * (TOP + BOTTOM);
    let columns = escaped(&axis_label(&plot.y));
    writeln!(text, "<text transform=\"translate(20 {across}) rotate(-90)\" text-anchor=\"middle\">{columns}</text>")
}

impl Line {
    /// Returns the bars: x, lower end and upper end.
    fn bars(&self) -> impl Iterator<Item = [f64; 3]> {
        let known = self.points.iter().zip(&self.deviations).filter(|(_, deviation)| **deviation > 0.0);
        known.map(|([x, y], deviation)| [*x, y - deviation, y + deviation])
    }
}

/// Draws a line, shifted to the right by `aside`, and its entry in the legend.
fn draw_line(
    text: &mut String,
    line: &Line,
    index: usize,
    mark: [f64; 2],
    [x, y]: [&Axis; 2],
    aside: f64,
) -> fmt::Result {
    let is_true = line.style == Style::Truth;
    let colour = if is_true { "black" } else { COLOURS[index % COLOURS.len()] };
    for [at, low, high] in line.bars() {
        let (Some(at), Some(low), Some(high)) = (x.place(at), y.place(low), y.place(high)) else { continue };
        let at = at + aside;
        let (left, right) = (at - 3.0, at + 3.0);
        writeln!(
            text,
            "<path d=\"M{left:.1} {low:.1}H{right:.1}M{at:.1} {low:.1}V{high:.1}M{left:.1} {high:.1}H{right:.1}\" \
             stroke=\"{colour}\"/>"
        )?;
    }
    let place = |point: &[f64; 2]| Some([x.place(point[0])? + aside, y.place(point[1])?]);
    let places: Vec<[f64; 2]> = line.points.iter().filter_map(place).collect();
    for points in line.points.split(|point| point[0].is_nan()).filter(|_| line.style != Style::Paper) {
        let points: Vec<String> = points.iter().filter_map(place).map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        writeln!(text, "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\"/>", points.join(" "))?;
    }
    let [left, middle] = mark;
    if is_true && line.name.is_empty() {
        return Ok(());
    }
    if is_true {
        writeln!(text, "<path d=\"M{} {middle}H{}\" stroke=\"{colour}\"/>", left - 8.0, left + 8.0)?;
    } else {
        let fill = if line.style == Style::Paper { "white" } else { colour };
        let radius = if places.len() > 60 { 1.5 } else { 3.5 };
        for [x, y] in places.iter().chain([&mark]) {
            writeln!(text, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\" stroke=\"{colour}\"/>")?;
        }
    }
    writeln!(text, "<text x=\"{}\" y=\"{}\">{}</text>", left + 12.0, middle + 4.0, escaped(&line.name))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot() -> Plot {
        let text = "path = \"a.svg\"\nx = \"d\"\ny = [\"r\"]\nlines = [\"stage\"]";
        toml::from_str(text).unwrap()
    }

    fn row(stage: &str, d: f64, r: f64) -> Row {
        let mut row = Row::default();
        row.text("stage", stage);
        row.number("d", d);
        row.number("r", r);
        row
    }

    #[test]
    fn rows_become_one_line_for_each_kind() {
        let rows = [row("a", 1.0, 2.0), row("b", 1.0, 3.0), row("a", 2.0, 4.0), row("a", 3.0, f64::NAN)];
        let lines = lines(&plot(), &rows);
        let line = |name: &str, points: &[[f64; 2]]| Line {
            name: name.into(),
            points: points.into(),
            deviations: vec![0.0; points.len()],
            style: Style::Measured,
        };
        assert_eq!(lines, [line("a", &[[1.0, 2.0], [2.0, 4.0]]), line("b", &[[1.0, 3.0]])]);
    }

    #[test]
    fn the_truth_is_in_front_once_and_measurements_have_bars() {
        let plot = Plot { y: vec!["radius_m".to_owned()], ..plot() };
        let row = |stage: &str, d: f64, radius: f64, sd: f64| {
            let mut row = row(stage, d, 0.0);
            for (name, number) in [("radius_m", radius), ("radius_sd_m", sd), ("radius_true_m", 0.2)] {
                row.number(name, number);
            }
            row
        };
        let rows =
            [row("a", 1.0, 0.21, 0.05), row("b", 1.0, 0.19, 0.0), row("a", 2.0, 0.22, 0.01), row("b", 2.0, 0.2, 0.0)];
        let lines = lines(&plot, &rows);
        let styles: Vec<_> = lines.iter().map(|line| (line.name.as_str(), line.style)).collect();
        assert_eq!(styles, [("a", Style::Measured), ("b", Style::Measured), ("true radius", Style::Truth)]);
        assert_eq!(lines[2].points, [[1.0, 0.2], [2.0, 0.2]]);
        assert_eq!(
            lines[0].bars().collect::<Vec<_>>(),
            [[1.0, 0.21 - 0.05, 0.21 + 0.05], [2.0, 0.22 - 0.01, 0.22 + 0.01]]
        );
        assert_eq!(lines[1].bars().count() + lines[2].bars().count(), 0);
        let text = svg("radius", &plot, &lines).unwrap();
        let (behind, front) = text.rsplit_once("<polyline").unwrap();
        assert!(front.contains("black") && !behind.contains("black"), "{text}");
        assert!(text.contains(">radius in m</text>") && text.contains(">d</text>"), "{text}");
        assert_eq!(
            axis_label(&["z_true_m".to_owned(), "z_m".to_owned(), "speed_mps".to_owned()]),
            "z in m, speed in m/s"
        );
    }

    #[test]
    fn bars_at_the_same_place_stand_beside_each_other() {
        let plot = Plot { y: vec!["radius_m".to_owned()], x_label: Some("distance in m".to_owned()), ..plot() };
        let row = |stage: &str| {
            let mut row = row(stage, 1.0, 0.0);
            row.number("radius_m", 0.2);
            row.number("radius_sd_m", 0.01);
            row
        };
        let text = svg("radius", &plot, &lines(&plot, &[row("measured"), row("filtered")])).unwrap();
        let dots: Vec<f64> = text
            .lines()
            .filter_map(|line| line.strip_prefix("<circle cx=\"")?.split_once('"')?.0.parse().ok())
            .filter(|x| *x > LEFT + 10.0 + ASIDE)
            .collect();
        assert!(dots.len() >= 2 && dots.contains(&415.5) && dots.contains(&424.5), "{dots:?}");
        assert!(text.contains(">distance in m</text>"), "{text}");
    }

    #[test]
    fn the_truth_goes_on_while_nothing_is_seen_and_is_told_once() {
        let plot = Plot { x: "x_m".to_owned(), y: vec!["z_m".to_owned()], lines: vec!["object".to_owned()], ..plot() };
        let row = |object: &str, time: f64, is_seen: bool| {
            let mut row = Row::default();
            row.text("object", object);
            row.number("x_true_m", time);
            row.number("z_true_m", time * time);
            if is_seen {
                row.number("x_m", time + 0.01);
                row.number("z_m", time * time);
            }
            row
        };
        let rows = [row("a", 1.0, true), row("a", 2.0, false), row("a", 3.0, true), row("b", 5.0, true)];
        assert_eq!(step_s(&rows), None, "without times nothing is parted");
        let lines = lines(&plot, &rows);
        let names: Vec<_> = lines.iter().map(|line| line.name.as_str()).collect();
        assert_eq!(names, ["a", "b", "true z", ""]);
        assert_eq!(lines[2].points, [[1.0, 1.0], [2.0, 4.0], [3.0, 9.0]]);
        assert_eq!(svg("balls", &plot, &lines).unwrap().matches(">true z</text>").count(), 1);
    }

    #[test]
    fn a_line_is_parted_where_frames_are_missing() {
        let row = |time_s: f64| {
            let mut row = row("a", time_s, 2.0);
            row.number(TIME, time_s);
            row
        };
        let rows = [0.0, 0.1, 0.2, 0.7, 0.8].map(row);
        let text = svg("parted", &plot(), &lines(&plot(), &rows)).unwrap();
        let strokes: Vec<_> = text.lines().filter(|line| line.starts_with("<polyline")).collect();
        let points: Vec<_> = strokes.iter().map(|line| line.matches(',').count()).collect();
        assert_eq!(points, [3, 2], "{text}");
    }

    #[test]
    fn a_long_legend_stays_within_the_paper() {
        let row = |index: i32| row(&format!("a kind of measurement with a long name, number {index}"), 1.0, 2.0);
        let text = svg("many", &plot(), &lines(&plot(), &(0..40).map(row).collect::<Vec<_>>())).unwrap();
        let (size, rest) = text.split_once("viewBox=\"0 0 ").unwrap().1.split_once('"').unwrap();
        let size: Vec<f64> = size.split(' ').map(|number| number.parse().unwrap()).collect();
        let last = rest.lines().find(|line| line.contains("number 39<")).unwrap();
        let number = |name: &str| -> f64 {
            last.split_once(&format!("{name}=\"")).unwrap().1.split_once('"').unwrap().0.parse().unwrap()
        };
        let letters = last.split_once('>').unwrap().1.len() - "</text>".len();
        assert!(number(" x") + 6.5 * letters as f64 <= size[0] && number(" y") + 4.0 <= size[1], "{size:?}: {last}");
    }

    #[test]
    fn the_drawing_holds_every_point_and_no_bare_markup() {
        let lines = lines(&plot(), &[row("a<b", 1.0, 2.0), row("a<b", 2.0, 4.0)]);
        let text = svg("r & d", &plot(), &lines).unwrap();
        assert_eq!(text.matches("<circle").count(), 3, "two points and the legend");
        assert!(text.contains("a&lt;b") && text.contains("r &amp; d"));
        assert!(svg("empty", &plot(), &[]).unwrap().ends_with("</svg>\n"));
    }
}
