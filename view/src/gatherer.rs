//! Combines the parts of a frame: its depth image comes first, and its results some milliseconds later.

use crate::frame::{Depth, Frame, List};
use conicflow_messages::{Header, Text};
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Depth images wait for their lists while they have at most this number of pixels together ...
const MAX_PIXELS: usize = 1 << 25;
/// ... and there are at most this number of images.
const MAX_IMAGES: usize = 32;
/// If no list has come for this time, depth images are shown without lists, and vice versa.
const PAIRING_TIMEOUT: Duration = Duration::from_secs(2);
/// Shortest mean interval of images, because nobody sees more: others are not copied.
const SHORTEST_INTERVAL: Duration = Duration::from_millis(20);
/// This many in a row may come sooner, so that each step of a paused run is shown.
const BURST: u32 = 3;

/// Combines depth images and lists of the same frame.
#[derive(Debug)]
pub struct Gatherer {
    depths: VecDeque<Arc<Depth>>,
    expects_lists: bool,
    /// Since when images have waited without any list.
    waits_since: Option<Instant>,
    /// When the last image was taken.
    taken: Option<Instant>,
    /// When the next image would be due at even intervals.
    due: Option<Instant>,
}

/// The identity of a frame: its first stage, the epoch, the sequence number.
type Key = (Text<32>, u64, u64);

fn key(header: &Header) -> Key {
    (header.origin(), header.epoch, header.sequence)
}

impl Gatherer {
    /// Creates a gatherer that shows depth images at once, or together with their lists.
    pub fn new(expects_lists: bool) -> Self {
        Self { depths: VecDeque::new(), expects_lists, waits_since: None, taken: None, due: None }
    }

    /// Takes a depth image; returns a frame if the image is to be shown without a list.
    pub fn depth(&mut self, header: &Header, pixels: &[u16], now: Instant) -> Option<Frame> {
        let due = self.due.map_or(now, |due| due.max(now));
        if due > now + SHORTEST_INTERVAL * BURST {
            return None;
        }
        (self.taken, self.due) = (Some(now), Some(due + SHORTEST_INTERVAL));
        let depth = Arc::new(Depth { header: *header, pixels: pixels.to_vec() });
        let alone = Frame { header: *header, depth: Some(Arc::clone(&depth)), ..Frame::default() };
        if !self.expects_lists {
            return Some(alone);
        }
        if self.depths.is_empty() {
            self.waits_since = Some(now);
        }
        self.depths.push_back(depth);
        let pixels = |depths: &VecDeque<Arc<Depth>>| depths.iter().map(|depth| depth.pixels.len()).sum::<usize>();
        while self.depths.len() > MAX_IMAGES || (self.depths.len() > 1 && pixels(&self.depths) > MAX_PIXELS) {
            self.depths.pop_front();
        }
        // Its list may still come; the frame is then shown again.
        let waited = self.waits_since.map_or(Duration::ZERO, |since| now.saturating_duration_since(since));
        (waited > PAIRING_TIMEOUT).then_some(alone)
    }

    /// Takes the results of a frame; returns the frame to show, unless its depth image belongs to another camera or was dropped.
    pub fn list(&mut self, header: &Header, list: List, latency_ms: Option<f64>, now: Instant) -> Option<Frame> {
        let found = self.depths.iter().position(|depth| key(&depth.header) == key(header));
        let has_images = self.taken.is_some_and(|taken| now.saturating_duration_since(taken) < PAIRING_TIMEOUT);
        if found.is_none() && has_images {
            return None;
        }
        self.waits_since = Some(now);
        let depth = found.and_then(|found| self.depths.drain(..=found).next_back());
        Some(Frame { header: *header, depth, list, compared: None, latency_ms })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    fn header(origin: &str, sequence: u64) -> Header {
        let mut header = Header { sequence, ..Header::default() };
        header.add_hop(Hop { stage: Text::new(origin), ..Hop::default() });
        header
    }

    #[test]
    fn a_list_is_joined_with_the_image_that_it_was_made_of() {
        let (mut gatherer, now) = (Gatherer::new(true), Instant::now());
        for number in 0..4 {
            assert!(gatherer.depth(&header("left", number), &[number as u16], now).is_none());
        }
        assert!(gatherer.depth(&header("left", 9), &[9], now).is_none(), "too many in a row");
        let frame = gatherer.list(&header("left", 2), List::default(), Some(4.5), now).unwrap();
        assert_eq!((frame.depth.unwrap().pixels[0], frame.latency_ms), (2, Some(4.5)));
        assert!(gatherer.list(&header("left", 1), List::default(), None, now).is_none(), "it is older");
        assert!(gatherer.list(&header("right", 3), List::default(), None, now).is_none(), "it is another camera's");
        assert!(gatherer.list(&header("left", 3), List::default(), None, now).is_some());
        assert!(gatherer.list(&header("left", 9), List::default(), None, now).is_none(), "its image was left out");
        assert!(
            gatherer.list(&header("left", 99), List::default(), None, now + 5 * PAIRING_TIMEOUT).is_some(),
            "no images come"
        );
    }

    #[test]
    fn images_are_shown_without_lists_if_none_arrive() {
        let now = Instant::now();
        assert!(Gatherer::new(false).depth(&header("left", 0), &[1], now).is_some());
        let mut gatherer = Gatherer::new(true);
        assert!(gatherer.depth(&header("left", 0), &[1], now).is_none());
        let later = now + 2 * PAIRING_TIMEOUT;
        let frame = gatherer.depth(&header("left", 1), &[7], later).unwrap();
        assert_eq!((frame.depth.unwrap().pixels[0], frame.header.sequence), (7, 1));
    }

    #[test]
    fn lists_that_arrive_again_are_shown_with_their_images() {
        let (mut gatherer, now) = (Gatherer::new(true), Instant::now());
        gatherer.depth(&header("left", 0), &[1], now);
        let later = now + 2 * PAIRING_TIMEOUT;
        assert!(gatherer.depth(&header("left", 1), &[7], later).is_some(), "alone");
        let frame = gatherer.list(&header("left", 1), List::Objects(Vec::new()), None, later).unwrap();
        assert_eq!(frame.depth.unwrap().pixels[0], 7);
        assert!(gatherer.depth(&header("left", 2), &[8], later + SHORTEST_INTERVAL).is_none(), "lists come again");
    }

    #[test]
    fn a_frame_after_a_long_pause_waits_for_its_list() {
        let (mut gatherer, now) = (Gatherer::new(true), Instant::now());
        gatherer.depth(&header("left", 0), &[1], now);
        gatherer.list(&header("left", 0), List::default(), None, now).unwrap();
        let later = now + 20 * PAIRING_TIMEOUT;
        assert!(gatherer.depth(&header("left", 1), &[7], later).is_none());
        assert!(gatherer.list(&header("left", 1), List::default(), None, later).unwrap().depth.is_some());
    }

    #[test]
    fn lists_without_images_are_shown() {
        let mut gatherer = Gatherer::new(true);
        let frame = gatherer.list(&header("left", 2), List::Objects(Vec::new()), None, Instant::now());
        assert!(frame.is_some_and(|frame| frame.depth.is_none()));
    }

    #[test]
    fn the_number_of_images_that_are_kept_is_limited() {
        let (mut gatherer, now) = (Gatherer::new(true), Instant::now());
        for number in 0..100 {
            let then = now + SHORTEST_INTERVAL * number as u32;
            gatherer.depth(&header("left", number), &[0], then);
        }
        assert_eq!(gatherer.depths.len(), MAX_IMAGES);
    }
}
