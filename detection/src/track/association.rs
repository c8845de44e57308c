//! Which detection belongs to which track: the assignment that is the cheapest as a whole (Kuhn 1955, Munkres 1957).

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;
use pathfinding::undirected::connected_components::components;
use std::collections::{BTreeMap, BTreeSet};

/// What it costs a track to stay alone. As minus twice the logarithm of a density, in 1/m^4 over place and radius, less the
/// 4 ln 2 pi that pairs leave out, too: one new object in 6000 cubic metres for each metre of radius, so that all but the
/// vaguest pairs are cheaper. An axis adds nothing: it may lie anywhere in 2 pi, which is what pairs leave out of it.
const COST_ALONE: f64 = 10.0; // [tuned]
/// The assignment is found in whole numbers: a cost of one is so many.
const UNITS_PER_COST: f64 = 1e6; // [algorithmic]
/// The gain of a pair that must not be: no sum of others makes up for it.
const FORBIDDEN: i64 = -1_000_000_000_000_000; // [algorithmic]

/// What is paired, by its index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Node {
    Track(usize),
    Detection(usize),
}

/// Pairs tracks with detections, each at most once.
///
/// Costs are added up over tracks, so they have to be on one scale, such as minus twice a logarithm of likelihood.
#[derive(Clone, Debug, Default)]
pub struct Association {
    detection_of: Vec<Option<usize>>,
    track_of: Vec<Option<usize>>,
}

impl Association {
    /// Forgets all pairs.
    pub fn reset(&mut self, tracks: usize, detections: usize) {
        self.detection_of.clear();
        self.detection_of.resize(tracks, None);
        self.track_of.clear();
        self.track_of.resize(detections, None);
    }

    /// Offers each pair of a free track and a free detection that has a cost, and joins those whose costs, with those of
    /// the tracks that stay alone, have the least sum. May be called again, with another cost, for what was left.
    pub fn assign(&mut self, cost: impl Fn(usize, usize) -> Option<f64>) {
        let (tracks, detections): (Vec<_>, Vec<_>) =
            (free(&self.detection_of).collect(), free(&self.track_of).collect());
        if tracks.is_empty() || detections.is_empty() {
            return;
        }
        let mut gains_of = BTreeMap::new();
        let mut beside: Vec<_> = tracks.iter().map(|&track| vec![Node::Track(track)]).collect();
        for (beside, &track) in beside.iter_mut().zip(&tracks) {
            for &detection in &detections {
                if let Some(cost) = cost(track, detection) {
                    gains_of.insert((track, detection), gain(cost));
                    beside.push(Node::Detection(detection));
                }
            }
        }
        // Those that no pair joins do not ask for the same: each group is small, however many there are.
        for group in components(&beside) {
            self.assign_group(&group.into_iter().collect(), &gains_of);
        }
    }

    fn assign_group(&mut self, group: &BTreeSet<Node>, gains_of: &BTreeMap<(usize, usize), i64>) {
        let (mut tracks, mut detections) = (Vec::new(), Vec::new());
        for node in group {
            match *node {
                Node::Track(track) => tracks.push(track),
                Node::Detection(detection) => detections.push(detection),
            }
        }
        // one column for each detection, and one for each track to stay alone in
        let mut gains = Matrix::new(tracks.len(), detections.len() + tracks.len(), 0);
        for (row, &track) in tracks.iter().enumerate() {
            for (column, &detection) in detections.iter().enumerate() {
                gains[(row, column)] = gains_of.get(&(track, detection)).copied().unwrap_or(FORBIDDEN);
            }
        }
        let (_, columns) = kuhn_munkres(&gains);
        for (row, column) in columns.into_iter().enumerate().filter(|(_, column)| *column < detections.len()) {
            if gains[(row, column)] > FORBIDDEN {
                self.detection_of[tracks[row]] = Some(detections[column]);
                self.track_of[detections[column]] = Some(tracks[row]);
            }
        }
    }

    /// The detection of each track.
    pub fn detections(&self) -> &[Option<usize>] {
        &self.detection_of
    }

    /// The detections that belong to no track.
    pub fn unclaimed(&self) -> impl Iterator<Item = usize> + '_ {
        free(&self.track_of)
    }
}

/// What a pair saves; `as` keeps what is not finite within the bounds of the numbers.
fn gain(cost: f64) -> i64 {
    ((COST_ALONE - cost).clamp(-1e6, 1e6) * UNITS_PER_COST) as i64 // [algorithmic]
}

fn free(partners: &[Option<usize>]) -> impl Iterator<Item = usize> + '_ {
    partners.iter().enumerate().filter_map(|(index, partner)| partner.is_none().then_some(index))
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

    #[test]
    fn nothing_seen_is_nothing_paired() {
        let association = assign(&[&[], &[]]);
        assert_eq!(association.detections(), [None, None]);
    }
}
