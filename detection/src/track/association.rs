//! Association of detections with tracks: the assignment of least total cost, by shortest augmenting paths (Jonker, Volgenant
//! 1987) over the pairs within the gate only.

/// Cost of a track without a detection, on the scale of the pairs: one new object in 6000 m^3 for each metre of radius, so that
/// all but the vaguest pairs are cheaper. The scale is minus twice the logarithm of a density over place and radius, in 1/m^4,
/// less 4 ln 2 pi, which pairs leave out, too. An axis adds nothing: it may lie anywhere in 2 pi, the factor that pairs leave
/// out.
const COST_ALONE: f64 = 10.0; // [tuned]

/// Pairs tracks with detections, each at most once.
///
/// Costs are added up over tracks, so they have to be on one scale, such as minus twice a logarithm of likelihood.
#[derive(Clone, Debug, Default)]
pub struct Association {
    detection_of: Vec<Option<usize>>,
    track_of: Vec<Option<usize>>,
}

impl Association {
    /// Removes all pairs, and sets the numbers of tracks and of detections.
    pub fn reset(&mut self, tracks: usize, detections: usize) {
        self.detection_of.clear();
        self.detection_of.resize(tracks, None);
        self.track_of.clear();
        self.track_of.resize(detections, None);
    }

    /// Pairs free tracks with free detections so that the sum of the costs of all pairs and of all tracks without a detection is
    /// least; `cost` of a track and a detection is `None` where they cannot be paired. A second call, with another cost, pairs
    /// those that the first left free.
    pub fn assign(&mut self, cost: impl Fn(usize, usize) -> Option<f64>) {
        let tracks: Vec<_> = free(&self.detection_of).collect();
        let detections: Vec<_> = free(&self.track_of).collect();
        // A pair that costs more than a track alone is in no assignment of least cost; neither is one without a number.
        let pairs = |&track: &usize| {
            let pair = |column| Some((column, cost(track, detections[column])? - COST_ALONE));
            (0..detections.len()).filter_map(pair).filter(|(_, saved)| *saved < 0.0).collect()
        };
        let edges: Vec<Vec<_>> = tracks.iter().map(pairs).collect();
        for (row, column) in cheapest(&edges, detections.len()).into_iter().enumerate() {
            if let Some(column) = column {
                self.detection_of[tracks[row]] = Some(detections[column]);
                self.track_of[detections[column]] = Some(tracks[row]);
            }
        }
    }

    /// Returns the detection of each track.
    pub fn detections(&self) -> &[Option<usize>] {
        &self.detection_of
    }

    /// Returns the detections that belong to no track.
    pub fn unclaimed(&self) -> impl Iterator<Item = usize> + '_ {
        free(&self.track_of)
    }
}

fn free(partners: &[Option<usize>]) -> impl Iterator<Item = usize> + '_ {
    partners.iter().enumerate().filter_map(|(index, partner)| partner.is_none().then_some(index))
}

/// The column of each row in the assignment of least cost. `edges` lists the columns of a row and their costs, which are
/// negative; a row without a column costs nothing.
fn cheapest(edges: &[Vec<(usize, f64)>], columns: usize) -> Vec<Option<usize>> {
    let mut column_of = vec![None; edges.len()];
    let mut row_of = vec![None; columns];
    // The dual variables: `cost - row - column` is never negative, and zero where a row has its column (or none).
    let mut row_prices: Vec<_> =
        edges.iter().map(|edges| edges.iter().map(|edge| edge.1).fold(0.0, f64::min)).collect();
    let mut column_prices = vec![0.0; columns];
    // The search for a path: the distance of each column, the row that it is reached from, and the columns in their order.
    let mut distances = vec![f64::INFINITY; columns];
    let mut reached_from = vec![0; columns];
    let (mut open, mut settled) = (Vec::new(), Vec::<(usize, f64)>::new());

    for start in 0..edges.len() {
        let (mut row, mut distance) = (start, 0.0);
        // The nearest row that may give up its column for none.
        let mut nearest_end = (f64::INFINITY, start);
        let end_column = loop {
            if distance - row_prices[row] < nearest_end.0 {
                nearest_end = (distance - row_prices[row], row);
            }
            for &(column, cost) in &edges[row] {
                let through = distance + cost - row_prices[row] - column_prices[column];
                if distances[column] == f64::INFINITY {
                    open.push(column);
                }
                if through < distances[column] {
                    (distances[column], reached_from[column]) = (through, row);
                }
            }
            let by_distance = |&a: &usize, &b: &usize| distances[open[a]].total_cmp(&distances[open[b]]);
            let Some(next) = (0..open.len()).min_by(by_distance).filter(|&next| distances[open[next]] < nearest_end.0)
            else {
                distance = nearest_end.0;
                break None;
            };
            let column = open.swap_remove(next);
            distance = std::mem::replace(&mut distances[column], f64::NEG_INFINITY); // no path there is shorter
            settled.push((column, distance));
            match row_of[column] {
                Some(taken_by) => row = taken_by,
                None => break Some(column),
            }
        };

        row_prices[start] += distance;
        for &(column, settled_at) in &settled {
            column_prices[column] -= distance - settled_at;
            if let Some(row) = row_of[column] {
                row_prices[row] += distance - settled_at;
            }
        }
        // Along the path each row takes the column that it was left for, from the end to the start.
        let mut freed = end_column.or_else(|| column_of[nearest_end.1].take());
        while let Some(column) = freed {
            let row = reached_from[column];
            row_of[column] = Some(row);
            freed = column_of[row].replace(column);
        }
        for column in open.drain(..).chain(settled.drain(..).map(|(column, _)| column)) {
            distances[column] = f64::INFINITY;
        }
    }
    column_of
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assign(costs: &[&[Option<f64>]]) -> Association {
        let mut association = Association::default();
        association.reset(costs.len(), costs[0].len());
        association.assign(|track, detection| costs[track][detection]);
        association
    }

    #[test]
    fn the_nearest_pair_goes_first_whoever_asks_first() {
        let association = assign(&[&[Some(2.0), Some(3.0)], &[Some(1.0), Some(9.0)]]);
        assert_eq!(association.detections(), [Some(1), Some(0)]);
    }

    #[test]
    fn the_sum_counts_not_the_nearest_pair() {
        let association = assign(&[&[Some(1.0), Some(2.0)], &[Some(1.5), Some(9.0)]]);
        assert_eq!(association.detections(), [Some(1), Some(0)]);
    }

    #[test]
    fn a_track_stays_alone_rather_than_take_what_is_most_unlikely() {
        let association = assign(&[&[Some(COST_ALONE + 1.0)]]);
        assert_eq!(association.detections(), [None]);
        let association = assign(&[&[Some(1.0), Some(9.0)], &[Some(9.5), Some(COST_ALONE + 5.0)]]);
        assert_eq!(association.detections(), [Some(0), None], "the second would have to push the first away");
    }

    #[test]
    fn what_lies_outside_the_gate_stays_alone() {
        let association = assign(&[&[None, Some(1.0), None], &[None, Some(0.5), None]]);
        assert_eq!(association.detections(), [None, Some(1)]);
        assert_eq!(association.unclaimed().collect::<Vec<_>>(), [0, 2]);
    }

    #[test]
    fn equal_costs_go_by_age() {
        let association = assign(&[&[Some(1.0), Some(1.0)], &[Some(1.0), Some(1.0)]]);
        assert_eq!(association.detections(), [Some(0), Some(1)]);
    }

    #[test]
    fn a_second_round_sees_only_what_was_left() {
        let mut association = assign(&[&[Some(1.0), None], &[None, None]]);
        association.assign(|track, detection| {
            assert_eq!((track, detection), (1, 1));
            Some(0.0)
        });
        assert_eq!(association.detections(), [Some(0), Some(1)]);
    }

    /// Each of many tracks is near one detection of its own and the next one's.
    #[test]
    fn many_tracks_take_what_is_best_for_all() {
        let many = 400;
        let mut association = Association::default();
        association.reset(many, many);
        association.assign(|track, detection| match detection.checked_sub(track) {
            Some(0) => Some(2.0),
            Some(1) if track % 4 < 3 => Some(1.0),
            _ => None,
        });
        // Of four in a row the first three would rather have the next one's, and the fourth would be left with nothing.
        assert!(association.detections().iter().enumerate().all(|(track, paired)| *paired == Some(track)));
    }

    /// The least cost of the rows from `row` on, with the columns that are left, by trying all.
    fn least_cost(edges: &[Vec<(usize, f64)>], taken: &mut Vec<usize>) -> f64 {
        let Some((first, others)) = edges.split_first() else { return 0.0 };
        let mut least = least_cost(others, taken);
        for &(column, cost) in first {
            if !taken.contains(&column) {
                taken.push(column);
                least = least.min(cost + least_cost(others, taken));
                taken.pop();
            }
        }
        least
    }

    #[test]
    fn no_assignment_costs_less() {
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..3000 {
            let (rows, columns) = (random.usize(1..6), random.usize(1..6));
            // Whole numbers give ties.
            let whole = random.bool();
            let mut cost = || if whole { -f64::from(random.u32(1..5)) } else { -4.0 * random.f64() };
            let mut edges = vec![vec![]; rows];
            for edges in &mut edges {
                edges.extend((0..columns).map(|column| (column, cost())));
                edges.retain(|_| cost() < -1.5);
            }
            let found = cheapest(&edges, columns);
            let mut taken: Vec<_> = found.iter().flatten().collect();
            taken.sort();
            assert!(taken.windows(2).all(|two| two[0] != two[1]), "a column twice: {found:?}");
            let cost_of = |(edges, column): (&Vec<(usize, f64)>, &Option<usize>)| {
                column.map(|column| edges.iter().find(|edge| edge.0 == column).expect("a pair of the list").1)
            };
            let cost: f64 = edges.iter().zip(&found).filter_map(cost_of).sum();
            assert!((cost - least_cost(&edges, &mut vec![])).abs() < 1e-9, "{edges:?}: {found:?}");
        }
    }

    #[test]
    fn nothing_seen_is_nothing_paired() {
        let association = assign(&[&[], &[]]);
        assert_eq!(association.detections(), [None, None]);
    }
}
