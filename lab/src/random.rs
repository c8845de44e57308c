//! Random numbers that depend only on seed, frame and pixel, so that any single frame can be made on any machine with the same
//! bits.
//!
//! Counter-based: the n-th number is the n-th of a SplitMix64 sequence (Steele, Lea, Flood, "Fast splittable pseudorandom number
//! generators", 2014), whose state after n steps is known without taking them. Gaussian numbers come from P. J. Acklam's rational
//! approximation of the inverse normal distribution (relative error below 1.2e-9). It only needs a logarithm in the tails: that
//! of `libm`, as the platform's may differ in the last bit.

const GOLDEN_RATIO: u64 = 0x9e37_79b9_7f4a_7c15;

/// The random numbers of one frame.
#[derive(Clone, Copy, Debug)]
pub struct CounterRng {
    key: u64,
}

impl CounterRng {
    /// The numbers of frame `frame` under a seed.
    pub fn new(seed: u64, frame: u64) -> Self {
        Self { key: mix(mix(seed.wrapping_add(GOLDEN_RATIO)).wrapping_add(frame.wrapping_mul(GOLDEN_RATIO))) }
    }

    /// Uniform in (0, 1): the number `counter` of this frame.
    #[inline]
    pub fn uniform(&self, counter: u64) -> f64 {
        let bits = mix(self.key.wrapping_add(counter.wrapping_add(1).wrapping_mul(GOLDEN_RATIO)));
        ((bits >> 11) as f64 + 0.5) * (1.0 / (1_u64 << 53) as f64)
    }

    /// Normal with mean 0 and variance 1: the number `counter` of this frame.
    #[inline]
    pub fn gaussian(&self, counter: u64) -> f64 {
        normal_quantile(self.uniform(counter))
    }
}

/// The output function of SplitMix64.
#[inline]
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Returns the quantile of the standard normal distribution for the probability `p`, 0 < p < 1.
#[inline]
fn normal_quantile(p: f64) -> f64 {
    const TAIL: f64 = 0.02425;
    if p < TAIL {
        lower_tail(p)
    } else if p > 1.0 - TAIL {
        -lower_tail(1.0 - p)
    } else {
        let q = p - 0.5;
        let r = q * q;
        let above = polynomial(
            r,
            [
                -3.969_683_028_665_376e1,
                2.209_460_984_245_205e2,
                -2.759_285_104_469_687e2,
                1.383_577_518_672_69e2,
                -3.066_479_806_614_716e1,
                2.506_628_277_459_239,
            ],
        );
        let below = polynomial(
            r,
            [
                -5.447_609_879_822_406e1,
                1.615_858_368_580_409e2,
                -1.556_989_798_598_866e2,
                6.680_131_188_771_972e1,
                -1.328_068_155_288_572e1,
                1.0,
            ],
        );
        q * above / below
    }
}

#[cold]
fn lower_tail(p: f64) -> f64 {
    let q = (-2.0 * libm::log(p)).sqrt();
    let above = polynomial(
        q,
        [
            -7.784_894_002_430_293e-3,
            -3.223_964_580_411_365e-1,
            -2.400_758_277_161_838,
            -2.549_732_539_343_734,
            4.374_664_141_464_968,
            2.938_163_982_698_783,
        ],
    );
    let below = polynomial(
        q,
        [7.784_695_709_041_462e-3, 3.224_671_290_700_398e-1, 2.445_134_137_142_996, 3.754_408_661_907_416, 1.0],
    );
    above / below
}

/// Horner's rule, highest power first.
#[inline]
fn polynomial<const N: usize>(x: f64, coefficients: [f64; N]) -> f64 {
    coefficients.iter().fold(0.0, |sum, coefficient| sum * x + coefficient)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_tables() {
        for (p, quantile) in [
            (0.5, 0.0),
            (0.75, 0.674_489_750_196_081_7),
            (0.975, 1.959_963_984_540_054),
            (0.001, -3.090_232_306_167_813_5),
            (1e-6, -4.753_424_308_822_899),
        ] {
            assert!((normal_quantile(p) - quantile).abs() <= 2e-9 * quantile.abs(), "{p}");
            assert!((normal_quantile(1.0 - p) + quantile).abs() <= 2e-9 * quantile.abs(), "{p}");
        }
    }

    #[test]
    fn moments_are_those_of_a_normal_distribution() {
        let count = 200_000;
        let dice = CounterRng::new(7, 3);
        let moment = |n: i32| (0..count).map(|i| dice.gaussian(i).powi(n)).sum::<f64>() / count as f64;
        assert!(moment(1).abs() < 0.01);
        assert!((moment(2) - 1.0).abs() < 0.02);
        assert!(moment(3).abs() < 0.05);
        assert!((moment(4) - 3.0).abs() < 0.12);
    }

    #[test]
    fn neighbouring_pixels_frames_and_seeds_are_independent() {
        let count = 50_000;
        let correlation = |a: &dyn Fn(u64) -> f64, b: &dyn Fn(u64) -> f64| {
            (0..count).map(|i| a(i) * b(i)).sum::<f64>() / count as f64
        };
        let first = |i| CounterRng::new(0, 0).gaussian(i);
        assert!(correlation(&first, &|i| first(i + 1)).abs() < 0.02);
        assert!(correlation(&first, &|i| CounterRng::new(0, 1).gaussian(i)).abs() < 0.02);
        assert!(correlation(&first, &|i| CounterRng::new(1, 0).gaussian(i)).abs() < 0.02);
    }

    #[test]
    fn bits_are_those_of_the_published_generator() {
        let mut state = 1_234_567_u64;
        let mut next = || {
            state = state.wrapping_add(GOLDEN_RATIO);
            mix(state)
        };
        assert_eq!([next(), next()], [6_457_827_717_110_365_317, 3_203_168_211_198_807_973]);
    }
}
