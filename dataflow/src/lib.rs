//! Stages as separate processes, connected by shared memory and described by a pipeline file.
//!
//! In the order of their use: a stage implements [`Stage`] or [`Source`]; the pipeline file names it by the row that [`Node`]
//! makes of it ([`pipeline`]); the [`Plan`] resolves all that each process has to know; [`run`] starts the processes; each runs
//! its loop over [`ports`], which use shared memory; and [`Status`] records show its progress. Transport between machines is not
//! part of this package: a program provides it as a [`Network`], beside its nodes, in its [`Registry`].

mod clock;
mod doctor;
mod file_lock;
mod file_use;
mod first_frame;
mod hangup;
mod heartbeat;
mod item_type;
mod launcher;
mod log;
mod mutex;
mod network;
mod node;
mod observe;
mod pause;
pub mod pipeline;
mod plan;
pub mod ports;
mod preflight;
mod registry;
mod runner;
mod side_inputs;
mod stage;
mod standstill;
mod status;
mod stop;
mod table;

/// Runs a single stage or source as in a pipeline, but alone.
pub mod testing {
    pub use crate::runner::alone::{Owned, collect, pass, step};
}

/// Building blocks of a program's network part: the ports of topics as a stage has them, and its report.
pub mod relay {
    pub use crate::log::ThrottledWarning;
    pub use crate::network::link_report::{read_links, write_links};
    pub use crate::ports::shared_memory::{SharedMemory, SharedReader, SharedWriter};
    pub use crate::runner::input_port::InputPort;
    pub use crate::runner::output_port::{OutputPort, end_of_stream};
    pub use crate::runner::peers::Peers;
    pub use crate::runner::{MemoryTrim, StageRuntime};
    pub use crate::status::StatusFile;
}

pub use clock::{monotonic_ns, unix_ns};
pub use conicflow_messages::{ConfigFault, Hinted};
pub use doctor::{Finding, clean, examine};
pub use file_use::FileUse;
pub use first_frame::{EmptyFrames, TOO_FAR, report_frame, report_median};
pub use item_type::{AnyMessage, BUILT_IN, ItemType};
pub use launcher::{
    FolderError, LaunchError, PIPELINE, ProcessError, RUNTIME_DIR, RunFolder, RunLock, RunOptions, StageSummary,
    Summary, SwapError, become_stage, join_as_source, join_as_stage, link_table, run, run_in_run, run_source,
    run_stage, user_folder,
};
pub use log::{CLEAR_LINE, DEFAULT_LOG, LOG, error_text, log_beside, log_filter, log_to_standard_error};
pub use mutex::lock;
pub use network::link_key::LinkKey;
pub use network::link_report::{EdgeReport, LinkReport, LinkState};
pub use network::{BridgePlan, BridgeRun, Carrier, Edge, Network, NetworkError, Receiver};
pub use node::{Host, Node, Variables, Variant};
pub use observe::watch::{RunningPipeline, WatchError, Watcher, Watching, termination_flag};
pub use observe::{
    InputActivity, Observation, PipelineActivity, RunRecord, StageActivity, StageRecord, TopicActivity, Usage, observe,
    records,
};
pub use pause::{PauseRequest, Sources};
pub use plan::{Origin, Plan, PlannedStage, Runs};
pub use preflight::{InsufficientResource, Requirements, TopicRequirements};
pub use registry::Registry;
pub use runner::RunError;
pub use runner::pulled_source::PulledSource;
pub use runner::pulled_stage::PulledStage;
pub use runner::side_ports::RetainedMessage;
pub use side_inputs::{Pairing, SideInput, SideInputs};
pub use stage::{Config, Context, Next, NoConfig, Output, Source, Stage, StageError};
pub use status::{Counter, Durations, InputCounts, Intervals, Life, NO_RUN, Status, used};
pub use stop::Stop;
pub use table::Table;
