//! What is wrong with a parameter: the one kind of error that every package below the pipeline file has to tell.

/// A parameter whose value cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFault {
    /// Name of the parameter.
    pub key: &'static str,
    /// What is wrong with its value.
    pub what: String,
    /// What to do about it.
    pub hint: String,
}
