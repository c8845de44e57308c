//! The graph of a pipeline as Mermaid text, which many tools draw.

use super::{Pipeline, StageSpec};
use crate::ports::Delivery;
use std::fmt::Write;

impl Pipeline {
    /// The stages and the topics between them as a Mermaid flow chart, grouped by machine where there are several.
    pub fn mermaid(&self) -> String {
        let mut text = String::from("flowchart LR\n");
        for machine in self.machines.keys() {
            let _ = writeln!(text, "  subgraph {machine}");
            let here = self.stages.iter().filter(|stage| stage.machine.as_ref() == Some(machine));
            here.for_each(|stage| text.push_str(&format!("    {}\n", box_of(stage))));
            text.push_str("  end\n");
        }
        let anywhere = self.stages.iter().filter(|stage| stage.machine.is_none());
        anywhere.for_each(|stage| text.push_str(&format!("  {}\n", box_of(stage))));
        for reader in &self.stages {
            let driving = reader.input.iter().map(|input| (input, true));
            for (input, drives) in driving.chain(reader.inputs.iter().map(|(_, input)| (input, false))) {
                let writers = self.stages.iter().filter(|stage| stage.output.as_ref() == Some(&input.topic));
                for writer in writers {
                    let arrow = if drives { "-->" } else { "-.->" };
                    let lossless = if input.delivery == Delivery::Lossless { ", lossless" } else { "" };
                    let label = format!("{}{lossless}", input.topic);
                    let _ = writeln!(text, "  {} {arrow}|\"{label}\"| {}", writer.name, reader.name);
                }
            }
        }
        text
    }
}

fn box_of(stage: &StageSpec) -> String {
    let runs = match &stage.program {
        super::Program::Node(node) => node.name,
        super::Program::Command(command) => command.first().map_or("?", String::as_str),
        super::Program::Unknown => "?",
    };
    format!("{}[\"{}<br/>{runs}\"]", stage.name, stage.name)
}
