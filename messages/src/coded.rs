//! Enumerations of messages: each value is a number there, and a word in JSON and in texts.

/// Gives an enumeration its numbers and words, one row for each value.
macro_rules! coded {
    ($type:ident: $($value:ident = $code:literal $word:literal),+ $(,)?) => {
        impl $type {
            /// All of them, in the order of their numbers.
            pub const ALL: [Self; [$($code),+].len()] = [$(Self::$value),+];

            /// The number that stands for it in a message.
            pub const fn code(self) -> u32 {
                match self {
                    $(Self::$value => $code,)+
                }
            }

            /// The value that a number stands for.
            pub const fn from_code(code: u32) -> Option<Self> {
                match code {
                    $($code => Some(Self::$value),)+
                    _ => None,
                }
            }

            /// The word for it.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$value => $word,)+
                }
            }
        }
    };
}

pub(crate) use coded;
