//! Enumerations in messages: each value has a number there, and a word in JSON and in texts.

/// Defines the numbers and words of an enumeration, one row per value.
macro_rules! coded {
    ($type:ident: $($value:ident = $code:literal $word:literal),+ $(,)?) => {
        impl $type {
            /// All values, in the order of their numbers.
            pub const ALL: [Self; [$($code),+].len()] = [$(Self::$value),+];

            /// The number of the value in a message.
            pub const fn code(self) -> u32 {
                match self {
                    $(Self::$value => $code,)+
                }
            }

            /// The value of a number, if there is one.
            pub const fn from_code(code: u32) -> Option<Self> {
                match code {
                    $($code => Some(Self::$value),)+
                    _ => None,
                }
            }

            /// The word for the value.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$value => $word,)+
                }
            }
        }
    };
}

pub(crate) use coded;
