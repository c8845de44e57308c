//! The place where the parameters of a source are written, so that hints name the right syntax.

/// The place of a source's parameters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WrittenIn {
    /// A stage of a pipeline file.
    #[default]
    PipelineFile,
    /// The command line of `conicflow detect`, or of `conicflow view`.
    CommandLine,
}

impl WrittenIn {
    /// Returns the syntax that chooses this topic.
    pub(super) fn topic(self, topic: &str) -> String {
        match self {
            Self::PipelineFile => format!("topic = \"{topic}\""),
            Self::CommandLine => format!("--topic {topic}"),
        }
    }

    /// Returns the syntax for intrinsics; each argument is a number or dots.
    pub(super) fn intrinsics(self, [fx, fy, cx, cy]: [&str; 4]) -> String {
        match self {
            Self::PipelineFile => format!("intrinsics = {{ fx = {fx}, fy = {fy}, cx = {cx}, cy = {cy} }}"),
            Self::CommandLine => format!("--camera {fx},{fy},{cx},{cy}"),
        }
    }
}
