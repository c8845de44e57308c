//! Why arcs are no ellipses.

crate::rejections! {
    /// Why an arc is turned down.
    ArcRejection, ArcRejections:
    FewPoints => "arcs of too few points",
    Line => "arcs that a line explains",
    Concave => "concave arcs",
    Radius => "ellipses beyond the radius limits",
}
