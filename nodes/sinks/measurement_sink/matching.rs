//! Which answer is about which true object, from frame to frame.

use super::sighting::Sighted;
use crate::sinks::evaluation_sink::matching::{Expected, compare, fault};
use std::collections::BTreeMap;

/// Remembers the identity that each object had.
#[derive(Clone, Debug, Default)]
pub struct Matcher {
    identities: BTreeMap<String, u64>,
}

/// The outcome of one frame.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Matches {
    /// As many as there are true objects: index of the answer.
    pub answer_of: Vec<Option<usize>>,
    /// Number of answers that are about nothing.
    pub wrong: u64,
}

impl Matcher {
    /// Matches one to one: identities that are still right stay, then the nearest pair goes first.
    pub fn match_up(&mut self, truths: &[Expected], answers: &[Sighted]) -> Matches {
        let mut pairs = Vec::new();
        for (truth, expected) in truths.iter().enumerate() {
            let known = self.identities.get(&expected.name);
            for (index, answer) in
                answers.iter().enumerate().filter(|(_, answer)| fault(expected, &answer.object).is_none())
            {
                let is_new = answer.id.is_none_or(|id| known != Some(&id));
                pairs.push((is_new, compare(&expected.body, &answer.object).position_m, truth, index));
            }
        }
        pairs.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then((a.2, a.3).cmp(&(b.2, b.3))));
        let (mut answer_of, mut used) = (vec![None; truths.len()], vec![false; answers.len()]);
        for (_, _, truth, index) in pairs {
            if answer_of[truth].is_none() && !used[index] {
                (answer_of[truth], used[index]) = (Some(index), true);
                answers[index].id.map(|id| self.identities.insert(truths[truth].name.clone(), id));
            }
        }
        Matches { answer_of, wrong: used.iter().filter(|used| !**used).count() as u64 }
    }
}
