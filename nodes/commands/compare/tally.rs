//! Counts, frame by frame, what two variants have in common and how they differ.

use super::variant::{Frame, Variant};
use anyhow::{Result, bail, ensure};
use conicflow_lab::quantile::quantile;
use conicflow_lab::score::Row;
use conicflow_lab::score::pairing::{Difference, Paired, pair_up};
use conicflow_messages::{Hinted, Hop, Object, ObjectKind};
use indexmap::IndexMap;
use std::collections::BTreeMap;

/// The counts of two variants.
#[derive(Default)]
pub(super) struct Tally {
    /// Number of frames that both have answered.
    pub(super) frames: u64,
    /// Number of frames with exactly the same answers.
    pub(super) same: u64,
    /// By the objects' kind: number in A, in B, in both, only in A, only in B.
    pub(super) kinds: BTreeMap<ObjectKind, [u64; 5]>,
    /// Objects that are of the first kind in A, and of the second in B.
    pub(super) other_kind: BTreeMap<(ObjectKind, ObjectKind), u64>,
    /// Differences of objects that have the same kind in both.
    pub(super) differences: Vec<(ObjectKind, Difference)>,
    /// Times of the stages in A and in B, in ms, in the order of the data flow, source first.
    pub(super) times: IndexMap<String, [Vec<f64>; 2]>,
    /// Sums of the times of all stages after the source, in ms.
    pub(super) together: [Vec<f64>; 2],
    /// The scores of each, if the truth is known.
    pub(super) scores: [Option<Row>; 2],
    /// Frames in which one variant finds an object that the other does not, or another kind.
    pub(super) unlike: Vec<Unlike>,
}

/// A frame in which the variants differ in objects or their kinds, not only in numbers.
pub(super) struct Unlike {
    pub(super) sequence: u64,
    pub(super) source: String,
    pub(super) only_a: Vec<Object>,
    pub(super) only_b: Vec<Object>,
    pub(super) other_kind: Vec<(Object, Object)>,
}

impl Tally {
    /// Counts the answers of two variants to the same frames.
    ///
    /// # Errors
    /// The frames are not the same, or the truth of one is not known although it should be.
    pub(super) fn of(a: &mut Variant, b: &mut Variant) -> Result<Self> {
        ensure_same_frames(&a.frames, &b.frames)?;
        let mut tally = Self::default();
        for (a, b) in a.frames.iter().zip(&b.frames) {
            tally.add(a, b);
        }
        for (score, variant) in tally.scores.iter_mut().zip([a, b]) {
            let Some(evaluation) = &mut variant.truth else { continue };
            for frame in &variant.frames {
                evaluation.add(&frame.header, &frame.answers)?;
            }
            *score = Some(evaluation.row());
        }
        Ok(tally)
    }

    fn add(&mut self, a: &Frame, b: &Frame) {
        let (in_a, in_b) = (a.objects(), b.objects());
        self.frames += 1;
        self.same += u64::from(in_a == in_b);
        self.time(a, 0);
        self.time(b, 1);
        let Paired { both, only_a, only_b } = pair_up(&in_a, &in_b);
        let mut count = |object: &Object, columns: &[usize]| {
            let row = self.kinds.entry(object.shape()).or_default();
            columns.iter().for_each(|column| row[*column] += 1);
        };
        in_a.iter().for_each(|object| count(object, &[0]));
        in_b.iter().for_each(|object| count(object, &[1]));
        only_a.iter().for_each(|number| count(&in_a[*number], &[3]));
        only_b.iter().for_each(|number| count(&in_b[*number], &[4]));
        let pairs = both.into_iter().map(|(first, second)| (in_a[first], in_b[second]));
        let (same_kind, other_kind): (Vec<_>, Vec<_>) = pairs.partition(|(one, other)| one.kind == other.kind);
        for (one, other) in &same_kind {
            count(one, &[2]);
            self.differences.push((one.shape(), Difference::of(one, other)));
        }
        for (one, other) in &other_kind {
            *self.other_kind.entry((one.shape(), other.shape())).or_default() += 1;
        }
        if !(only_a.is_empty() && only_b.is_empty() && other_kind.is_empty()) {
            self.unlike.push(Unlike {
                sequence: a.header.sequence,
                source: a.header.source.as_str().unwrap_or_default().to_owned(),
                only_a: only_a.iter().map(|number| in_a[*number]).collect(),
                only_b: only_b.iter().map(|number| in_b[*number]).collect(),
                other_kind,
            });
        }
    }

    /// Adds the time of each stage with the frame, from receiving its message until sending its own.
    fn time(&mut self, frame: &Frame, variant: usize) {
        let ms = |hop: &Hop| hop.sent_ns.saturating_sub(hop.received_ns) as f64 * 1e-6;
        self.together[variant].push(frame.header.trace().iter().skip(1).map(ms).sum());
        for hop in frame.header.trace() {
            self.times.entry(hop.stage.to_string()).or_default()[variant].push(ms(hop));
        }
    }
}

impl Unlike {
    /// Number of objects that differ.
    pub(super) fn count(&self) -> usize {
        self.only_a.len() + self.only_b.len() + self.other_kind.len()
    }
}

/// Returns the value below which a share of the values lies; `None` if there are none.
pub(super) fn share_below(values: impl Iterator<Item = f64>, share: f64) -> Option<f64> {
    quantile(&mut values.filter(|value| value.is_finite()).collect::<Vec<_>>(), share)
}

fn ensure_same_frames(a: &[Frame], b: &[Frame]) -> Result<()> {
    let name = |frame: &Frame| {
        let header = &frame.header;
        format!("frame {} of `{}`, {}x{}", header.sequence, header.source, header.camera.width, header.camera.height)
    };
    let hint = "a variant may not change which frames there are: a source that is live, or has other files, cannot be compared";
    if let Some((a, b)) = a.iter().zip(b).find(|(a, b)| name(a) != name(b)) {
        bail!(Hinted::new(format!("the variants did not see the same frames: a has {}, b {}", name(a), name(b)), hint));
    }
    ensure!(
        a.len() == b.len(),
        Hinted::new(format!("the variants did not see the same frames: a has {}, b {}", a.len(), b.len()), hint)
    );
    Ok(())
}
