//! Plots as SVG: lines of the rows of an experiment, or of a trace, with the paper's figures as open circles.

use super::axes::Axis;
use super::{Experiment, Plot, prepared};
use crate::csv;
use crate::score::{Figure, Row};
use anyhow::{Context as _, Result};
use std::fmt::{self, Write};
use std::path::Path;

const WIDTH: f64 = 780.0;
const HEIGHT: f64 = 460.0;
const LEFT: f64 = 80.0;
const RIGHT: f64 = 520.0;
const TOP: f64 = 40.0;
const BOTTOM: f64 = 410.0;
/// Height of a line of the legend, and the width of its letters, at the least what they take.
const LEGEND_STEP: f64 = 18.0;
const LETTER: f64 = 7.0;
/// Told apart by most eyes that do not see all colours (Okabe and Ito 2008).
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000"];

/// Points of one colour.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Line {
    name: String,
    points: Vec<[f64; 2]>,
    /// Open circles that are not joined.
    circles: bool,
}

/// Draws what an experiment asks for.
///
/// # Errors
/// A file cannot be read or written.
pub fn draw(experiment: &Experiment, rows: &[Row], base: &Path) -> Result<()> {
    let Some(plot) = &experiment.plot else { return Ok(()) };
    let path = prepared(base, &plot.path)?;
    let lines = match &plot.trace {
        Some(trace) => lines(plot, &read_csv(&base.join(trace))?),
        None => {
            let rows: Vec<Row> = rows.iter().filter(|row| is_drawn(plot, row)).cloned().collect();
            [lines(plot, &rows), paper_lines(experiment, plot, &rows)].concat()
        }
    };
    // What the paper says of it stands behind, and has no room here.
    let title = experiment.title.split(';').next().unwrap_or_default();
    let text = svg(title, plot, &lines).unwrap_or_default();
    std::fs::write(&path, text).with_context(|| format!("cannot write `{}`", path.display()))
}

fn is_drawn(plot: &Plot, row: &Row) -> bool {
    plot.only.iter().all(|(column, cell)| row.get(column) == Some(cell))
}

fn lines(plot: &Plot, rows: &[Row]) -> Vec<Line> {
    gather(plot, rows, "", &|row, column| row.number_of(column))
}

/// The paper's figures, once for each place that one has.
fn paper_lines(experiment: &Experiment, plot: &Plot, rows: &[Row]) -> Vec<Line> {
    let Some(paper) = &experiment.paper else { return Vec::new() };
    let told_apart = plot.lines.iter().filter(|column| paper.r#match.contains(column)).cloned().collect();
    let plot = Plot { lines: told_apart, ..plot.clone() };
    let mut lines = gather(&plot, rows, "the paper ", &|row, column| match paper.figure(row, column) {
        Some(Figure::Number(number)) => Some(*number),
        _ => None,
    });
    for line in &mut lines {
        line.circles = true;
        line.points.dedup();
    }
    lines
}

fn gather(plot: &Plot, rows: &[Row], prefix: &str, number: &dyn Fn(&Row, &str) -> Option<f64>) -> Vec<Line> {
    let mut lines: Vec<Line> = Vec::new();
    for column in &plot.y {
        for row in rows {
            let (Some(x), Some(y)) = (row.number_of(&plot.x), number(row, column)) else { continue };
            let name = format!("{prefix}{}", name(plot, row, column));
            let index = lines.iter().position(|line| line.name == name).unwrap_or_else(|| {
                lines.push(Line { name, ..Line::default() });
                lines.len() - 1
            });
            lines[index].points.push([x, y]);
        }
    }
    lines
}

fn name(plot: &Plot, row: &Row, column: &str) -> String {
    let told = plot.lines.iter().filter_map(|key| match row.get(key)? {
        Figure::Text(text) => Some(text.clone()),
        Figure::Number(number) => Some(format!("{key} {number}")),
    });
    let column = (plot.y.len() > 1 || plot.lines.is_empty()).then(|| column.to_owned());
    column.into_iter().chain(told).collect::<Vec<_>>().join(", ")
}

/// A CSV file, as the sinks write it.
fn read_csv(path: &Path) -> Result<Vec<Row>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read `{}`", path.display()))?;
    let mut records = csv::records(&text).into_iter();
    let titles = records.next().unwrap_or_default();
    let row = |record: Vec<String>| {
        let mut row = Row::default();
        for (title, cell) in titles.iter().zip(&record).filter(|(_, cell)| !cell.is_empty()) {
            match cell.parse() {
                Ok(number) => row.number(title, number),
                Err(_) => row.text(title, cell),
            }
        }
        row
    };
    Ok(records.map(row).collect())
}

fn svg(title: &str, plot: &Plot, lines: &[Line]) -> Result<String, fmt::Error> {
    let along = |index: usize| lines.iter().flat_map(move |line| line.points.iter().map(move |point| point[index]));
    let x = Axis::holding(along(0), [LEFT, RIGHT], plot.logarithmic);
    let y = Axis::holding(along(1), [BOTTOM, TOP], plot.logarithmic);
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
        for (index, line) in lines.iter().enumerate() {
            draw_line(&mut text, line, index, &x, &y)?;
        }
    }
    text += "</svg>\n";
    Ok(text)
}

/// Width and height of a drawing that has room for its legend, beside the axes.
fn paper_size(lines: &[Line]) -> [f64; 2] {
    let longest = lines.iter().map(|line| line.name.chars().count()).max().unwrap_or(0);
    let legend = [RIGHT + 32.0 + LETTER * longest as f64, TOP + 10.0 + LEGEND_STEP * lines.len() as f64];
    [WIDTH.max(legend[0]), HEIGHT.max(legend[1])]
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
    writeln!(text, "<text x=\"{middle}\" y=\"{below}\" text-anchor=\"middle\">{}</text>", escaped(&plot.x))?;
    let across = 0.5 * (TOP + BOTTOM);
    let columns = escaped(&plot.y.join(", "));
    writeln!(text, "<text transform=\"translate(20 {across}) rotate(-90)\" text-anchor=\"middle\">{columns}</text>")
}

fn draw_line(text: &mut String, line: &Line, index: usize, x: &Axis, y: &Axis) -> fmt::Result {
    let colour = COLOURS[index % COLOURS.len()];
    let places: Vec<[f64; 2]> =
        line.points.iter().filter_map(|point| Some([x.place(point[0])?, y.place(point[1])?])).collect();
    let fill = if line.circles { "white" } else { colour };
    if !line.circles {
        let points: Vec<String> = places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        writeln!(text, "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\"/>", points.join(" "))?;
    }
    let radius = if places.len() > 60 { 1.5 } else { 3.5 };
    let marks = [RIGHT + 16.0, TOP + 10.0 + LEGEND_STEP * index as f64];
    for [x, y] in places.iter().chain([&marks]) {
        writeln!(text, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\" stroke=\"{colour}\"/>")?;
    }
    writeln!(text, "<text x=\"{}\" y=\"{}\">{}</text>", marks[0] + 10.0, marks[1] + 4.0, escaped(&line.name))
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
        let line = |name: &str, points: &[[f64; 2]]| Line { name: name.into(), points: points.into(), circles: false };
        assert_eq!(lines, [line("a", &[[1.0, 2.0], [2.0, 4.0]]), line("b", &[[1.0, 3.0]])]);
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
