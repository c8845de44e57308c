//! Bisection: finds where a condition ends that holds on one side.

/// Halvings, which reduce the interval to a millionth of a millionth.
const HALVINGS: u32 = 40; // [algorithmic]

/// Returns where `holds` ends, between a point `inside` where it holds and one `outside` where it does not.
pub(crate) fn end_of(holds: impl Fn(f64) -> bool, [mut inside, mut outside]: [f64; 2]) -> f64 {
    for _ in 0..HALVINGS {
        let middle = 0.5 * (inside + outside);
        *(if holds(middle) { &mut inside } else { &mut outside }) = middle;
    }
    inside
}
