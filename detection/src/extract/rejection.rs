//! Why arcs are turned down, and how often.

/// Why an arc is turned down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArcRejection {
    /// Fewer points than asked for.
    FewPoints,
    /// A line explains the points: wall, floor, box.
    Line,
    /// The points determine no ellipse that explains them.
    NoEllipse,
    /// The centre lies before the surface: the inside of something.
    Concave,
    /// A semi-axis outside the limits.
    Radius,
    /// One semi-axis much longer than the other: wall, floor.
    Elongated,
    /// The points span too small an angle around the centre.
    ShortArc,
}

impl ArcRejection {
    const NAMES: [&'static str; 7] = [
        "arcs of too few points",
        "arcs that a line explains",
        "arcs without ellipse",
        "concave arcs",
        "ellipses beyond the radius limits",
        "elongated ellipses",
        "ellipses of short arcs",
    ];
}

/// How often each reason occurred.
#[derive(Clone, Copy, Debug, Default)]
pub struct ArcRejections([u64; ArcRejection::NAMES.len()]);

impl ArcRejections {
    /// Counts one more.
    pub fn count(&mut self, reason: ArcRejection) {
        self.0[reason as usize] += 1;
    }

    /// The reasons that occurred, in words, and how often.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> {
        ArcRejection::NAMES.into_iter().zip(self.0).filter(|(_, times)| *times > 0)
    }
}
