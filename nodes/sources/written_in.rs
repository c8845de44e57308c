//! Where the parameters of a source are written, so that hints say what to write there.

/// What has the parameters of a source.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WrittenIn {
    /// A stage of a pipeline file.
    #[default]
    PipelineFile,
    /// The command line of `conicflow detect`, or of `conicflow view`.
    CommandLine,
}

impl WrittenIn {
    /// How this topic is chosen.
    pub(super) fn topic(self, topic: &str) -> String {
        match self {
            Self::PipelineFile => format!("topic = \"{topic}\""),
            Self::CommandLine => format!("--topic {topic}"),
        }
    }

    /// How intrinsics are given: each is a number or dots.
    pub(super) fn intrinsics(self, [fx, fy, cx, cy]: [&str; 4]) -> String {
        match self {
            Self::PipelineFile => format!("intrinsics = {{ fx = {fx}, fy = {fy}, cx = {cx}, cy = {cy} }}"),
            Self::CommandLine => format!("--camera {fx},{fy},{cx},{cy}"),
        }
    }
}
