//! Growth of an object: a model starts from a few neighbouring arcs, and takes in line after line the arcs that it explains.

use super::arcs::{Arc, Arcs, Residual};
use super::model::{self, Model, Predictor};
use super::parameters::AssemblerParameters;
use super::region::Region;
use super::rejection::Rejection;
use conicflow_messages::ObjectKind;

/// Most arcs of a chain on each side of its seed.
const MAX_CHAIN_SIDE: usize = 12; // [algorithmic]
/// Number of arcs in the middle of a chain that are tried if no model explains the whole chain.
const CORE_ARCS: usize = 9; // [algorithmic]
/// Fewest arcs that a model is fitted to.
const MIN_FIT_ARCS: usize = 5; // [algorithmic]
/// Most rounds of growing and refitting; each round triples the extent at most.
const MAX_ROUNDS: usize = 7; // [algorithmic]
/// Fewest standard deviations by which the summed bulge of a chain has to exceed that of straight arcs.
const CHAIN_SIGMAS: f64 = 3.0; // [sigmas]
/// Mean and variance of the bulge of a straight arc with noise: zero for one arc in two, else chi squared with one degree of
/// freedom.
const STRAIGHT: [f64; 2] = [0.5, 1.25]; // [derived] [derived]
/// Margin in pixels on both sides of the arcs of one line, within which arcs of the next line are accepted.
const BESIDE_MARGIN_PX: i64 = 2; // [tuned]
/// Length of the arcs of one line, in pixels, for which [`BESIDE_MARGIN_PX`] grows by one pixel.
const BESIDE_MARGIN_DIVISOR: i64 = 8; // [tuned]
/// Least number of lines by which a model may grow in one round, even if it has fewer lines.
const LEAST_STEP: i64 = 4; // [algorithmic]
/// Widest gap that is bridged, as a part of the lines of the object: something may stand in front of it.
const MAX_GAP_SHARE: f64 = 0.5; // [tuned]
/// Fewest lines beyond a gap, for each line of the gap: fewer are dropped. Beyond a wide gap many lines are tried, and a model
/// explains a few by chance, such as a line of the lid of a can where its far wall would be.
const MIN_LINES_PER_GAP_LINE: f64 = 0.1; // [tuned]

/// Standard deviations by which a radius has to exceed its limit for the model to count as a wall.
const WALL_SIGMAS: f64 = 4.0; // [sigmas]

/// Gate on the residuals of an arc from a model to which it may belong.
pub(crate) struct Gate {
    /// Standard deviations by which the mean, and the mean square less that of the noise, may differ from zero, given the noise
    /// and the uncertainty of the model.
    scatter: f64,
    /// Mean square by which the surface may differ from its model besides the noise, in variances of a point. All points of an
    /// arc may be off alike, so the mean may be off by the root of it.
    slack: f64,
}

/// Gate of one more arc while a model grows.
const GROWING: Gate = Gate { scatter: 2.5, slack: 0.3 }; // [sigmas] [tuned]
/// Gate of all arcs of the first fit together.
const FIRST: Gate = Gate { scatter: 3.0, slack: 0.5 }; // [sigmas] [tuned]
/// Gate of each arc of a grown model.
const SETTLED: Gate = Gate { scatter: 2.5, slack: 0.15 }; // [sigmas] [tuned]
/// Gate of the first and the last arcs of a grown model, where an object meets the floor, a rim or another object.
const AT_ENDS: Gate = Gate { scatter: 1.2, slack: 0.0 }; // [sigmas]
/// Gate of arcs beyond a grown model: an arc that is off by more than noise explains is of another surface.
pub(crate) const NOISE_ONLY: Gate = Gate { scatter: 2.5, slack: 0.0 }; // [sigmas]
/// Factor on the variance of the model in the gate on a mean square: the variance is evaluated in the middle of the arc, and it
/// is larger elsewhere on the arc.
const ALONG_ARC: f64 = 4.0; // [tuned]

impl Gate {
    /// Returns whether an arc may have this residual, given the variance of the model at the arc, in square metres.
    pub fn admits(&self, arc: &Arc, residual: &Residual, uncertainty: f64) -> bool {
        let square = arc.variance * self.square_limit(arc.points) + ALONG_ARC * uncertainty;
        let scatter = (arc.variance / arc.points + uncertainty).sqrt();
        residual.square <= square && residual.mean.abs() <= (self.slack * arc.variance).sqrt() + self.scatter * scatter
    }

    /// Returns the limit on the mean square, in variances of a point.
    fn square_limit(&self, points: f64) -> f64 {
        self.slack + self.scatter * (2.0 / points).sqrt()
    }
}

/// Collects the seed with its neighbours on both sides, in the order of the lines.
pub(crate) fn chain(arcs: &Arcs, seed: usize, gap: i64, free: impl Fn(usize) -> bool + Copy, chain: &mut Vec<usize>) {
    chain.clear();
    for side in [-1, 1] {
        let mut at = seed;
        for _ in 0..MAX_CHAIN_SIDE {
            let Some(next) = arcs.beside(at, side, gap, free) else { break };
            chain.push(next);
            at = next;
        }
        if side < 0 {
            chain.reverse();
            chain.push(seed);
        }
    }
}

/// Checks that a chain has enough arcs, and that together they are surely curved.
pub(crate) fn is_promising(arcs: &Arcs, chain: &[usize], parameters: &AssemblerParameters) -> Result<(), Rejection> {
    if chain.len() < parameters.pooled.min_lines as usize {
        return Err(Rejection::FewLines);
    }
    let bulge: f64 = chain.iter().map(|&index| arcs.arcs[index].bulge).sum();
    let [mean, variance] = STRAIGHT.map(|moment| moment * chain.len() as f64);
    let variance = variance * arcs.shared_lines(chain);
    if bulge > mean + CHAIN_SIGMAS * variance.sqrt() { Ok(()) } else { Err(Rejection::Flat) }
}

/// Buffers of the growth.
#[derive(Debug, Default)]
pub(crate) struct RegionGrower {
    /// The seed with its neighbours.
    pub chain: Vec<usize>,
    spare: Vec<usize>,
    /// The members of each shape.
    pub members: [Vec<usize>; ObjectKind::ALL.len()],
}

impl RegionGrower {
    /// Grows a sphere, a cylinder and a cone from the chain; returns each model, or why it was rejected. If a cylinder explains
    /// the whole chain, a sphere has to explain it all, too. A cone starts from the lines that the cylinder reached, because its
    /// slope shows only over many lines.
    pub fn models(
        &mut self,
        arcs: &Arcs,
        parameters: &AssemblerParameters,
        free: impl Fn(usize) -> bool + Copy,
    ) -> [Result<Model, Rejection>; 3] {
        let Self { chain, spare, members: [spheres, cylinders, cones], .. } = self;
        let mut grow = |start: &Start, members: &mut Vec<usize>| grow(arcs, start, parameters, free, members, spare);
        let start = Start { kind: ObjectKind::Cylinder, chain, guess: None, middle_suffices: true };
        let Growth { grown: cylinder, from_whole } = grow(&start, cylinders);
        let sphere = grow(&Start { kind: ObjectKind::Sphere, middle_suffices: !from_whole, ..start }, spheres).grown;
        let guess = cylinder.as_ref().ok();
        let longer = if guess.is_some() && cylinders.len() > chain.len() { &*cylinders } else { &*chain };
        let cone = grow(&Start { kind: ObjectKind::Cone, chain: longer, guess, ..start }, cones).grown;
        [sphere, cylinder, cone]
    }
}

/// Start of a growth.
#[derive(Clone, Copy)]
struct Start<'a> {
    pub kind: ObjectKind,
    pub chain: &'a [usize],
    /// A model of the chain as first guess, of this or another kind.
    pub guess: Option<&'a Model>,
    /// Whether a model of the middle of the chain suffices if the ends spoil the whole.
    pub middle_suffices: bool,
}

/// Result of a growth.
struct Growth {
    pub grown: Result<Model, Rejection>,
    /// Whether the first model of the growth explained the whole chain.
    pub from_whole: bool,
}

/// Grows a model of one kind from a chain; puts the arcs that it explains into `members`, in the order of the lines. `spare` is a
/// buffer.
fn grow(
    arcs: &Arcs,
    start: &Start,
    parameters: &AssemblerParameters,
    free: impl Fn(usize) -> bool + Copy,
    members: &mut Vec<usize>,
    spare: &mut Vec<usize>,
) -> Growth {
    let first = first(arcs, start, members);
    let from_whole = first.is_some() && members.len() == start.chain.len();
    let first = first.ok_or(Rejection::NotGrown);
    Growth { grown: first.and_then(|first| grow_on(arcs, first, parameters, free, members, spare)), from_whole }
}

/// Takes in the arcs that the model explains and fits it again, as long as it grows; gives up a model that is a wall.
fn grow_on(
    arcs: &Arcs,
    mut model: Model,
    parameters: &AssemblerParameters,
    free: impl Fn(usize) -> bool + Copy,
    members: &mut Vec<usize>,
    spare: &mut Vec<usize>,
) -> Result<Model, Rejection> {
    let kind = model.kind();
    for round in 0..MAX_ROUNDS {
        reach(&Region { arcs, model, members }, parameters.max_gap(), free, spare);
        if spare.len() < MIN_FIT_ARCS {
            return Err(Rejection::NotGrown);
        }
        if round > 0 && spare == members {
            break;
        }
        std::mem::swap(members, spare);
        model = model::fit(kind, &arcs.of(members), Some(&model), f64::INFINITY).ok_or(Rejection::NotGrown)?;
        let (radius, variance) = model.radius();
        let sigma = (variance * arcs.shared_lines(members)).sqrt();
        if radius - WALL_SIGMAS * sigma > *parameters.radii_m(kind).end() {
            return Err(Rejection::Radius);
        }
    }
    for _ in 0..2 {
        let before = members.len();
        clean(arcs, &model, members);
        if members.len() < MIN_FIT_ARCS {
            return Err(Rejection::NotGrown);
        }
        // The model was fitted to these members already.
        if members.len() == before {
            break;
        }
        model = model::fit(kind, &arcs.of(members), Some(&model), f64::INFINITY).ok_or(Rejection::NotGrown)?;
    }
    Ok(model)
}

/// Fits a model to the chain; if it does not explain the chain, to its middle, if that suffices.
fn first(arcs: &Arcs, start: &Start, members: &mut Vec<usize>) -> Option<Model> {
    let &Start { kind, chain, guess, middle_suffices } = start;
    let lengths = [chain.len(), CORE_ARCS, MIN_FIT_ARCS];
    for length in if middle_suffices { &lengths[..] } else { &lengths[..1] } {
        let start = chain.len().saturating_sub(*length) / 2;
        members.clear();
        members.extend(&chain[start..(start + length).min(chain.len())]);
        let points: f64 = arcs.of(members).map(|arc| arc.points).sum();
        let most = points * FIRST.square_limit(points);
        let model = model::fit(kind, &arcs.of(members), guess, most);
        if let Some(model) = model.filter(|model| model.square_sum() <= most) {
            return Some(model);
        }
    }
    None
}

/// Finds the arcs around the members that the model explains, across gaps that are not too wide, up to the length of the members
/// beyond either end.
fn reach(region: &Region, gap: i64, free: impl Fn(usize) -> bool, found: &mut Vec<usize>) {
    let Region { arcs, model, members } = region;
    let line = |index: usize| i64::from(arcs.arcs[members[index]].line);
    let (from, to) = (line(0), line(members.len() - 1));
    let (gap, more) = (gap.max((MAX_GAP_SHARE * members.len() as f64) as i64), (to - from + 1).max(LEAST_STEP));
    let middle = &arcs.arcs[members[members.len() / 2]];
    let (q, predictor) = (model.coefficients(), Predictor::new(model));
    let accept = |index: usize| {
        let arc = &arcs.arcs[index];
        // Computes the uncertainty of the model only where the noise alone does not explain the residual.
        let admits = |residual| {
            GROWING.admits(arc, &residual, 0.0) || GROWING.admits(arc, &residual, predictor.variance(&arc.mean))
        };
        free(index) && model.residual(&q, arc).is_some_and(admits)
    };
    found.clear();
    for side in [-1, 1] {
        let (mut line, mut span, mut misses) = (i64::from(middle.line), middle.pixels, 0);
        if side > 0 {
            line += 1;
        }
        while misses <= gap && line >= from - more && line <= to + more {
            let (before, margin) = (found.len(), (span[1] - span[0]) / BESIDE_MARGIN_DIVISOR + BESIDE_MARGIN_PX);
            let near = [span[0] - margin, span[1] + margin];
            found.extend(arcs.on_line(middle.scan, line).filter(|&index| arcs.reaches(index, near) && accept(index)));
            misses = if found.len() > before { 0 } else { misses + 1 };
            span = arcs.span(&found[before..]).unwrap_or(span);
            line += side;
        }
    }
    found.sort_unstable();
}

/// Removes the members that the model explains badly; at the ends the gate is narrower.
fn clean(arcs: &Arcs, model: &Model, members: &mut Vec<usize>) {
    let q = model.coefficients();
    let admits = |gate: &Gate, index: usize| {
        let arc = &arcs.arcs[index];
        model.residual(&q, arc).is_some_and(|residual| gate.admits(arc, &residual, 0.0))
    };
    members.retain(|&index| admits(&SETTLED, index));
    let last = members.iter().rposition(|&index| admits(&AT_ENDS, index)).map_or(0, |last| last + 1);
    members.truncate(last);
    let first = members.iter().position(|&index| admits(&AT_ENDS, index)).unwrap_or(0);
    members.drain(..first);
    drop_strays(members, |index| f64::from(arcs.arcs[index].line));
}

/// Removes, at either end, the few lines that lie beyond a gap.
fn drop_strays(members: &mut Vec<usize>, line: impl Fn(usize) -> f64) {
    let are_few = |beyond: f64, pair: &[usize]| beyond < MIN_LINES_PER_GAP_LINE * (line(pair[1]) - line(pair[0]) - 1.0);
    let lines_from = |from: usize, to: usize| line(to) - line(from) + 1.0;
    let Some(&last) = members.last() else { return };
    let stray = members.windows(2).position(|pair| are_few(lines_from(pair[1], last), pair));
    members.truncate(stray.map_or(members.len(), |at| at + 1));
    let first = members[0];
    let stray = members.windows(2).rposition(|pair| are_few(lines_from(first, pair[0]), pair));
    members.drain(..stray.map_or(0, |at| at + 1));
}

#[cfg(test)]
mod tests {
    use super::super::tests::{arcs_of, ellipses_of_a_can, rows_of};
    use super::*;
    use conicflow_geometry::{Scan, Vector3};
    use conicflow_lab::random::CounterRng;
    use conicflow_lab::rendered::{cylinder, sphere};
    use conicflow_messages::Ellipse;

    #[test]
    fn few_lines_beyond_a_wide_gap_are_left_out_and_many_are_not() {
        let left = |lines: &[usize]| {
            let mut members = (0..lines.len()).collect();
            drop_strays(&mut members, |index| lines[index] as f64);
            members.iter().map(|&index| lines[index]).collect::<Vec<_>>()
        };
        let with = |more: &[usize]| [&(50..60).collect::<Vec<_>>(), more].concat();
        assert_eq!(left(&with(&[80])), with(&[]), "one after twenty empty ones");
        assert_eq!(left(&[&[20, 21], &*with(&[])].concat()), with(&[]), "two before 28");
        for kept in [with(&[66]), with(&[80, 81]), with(&[80, 90]), vec![5], vec![]] {
            assert_eq!(left(&kept), kept);
        }
    }

    #[test]
    fn noise_alone_seldom_exceeds_the_limit_of_a_mean_square_and_few_points_have_more_room() {
        for points in [8, 30, 200] {
            let limit = GROWING.square_limit(points as f64);
            let is_refused = |arc: u64| {
                let random = CounterRng::new(3, arc);
                let sum: f64 = (0..points).map(|point| random.gaussian(point).powi(2)).sum();
                sum / points as f64 - 1.0 > limit
            };
            let refused = (0..1000).filter(|&arc| is_refused(arc)).count();
            assert!(refused < 20, "{refused} of 1000 with {points} points");
        }
        assert!(GROWING.square_limit(200.0) < 0.6, "so many points that are off by as much as noise is large show it");
    }

    #[test]
    fn an_arc_may_be_off_as_a_whole_by_what_its_points_may_be_off() {
        let (arcs, _) = two_cans();
        let mut arc = arcs.arcs[0].clone();
        arc.points = 1e8;
        let sigma = arc.variance.sqrt();
        for (gate, most) in [(GROWING, 0.3_f64.sqrt()), (SETTLED, 0.15_f64.sqrt()), (NOISE_ONLY, 0.0)] {
            let admits = |mean: f64| gate.admits(&arc, &Residual { square: 0.0, mean: mean * sigma }, 0.0);
            assert_eq!([0.99 * most, most + 0.01, -most - 0.01].map(admits), [true, false, false], "{most}");
        }
    }

    /// The arcs of two cans side by side, and the indices of each can's rows in order.
    fn two_cans() -> (Arcs, [Vec<usize>; 2]) {
        let can = |x: f64| {
            let (center, axis) = (Vector3::new(x, 0.0, 2.0), Vector3::y());
            cylinder(center, axis, 0.2, 0.7)
        };
        let arcs = arcs_of(&[can(-0.4), can(0.4)]);
        let rows_of = |is_left: bool| {
            let is_of_it = |arc: &Arc| arc.scan == Scan::Row && (arc.mean.x < 0.0) == is_left;
            (0..arcs.arcs.len()).filter(|&index| is_of_it(&arcs.arcs[index])).collect()
        };
        let rows = [rows_of(true), rows_of(false)];
        (arcs, rows)
    }

    #[test]
    fn a_chain_is_the_seed_with_twelve_lines_on_either_side_in_their_order() {
        let (arcs, [left, _]) = two_cans();
        let (middle, mut found) = (left.len() / 2, Vec::new());
        chain(&arcs, left[middle], 4, |_| true, &mut found);
        assert_eq!(found, left[middle - MAX_CHAIN_SIDE..=middle + MAX_CHAIN_SIDE]);
        chain(&arcs, left[1], 4, |_| true, &mut found);
        assert_eq!(found, left[..=1 + MAX_CHAIN_SIDE], "there is nothing before the first");
        chain(&arcs, left[middle], 4, |index| index >= left[middle], &mut found);
        assert_eq!(found, left[middle..=middle + MAX_CHAIN_SIDE], "what is before it belongs to another");
    }

    /// The bulges of 16 straight arcs sum up to 8. The standard deviation is 4.47 with independent noise, and twice that where
    /// four lines share their noise.
    #[test]
    fn a_chain_is_promising_where_its_arcs_are_bent_by_more_than_noise_bends_straight_ones() {
        let (mut arcs, [left, _]) = two_cans();
        let chain = &left[..16];
        let mut is_promising = |sum: f64, shared_lines: f64| {
            for &index in chain {
                (arcs.arcs[index].bulge, arcs.arcs[index].shared_lines) = (sum / 16.0, shared_lines);
            }
            is_promising(&arcs, chain, &AssemblerParameters::default())
        };
        for (shared_lines, limit) in [(1.0, 21.4164), (4.0, 34.8328)] {
            assert_eq!(is_promising(limit - 0.001, shared_lines), Err(Rejection::Flat));
            assert_eq!(is_promising(limit + 0.001, shared_lines), Ok(()));
        }
        let of = |lines: usize| super::is_promising(&arcs, &left[..lines], &AssemblerParameters::default());
        assert_eq!(
            [of(9), of(10)],
            [Err(Rejection::FewLines), Err(Rejection::Flat)],
            "ten are as many as there have to be"
        );
    }

    #[test]
    fn five_lines_are_enough_to_grow_from_and_four_are_not() {
        let (arcs, [left, _]) = two_cans();
        let (middle, parameters) = (left.len() / 2, AssemblerParameters::default());
        let grown = |lines: usize| {
            let chain = &left[middle..middle + lines];
            let start = Start { kind: ObjectKind::Sphere, chain, guess: None, middle_suffices: false };
            let free = |index: usize| chain.contains(&index);
            let mut members = Vec::new();
            let growth = grow(&arcs, &start, &parameters, free, &mut members, &mut Vec::new());
            growth.grown.is_ok().then_some(members.len())
        };
        assert_eq!([grown(4), grown(5)], [None, Some(5)]);
    }

    /// The limit on the mean square is half a variance plus three times the standard deviation for this number of points.
    #[test]
    fn a_first_model_leaves_no_more_of_its_points_than_noise_and_a_little_accounts_for() {
        let (mut arcs, [left, _]) = two_cans();
        let chain = &left[20..45];
        let points: f64 = arcs.of(chain).map(|arc| arc.points).sum();
        for (share, will_do) in [(0.98, true), (1.02, false)] {
            // A sphere does not explain a can. The noise is scaled so that it leaves the given share of the limit.
            let model = model::fit(ObjectKind::Sphere, &arcs.of(chain), None, f64::INFINITY).unwrap();
            let louder = model.square_sum() / (share * (0.5 * points + 3.0 * (2.0 * points).sqrt()));
            chain.iter().for_each(|&index| arcs.arcs[index].variance *= louder);
            let start = Start { kind: ObjectKind::Sphere, chain, guess: None, middle_suffices: false };
            assert_eq!(first(&arcs, &start, &mut Vec::new()).is_some(), will_do, "{share} of what there may be");
        }
    }

    #[test]
    fn an_arc_of_the_next_line_may_lie_a_little_beside_the_last_one() {
        let (header, mut ellipses) = ellipses_of_a_can();
        let at = |line: u32| move |ellipse: &Ellipse| ellipse.scan == 0 && ellipse.line == line;
        let own = *ellipses.iter().find(|ellipse| at(120)(ellipse)).unwrap();
        let next = ellipses.iter().position(at(121)).unwrap();
        let margin = (own.last - own.first) / 8 + 2;
        let [before, behind] = [own.first - margin, own.last + margin];
        for ([first, last], is_beside) in [
            ([behind, behind + 9], true),
            ([behind + 1, behind + 9], false),
            ([before - 9, before], true),
            ([before - 9, before - 1], false),
        ] {
            (ellipses[next].first, ellipses[next].last) = (first, last);
            let (mut arcs, mut found) = (Arcs::default(), Vec::new());
            arcs.read(&header, &ellipses);
            let rows = (0..arcs.arcs.len()).filter(|&index| arcs.arcs[index].scan == Scan::Row).collect::<Vec<_>>();
            let model = model::fit(ObjectKind::Cylinder, &arcs.of(&rows), None, f64::INFINITY).unwrap();
            let members = rows.iter().copied().filter(|&index| arcs.arcs[index].line == 120).collect::<Vec<_>>();
            let free = |index: usize| arcs.arcs[index].line <= 121;
            reach(&Region { arcs: &arcs, model, members: &members }, 0, free, &mut found);
            let reached = found.iter().any(|&index| arcs.arcs[index].line == 121);
            assert_eq!(reached, is_beside, "{first} to {last} beside {} to {}", own.first, own.last);
        }
    }

    /// If the ends of a chain belong to another can, the middle suffices, unless a sphere has to explain what a cylinder does.
    #[test]
    fn a_shape_explains_the_whole_chain_its_middle_or_nothing_of_it() {
        let (arcs, [left, right]) = two_cans();
        let from = |chain: &[usize], middle_suffices: bool| {
            let start = Start { kind: ObjectKind::Cylinder, chain, guess: None, middle_suffices };
            let (mut members, parameters) = (Vec::new(), AssemblerParameters::default());
            let Growth { grown, from_whole } =
                grow(&arcs, &start, &parameters, |_| true, &mut members, &mut Vec::new());
            (grown.is_ok(), from_whole)
        };
        let whole = &left[20..45];
        let spoilt = [&right[17..20], &left[20..42], &right[42..45]].concat();
        let nothing = [left[20], right[21], left[22], right[23], left[24]];
        assert_eq!([from(whole, true), from(whole, false)], [(true, true); 2]);
        assert_eq!([from(&spoilt, true), from(&spoilt, false)], [(true, false), (false, false)]);
        assert_eq!([from(&nothing, true), from(&nothing, false)], [(false, false); 2]);
    }

    #[test]
    fn what_a_cylinder_explains_as_a_whole_is_no_sphere_because_of_its_middle() {
        let (arcs, [left, _]) = two_cans();
        let mut grower = RegionGrower { chain: left, ..RegionGrower::default() };
        let [sphere, cylinder, _] = grower.models(&arcs, &AssemblerParameters::default(), |_| true);
        assert!(matches!(sphere, Err(Rejection::NotGrown)) && cylinder.is_ok(), "{sphere:?}");
    }

    #[test]
    fn one_round_takes_in_as_many_lines_on_either_side_as_there_are_and_at_least_four() {
        let (arcs, [left, _]) = two_cans();
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&left), None, f64::INFINITY).unwrap();
        let middle = left.len() / 2;
        for (lines, more) in [(1, 4), (3, 4), (4, 4), (5, 5), (12, 12)] {
            let (members, mut found) = (&left[middle..middle + lines], Vec::new());
            reach(&Region { arcs: &arcs, model, members }, 4, |_| true, &mut found);
            assert_eq!(found, left[middle - more..middle + lines + more], "from {lines} lines");
        }
    }

    #[test]
    fn where_the_model_is_unsure_an_arc_may_be_off_by_as_much_more() {
        let (arcs, _) = two_cans();
        let (mut arc, unsure) = (arcs.arcs[0].clone(), 0.01_f64);
        arc.points = 1e8;
        let admits = |square: f64, mean: f64| NOISE_ONLY.admits(&arc, &Residual { square, mean }, unsure * unsure);
        assert_eq!([2.4, 2.6].map(|sigmas| admits(0.0, sigmas * unsure)), [true, false]);
        assert_eq!([3.9, 4.1].map(|squares| admits(squares * unsure * unsure, 0.0)), [true, false]);
    }

    #[test]
    fn arcs_are_reached_that_are_off_by_no_more_than_the_model_is_unsure() {
        let (arcs, [left, _]) = two_cans();
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&left), None, f64::INFINITY);
        let Some(Model::Cylinder(mut fit)) = model else { panic!("{model:?}") };
        fit.surface.point.z -= 0.1;
        let mut reached = || {
            let (model, mut found) = (Model::Cylinder(fit), Vec::new());
            reach(&Region { arcs: &arcs, model, members: &left }, 4, |_| true, &mut found);
            fit.inverse *= 1e8;
            found.len()
        };
        assert_eq!([reached(), reached()], [0, left.len()]);
    }

    #[test]
    fn a_growth_follows_what_leans_over_the_image() {
        let axis = Vector3::new(0.7, 0.7, 0.0).normalize();
        let arcs = arcs_of(&[cylinder(Vector3::z() * 1.5, axis, 0.05, 1.2)]);
        let rows = rows_of(&arcs, |_| true);
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&rows), None, f64::INFINITY).unwrap();
        let (middle, mut found) = (rows.len() / 2, Vec::new());
        reach(&Region { arcs: &arcs, model, members: &rows[middle - 20..middle + 20] }, 4, |_| true, &mut found);
        assert_eq!(found, rows[middle - 60..middle + 60]);
    }

    #[test]
    fn a_gap_is_bridged_that_is_half_as_wide_as_what_was_grown() {
        let (arcs, [left, _]) = two_cans();
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&left), None, f64::INFINITY).unwrap();
        let middle = left.len() / 2;
        let members = &left[middle - 10..middle + 10];
        for (hidden, is_bridged) in [(10, true), (11, false)] {
            let (is_hidden, mut found) = (middle + 10..middle + 10 + hidden, Vec::new());
            let free = |index: usize| !left[is_hidden.clone()].contains(&index);
            reach(&Region { arcs: &arcs, model, members }, 4, free, &mut found);
            assert_eq!(found.contains(&left[is_hidden.end]), is_bridged, "{hidden} lines");
        }
    }

    #[test]
    fn what_has_grown_is_fitted_to_all_that_it_explains() {
        let (can, ball) = (Vector3::new(0.0, 0.25, 1.4), Vector3::new(0.0, -0.02, 1.4));
        let arcs = arcs_of(&[cylinder(can, Vector3::y(), 0.1, 0.3), sphere(ball, 0.12)]);
        let (mut grower, parameters, mut grown) = (RegionGrower::default(), AssemblerParameters::default(), 0);
        for seed in rows_of(&arcs, |_| true) {
            chain(&arcs, seed, parameters.max_gap(), |_| true, &mut grower.chain);
            let models = grower.models(&arcs, &parameters, |_| true);
            // Too few lines do not determine a cone.
            for (model, members) in models.into_iter().zip(&grower.members).take(2) {
                let Ok(model) = model else { continue };
                let again = model::fit(model.kind(), &arcs.of(members), Some(&model), f64::INFINITY).unwrap();
                assert!((again.square_sum() - model.square_sum()).abs() < 0.5, "{model:?} {again:?}");
                grown += 1;
            }
        }
        assert!(grown > 100, "{grown}");
    }
}
