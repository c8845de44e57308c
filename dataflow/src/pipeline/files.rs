//! Compares the files of all stages with each other and with the pipeline file: no file that a run reads is written, and none is
//! written twice.

use super::diagnostic::Diagnostic;
use super::{Pipeline, Program, StageSpec};
use crate::file_use::FileUse;
use crate::node::Node;
use conicflow_messages::Hinted;
use serde_json::Value as Json;
use std::path::Path;

/// Files, and the stage whose parameter names them; `None`: the pipeline file itself.
struct Named<'a> {
    stage: Option<&'a StageSpec>,
    files: FileUse,
}

impl Named<'_> {
    fn in_words(&self) -> String {
        match self.stage {
            Some(stage) => format!("`{}` of stage `{}`", self.files.key, stage.name),
            None => "this pipeline".to_owned(),
        }
    }

    /// Whether both are on one machine, as far as the file says.
    fn is_beside(&self, other: &Self) -> bool {
        self.stage.zip(other.stage).is_none_or(|(stage, other)| stage.machine == other.machine)
    }
}

/// Reports stages that write a file that the run reads, or that another stage writes: on `machine`, or without one on each
/// machine.
pub(super) fn overwritten(pipeline: &Pipeline, machine: Option<&str>, faults: &mut Vec<Diagnostic>) {
    let written = named(pipeline, machine, |node| node.writes);
    if written.is_empty() {
        return;
    }
    let read = read(pipeline, machine);
    for (index, own) in written.iter().enumerate() {
        let Some(stage) = own.stage else { continue };
        let writer = own.in_words();
        let mut others = read.iter().filter(|other| own.is_beside(other));
        let over_read = others.find_map(|other| own.files.conflict_with_read(&writer, &other.files, &other.in_words()));
        let mut earlier = written[..index].iter().filter(|other| own.is_beside(other));
        let over_written =
            || earlier.find_map(|other| own.files.conflict_with_written(&writer, &other.files, &other.in_words()));
        if let Some(Hinted { what, hint, .. }) = over_read.or_else(over_written) {
            let place = stage.parameter_places.get(own.files.key).unwrap_or(&stage.place);
            faults.push(Diagnostic::error(place, what, hint));
        }
    }
}

impl Pipeline {
    /// Error if `files`, which `writer` names, may overwrite files that a run of this pipeline reads.
    pub fn over_what_it_reads(&self, files: &FileUse, writer: &str) -> Option<Hinted> {
        let over = |other: &Named<'_>| files.conflict_with_read(writer, &other.files, &other.in_words());
        read(self, None).iter().find_map(over)
    }
}

/// Files that the run reads: those of its stages, and the pipeline file.
fn read<'a>(pipeline: &'a Pipeline, machine: Option<&str>) -> Vec<Named<'a>> {
    let mut read = named(pipeline, machine, |node| node.reads);
    let file = Path::new(&pipeline.source.0.name);
    if file.is_file() {
        read.push(Named { stage: None, files: FileUse::one("", file.to_owned()) });
    }
    read
}

type FilesOf = fn(Json, &Path) -> Vec<FileUse>;

fn named<'a>(pipeline: &'a Pipeline, machine: Option<&str>, of: fn(&Node) -> FilesOf) -> Vec<Named<'a>> {
    let here = |stage: &&StageSpec| machine.is_none_or(|machine| stage.machine.as_deref() == Some(machine));
    let mut named = Vec::new();
    for stage in pipeline.stages.iter().filter(here) {
        let Program::Node(node) = &stage.program else { continue };
        let files = of(node)(stage.parameters.clone(), &pipeline.base);
        named.extend(files.into_iter().map(|files| Named { stage: Some(stage), files }));
    }
    named
}
