//! Reasons for rejecting candidates.

conicflow_detection::rejections! {
    /// The reason for rejecting a candidate.
    Rejection, Rejections:
    FewRows => "candidates of too few rows",
    Gaps => "candidates with too many gaps",
    ShortArc => "candidates of short arcs",
    Flat => "candidates as flat as a plane",
    Degenerate => "candidates without extent",
    NotCollinear => "candidates with scattered centers (line)",
    NotConcyclic => "candidates with scattered centers (circle)",
    Profile => "candidates with scattered radii",
    Tilted => "candidates too tilted",
    HalfAngle => "cones too blunt",
    Constant => "cones too sharp",
    BeyondApex => "cones seen beyond their apex",
    Cap => "caps of spheres",
    Radius => "candidates beyond the radius limits",
    Short => "candidates too short",
    Rms => "candidates that miss their points",
    Double => "objects seen twice",
    Length => "candidates beyond the length limits",
}
