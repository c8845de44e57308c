//! Counts the reasons for which candidates are rejected.

/// Declares the reasons of one method with the words that the summary prints for them, and their counters.
#[macro_export]
macro_rules! rejections {
    ($(#[$about:meta])* $Reason:ident, $Counts:ident: $($reason:ident => $words:literal,)+) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $Reason {
            $(#[doc = $words] $reason,)+
        }

        /// The number of times each reason occurred.
        #[derive(Clone, Copy, Debug, Default)]
        pub struct $Counts([u64; [$($words),+].len()]);

        impl $Counts {
            /// Counts a reason.
            pub fn count(&mut self, reason: $Reason) {
                self.0[reason as usize] += 1;
            }

            /// Returns the reasons that occurred, in words, with their numbers.
            pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
                [$($words),+].into_iter().zip(self.0).filter(|(_, times)| *times > 0)
            }
        }
    };
}

#[cfg(test)]
mod tests {
    rejections! {
        /// The reason for which something is rejected.
        Rejection, Rejections:
        Short => "short ones",
        Long => "long ones",
    }

    #[test]
    fn only_what_occurred_is_listed() {
        let mut rejections = Rejections::default();
        assert_eq!(rejections.iter().count(), 0);
        rejections.count(Rejection::Long);
        rejections.count(Rejection::Long);
        assert!(rejections.iter().eq([("long ones", 2)]));
        rejections.count(Rejection::Short);
        assert!(rejections.iter().eq([("short ones", 1), ("long ones", 2)]), "in their order");
    }
}
