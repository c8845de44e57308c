//! Chooses one in so many messages of each camera.

use conicflow_messages::{Header, Text};
use std::collections::BTreeMap;

/// Counts the messages of each camera separately, so that of alternating cameras none is always left out.
pub struct Decimator {
    every: u64,
    resume_at: u64,
    taken: BTreeMap<Text<32>, u64>,
}

impl Decimator {
    /// Chooses one in `every` messages; `resume_at` were taken before a restart.
    pub fn new(every: u64, resume_at: u64) -> Self {
        Self { every: every.max(1), resume_at, taken: BTreeMap::new() }
    }

    /// Whether a message is due.
    pub fn is_due(&mut self, header: &Header) -> bool {
        let taken = self.taken.entry(header.origin()).or_insert(self.resume_at);
        *taken += 1;
        (*taken - 1).is_multiple_of(self.every)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    #[test]
    fn alternating_cameras_are_decimated_separately() {
        let mut decimator = Decimator::new(2, 0);
        let mut is_due = |camera| {
            let mut header = Header::default();
            header.add_hop(Hop { stage: Text::new(camera), ..Hop::default() });
            decimator.is_due(&header)
        };
        let due = ["left", "right", "left", "right", "left", "right"].map(&mut is_due);
        assert_eq!(due, [true, true, false, false, true, true]);
    }

    #[test]
    fn counting_continues_after_a_restart() {
        let mut decimator = Decimator::new(3, 4);
        assert_eq!([(); 3].map(|()| decimator.is_due(&Header::default())), [false, false, true]);
    }
}
