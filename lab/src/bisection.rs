//! Bisection: where something ends that holds on one side.

/// Where `holds` ends between a place where it does and one where it does not.
pub(crate) fn end_of(holds: impl Fn(f64) -> bool, [mut inside, mut outside]: [f64; 2], halvings: u32) -> f64 {
    for _ in 0..halvings {
        let middle = 0.5 * (inside + outside);
        *(if holds(middle) { &mut inside } else { &mut outside }) = middle;
    }
    inside
}
