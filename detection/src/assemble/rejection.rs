//! Reasons for which candidates are rejected.

crate::rejections! {
    /// The reason for which a candidate is rejected.
    Rejection, Rejections:
    FewLines => "candidates of too few lines",
    Gaps => "candidates with too many gaps",
    ShortArc => "candidates of short arcs",
    Flat => "candidates as flat as a plane",
    Tilted => "candidates too tilted",
    HalfAngle => "cones too blunt",
    Radius => "candidates beyond the radius limits",
    Short => "candidates too short",
    Taper => "candidates that may taper or not",
    Odds => "candidates that are more probably something else",
    Overlap => "candidates in the place of an object",
    Length => "candidates beyond the length limits",
    Small => "candidates that look too small",
    NotGrown => "candidates that no shape explains",
    Untried => "arcs left untried",
    Late => "images cut short by budget_ms",
}
