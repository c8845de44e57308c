//! Reasons for which arcs are rejected.

crate::rejections! {
    /// The reason for which an arc is rejected.
    ArcRejection, ArcRejections:
    FewPoints => "arcs of too few points",
    Line => "arcs that a line explains",
    Concave => "concave arcs",
    Radius => "ellipses beyond the radius limits",
}
