//! Reasons for rejecting arcs.

conicflow_detection::rejections! {
    /// The reason for rejecting an arc.
    ArcRejection, ArcRejections:
    FewPoints => "arcs of too few points",
    Line => "arcs that a line explains",
    NoEllipse => "arcs without ellipse",
    Concave => "concave arcs",
    Radius => "ellipses beyond the radius limits",
    Elongated => "elongated ellipses",
    ShortArc => "ellipses of short arcs",
}
