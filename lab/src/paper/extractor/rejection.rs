//! Why arcs are no ellipses.

conicflow_detection::rejections! {
    /// Why an arc is turned down.
    ArcRejection, ArcRejections:
    FewPoints => "arcs of too few points",
    Line => "arcs that a line explains",
    NoEllipse => "arcs without ellipse",
    Concave => "concave arcs",
    Radius => "ellipses beyond the radius limits",
    Elongated => "elongated ellipses",
    ShortArc => "ellipses of short arcs",
}
