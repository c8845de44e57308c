//! Why candidates are turned down, and how often.

/// Declares the reasons with the words that the summary has for them.
macro_rules! rejections {
    ($($reason:ident => $words:literal,)+) => {
        /// Why a candidate is turned down.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Rejection {
            $(#[doc = $words] $reason,)+
        }

        impl Rejection {
            const WORDS: &'static [&'static str] = &[$($words,)+];
        }
    };
}

rejections! {
    FewRows => "candidates of too few rows",
    Gaps => "candidates with too many gaps",
    ShortArc => "candidates of short arcs",
    Flat => "candidates as flat as a plane",
    Degenerate => "candidates without extent",
    NotCollinear => "candidates with scattered centers (line)",
    NotConcyclic => "candidates with scattered centers (circle)",
    Profile => "candidates with scattered radii",
    Tilted => "candidates too tilted",
    HalfAngle => "cones too blunt",
    Constant => "cones too sharp",
    BeyondApex => "cones seen beyond their apex",
    Cap => "caps of spheres",
    Radius => "candidates beyond the radius limits",
    Short => "candidates too short",
    Rms => "candidates that miss their points",
    Double => "objects seen twice",
    Taper => "candidates that may taper or not",
    Odds => "candidates that are more probably something else",
    Length => "candidates beyond the length limits",
    Small => "candidates that look too small",
    NotGrown => "candidates that no shape explains",
    Untried => "arcs left untried",
    Late => "images cut short by budget_ms",
}

/// How often each reason occurred.
#[derive(Clone, Copy, Debug, Default)]
pub struct Rejections([u64; Rejection::WORDS.len()]);

impl Rejections {
    /// Counts one more.
    pub fn count(&mut self, reason: Rejection) {
        self.0[reason as usize] += 1;
    }

    /// The reasons that occurred, in words, and how often.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> {
        Rejection::WORDS.iter().copied().zip(self.0).filter(|(_, times)| *times > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_occurred_is_listed() {
        let mut rejections = Rejections::default();
        assert_eq!(rejections.iter().count(), 0);
        rejections.count(Rejection::Flat);
        rejections.count(Rejection::Flat);
        assert!(rejections.iter().eq([("candidates as flat as a plane", 2)]));
    }
}
