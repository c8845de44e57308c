//! Which detection belongs to which track: the cheapest pair of all first, then the cheapest of what is left.

/// Pairs tracks with detections, each at most once.
///
/// Costs are compared across tracks, so they have to be on one scale, such as minus twice a logarithm of likelihood.
#[derive(Clone, Debug, Default)]
pub struct Association {
    candidates: Vec<Candidate>,
    detection_of: Vec<Option<usize>>,
    track_of: Vec<Option<usize>>,
}

#[derive(Clone, Copy, Debug)]
struct Candidate {
    cost: f64,
    track: usize,
    detection: usize,
}

impl Association {
    /// Forgets all pairs.
    pub fn reset(&mut self, tracks: usize, detections: usize) {
        self.candidates.clear();
        self.detection_of.clear();
        self.detection_of.resize(tracks, None);
        self.track_of.clear();
        self.track_of.resize(detections, None);
    }

    /// Offers each pair of a free track and a free detection that has a cost, and joins them, the cheapest first; among
    /// equals the older track, then the earlier detection. May be called again, with another cost, for what was left.
    pub fn assign(&mut self, cost: impl Fn(usize, usize) -> Option<f64>) {
        for track in free(&self.detection_of) {
            let costs = free(&self.track_of).filter_map(|detection| Some((detection, cost(track, detection)?)));
            self.candidates.extend(costs.map(|(detection, cost)| Candidate { cost, track, detection }));
        }
        let order = |c: &Candidate| (c.track, c.detection);
        self.candidates.sort_unstable_by(|a, b| a.cost.total_cmp(&b.cost).then_with(|| order(a).cmp(&order(b))));
        for Candidate { track, detection, .. } in self.candidates.drain(..) {
            if self.detection_of[track].is_none() && self.track_of[detection].is_none() {
                self.detection_of[track] = Some(detection);
                self.track_of[detection] = Some(track);
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

    #[test]
    fn nothing_seen_is_nothing_paired() {
        let association = assign(&[&[], &[]]);
        assert_eq!(association.detections(), [None, None]);
    }
}
