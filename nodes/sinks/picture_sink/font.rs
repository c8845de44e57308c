//! A font of 3x5 pixels for the few signs that a label needs: digits, a colon, and the letters of `sph`, `cyl` and `con`.

/// Width of a sign.
pub(super) const WIDTH: u32 = 3;
/// Height of a sign.
pub(super) const HEIGHT: u32 = 5;

/// The signs, row by row from the top left, the first pixel in the highest of 15 bits.
const SIGNS: [(char, u16); 19] = [
    ('0', 0b111_101_101_101_111),
    ('1', 0b010_110_010_010_111),
    ('2', 0b111_001_111_100_111),
    ('3', 0b111_001_111_001_111),
    ('4', 0b101_101_111_001_001),
    ('5', 0b111_100_111_001_111),
    ('6', 0b111_100_111_101_111),
    ('7', 0b111_001_010_010_010),
    ('8', 0b111_101_111_101_111),
    ('9', 0b111_101_111_001_111),
    (':', 0b000_010_000_010_000),
    ('c', 0b000_000_011_100_011),
    ('h', 0b100_100_110_101_101),
    ('l', 0b010_010_010_010_011),
    ('n', 0b000_000_110_101_101),
    ('o', 0b000_000_010_101_010),
    ('p', 0b000_110_101_110_100),
    ('s', 0b000_011_010_001_110),
    ('y', 0b000_101_101_010_100),
];

/// The pixels `(x, y)` of a sign, from its top left; of one that the font does not have, none.
pub(super) fn pixels(sign: char) -> impl Iterator<Item = (u32, u32)> {
    let bits = SIGNS.iter().find(|(known, _)| *known == sign).map_or(0, |(_, bits)| *bits);
    (0..WIDTH * HEIGHT).filter(move |index| bits >> (14 - index) & 1 == 1).map(|index| (index % WIDTH, index / WIDTH))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sign_of_a_label_is_there_and_its_own() {
        let mut shapes: Vec<Vec<_>> = "0123456789:sphcylon".chars().map(|sign| pixels(sign).collect()).collect();
        assert!(shapes.iter().all(|shape| shape.len() >= 2));
        let count = shapes.len();
        shapes.sort();
        shapes.dedup();
        assert_eq!(shapes.len(), count);
        assert_eq!(pixels(' ').count(), 0);
    }

    #[test]
    fn a_sign_stands_upright() {
        let seven: Vec<_> = pixels('7').collect();
        assert_eq!(seven, [(0, 0), (1, 0), (2, 0), (2, 1), (1, 2), (1, 3), (1, 4)]);
    }
}
