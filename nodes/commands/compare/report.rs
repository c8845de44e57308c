//! The report of a comparison: tables for people, and the same as JSON together with the objects.

use super::tally::{Tally, Unlike, share_below};
use conicflow_dataflow::Table;
use conicflow_lab::score::pairing::Difference;
use conicflow_messages::{Object, ObjectKind, ToJson as _};
use indexmap::IndexSet;
use serde_json::{Value as Json, json};
use std::fmt::{self, Display};

/// Number of frames that are listed.
const POINTED_OUT: usize = 5;

/// Two variants and their counts.
pub(super) struct Variants<'a> {
    pub(super) topic: &'a str,
    /// The parameters that each sets.
    pub(super) sets: [&'a [String]; 2],
    pub(super) tally: &'a Tally,
}

/// A quantity in which objects differ, and the kinds of objects that have it.
struct Quantity {
    name: &'static str,
    unit: &'static str,
    key: &'static str,
    of: fn(&Difference) -> f64,
    has: fn(ObjectKind) -> bool,
    /// Whether the difference has a sign; a distance, an angle and a ratio have none.
    is_signed: bool,
}

const QUANTITIES: [Quantity; 5] = [
    Quantity {
        name: "position",
        unit: "mm",
        key: "position_mm",
        of: |d| 1e3 * d.position_m,
        has: |_| true,
        is_signed: false,
    },
    Quantity { name: "radius", unit: "mm", key: "radius_mm", of: |d| 1e3 * d.radius_m, has: |_| true, is_signed: true },
    Quantity {
        name: "axis",
        unit: "deg",
        key: "axis_deg",
        of: |d| d.axis.to_degrees(),
        has: ObjectKind::has_axis,
        is_signed: false,
    },
    Quantity {
        name: "half-angle",
        unit: "deg",
        key: "half_angle_deg",
        of: |d| d.half_angle.to_degrees(),
        has: ObjectKind::has_half_angle,
        is_signed: true,
    },
    Quantity {
        name: "sigma of radius",
        unit: "B / A",
        key: "radius_sigma_ratio",
        of: |d| d.radius_sigma,
        has: |_| true,
        is_signed: false,
    },
];

/// Names the parameters that a variant sets.
pub(super) fn words(set: &[String]) -> String {
    if set.is_empty() { "the file as it stands".to_owned() } else { set.join(" ") }
}

fn cell(number: Option<f64>, digits: usize) -> String {
    number.map_or_else(|| "-".to_owned(), |number| format!("{number:.digits$}"))
}

impl Variants<'_> {
    /// Returns the differences of one quantity.
    fn values(&self, quantity: &Quantity) -> impl Iterator<Item = f64> + Clone {
        let having = self.tally.differences.iter().filter(|(kind, _)| (quantity.has)(*kind));
        having.map(|(_, difference)| (quantity.of)(difference))
    }

    fn found(&self) -> Table {
        let mut table = Table::new(&["FOUND", "", "A", "B", "both", "only A", "only B"]);
        let mut all = [0; 5];
        for (kind, counts) in &self.tally.kinds {
            all.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
            table.row([kind.name().to_owned(), String::new()].into_iter().chain(counts.iter().map(u64::to_string)));
        }
        table.row(["all".to_owned(), String::new()].into_iter().chain(all.iter().map(u64::to_string)));
        table
    }

    fn differences(&self) -> Table {
        let mut table = Table::new(&["DIFFERENCE", "UNIT", "B - A", "size", "90 %", "greatest"]);
        for quantity in &QUANTITIES {
            let values = self.values(quantity);
            let sizes = || values.clone().map(f64::abs);
            if let Some(middle) = share_below(sizes(), 0.5) {
                let signed = share_below(values.clone(), 0.5).filter(|_| quantity.is_signed);
                let figures = [signed, Some(middle), share_below(sizes(), 0.9), share_below(sizes(), 1.0)];
                let names = [quantity.name, quantity.unit].map(str::to_owned).into_iter();
                table.row(names.chain(figures.map(|figure| cell(figure, 2))));
            }
        }
        table
    }

    fn times(&self) -> Table {
        let mut table = Table::new(&["TIME", "UNIT", "A p50", "p90", "B p50", "p90", "B / A"]);
        let together = ("together".to_owned(), self.tally.together.clone());
        for (stage, times) in self.tally.times.iter().skip(1).chain([(&together.0, &together.1)]) {
            let at = |variant: usize, share: f64| share_below(times[variant].iter().copied(), share);
            let ratio = at(1, 0.5).zip(at(0, 0.5)).map(|(b, a)| b / a);
            let figures = [at(0, 0.5), at(0, 0.9), at(1, 0.5), at(1, 0.9), ratio].map(|figure| cell(figure, 2));
            table.row([stage.clone(), "ms".to_owned()].into_iter().chain(figures));
        }
        table
    }

    /// Returns the scores of both against the truth, if that is known.
    fn scores(&self) -> Option<Table> {
        let mut table = Table::new(&["TRUTH", "", "A", "B"]);
        let [a, b] = &self.tally.scores;
        let rows = [a.as_ref()?, b.as_ref()?];
        let columns: IndexSet<&String> = rows.iter().flat_map(|row| &row.0).map(|(column, _)| column).collect();
        for column in columns.into_iter().filter(|column| *column != "frames") {
            let numbers = rows.map(|row| row.number_of(column));
            let digits = if numbers.iter().flatten().all(|number| number.fract() == 0.0) { 0 } else { 3 };
            let figures = numbers.map(|number| cell(number, digits));
            table.row([column.replace('_', " "), String::new()].into_iter().chain(figures));
        }
        Some(table)
    }

    /// Returns the frames with the most differences, in descending order.
    fn most_unlike(&self) -> Vec<&Unlike> {
        let mut unlike: Vec<_> = self.tally.unlike.iter().collect();
        unlike.sort_by_key(|frame| std::cmp::Reverse(frame.count()));
        unlike.truncate(POINTED_OUT);
        unlike
    }

    /// Returns all results in the units of their keys; objects are as in `json_sink`.
    pub(super) fn json(&self) -> Json {
        let tally = self.tally;
        let kinds = tally.kinds.iter().map(|(kind, [a, b, both, only_a, only_b])| {
            let counts = json!({ "a": a, "b": b, "both": both, "only_a": only_a, "only_b": only_b });
            (kind.name().to_owned(), counts)
        });
        let other_kind =
            tally.other_kind.iter().map(|((a, b), count)| json!({ "a": a.name(), "b": b.name(), "times": count }));
        let differences = QUANTITIES.iter().map(|quantity| {
            let values = self.values(quantity);
            let [p50, p90, greatest] = [0.5, 0.9, 1.0].map(|share| share_below(values.clone().map(f64::abs), share));
            let signed = share_below(values, 0.5);
            (
                quantity.key.to_owned(),
                json!({ "median": signed, "size_p50": p50, "size_p90": p90, "greatest": greatest }),
            )
        });
        let variant = |index: usize| {
            let times = tally.times.iter().map(|(stage, times)| {
                let [p50, p90] = [0.5, 0.9].map(|share| share_below(times[index].iter().copied(), share));
                (stage.clone(), json!({ "p50": p50, "p90": p90 }))
            });
            let together = share_below(tally.together[index].iter().copied(), 0.5);
            let times = Json::Object(times.collect());
            json!({ "set": self.sets[index], "times_ms": times, "together_ms": together, "score": tally.scores[index] })
        };
        json!({
            "topic": self.topic, "frames": tally.frames, "same_frames": tally.same, "a": variant(0), "b": variant(1),
            "found": Json::Object(kinds.collect()), "other_kind": other_kind.collect::<Json>(),
            "differences": Json::Object(differences.collect()),
            "unlike": tally.unlike.iter().map(unlike_json).collect::<Json>(),
        })
    }
}

fn unlike_json(frame: &Unlike) -> Json {
    let object = |object: &Object| serde_json::to_value(object.to_json()).unwrap_or_default();
    let objects = |objects: &[Object]| objects.iter().map(object).collect::<Json>();
    let pairs = frame.other_kind.iter().map(|(a, b)| json!({ "a": object(a), "b": object(b) }));
    json!({
        "sequence": frame.sequence, "source": frame.source, "only_a": objects(&frame.only_a),
        "only_b": objects(&frame.only_b), "other_kind": pairs.collect::<Json>(),
    })
}

impl Display for Variants<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let tally = self.tally;
        writeln!(f, "a: {}\nb: {}", words(self.sets[0]), words(self.sets[1]))?;
        writeln!(f, "{} frames, `{}`; the same to the bit in {}\n", tally.frames, self.topic, tally.same)?;
        write!(f, "{}", self.found())?;
        for ((a, b), count) in &tally.other_kind {
            let times = if *count == 1 { "once".to_owned() } else { format!("{count} times") };
            writeln!(f, "{} in A, {} in B: {times}", a.name(), b.name())?;
        }
        if !tally.differences.is_empty() {
            write!(f, "\n{}", self.differences())?;
        }
        write!(f, "\n{}", self.times())?;
        if let Some(scores) = self.scores() {
            write!(f, "\n{scores}")?;
        }
        let unlike = self.most_unlike();
        if !unlike.is_empty() {
            writeln!(f, "\nmost unlike:")?;
        }
        for frame in unlike {
            let [a, b, other] = [frame.only_a.len(), frame.only_b.len(), frame.other_kind.len()];
            writeln!(
                f,
                "  frame {} ({}): {a} only A, {b} only B, {other} of another kind",
                frame.sequence, frame.source
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_signed_values_have_a_bias_in_the_table_even_if_all_differences_are_positive() {
        let difference =
            Difference { position_m: 0.002, radius_m: 0.001, axis: 0.1, half_angle: 0.1, radius_sigma: 1.5 };
        let tally = Tally { differences: vec![(ObjectKind::Cone, difference)], ..Tally::default() };
        let table = Variants { topic: "objects", sets: [&[], &[]], tally: &tally }.differences().to_string();
        let signed = |name: &str| table.lines().find(|line| line.starts_with(name)).unwrap().split_whitespace().nth(2);
        assert_eq!([signed("position"), signed("radius"), signed("axis")], [Some("-"), Some("1.00"), Some("-")]);
    }
}
