//! Bisection: where something ends that holds on one side.

/// Leaves a millionth of a millionth of the stretch.
const HALVINGS: u32 = 40; // [algorithmic]

/// Where `holds` ends between a place where it does and one where it does not.
pub(crate) fn end_of(holds: impl Fn(f64) -> bool, [mut inside, mut outside]: [f64; 2]) -> f64 {
    for _ in 0..HALVINGS {
        let middle = 0.5 * (inside + outside);
        *(if holds(middle) { &mut inside } else { &mut outside }) = middle;
    }
    inside
}
